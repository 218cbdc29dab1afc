"""Inputs that were measured with noise: is a model that knows of it nearer to the function?

Seven ways were tried on five or six seeds from 1000 before the first run: slopes of the posterior
mean (McHutchon and Rasmussen 2011), inputs moved along the slope, and parts of what was taken.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, fit
from gpadjust.core import SamplingWarning
from gpadjust.kinds import NoisyInputs
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.validation import Scores
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Noisyinputs

_COLORS = {"ignoring": "0.45", "noisy": "#D55E00"}


class Problem(NamedTuple):
    """A function of inputs between 0 and 1, and what is known of it."""

    num_inputs: int
    truth: Callable[[Tensor], Tensor]
    physics: Any
    parameter: float | None = None  # the true value of the first one


def _forrester(X: Tensor) -> Tensor:
    return (6 * X - 2).square() * torch.sin(12 * X - 4)


def _line() -> FunctionPhysics:
    unknowns = {"slope": Unknown(1.5, sd=2.0), "offset": Unknown(0.0, sd=1.0)}
    return FunctionPhysics(lambda X, p: p.slope * X[:, 0] + p.offset, unknowns=unknowns)


def _decay() -> FunctionPhysics:
    unknowns = {"rate": Unknown(2.0, sd=2.0)}
    return FunctionPhysics(lambda X, p: (-p.rate * X[:, 0]).exp(), unknowns=unknowns)


def _saturation() -> FunctionPhysics:
    unknowns = {"limit": Unknown(2.0, sd=2.0), "half": Unknown(0.3, factor=3.0)}
    return FunctionPhysics(
        lambda X, p: p.limit * X[:, 0] / (p.half + X[:, 0]).clamp_min(0.02), unknowns=unknowns
    )


PROBLEMS: Mapping[str, Problem] = {
    "wave": Problem(
        1, lambda X: (1 + 0.3 * X) * (6 * X).sin() + 0.3 * X.square(), lambda X: (6 * X).sin()
    ),
    "step": Problem(
        1, lambda X: (14 * (X - 0.5)).sigmoid() + 0.2 * X, lambda X: (12 * (X - 0.45)).sigmoid()
    ),
    "forrester": Problem(1, _forrester, lambda X: 0.5 * _forrester(X) + 10 * (X - 0.5) - 5),
    "heat": Problem(
        2,
        lambda X: (-3 * X[:, :1]).exp() * (1 + X[:, 1:]) + 0.2 * X[:, 1:] * X[:, :1],
        lambda X: (-3 * X[:, :1]).exp() * (1 + X[:, 1:]),
    ),
    "pump": Problem(
        2,
        lambda X: (1 + X[:, 1:]).square() * (1 - 0.6 * X[:, :1] ** 3) + 0.3 * X[:, :1] * X[:, 1:],
        lambda X: (1 + X[:, 1:]).square() * (1 - 0.5 * X[:, :1] ** 2),
    ),
    "line": Problem(1, lambda X: 2 * X, _line, 2.0),
    "decay": Problem(1, lambda X: (-3.5 * X).exp(), _decay, 3.5),
    "saturation": Problem(1, lambda X: 3 * X / (0.2 + X), _saturation, 3.0),
}


class Case(NamedTuple):
    """Observations of a problem, the variances of its inputs, and points to predict."""

    X: Tensor
    Y: Tensor
    Xvar: list[float]
    test: Tensor
    truth: Tensor


def case_of(experiment: Noisyinputs, problem: str, seed: int) -> Case:
    """A case: true inputs are uniform; test inputs are exact, in all but the outermost 2 %."""
    settings, (d, truth, _, parameter) = experiment.settings, PROBLEMS[problem]
    draw = torch.Generator().manual_seed(seed)
    n = settings.observations if parameter is None else settings.observations_of_law
    true = torch.rand(n, d, generator=draw, dtype=torch.float64)
    test = 0.02 + 0.96 * torch.rand(400, d, generator=draw, dtype=torch.float64)
    sd = settings.noise * (truth(test).max() - truth(test).min())
    Y = truth(true) + sd * torch.randn(n, 1, generator=draw, dtype=torch.float64)
    X = true + settings.input_noise * torch.randn(n, d, generator=draw, dtype=torch.float64)
    return Case(X, Y, [settings.input_noise**2] * d, test, truth(test))


def _inputs(model: str, case: Case) -> tuple[Tensor, NoisyInputs | None]:
    """The training inputs of a model, and its noise."""
    noise = NoisyInputs(case.X, case.Xvar) if model == "noisy" else None
    return (case.X if noise is None else noise.X), noise


def run(experiment: Noisyinputs, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; return its errors, and the parameter if there is one."""
    warnings.simplefilter("ignore", SamplingWarning)
    case, known = case_of(experiment, problem, seed), PROBLEMS[problem]
    begin = time.perf_counter()
    X, noise = _inputs(model, case)
    if known.parameter is None:
        fitted: Any = CKA(X, case.Y, physics=known.physics, noise=noise)
    else:
        fitted = CalibratedPhysics(X, case.Y, physics=known.physics(), noise=noise)
    fit(fitted)
    seconds = time.perf_counter() - begin
    (mean, variance), (lower, upper) = fitted.predict(case.test), fitted.interval(case.test)
    found = {
        "rmse": Scores.of(mean, variance, case.truth).rmse.item(),
        "coverage": ((lower <= case.truth) & (case.truth <= upper)).double().mean().item(),
        "seconds": seconds,
    }
    if known.parameter is not None:
        parameters = fitted.physics_parameters
        low, high = (float(end[0]) for end in parameters.interval())
        found |= {"parameter": float(parameters.mean[0]), "interval": [low, high]}
    return found


