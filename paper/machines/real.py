"""Learn from some transitions of a machine; compare free runs with what was measured."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, Windows
from gpadjust.physics import PhysicsError
from gpadjust.records import smooth
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, across, groups, mean_error, of, part_of, ratio_of, table
from paper.machines import HORIZONS, Real
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import STEP, Machine
from paper.machines.records import REAL, System

SCORES = {"rmse": (".3g", ".1g"), "coverage": (".2f", ".2f")}
"""With the forms of means and standard errors."""
DRAWN = "double-pendulum"
_TITLES = {"rmse": "RMSE of the last angle in rad", "coverage": "Coverage of 95 %"}
_KEPT = 2  # free runs that are kept for a figure


def train(learner: str, known: System, n: int, seed: int) -> tuple[Dynamics, Tensor | None]:
    """Learn from transitions of a machine, or from states that are smoothed along stretches.

    Returns:
        Dynamics, and standard deviations of what was measured if they learnt smoothed states.
    """
    noise = None
    if learner.startswith("smoothed"):
        smoothed = smooth(known.stretches(n, seed), known.machine.physics())
        noise, data = smoothed.noise, smoothed.draw(seed).trajectories()
    else:
        data = known.drawn(n, seed)
    dynamics = _dynamics(learner, known.machine, data, seed)
    if learner != "phy":
        dynamics.update(*data)
    return dynamics, noise


def _dynamics(learner: str, machine: Machine, data: Any, seed: int) -> Dynamics:
    first, _, model = learner.partition("-")
    spec, unknown = machine.spec, first in ("fitted", "calibrated", "smoothed")
    physics = machine.physics("unknown" if unknown else "crude")
    if learner in ("phy", "fitted"):
        return PhysicsDynamics(spec, physics)
    if learner == "residual":
        return NetworkDynamics(spec, physics, seed=seed)
    if learner == "phymean-fitted":
        fitted = PhysicsDynamics(spec, machine.physics())
        fitted.update(*data)
        found = fitted.physics_parameters
        physics = machine.physics(dict(zip(found, found.mean.tolist(), strict=True)))
    made = LEARNERS[(model or "calibrated") if unknown else first]
    return LearnedDynamics(spec, physics if made.adjusts else None, model=made.make)


def run(experiment: Real, name: str, n: int, learner: str, seed: int) -> Run:
    """Learn, and return the scores of each test: by steps ahead, of each state."""
    known = REAL[name]
    begin = time.perf_counter()
    dynamics, noise = train(learner, known, n, seed)
    found: Run = {"fit_seconds": time.perf_counter() - begin, "tests": {}}
    for test in known.tests:
        try:
            scores, free = _scores(dynamics, noise, known, test, experiment)
        except PhysicsError:  # a free run left the range in which f_p has values
            found["tests"][test] = _lost(known)
            continue
        found["tests"][test] = scores
        if name == DRAWN and n == 100 and seed == 0 and learner in _SHOWN:
            found.setdefault("paths", {})[test] = _paths(known, free)
    return found


def _scores(
    dynamics: Dynamics, noise: Tensor | None, known: System, test: str, experiment: Real
) -> tuple[Any, Any]:
    """Return scores by name and steps ahead, and their free runs.

    Those of one step are of all steps of the test. If the noise of what is measured is known, the
    dynamics learnt process noise; else half of what they learnt is that of a state (the windows
    start at measured ones), and there is no process noise.
    """
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


def _lost(known: System) -> dict[str, Any]:
    """Return scores of free runs without an end: infinite errors, and a coverage of zero."""
    d = len(known.machine.spec.states)
    steps = [str(ahead) for ahead in (1, *HORIZONS)]
    return {
        "rmse": {step: [float("inf")] * d for step in steps},
        "coverage": {step: [0.0] * d for step in steps},
    }


def _paths(known: System, free: Any) -> dict[str, Any]:
    """Return a few free runs of the last angle: windows, means and ends of intervals."""
    rows = torch.linspace(0, len(free.mean) - 1, _KEPT + 2).round().long()[1:-1].unique()
    angle = known.machine.spec.angle_columns[-1]
    parts = {"mean": free.mean, "lower": free.lower, "upper": free.upper}
    return {"windows": rows.tolist(), **{k: p[rows, :, angle].tolist() for k, p in parts.items()}}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """Return a row for each test of each run: the last angle's error, mean coverage, by steps."""
    rows = []
    for each in runs:
        angle = REAL[each["system"]].machine.spec.angle_columns[-1]
        shared = {name: each[name] for name in ("system", "learner", "n", "seed", "fit_seconds")}
        for test, scores in each["tests"].items():
            row = {**shared, "test": test}
            for steps, values in scores["rmse"].items():
                row[f"rmse-{steps}"] = values[angle]
                row[f"coverage-{steps}"] = np.mean(np.array(scores["coverage"][steps], float))
            rows.append(row)
    return pd.DataFrame(rows)


def tables(runs: Sequence[Run], experiment: Real) -> dict[str, Table]:
    """Return all tables, by name."""
    scored, axes = load(runs), experiment.axes
    found = {
        "paired": Table("n = 100, divided by least squares of the same draws", _paired(scored))
    }
    for (name, test), own in scored.groupby(["system", "test"], sort=False):
        for score, forms in SCORES.items():
            for steps in (1, *HORIZONS):
                cell = mean_error(f"{score}-{steps}", *forms, counted=True)
                columns = across(own, "n", axes["n"], cell)
                text = table(groups(own, "learner", axes["learner"]), columns, "learner")
                title = f"{_TITLES[score]} after {_ahead(steps)}, {axes['system'][name]}, {test}"
                found[f"{name}-{test}-{score}-{steps}"] = Table(title, text)
    columns = {
        f"{label}, s": of("fit_seconds", "median", ".1f", system=name, n=100)
        for name, label in axes["system"].items()
    }
    text = table(groups(scored, "learner", axes["learner"]), columns, "learner")
    return found | {"seconds": Table("Median seconds of a fit, n = 100", text)}


def _ahead(steps: int) -> str:
    return "a step" if steps == 1 else f"{steps * STEP:g} s"


def _paired(scored: pd.DataFrame) -> str:
    """Return ratios of errors at n = 100 to least squares, and of CKA to its delta alone."""
    at = part_of(scored, n=100)
    columns: dict[str, Cell] = {}
    for name, test, steps in ((DRAWN, "near", 20), (DRAWN, "far", 20), ("pendulum", "sac", 10)):
        own = part_of(at, system=name, test=test)
        columns[f"{test}, {_ahead(steps)}: error / least squares"] = _ratio(own, steps)
    return table(groups(at, "learner", Real.axes["learner"]), columns, "learner")


def _ratio(own: pd.DataFrame, steps: int) -> Cell:
    def cell(part: pd.DataFrame) -> str:
        learner = part["learner"].iloc[0]
        if learner == "fitted":
            return ""
        return ratio_of(f"rmse-{steps}", learner, "fitted")(own)

    return cell


_SHOWN = ("fitted", "gp", "calibrated-delta", "smoothed-cka")


def draw(runs: Sequence[Run], experiment: Real) -> list[Path]:
    """Draw free runs of the double pendulum: a row of panels for each learner."""
    kept = {r["learner"]: r["paths"] for r in runs if r["system"] == DRAWN and "paths" in r}
    learners = [learner for learner in _SHOWN if learner in kept]
    if not learners:
        return []
    known, labels = REAL[DRAWN], experiment.axes["learner"]
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
    return [save(figure, experiment.folder / f"{DRAWN}.png")]
