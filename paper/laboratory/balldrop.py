"""Drag and gravity from drop times of three balls, by runs of a simulator.

The fourth ball is predicted. Data, runs and priors (uniform within the range of the runs) are those
of the documentation of SEPIA (notebooks `ball_drop_2` and `ball_drop_2_ragged` of lanl/SEPIA at
3098904). What the second prints, of all four balls with six drops of the bowling ball: C_D = 0.2125
± 0.0407 and g = 0.5009 ± 0.0747 in the range of the runs, so 0.583 ± 0.073 and 10.00 ± 0.30 m/s².
Neither leaves the softball out.

Tried before the first run, on the same data (there are no others): the heights at which the runs
are taken, and the three models of the softball; nothing was changed after that.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, EmulatedPhysics, PhysicsMeanGP, Unknown, fit
from gpadjust.core import SamplingWarning
from gpadjust.physics import FunctionPhysics, ParameterValues
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Balldrop, BalldropSettings

DATA = Path(__file__).parent / "data" / "ball_drop"
BALLS = {"basketball": 0.12, "baseball": 0.038, "bowling ball": 0.11, "softball": 0.0485}
"""Their radii in m."""
_AIR = 1.184  # kg/m³, of all balls and of the first 80 runs
_UNKNOWNS = {
    "C_D": Unknown(1.1, bounds=(0.2, 2.0)),
    "g": Unknown(10.0, bounds=(8.0, 12.0), unit="m/s²"),
}
_MODELS = {"physics": CalibratedPhysics, "mean": PhysicsMeanGP, "cka": CKA}
_SEPIA = {"C_D": (0.2 + 1.8 * 0.2125, 1.8 * 0.0407), "g": (8 + 4 * 0.5009, 4 * 0.0747)}


@cache
def emulated(settings: BalldropSettings, seed: int) -> tuple[EmulatedPhysics, float]:
    """The physics known by its runs, and the seconds of its fit."""
    design, times = pd.read_csv(DATA / "design.csv"), pd.read_csv(DATA / "runs.csv").to_numpy()
    rows, outputs = [], []
    for i, each in design.head(settings.num_runs).iterrows():
        for height in settings.heights:
            rows.append([each.R_ball, each.rho_ball, height, each.C_D, each.g])
            outputs.append([times[height, i]])
    begin = time.perf_counter()
    physics = EmulatedPhysics(
        np.array(rows), np.array(outputs), unknowns=_UNKNOWNS, fit_options={"seed": seed}
    )
    return physics, time.perf_counter() - begin


def formula(X: Tensor, p: ParameterValues) -> Tensor:
    """The drop time of a ball with quadratic drag, which the runs follow within 1.4 ms."""
    k = 3 * p.C_D * _AIR / (8 * X[:, 0] * X[:, 1])
    return torch.acosh((k * X[:, 2]).exp()) / (p.g * k).sqrt()


def run(experiment: Balldrop, physics: str, left: str, model: str, seed: int) -> Run:
    """Fit a model to the drop times of the other balls, and predict those of one."""
    warnings.simplefilter("ignore", SamplingWarning)
    field, seconds = pd.read_csv(DATA / "field.csv"), 0.0
    f_p: EmulatedPhysics | FunctionPhysics = FunctionPhysics(formula, unknowns=_UNKNOWNS)
    if physics == "runs":
        f_p, seconds = emulated(experiment.settings, seed)
    out = (field["R_ball"] == BALLS.get(left)).to_numpy()
    named = ["R_ball", "rho_ball", "height"], ["time"]
    X, Y = (torch.from_numpy(field[columns].to_numpy(copy=True)) for columns in named)
    noise = torch.from_numpy(field[["sd"]].to_numpy(copy=True)).square()
    begin = time.perf_counter()
    fitted = _MODELS[model](X[~out], Y[~out], noise[~out], physics=f_p)
    fit(fitted, seed=seed)
    took = time.perf_counter() - begin
    parameters, asked = fitted.physics_parameters, out if out.any() else ~out
    low, high = parameters.interval()
    curve = torch.arange(10.0, 61.0, 2).double().unsqueeze(-1)
    ball = X[asked][0, :2].expand(len(curve), 2)
    with torch.no_grad():
        predicted = fitted.predict(X[asked])
        lower, upper = fitted.interval(X[asked], observation_noise=True)
        band = [fitted.predict(torch.cat([ball, curve], -1)).mean]
        band += fitted.interval(torch.cat([ball, curve], -1))
    return {
        "names": [*parameters],
        "mean": parameters.mean.tolist(),
        "sd": parameters.draws.std(0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "draws": parameters.draws[:200].tolist(),
        "height": X[asked][:, 2].tolist(),
        "time": Y[asked].flatten().tolist(),
        "predicted": predicted.mean.flatten().tolist(),
        "lower": lower.flatten().tolist(),
        "upper": upper.flatten().tolist(),
        "band": [each.flatten().tolist() for each in band],
        "seconds": took,
        "emulator_seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Balldrop) -> dict[str, Table]:
    """All tables, by name."""
    parameters, predictions, axes = [], [], experiment.axes
    for physics, left, model in product(axes["physics"], axes["left"], axes["model"]):
        own = [r for r in runs if (r["physics"], r["left"], r["model"]) == (physics, left, model)]
        if not own:
            continue
        row = [axes["physics"][physics], axes["model"][model], left]
        mean, sd, low, high, lower, upper, time_, predicted = (
            np.array(own[0][name])
            for name in ("mean", "sd", "low", "high", "lower", "upper", "time", "predicted")
        )
        cells = [
            f"{mean[i]:.{d}f} ± {sd[i]:.{d}f} ({low[i]:.{d}f} to {high[i]:.{d}f})"
            for i, d in enumerate((3, 2))
        ]
        parameters.append([*row, *cells, number(own[0]["seconds"], ".1f")])
        if left != "none":
            off, held = predicted - time_, (lower <= time_) & (time_ <= upper)
            rmse = number(float(np.sqrt(np.mean(off**2))))
            count, half = (
                f"{held.sum()} of {len(held)}",
                number(((upper - lower) / 2).mean(), ".2f"),
            )
            predictions.append([*row, ", ".join(f"{o:+.2f}" for o in off), rmse, count, half])
    sepia = [f"{m:.{d}f} ± {sd:.{d}f}" for (m, sd), d in zip(_SEPIA.values(), (3, 2), strict=True)]
    parameters.append(["80 runs", "SEPIA's documentation", "none", *sepia, ""])
    header = [
        "f_p known by",
        "model",
        "left out",
        "C_D, mean ± sd (95 %)",
        "g in m/s², mean ± sd (95 %)",
    ]
    told = ["f_p known by", "model", "left out", "predicted less measured, s", "RMSE, s"]
    told += ["held by 95 %", "half width of 95 %, s"]
    return {
        "parameters": Table("Parameters", markdown([*header, "seconds of the fit"], parameters)),
        "predictions": Table("The ball that is left out", markdown(told, predictions)),
    }


def draw(runs: Sequence[Run], experiment: Balldrop) -> list[Path]:
    """Draw the posterior of the parameters, and the softball that was left out."""
    figure, (left, right) = panels(
        ["posterior of g and C_D", "softball, left out"], 2, (4.4, 3.4), share=False
    )
    found = {(r["physics"], r["model"]): r for r in runs if r["left"] == "softball"}
    for physics, color, marker in (("runs", "#D55E00", "o"), ("formula", "0.45", "x")):
        if (own := found.get((physics, "mean"))) is None:
            continue
        draws = np.array(own["draws"])
        label = (
            "physics mean, f_p by 80 runs"
            if physics == "runs"
            else "physics mean, f_p by its formula"
        )
        left.plot(draws[:, 1], draws[:, 0], marker, ms=3, color=color, alpha=0.5, label=label)
        mean, lower, upper = (np.array(each) for each in own["band"])
        height = np.arange(10.0, 61.0, 2)
        if physics == "runs":
            right.fill_between(height, lower, upper, color=color, alpha=0.25, lw=0)
        right.plot(height, mean, color=color, lw=2 if physics == "runs" else 1)
        right.errorbar(own["height"], own["time"], 0.196, fmt="ok", ms=4, capsize=3)
    (c, c_sd), (g, g_sd) = _SEPIA.values()
    left.errorbar(g, c, c_sd, g_sd, fmt="sk", ms=5, capsize=3, label="SEPIA, all balls, ± sd")
    left.set(xlabel="g [m/s²]", ylabel="C_D")
    right.set(xlabel="height [m]", ylabel="drop time [s]")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return [save(figure, experiment.out / "balldrop.png")]
