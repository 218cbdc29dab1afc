"""Learn from some transitions of a machine; compare free runs with what was measured."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes

from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, FreeRun, Windows
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.tables import Cell, across, groups, number, table
from paper.common.verdicts import Difference, paired
from paper.machines import HORIZONS, REAL_LEARNERS, UNTRAINED, Real, RealSettings
from paper.machines.learners import Trained, train
from paper.machines.pendulums import STEP
from paper.machines.records import REAL, System

SCORES = {"rmse": ".3g", "coverage": ".2f", "nlpd": ".3g"}
_TITLES = {"rmse": "RMSE of {angle} in rad", "coverage": "Coverage of 95 %", "nlpd": "NLPD in nats"}
_SECONDS = {"fit_seconds": "a fit", "score_seconds": "the scores"}
_KEPT = 2  # free runs that are kept for a figure
_FEWEST = 3  # draws that a spread is given of
_LABELS = Real.axes["learner"]
_SYSTEMS = Real.axes["system"]


def run(experiment: Real, name: str, n: int, learner: str, seed: int) -> Run:
    """Learn, and return the scores of each test: by steps ahead, of each state."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings, known = experiment.settings, REAL[name]
    alone = REAL_LEARNERS[learner].states == "transitions"
    data = known.drawn(n, seed) if alone else known.stretches(n, seed)
    begin = time.perf_counter()
    made = train(learner, known.machine, data, seed)
    fitted = time.perf_counter()
    tests = {test: _scores(made, known, test, settings) for test in known.tests}
    found: Run = {
        "fit_seconds": fitted - begin,
        "score_seconds": time.perf_counter() - fitted,
        "tests": {test: scores for test, (scores, _) in tests.items()},
    }
    if made.parameters is not None:
        ends = torch.stack(made.parameters.interval(), -1).tolist()
        found["parameters"] = dict(zip(made.parameters, ends, strict=True))
    if learner in UNTRAINED or (n == settings.drawn and seed == 0):
        found["paths"] = {test: _paths(known, free) for test, (_, free) in tests.items()}
    return found


def _scores(
    made: Trained, known: System, test: str, settings: RealSettings
) -> tuple[dict[str, Any], FreeRun]:
    """Scores by name and steps ahead, and the free runs of which they are.

    Those of one step are of all steps of the test. If the noise of what is measured is known, the
    dynamics learnt process noise; else half of what they learnt is that of a state (the windows
    start at measured ones), and there is no process noise.
    """
    dynamics, noise, windows = made.dynamics, made.noise, windows_of(known, test, settings)
    if noise is None:
        single: Any = dynamics.score(*known.steps(test))
        free = follow(dynamics, windows, settings, start_noise="learnt")
    else:
        given = {"start_noise": noise, "noise": noise, "process_noise": "learnt"}
        states, actions, following = known.steps(test)
        steps = Windows(states, actions.unsqueeze(1), following.unsqueeze(1))
        score = follow(dynamics, steps, settings, **given).score(steps.measured)
        single = score[0]
        free = follow(dynamics, windows, settings, **given)
    after = free.score(windows.measured)
    scores: dict[str, Any] = {}
    for name in SCORES:
        found, ahead = getattr(single, name).tolist(), getattr(after, name).tolist()
        scores[name] = {"1": found, **{str(steps): ahead[steps - 1] for steps in HORIZONS}}
    return {**scores, "lost": free.lost[:, -1].mean().item()}, free


def follow(dynamics: Dynamics, windows: Windows, settings: Any, **given: Any) -> FreeRun:
    """Free runs of windows."""
    states, actions, _ = windows
    return dynamics.free_run(states, actions, num_functions=settings.num_functions, **given)


def windows_of(known: System, test: str, settings: RealSettings) -> Windows:
    """The windows of a test, the same for all learners."""
    return known.windows(test, HORIZONS[-1], settings.windows)