def tables(runs: Sequence[Run], experiment: Noisyinputs) -> dict[str, Table]:
    """All tables, by name."""
    pairs = load(runs)
    rows, laws = [], []
    for problem, title in experiment.axes["problem"].items():
        own = pairs[pairs["problem"] == problem]
        true = PROBLEMS[problem].parameter
        if not len(own):
            continue
        if true is None:
            rows.append(
                [
                    *(title, f"{len(own)}", number(_ratio(own), ".2f")),
                    *(number(own[f"{key}_{m}"].mean(), ".3g")
                      for key in ("rmse", "coverage") for m in ("ignoring", "noisy")),
                    *(number(own[f"seconds_{m}"].median(), ".1f") for m in ("ignoring", "noisy")),
                ]
            )  # fmt: skip
        else:
            laws.append(
                [
                    *(title, number(true)),
                    *(f"{own[f'parameter_{m}'].mean():.3f} ± {own[f'parameter_{m}'].sem():.3f}"
                      for m in ("ignoring", "noisy")),
                    *(number(_held(own, m, true), ".2f") for m in ("ignoring", "noisy")),
                ]
            )  # fmt: skip
    shown = {}
    if rows:
        header = ["problem", "cases", "RMSE over that of ignoring it", "RMSE, ignoring it", "RMSE"]
        header += ["coverage, ignoring it", "coverage", "seconds, ignoring it", "seconds"]
        shown["functions"] = Table("Functions of noisy inputs", markdown(header, rows))
    if laws:
        header = ["law: parameter", "true", "mean estimate, ignoring it", "mean estimate"]
        header += ["held by 95 %, ignoring it", "held by 95 %"]
        shown["laws"] = Table("Parameters of laws", markdown(header, laws))
    return shown


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each case, with the results of both models."""
    keys = ("rmse", "coverage", "seconds", "parameter", "interval")
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for each in runs:
        row = found.setdefault((each["problem"], each["seed"]), {"problem": each["problem"]})
        row |= {f"{key}_{each['model']}": each[key] for key in keys if key in each}
    rows = pd.DataFrame([*found.values()])
    return rows.dropna(subset=["rmse_ignoring", "rmse_noisy"])


def _ratio(pairs: pd.DataFrame) -> float:
    return float(np.exp(np.log(pairs["rmse_noisy"] / pairs["rmse_ignoring"]).mean()))


def _held(pairs: pd.DataFrame, model: str, true: float) -> float:
    return float(np.mean([low <= true <= high for low, high in pairs[f"interval_{model}"]]))


def draw(runs: Sequence[Run], experiment: Noisyinputs) -> list[Path]:
    """Draw the first case of the wave and Forrester's function, with both models."""
    warnings.simplefilter("ignore", SamplingWarning)
    names = ("wave", "forrester")
    titles = [experiment.axes["problem"][name] for name in names]
    figure, axes = panels(titles, 2, (4.6, 3.4), share=False)
    line = torch.linspace(0, 1, 201, dtype=torch.float64).unsqueeze(-1)
    for ax, name in zip(axes, names, strict=True):
        case, known = case_of(experiment, name, experiment.seed), PROBLEMS[name]
        ax.plot(line, known.truth(line), color="0.1", lw=1, ls="--", label="truth")
        ax.plot(line, known.physics(line), color="0.7", lw=1, label="$f_p$")
        for model, label in experiment.axes["model"].items():
            X, noise = _inputs(model, case)
            fitted = CKA(X, case.Y, physics=known.physics, noise=noise)
            fit(fitted)
            lower, upper = (end[:, 0] for end in fitted.interval(line))
            ax.plot(line, fitted.predict(line).mean, color=_COLORS[model], lw=1.5, label=label)
            ax.fill_between(line[:, 0], lower, upper, color=_COLORS[model], alpha=0.2, lw=0)
        ax.errorbar(
            case.X[:, 0], case.Y[:, 0], xerr=case.Xvar[0] ** 0.5, fmt="o", ms=2, lw=0.5, color="0.3"
        )
        ax.set(xlabel="input", ylabel="output")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return [save(figure, experiment.out / "noisyinputs.png")]
