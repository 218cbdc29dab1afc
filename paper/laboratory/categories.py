"""Categories and batches as inputs: what is a material known to be, and what an offset of a rig?

Heads of pumps of three materials on five rigs, by flow and speed. The formula knows a constant of
each material. The material changes the shape of what is missing, the rig adds an offset. Test
points are 200 on the same rigs, and the same points on a sixth rig.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust import CKA, fit
from gpadjust.core import GP, SamplingWarning
from gpadjust.kinds import Categories as Columns
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Categories

_ROWS, _TEST, _MATERIALS, _RIGS = 60, 200, 3, 5
_CONSTANTS = torch.tensor([0.9, 1.3, 1.1], dtype=torch.float64)  # of the materials, in the formula
_OFFSET = 1.0  # m, sd of rigs
_NOISE = 0.2  # m
_COLORS = ("0.45", "#E69F00", "#009E73", "#CC79A7", "#0072B2")


class Case(NamedTuple):
    """Observations of pumps, and what they are asked: columns flow, speed, material, rig."""

    X: Tensor
    Y: Tensor
    test: Tensor
    truth: Tensor
    new: Tensor  # the same on a sixth rig
    new_truth: Tensor
    offsets: Tensor


def head(X: Tensor) -> Tensor:
    """The formula: affinity laws with a loss by the constant of the material."""
    flow, speed = X[:, 0], X[:, 1]
    return 20 * speed.square() - 4 * _CONSTANTS[X[:, 2].long()] * flow.square()


def case_of(seed: int) -> Case:
    """A set of pumps and rigs."""
    draw = np.random.default_rng(seed)
    slips = torch.from_numpy(draw.uniform(0.5, 3.0, _MATERIALS))
    offsets = _OFFSET * torch.from_numpy(draw.normal(size=_RIGS + 1))

    def system(X: Tensor) -> Tensor:
        flow, speed, material, rig = X.unbind(-1)
        bend = slips[material.long()] * torch.sin(2 * flow) * speed + 0.6 * flow
        return (0.95 * head(X) - bend + offsets[rig.long()]).unsqueeze(-1)

    def points(number: int) -> Tensor:
        numbers = torch.from_numpy(draw.uniform((0.0, 0.8), (2.0, 1.2), (number, 2)))
        codes = [torch.from_numpy(draw.integers(0, k, number)) for k in (_MATERIALS, _RIGS)]
        return torch.cat([numbers, torch.stack(codes, -1).double()], -1)

    X, test = points(_ROWS), points(_TEST)
    new = torch.cat([test[:, :3], torch.full((_TEST, 1), float(_RIGS)).double()], -1)
    Y = system(X) + _NOISE * torch.from_numpy(draw.normal(size=(_ROWS, 1)))
    return Case(X, Y, test, system(test), new, system(new), offsets)


class _OneHot(InputTransform):
    """Columns of ones and zeros for material and rig; a new rig has zeros."""

    transform_on_train = transform_on_eval = transform_on_fantasize = True
    is_one_to_many = False

    def transform(self, X: Tensor) -> Tensor:
        own = [(X[..., 2:3] == torch.arange(_MATERIALS)).to(X)]
        return torch.cat([X[..., :2], *own, (X[..., 3:] == torch.arange(_RIGS)).to(X)], -1)


def of_number(X: Tensor) -> Tensor:
    """The formula with the mean of the constants."""
    return 20 * X[:, 1].square() - 4 * _CONSTANTS.mean() * X[:, 0].square()


def models_of(name: str, case: Case) -> list[tuple[GP, Callable[[Tensor], Tensor], Any]]:
    """Models of a name before their fits, the columns they read, and the material each is of."""
    X, Y = case.X, case.Y
    if name == "ignored":
        return [(CKA(X[:, :2], Y, physics=of_number), lambda X: X[:, :2], None)]
    if name == "each":
        found = []
        for k in range(_MATERIALS):
            own = X[:, 2] == k

            def of_material(X: Tensor, k: int = k) -> Tensor:
                return head(torch.cat([X, torch.full_like(X[:, :1], k)], -1))

            model = CKA(X[own, :2], Y[own], physics=of_material)
            found.append((model, lambda X: X[:, :2], float(k)))
        return found
    transforms = {"onehot": _OneHot(), "ours": Columns([2], batches=[3])}
    model = CKA(X, Y, physics=head, input_transform=transforms.get(name))
    return [(model, lambda X: X, None)]


@torch.no_grad()
def predicted(models: list[Any], X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means and ends of 95 % intervals, each point by the model of its material."""
    mean = torch.full((len(X), 1), math.nan).double()
    lower, upper = mean.clone(), mean.clone()
    for model, read, material in models:
        own = torch.ones(len(X), dtype=torch.bool) if material is None else X[:, 2] == material
        mean[own] = model.predict(read(X[own])).mean
        lower[own], upper[own] = model.interval(read(X[own]))
    return mean, lower, upper


