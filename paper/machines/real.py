"""Learn from some transitions of a machine; compare free runs with what was measured."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, Windows
from gpadjust.records import smooth
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, across, groups, number, table
from paper.common.verdicts import Difference, paired
from paper.machines import HORIZONS, Real
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import STEP, Machine
from paper.machines.records import REAL, System

SCORES = {"rmse": ".3g", "coverage": ".2f"}
_TITLES = {"rmse": "RMSE of the last angle in rad", "coverage": "Coverage of 95 %"}
_KEPT = 2  # free runs that are kept for a figure


class Trained(NamedTuple):
    """Dynamics, and standard deviations of what was measured if they learnt smoothed states."""

    dynamics: Dynamics
    noise: Tensor | None = None


def train(learner: str, machine: Machine, known: System, n: int, seed: int) -> Trained:
    """Learn from transitions of a machine, or from states that are smoothed along stretches."""
    noise = None
    if learner.startswith("smoothed"):
        smoothed = smooth(known.stretches(n, seed), machine.physics())
        noise, data = smoothed.noise, smoothed.draw(seed).trajectories()
    else:
        data = known.drawn(n, seed)
    dynamics = _dynamics(learner, machine, data, seed)
    if learner != "phy":
        dynamics.update(*data)
    return Trained(dynamics, noise)


def _dynamics(learner: str, machine: Machine, data: Any, seed: int) -> Dynamics:
    first, _, model = learner.partition("-")
    if learner in ("phy", "fitted"):
        return PhysicsDynamics(
            machine.spec, machine.physics("crude" if learner == "phy" else "unknown")
        )
    if learner == "residual":
        return NetworkDynamics(machine.spec, machine.physics("crude"), seed=seed)
    if learner == "phymean-fitted":
        fitted = PhysicsDynamics(machine.spec, machine.physics())
        fitted.update(*data)
        found = fitted.physics_parameters
        physics = machine.physics(dict(zip(found, found.mean.tolist(), strict=True)))
        return LearnedDynamics(machine.spec, physics, model=LEARNERS["phymean"].make)
    unknown = first in ("calibrated", "smoothed")
    names = {"": "calibrated", "delta": "phymean", "cka": "cka"}
    known = LEARNERS[names[model] if unknown else learner]
    physics = machine.physics("unknown" if unknown else "crude")
    return LearnedDynamics(machine.spec, physics if known.adjusts else None, model=known.make)


def run(experiment: Real, name: str, n: int, learner: str, seed: int) -> Run:
    """Learn, and return the scores of each test: by steps ahead, of each state."""
    warnings.simplefilter("ignore", SamplingWarning)
    known = REAL[name]
    begin = time.perf_counter()
    made = train(learner, known.machine, known, n, seed)
    found: Run = {"fit_seconds": time.perf_counter() - begin, "tests": {}}
    for test in known.tests:
        scores, free = _scores(made, known, test, experiment)
        found["tests"][test] = scores
        if n == 100 and seed == 0 and learner in _SHOWN:
            found.setdefault("paths", {})[test] = _paths(known, free)
    return found


def _scores(made: Trained, known: System, test: str, experiment: Real) -> tuple[Any, Any]:
    """Scores by name and steps ahead, and the free runs of which they are.

    Those of one step are of all steps of the test. If the noise of what is measured is known, the
    dynamics learnt process noise; else half of what they learnt is that of a state (the windows
    start at measured ones), and there is no process noise.
    """
    dynamics, noise = made.dynamics, made.noise
    windows = known.windows(test, HORIZONS[-1], experiment.windows)
    given: dict[str, Any] = {"num_functions": experiment.num_functions, "start_noise": "learnt"}
    if noise is None:
        single: Any = dynamics.score(*known.steps(test))
    else:
        given |= {"start_noise": noise, "noise": noise, "process_noise": "learnt"}
        states, actions, following = known.steps(test)
        steps = Windows(states, actions.unsqueeze(1), following.unsqueeze(1))
        single = dynamics.free_run(states, steps.actions, **given).score(steps.measured)[0]
    free = dynamics.free_run(windows.initial_states, windows.actions, **given)
    after = free.score(windows.measured)
    scores: dict[str, Any] = {}
    for name in SCORES:
        first, ahead = getattr(single, name).tolist(), getattr(after, name).tolist()
        scores[name] = {"1": first, **{str(steps): ahead[steps - 1] for steps in HORIZONS}}
    return scores, free


def _paths(known: System, free: Any) -> dict[str, Any]:
    """A few free runs of the last angle: which windows they are, means and ends of intervals."""
    rows = torch.linspace(0, len(free.mean) - 1, _KEPT + 2).round().long()[1:-1].unique()
    angle = known.machine.spec.angle_columns[-1]
    parts = {"mean": free.mean, "lower": free.lower, "upper": free.upper}
    return {"windows": rows.tolist(), **{k: p[rows, :, angle].tolist() for k, p in parts.items()}}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each test of each run: the last angle's error, mean coverage, by steps ahead."""
    rows = []
    for each in runs:
        angle = REAL[each["system"]].machine.spec.angle_columns[-1]
        shared = {name: each[name] for name in ("system", "learner", "n", "seed", "fit_seconds")}
        for test, scores in each["tests"].items():
            row = {**shared, "test": test}
            for steps, values in scores["rmse"].items():
                row[f"rmse-{steps}"] = values[angle]
                row[f"coverage-{steps}"] = float(
                    np.mean(np.array(scores["coverage"][steps], float))
                )
            rows.append(row)
    return pd.DataFrame(rows)


