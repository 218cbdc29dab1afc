"""The free run beside what was measured, and what cross-validation foresaw."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from paper.common.experiment import Record
from paper.common.figures import one_legend, panels, save
from paper.tanks import CANDIDATES, NARX, STRUCTURES, Tanks
from paper.tanks.run import KEPT
from paper.tanks.systems import STEP, measured
from paper.tanks.tables import chosen, label_of, load

COLORS = {"overflow": "tab:orange", "sensor": "tab:green", "kink": "tab:blue", "narx": "tab:red"}
_LABELS = {**STRUCTURES, "narx": "GP, no f_p"}


def draw(records: Sequence[Record], experiment: Tanks) -> list[Path]:
    """Draw the chosen f_p's free run, that without the sensor's bend, and all candidates."""
    runs = load(records)
    best = chosen(runs, CANDIDATES)
    bent = chosen(runs, [name for name in CANDIDATES if name.startswith("overflow")])
    first = {record["learner"]: record for record in records if record["seed"] == 0}
    shown = [name for name in dict.fromkeys((best, bent)) if name in first]
    titles = [label_of(name, best) for name in shown]
    figure, axes = panels([*titles, "Errors of all candidates"], 1, (8.4, 2.7), share=False)
    for ax, name in zip(axes, shown, strict=False):
        _free_run(ax, first[name], experiment)
    ax = axes[-1]
    for name in (*CANDIDATES, *NARX):
        record = first.get(name, {})
        if "cv" in record:
            kind = name.partition("-")[0]
            ax.plot(record["cv"], record["rmse"], "o", color=COLORS[kind], label=_LABELS[kind])
            place = (record["cv"], record["rmse"])
            ax.annotate(
                name.partition("-")[2], place, (4, 2), textcoords="offset points", fontsize=7
            )
    ax.set(xscale="log", yscale="log", ylabel="validation, V")
    ax.set_xlabel("cross-validated on the estimation record, V")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    one_legend(figure, axes, ncols=4)
    return [save(figure, experiment.out / "tanks.png")]


def _free_run(ax: Axes, record: Record, experiment: Tanks) -> None:
    _, lower = measured("Val", experiment.settings.samples)
    minutes = STEP / 60 * torch.arange(len(lower)).double()
    path = record["path"]
    rows = minutes[::KEPT].tolist()
    ax.fill_between(
        rows, path["lower"], path["upper"], color="tab:blue", alpha=0.25, lw=0, label="95 %"
    )
    ax.plot(rows, path["mean"], color="tab:blue", lw=1.2, label="free run")
    ax.plot(minutes, lower, color="black", lw=1.0, ls="--", label="measured")
    ax.set(xlabel="min", ylabel="lower level, V")