def run(experiment: Categories, model: str, seed: int) -> Run:
    """Fit the model or models to a set of pumps; return errors on its rigs, and on a new one."""
    warnings.simplefilter("ignore", SamplingWarning)
    case = case_of(seed)
    models = models_of(model, case)
    begin = time.perf_counter()
    for each, _, _ in models:
        fit(each)
    seconds = time.perf_counter() - begin
    found: Run = {"seconds": seconds}
    for key, X, truth in (("", case.test, case.truth), ("new_", case.new, case.new_truth)):
        mean, lower, upper = predicted(models, X)
        found[f"{key}rmse"] = (mean - truth).square().mean().sqrt().item()
        found[f"{key}coverage"] = ((lower <= truth) & (truth <= upper)).double().mean().item()
    if model == "ours":
        rigs = torch.cat([case.X[:1, :3].expand(_RIGS, 3), torch.arange(_RIGS)[:, None]], -1)
        with torch.no_grad():
            term = models[0][0].term("x4", rigs.double())
        found["offsets"] = [term.mean.flatten().tolist(), term.variance.sqrt().flatten().tolist()]
        found["true_offsets"] = case.offsets[:_RIGS].tolist()
    return found


def tables(runs: Sequence[Run], experiment: Categories) -> dict[str, Table]:
    """All tables, by name."""
    keys = ("model", "seed", "rmse", "coverage", "new_rmse", "new_coverage", "seconds")
    found = pd.DataFrame([{key: each[key] for key in keys} for each in runs])
    rows = []
    for model, label in experiment.axes["model"].items():
        own = found[found["model"] == model]
        if len(own):
            rows.append(
                [
                    *(label, f"{len(own)}"),
                    number(own["rmse"].median()),
                    number(own["coverage"].mean(), ".3f"),
                    number(own["new_rmse"].median()),
                    number(own["new_coverage"].mean(), ".3f"),
                    number(own["seconds"].median(), ".2f"),
                ]
            )
    header = ["model", "sets", "median RMSE on the rigs [m]", "coverage of 95 %"]
    header += ["median RMSE on a new rig [m]", "coverage there", "seconds"]
    return {"categories": Table("Pumps of three materials on five rigs", markdown(header, rows))}


def draw(runs: Sequence[Run], experiment: Categories) -> list[Path]:
    """Draw the errors of each way, and the offsets of rigs beside the true ones."""
    figure, axes = panels(
        ["errors on the rigs", "offsets of five rigs"], 2, (4.6, 3.2), share=False
    )
    for i, (model, label) in enumerate(experiment.axes["model"].items()):
        own = [r["rmse"] for r in runs if r["model"] == model]
        axes[0].plot(own, np.full(len(own), i), "o", color=_COLORS[i], ms=4, alpha=0.6)
        axes[0].text(0.02, i - 0.22, label, transform=axes[0].get_yaxis_transform(), va="bottom")
    axes[0].set(xscale="log", xlabel="RMSE [m]", yticks=[], ylim=(4.5, -0.8))
    for each in (r for r in runs if r["model"] == "ours"):
        (mean, _), true = each["offsets"], np.array(each["true_offsets"])
        # Of all rigs together only the differences are known.
        mean, true = np.array(mean) - np.mean(mean), true - true.mean()
        axes[1].plot(true, mean, "o", color=_COLORS[-1], ms=4, alpha=0.6)
    axes[1].axline((0, 0), slope=1, color="0.2", lw=1, ls="--")
    axes[1].set(xlabel="true, less their mean [m]", ylabel="term of the rig, likewise [m]")
    return [save(figure, experiment.out / "categories.png")]