def tables(runs: Sequence[Run], experiment: Real) -> dict[str, Table]:
    """All tables, by name."""
    scored, axes = load(runs), experiment.axes
    found = {"paired": Table("n = 100, beside least squares by the same draws", _paired(scored))}
    for (name, test), own in scored.groupby(["system", "test"], sort=False):
        for score, form in SCORES.items():
            for steps in (1, *HORIZONS):
                cell = _drawn(f"{score}-{steps}", form)
                columns = across(own, "n", axes["n"], cell)
                text = table(groups(own, "learner", axes["learner"]), columns, "learner")
                title = f"{_TITLES[score]} after {_ahead(steps)}, {axes['system'][name]}, {test}"
                found[f"{name}-{test}-{score}-{steps}"] = Table(title, text)
    columns = {f"{label}, s": _seconds(name) for name, label in axes["system"].items()}
    text = table(groups(scored, "learner", axes["learner"]), columns, "learner")
    return found | {"seconds": Table("Median seconds of a fit, n = 100", text)}


def _seconds(system: str) -> Cell:
    def cell(part: pd.DataFrame) -> str:
        own = part[(part["system"] == system) & (part["n"] == 100)]
        return number(own["fit_seconds"].median(), ".1f")

    return cell


def _drawn(column: str, form: str) -> Cell:
    """The mean, its standard error, and of how many it is."""

    def cell(part: pd.DataFrame) -> str:
        found = Difference.of(part[column].astype(float))
        if found.n < 2:
            return number(found.mean, form)
        error = f"{found.error:{'.1g' if form.endswith('g') else form}}"
        return f"{found.mean:{form}} ± {error} ({found.n})"

    return cell


def _ahead(steps: int) -> str:
    return "a step" if steps == 1 else f"{steps * STEP:g} s"


def _paired(scored: pd.DataFrame) -> str:
    """Errors of n = 100 beside those of least squares, and of CKA beside its delta alone."""
    at = scored[scored["n"] == 100]
    columns: dict[str, Cell] = {}
    for name, test, steps in (
        ("double-pendulum", "near", 20),
        ("double-pendulum", "far", 20),
        ("pendulum", "sac", 10),
    ):
        own = at[(at["system"] == name) & (at["test"] == test)]

        def ratio(part: pd.DataFrame, own: pd.DataFrame = own, steps: int = steps) -> str:
            learner = part["learner"].iloc[0]
            if learner == "fitted":
                return ""
            given = (own, f"rmse-{steps}", "learner", learner, "fitted")
            return paired(*given, ratio=True).ratio()

        columns[f"{test}, {_ahead(steps)}: error / least squares"] = ratio
    return table(groups(at, "learner", Real.axes["learner"]), columns, "learner")


_SHOWN = ("fitted", "gp", "calibrated-delta", "smoothed-cka")


def draw(runs: Sequence[Run], experiment: Real) -> list[Path]:
    """Draw free runs of the double pendulum: a row of panels for each learner."""
    system = "double-pendulum"
    kept = {r["learner"]: r["paths"] for r in runs if r["system"] == system and "paths" in r}
    learners = [learner for learner in _SHOWN if learner in kept]
    if not learners:
        return []
    known, labels = REAL[system], experiment.axes["learner"]
    angle = known.machine.spec.angle_columns[-1]
    drawn = [(name, test, i) for name in learners for test in known.tests for i in range(_KEPT)]
    titles = [f"{labels[learner]}, {test}" for learner, test, _ in drawn]
    size = len(known.tests) * _KEPT
    figure, axes = panels(titles, size, (2.9, 2.1), share=False, width=8.4)
    for ax, (learner, test, i) in zip(axes, drawn, strict=True):
        windows, path = known.windows(test, HORIZONS[-1], experiment.windows), kept[learner][test]
        row = int(path["windows"][i])
        first = windows.initial_states[row, angle].view(1)
        measured = torch.cat([first, windows.measured[row, :, angle]]).tolist()
        times = [STEP * k for k in range(len(measured))]
        mean, low, high = ([measured[0], *path[part][i]] for part in ("mean", "lower", "upper"))
        ax.fill_between(times, low, high, color="tab:blue", alpha=0.25, lw=0, label="95 %")
        ax.plot(times, mean, color="tab:blue", lw=1.2, label="free run")
        ax.plot(times, measured, color="black", lw=1.2, ls="--", label="measured")
        room = 0.5 * (max(measured) - min(measured))
        ax.set_ylim(min(measured) - room, max(measured) + room)
    figure.supxlabel("s", fontsize="medium")
    figure.supylabel("last angle, rad", fontsize="medium")
    one_legend(figure, axes)
    return [save(figure, experiment.folder / f"{system}.png")]
