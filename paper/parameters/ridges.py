"""Coverage, widths, warnings and seconds, beside posteriors that are computed independently."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from torch import Tensor

from gpadjust import fit
from paper.common.experiment import Run, Table
from paper.common.runs import timed
from paper.common.tables import markdown
from paper.common.verdicts import Verdict, met
from paper.parameters import FOLDS, NINE, RIDGES, Ridges
from paper.parameters.laws import Case, case
from paper.parameters.parameters import MODELS
from paper.parameters.reference import Posterior, distance, ends, grid, sample

_OFF = 0.2  # difference of distribution functions, above which an answer is off
_POINTS = {  # of grids
    "pendulum": (301, 901),
    "focus": (901, 301),
    "alias": (61, 2001),
    "radar": (61, 4001),
}
_LABELS = Ridges.axes["model"]


def run(experiment: Ridges, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; what is returned is for each parameter, in their order."""
    known = case(problem, seed)
    fitted: Any = MODELS[model](known.X, known.Y, physics=known.physics)
    result: Any
    result, timing = timed(lambda: fit(fitted), time.process_time)
    parameters = fitted.physics_parameters
    found: Run = {
        "true": [*known.true.values()],
        "interval": [end.tolist() for end in parameters.interval()],
        "size": result.effective_size.min().item(),
        **timing,
        "reference": None,
        "distance": None,
    }
    is_first = seed - experiment.seed < experiment.settings.compared
    if problem != NINE and (problem in FOLDS or is_first):
        z, weights = reference(problem, known, model, seed)
        values = known.physics.unknowns.at(z)
        found["reference"] = [end.tolist() for end in ends(values, weights)]
        found["distance"] = distance(parameters.draws, values, weights)
    return found


def reference(problem: str, known: Case, model: str, seed: int) -> tuple[Tensor, Tensor]:
    """Coordinates and weights that stand for the posterior."""
    if problem in FOLDS:
        return grid(known, _POINTS[problem])
    return sample(Posterior(known, model), seed)


def tables(runs: Sequence[Run], experiment: Ridges) -> dict[str, Table]:
    """All tables, by name."""
    found = pd.DataFrame([_judged(run) for run in runs])
    header = ["", "", "cases", "true values in", "compared", "reference holds"]
    header += ["width / reference's", "off", "warned if off", "warned else"]
    header += ["effective size", "seconds"]
    rows = []
    for problem in (*RIDGES, NINE, *FOLDS):
        for model, label in _LABELS.items():
            own = found[(found["problem"] == problem) & (found["model"] == model)]
            if len(own):
                rows.append([problem if model == "physics" else "", label, *_row(own)])
    return {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(found))),
        "cases": Table("Intervals of parameters", markdown(header, rows)),
    }


def _judged(run: Run) -> Run:
    low, high = np.array(run["interval"])
    true = np.array(run["true"])
    found = {name: run[name] for name in ("problem", "model", "size", "warned", "seconds")}
    found |= {"held": ((low <= true) & (true <= high)).mean(), "width": np.nan, "right": np.nan}
    found["off"] = np.nan if run["distance"] is None else float(run["distance"] > _OFF)
    if run["reference"] is not None:
        first, last = np.array(run["reference"])
        found["width"] = np.log((high - low) / (last - first)).mean()
        found["right"] = ((first <= true) & (true <= last)).mean()
    return found


def _row(own: pd.DataFrame) -> list[str]:
    compared = own.dropna(subset="off")
    off = compared["off"] == 1
    return [
        f"{len(own)}",
        f"{own['held'].mean():.2f}",
        f"{len(compared)}",
        f"{compared['right'].mean():.2f}" if len(compared) else "",
        f"{np.exp(compared['width'].mean()):.2f}" if len(compared) else "",
        f"{off.sum()}" if len(compared) else "",
        f"{compared['warned'][off].sum()}" if off.any() else "",
        f"{compared['warned'][~off].sum()}" if len(compared) else f"({own['warned'].sum()})",
        f"{own['size'].median():.0f}",
        f"{own['seconds'].median():.2f} to {own['seconds'].max():.2f}",
    ]


def _targets(runs: pd.DataFrame) -> list[list[str]]:
    rows = []

    def enter(name: str, text: str, verdict: Verdict, numbers: str) -> None:
        rows.append([name, text, f"**{verdict}**: {numbers}"])

    ridges = runs[runs["problem"].isin(RIDGES)]
    models = [model for model in _LABELS if model in {*ridges["model"]}]
    if models:
        held = {m: ridges[ridges["model"] == m]["held"].mean() for m in models}
        text = "ridges: 95 % intervals hold .90 to .98 of the true values"
        said = ", ".join(f"{_LABELS[m]} {each:.3f}" for m, each in held.items())
        enter("P1", text, met(all(0.9 <= each <= 0.98 for each in held.values())), said)
        groups = ridges.dropna(subset="width").groupby(["problem", "model"], sort=False)
        widths = np.exp(groups["width"].mean())
        if len(widths):
            text = "ridges: widths .9 to 1.15 of the reference's, each problem and model"
            is_met = bool(widths.between(0.9, 1.15).all())
            enter("P2", text, met(is_met), f"{widths.min():.2f} to {widths.max():.2f}")
    compared = runs.dropna(subset="off")
    off = compared["off"] == 1
    if len(compared):
        warned, rarely = (int(compared["warned"][which].sum()) for which in (off, ~off))
        text = f"a warning in 9 of 10 cases that are off (distribution functions by {_OFF:g})"
        verdict = met(warned >= 0.9 * off.sum()) if off.any() else "undetermined"
        enter("P3", text, verdict, f"{warned} of {off.sum()}")
        text = "a warning in fewer than 1 of 20 that are not"
        enter("P4", text, met(rarely < 0.05 * (~off).sum()), f"{rarely} of {(~off).sum()}")
    for name, problems, most in (("P5", RIDGES[:3], 2.0), ("P6", (NINE,), 5.0)):
        own = runs[runs["problem"].isin(problems)]
        if len(own):
            parameters = "two parameters" if name == "P5" else "nine"
            text = f"{parameters}: at most {most:g} s of CPU time a fit"
            said = f"{own['seconds'].median():.2f}, at most {own['seconds'].max():.2f}"
            enter(name, text, met(own["seconds"].max() <= most), said)
    return rows
