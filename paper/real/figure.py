"""Figures of the runs that there are: free runs beside what was measured, and errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.real import LEARNERS, SMOOTHED, SYSTEMS, Real
from paper.real.machines import STEP
from paper.real.run import windows_of
from paper.real.systems import system
from paper.real.tables import load

COLORS = {
    "phy": "tab:orange",
    "phy-identified": "gold",
    "fitted": "tab:brown",
    "gp": "tab:red",
    "phymean": "tab:purple",
    "phymean-identified": "plum",
    "phymean-fitted": "black",
    "cka": "navy",
    "cka-identified": "tab:cyan",
    "rra": "tab:green",
    "rra-identified": "yellowgreen",
    "calibrated": "tab:olive",
    "calibrated-delta": "deepskyblue",
    "calibrated-orthogonal": "teal",
    "calibrated-cka": "blue",
    "stretches-delta": "slategray",
    "smoothed": "darkkhaki",
    "smoothed-delta": "limegreen",
    "smoothed-cka": "darkviolet",
    "network": "0.55",
    "residual": "tab:pink",
}
_SHOWN = ("phy", "fitted", "gp", "calibrated-delta", "smoothed-cka")
_Paths = dict[str, list[Any]]


def draw(records: Sequence[Record], experiment: Real) -> list[Path]:
    """Draw free runs of each system, and the errors; return their files."""
    found = [_errors(records, experiment)]
    for name in SYSTEMS:
        kept = {r["learner"]: r["paths"] for r in records if r["system"] == name and "paths" in r}
        if {*kept} & {*_SHOWN}:
            found.append(_free_runs(name, kept, experiment))
    of_most = [r for r in records if "parameters" in r and r["n"] == experiment.settings.drawn]
    of_systems = {name: [r for r in of_most if r["system"] == name] for name in SYSTEMS}
    drawn = {name: own for name, own in of_systems.items() if own}
    return [*found, *(_parameters(name, own, experiment) for name, own in drawn.items())]


def _errors(records: Sequence[Record], experiment: Real) -> Path:
    """The error of the last angle over the number of transitions, a panel for each test."""
    runs = load(records)
    tests = [*runs[["system", "test"]].drop_duplicates().itertuples(index=False)]
    titles = [f"{SYSTEMS[name]}, {test}" for name, test in tests]
    figure, axes = panels(titles, 3, (4.2, 3.4), share=False, width=13)
    for ax, (name, test) in zip(axes, tests, strict=True):
        own = runs[(runs["system"] == name) & (runs["test"] == test)]
        for learner, label in LEARNERS.items():
            mine = own[own["learner"] == learner]
            if len(mine):
                color = COLORS[learner]
                draw_quartiles(ax, mine, "rmse-20", by="n", color=color, label=label, band=False)
                ax.lines[-1].set(marker="o", markersize=3)
        sizes = sorted(own["n"].unique())
        ax.set(xscale="log", yscale="log", xticks=sizes, xticklabels=sizes)
        ax.minorticks_off()
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
    figure.supxlabel("transitions", fontsize="medium")
    figure.supylabel("median RMSE of the last angle after 1 s, rad", fontsize="medium")
    one_legend(figure, axes, ncols=4)
    return save(figure, experiment.out / "errors.png")


def _free_runs(name: str, kept: dict[str, dict[str, _Paths]], experiment: Real) -> Path:
    """The last angle, measured and in free runs: a row of panels for each learner."""
    known, columns = system(name), []
    learners = [learner for learner in _SHOWN if learner in kept]
    angle = known.machine.spec.angle_columns[-1]
    for test in known.tests:
        windows = windows_of(known, test, experiment.settings)
        for i, row in enumerate(kept[learners[0]][test]["windows"]):
            first = windows.initial_states[int(row), angle].view(1)
            measured = torch.cat([first, windows.measured[int(row), :, angle]])
            columns.append((test, i, measured.tolist()))
    titles = [f"{LEARNERS[learner]}, {test}" for learner in learners for test, *_ in columns]
    figure, axes = panels(titles, len(columns), (2.9, 2.1), share=False, width=8.4)
    drawn = [(learner, *column) for learner in learners for column in columns]
    for ax, (learner, test, i, truth) in zip(axes, drawn, strict=True):
        path = kept[learner][test]
        _free_run(ax, truth, [path[part][i] for part in ("mean", "lower", "upper")])
    figure.supxlabel("s", fontsize="medium")
    figure.supylabel("last angle, rad", fontsize="medium")
    one_legend(figure, axes)
    return save(figure, experiment.out / f"{name}.png")


def _parameters(name: str, records: Sequence[Record], experiment: Real) -> Path:
    """Intervals of each parameter, of each learner by its first draw, and the prior's."""
    first: dict[str, Record] = {}
    for record in sorted(records, key=lambda r: int(r["seed"])):
        if record["learner"] not in SMOOTHED[1:]:  # which have the parameters of the first
            first.setdefault(record["learner"], record)
    machine = system(name).machine
    unknowns, identified = machine.unknowns, machine.known["identified"]
    figure, axes = panels([*unknowns], 3, (4.0, 2.0), share=False, width=11)
    for ax, (parameter, unknown) in zip(axes, unknowns.items(), strict=True):
        ends = [float(unknown.value(torch.tensor(z).double())) for z in (-1.96, 1.96)]
        bars = {"prior": (ends, "0.7")}
        for learner, record in first.items():
            bars[LEARNERS[learner]] = (record["parameters"][parameter], COLORS[learner])
        for place, (label, (bar, color)) in enumerate(bars.items()):
            ax.plot(bar, [-place, -place], color=color, lw=4, label=label, solid_capstyle="butt")
        ax.axvline(identified[parameter], color="black", lw=0.8, ls="--", label="identified")
        learnt = [end for label, (bar, _) in bars.items() if label != "prior" for end in bar]
        room = 0.4 * (max(learnt) - min(learnt))
        ax.locator_params(axis="x", nbins=5)
        ax.set(yticks=[], xlim=(min(learnt) - room, max(learnt) + room))
    one_legend(figure, axes, ncols=4)
    return save(figure, experiment.out / f"{name}-parameters.png")


def _free_run(ax: Axes, measured: list[float], path: list[list[float]]) -> None:
    times = [STEP * k for k in range(len(measured))]
    mean, low, high = ([measured[0], *part] for part in path)
    ax.fill_between(times, low, high, color="tab:blue", alpha=0.25, lw=0, label="95 %")
    ax.plot(times, mean, color="tab:blue", lw=1.2, label="free run")
    ax.plot(times, measured, color="black", lw=1.2, ls="--", label="measured")
    room = 0.5 * (max(measured) - min(measured))
    ax.set_ylim(min(measured) - room, max(measured) + room)