def _paths(known: System, free: FreeRun) -> dict[str, Any]:
    """A few free runs of the last angle: which windows they are, means and ends of intervals."""
    rows = torch.linspace(0, len(free.mean) - 1, _KEPT + 2).round().long()[1:-1].unique()
    angle = known.machine.spec.angle_columns[-1]
    parts = {"mean": free.mean, "lower": free.lower, "upper": free.upper}
    paths = {name: part[rows, :, angle].tolist() for name, part in parts.items()}
    return {"windows": rows.tolist(), **paths}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each test of each run.

    Columns beside those of the run are ``rmse-<steps>`` of the last angle, ``coverage-<steps>`` and
    ``nlpd-<steps>``, means over the states, and seconds. A learner that learns nothing has a row
    for each number of transitions that others have.
    """
    rows = []
    for each in runs:
        angle = REAL[each["system"]].machine.spec.angle_columns[-1]
        own = {name: each[name] for name in ("system", "learner", "n", "seed", *_SECONDS)}
        for test, scores in each["tests"].items():
            values = {
                f"{name}-{steps}": np.array(of_states, dtype=float)  # None is NaN
                for name in SCORES
                for steps, of_states in scores[name].items()
            }
            shown = {k: v[angle] if k.startswith("rmse") else v.mean() for k, v in values.items()}
            rows.append({**own, "test": test, **shown})
    found = pd.DataFrame(rows)
    untaught = found["learner"].isin(UNTRAINED)
    sizes = found.loc[~untaught, ["system", "n"]].drop_duplicates()
    everywhere = found[untaught].drop(columns="n").merge(sizes, on="system", how="left")
    everywhere = everywhere.fillna({"n": 0}).astype({"n": int})  # where no other was run
    return pd.concat([found[~untaught], everywhere], ignore_index=True)


def tables(runs: Sequence[Run], experiment: Real) -> dict[str, Table]:
    """All tables, by name."""
    scored = load(runs)
    title = "n = 100, beside least squares by the same draws"
    found = {"paired": Table(title, _paired(scored))}
    sizes = {n: f"n = {n}" for n in sorted({*scored["n"]})}

    def by_size(own: pd.DataFrame, column: str, form: str) -> str:
        rows = groups(own[own[column].notna()], "learner", _LABELS)
        return table(rows, across(own, "n", sizes, _drawn(column, form)))

    for (name, test), own in scored.groupby(["system", "test"], sort=False):
        angle = "the second angle" if name.startswith("double") else "the angle"
        for column in own.columns:
            score, _, steps = column.partition("-")
            if score in SCORES:
                title = f"{_TITLES[score].format(angle=angle)} after {_ahead(steps)}"
                found[f"{name}-{test}-{column}"] = Table(
                    f"{title}, {_SYSTEMS[name]}, test {test}", by_size(own, column, SCORES[score])
                )
    return found


def _drawn(column: str, form: str) -> Cell:
    """The mean, its standard error of three draws and more, and of how many it is."""

    def cell(part: pd.DataFrame) -> str:
        found = Difference.of(part[column])
        if found.n < 2:
            return number(found.mean, form)
        error = f" ± {found.error:{'.1g' if form.endswith('g') else form}}" * (found.n >= _FEWEST)
        return f"{found.mean:{form}}{error} ({found.n})"

    return cell


def _ahead(steps: str) -> str:
    return "a step" if steps == "1" else f"{int(steps) * STEP:g} s"


def _paired(scored: pd.DataFrame) -> str:
    """Errors of n = 100 beside those of least squares, by the same draws."""
    columns: dict[str, Cell] = {}
    for name, test, steps in (
        ("double-pendulum", "near", "20"),
        ("double-pendulum", "far", "20"),
        ("pendulum", "sac", "10"),
    ):
        own = scored[(scored["system"] == name) & (scored["test"] == test) & (scored["n"] == 100)]
        columns |= {
            f"{test}, rad after {_ahead(steps)}": _restricted(own, _with_draws, f"rmse-{steps}"),
            f"{test}: ratio to least squares, 95 %": _restricted(own, _ratio, f"rmse-{steps}"),
            f"{test}: 95 % hold": _restricted(own, _held, f"coverage-{steps}"),
        }
    rows = groups(scored[scored["n"] == 100], "learner", _LABELS)
    return table(rows, columns)


def _restricted(own: pd.DataFrame, show: Any, column: str) -> Cell:
    return lambda part: show(own, str(part["learner"].iloc[0]), column)


def _with_draws(own: pd.DataFrame, learner: str, column: str) -> str:
    values = own.loc[own["learner"] == learner, column]
    draws = "" if learner in UNTRAINED or values.empty else f" ({len(values)})"
    return number(values.mean(), ".3f") + draws


def _ratio(own: pd.DataFrame, learner: str, column: str) -> str:
    if learner in UNTRAINED:  # one run, beside all draws
        value = own.loc[own["learner"] == learner, column]
        draws = own[own["learner"] == "fitted"]
        rows = draws.assign(learner=learner, **{column: value.iloc[0] if len(value) else np.nan})
        own = pd.concat([draws, rows])
    found = paired(own, column, "learner", learner, "fitted", ratio=True)
    if learner == "fitted" or np.isnan(found.mean):
        return ""
    return found.ratio() if found.n >= _FEWEST else f"{np.exp(found.mean):.2f}"


def _held(own: pd.DataFrame, learner: str, column: str) -> str:
    return number(own.loc[own["learner"] == learner, column].mean(), ".2f")


_SHOWN = ("phy", "fitted", "gp", "calibrated-delta", "smoothed-cka")


def draw(runs: Sequence[Run], experiment: Real) -> list[Path]:
    """Draw free runs of the double pendulum."""
    name = "double-pendulum"
    kept = {r["learner"]: r["paths"] for r in runs if r["system"] == name and "paths" in r}
    return [_free_runs(name, kept, experiment)] if {*kept} & {*_SHOWN} else []


def _free_runs(name: str, kept: dict[str, Any], experiment: Real) -> Path:
    """The last angle, measured and in free runs: a row of panels for each learner."""
    known, columns = REAL[name], []
    learners = [learner for learner in _SHOWN if learner in kept]
    angle = known.machine.spec.angle_columns[-1]
    for test in known.tests:
        windows = windows_of(known, test, experiment.settings)
        for i, row in enumerate(kept[learners[0]][test]["windows"]):
            first = windows.initial_states[int(row), angle].view(1)
            measured = torch.cat([first, windows.measured[int(row), :, angle]])
            columns.append((test, i, measured.tolist()))
    titles = [f"{_LABELS[learner]}, {test}" for learner in learners for test, *_ in columns]
    figure, axes = panels(titles, len(columns), (2.9, 2.1), share=False, width=8.4)
    drawn = [(learner, *column) for learner in learners for column in columns]
    for ax, (learner, test, i, truth) in zip(axes, drawn, strict=True):
        path = kept[learner][test]
        _free_run(ax, truth, [path[part][i] for part in ("mean", "lower", "upper")])
    figure.supxlabel("s", fontsize="medium")
    figure.supylabel("last angle, rad", fontsize="medium")
    one_legend(figure, axes)
    return save(figure, experiment.out / f"{name}.png")


def _free_run(ax: Axes, measured: list[float], path: list[list[float]]) -> None:
    times = [STEP * k for k in range(len(measured))]
    mean, low, high = ([measured[0], *part] for part in path)
    ax.fill_between(times, low, high, color="tab:blue", alpha=0.25, lw=0, label="95 %")
    ax.plot(times, mean, color="tab:blue", lw=1.2, label="free run")
    ax.plot(times, measured, color="black", lw=1.2, ls="--", label="measured")
    room = 0.5 * (max(measured) - min(measured))
    ax.set_ylim(min(measured) - room, max(measured) + room)
