"""A small problem of each kind of data, by the option that is for it and by plain CKA.

Each kind is a function that draws its data and returns the predictions of a learner at points where
the truth is known, and those along a line for a picture. The problems, their sizes and what plain
means were taken from nine earlier experiments (``earlier.md``), of other seeds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, EmulatedPhysics, FunctionPhysics, PhysicsMeanGP, Unknown
from gpadjust.kinds import (
    Categories,
    HeavyTails,
    LinkedCKA,
    NoisyInputs,
    RelativeNoise,
    Vanishing,
    Window,
)
from paper.common.experiment import Run, Table, fitted
from paper.common.figures import panels, save
from paper.common.tables import Cell, frame, groups, of, ratio_of, table
from paper.common.verdicts import scores_of
from paper.functions.problems import PROBLEMS
from paper.kinds import Kinds

DATA = Path(__file__).parent / "data" / "ball_drop"
_LINE = 61  # points of a picture


class Predicted(NamedTuple):
    """Predictions of a learner."""

    mean: Tensor  # means `n x 1`, or medians, in units in which errors count
    low: Tensor  # lower ends of 95 % intervals
    high: Tensor  # upper ends
    truth: Tensor  # true values, or measured ones
    # For a picture, if any: `x`, `truth`, `low` and `high` along a line, and data.
    lines: dict[str, Tensor]
    seconds: float  # of the fit


def _at(model: Any, test: Tensor, truth: Tensor, line: Tensor, data: Any) -> Predicted:
    """Fit a model, and predict the function at test points and along a line.

    Args:
        model: The model, before its fit.
        test: Test points ``n x d``.
        truth: The truth there, ``n x 1``.
        line: Points of a picture, and the truth there, as its last column.
        data: Inputs and outputs of the picture.
    """
    seconds = fitted(model)
    with torch.no_grad():
        low, high = model.interval(line[:, :-1])
        mean, ends = model.predict(test).mean, model.interval(test)
    lines = {"x": line[:, 0], "truth": line[:, -1:], "low": low, "high": high}
    lines |= {"data_x": data[0][:, 0], "data_y": data[1]}
    return Predicted(mean, ends[0], ends[1], truth, lines, seconds)


def _line(function: Callable[[Tensor], Tensor], low: float = 0.0, high: float = 1.0) -> Tensor:
    """Return points of one input with the truth as a further column."""
    x = torch.linspace(low, high, _LINE, dtype=torch.float64).unsqueeze(-1)
    return torch.cat([x, function(x)], -1)


def relative(option: bool, seed: int) -> Predicted:
    """Predict an output of three decades with noise of 5 %; errors are relative."""
    draw = np.random.default_rng(seed)

    def physics(X: Tensor) -> Tensor:
        return (math.log(1e3) * (X[..., :1] - 1)).exp()

    def truth(X: Tensor) -> Tensor:
        return physics(X) * (1 + 0.3 * (5 * X[:, :1]).sin())

    X, test = (torch.from_numpy(draw.uniform(size=(n, 1))) for n in (40, 400))
    Y = truth(X) * (1 + 0.05 * torch.from_numpy(draw.normal(size=(40, 1))))
    noise = RelativeNoise() if option else None
    model = CKA(X, Y, physics=physics, noise=noise)
    found = _at(model, test, truth(test), _line(truth), (X, Y))
    scale = found.truth  # relative errors
    return found._replace(mean=found.mean / scale, low=found.low / scale, high=found.high / scale,
                          truth=torch.ones_like(scale))  # fmt: skip


def outliers(option: bool, seed: int) -> Predicted:
    """Predict from forty observations, of which two are off by 10 to 100 sd."""
    draw = np.random.default_rng(seed)

    def truth(X: Tensor) -> Tensor:
        return 2 * (6 * X).sin() + X

    X, test = (torch.from_numpy(draw.uniform(size=(n, 1))) for n in (40, 400))
    sd = 0.05 * truth(test).std()
    Y = truth(X) + sd * torch.from_numpy(draw.normal(size=(40, 1)))
    off = 10 ** draw.uniform(1, 2, 2) * draw.choice([-1, 1], 2)
    Y[draw.choice(40, 2, replace=False)] += sd * torch.from_numpy(off).unsqueeze(-1)
    model = CKA(X, Y, physics=lambda X: (6 * X).sin(), noise=HeavyTails() if option else None)
    return _at(model, test, truth(test), _line(truth), (X, Y))


def noisy_inputs(option: bool, seed: int) -> Predicted:
    """Predict from inputs with an error of 5 % of their range; test inputs are exact."""
    draw = torch.Generator().manual_seed(seed)

    def truth(X: Tensor) -> Tensor:
        return (1 + 0.3 * X) * (6 * X).sin() + 0.3 * X.square()

    exact = torch.rand(40, 1, generator=draw, dtype=torch.float64)
    test = 0.02 + 0.96 * torch.rand(400, 1, generator=draw, dtype=torch.float64)
    Y = truth(exact) + 0.04 * torch.randn(40, 1, generator=draw, dtype=torch.float64)
    X = exact + 0.05 * torch.randn(40, 1, generator=draw, dtype=torch.float64)
    noise = NoisyInputs(X, [0.05**2]) if option else None
    inputs = X if noise is None else noise.X
    model = CKA(inputs, Y, physics=lambda X: (6 * X).sin(), noise=noise)
    return _at(model, test, truth(test), _line(truth), (X, Y))


def links(option: bool, seed: int) -> Predicted:
    """Predict the current of a diode with leak and resistance; errors are of its logarithm."""
    draw = np.random.default_rng(seed)
    ideal, leak = draw.uniform(1.05, 1.3), draw.uniform(1e-7, 1e-5)

    def truth(X: Tensor) -> Tensor:
        knee = (X / (0.0259 * ideal)).expm1() * 1e-9
        return 1 / (1 / (knee + leak * X) + 20.0)

    def physics(X: Tensor) -> Tensor:
        return (X / 0.0259).expm1() * 1e-9

    X, test = (torch.from_numpy(draw.uniform(0.1, 0.75, (n, 1))) for n in (20, 200))
    Y = truth(X) * (0.1 * torch.from_numpy(draw.normal(size=(20, 1)))).exp()
    model = LinkedCKA(X, Y, physics=physics, link="log") if option else CKA(X, Y, physics=physics)
    found = _at(model, test, truth(test), _line(truth, 0.1, 0.75), (X, Y))
    least = 0.5 * Y.min()  # what is not positive has no logarithm
    mean, low, high, true = (e.clamp_min(least).log() for e in found[:4])
    return found._replace(mean=mean, low=low, high=high, truth=true)


_CONSTANTS = torch.tensor([0.9, 1.3, 1.1], dtype=torch.float64)  # of the materials, in the formula


def _head(X: Tensor) -> Tensor:
    """Return the head of a pump by flow, speed and material."""
    return 20 * X[:, 1].square() - 4 * _CONSTANTS[X[:, 2].long()] * X[:, 0].square()


def categories(option: bool, seed: int) -> Predicted:
    """Predict pumps of three materials on rigs with an offset each; plain: codes as numbers."""
    draw = np.random.default_rng(seed)
    slips = torch.from_numpy(draw.uniform(0.5, 3.0, 3))
    offsets = torch.from_numpy(draw.normal(size=5))

    def truth(X: Tensor) -> Tensor:
        flow, speed, material, rig = X.unbind(-1)
        bend = slips[material.long()] * torch.sin(2 * flow) * speed + 0.6 * flow
        return (0.95 * _head(X) - bend + offsets[rig.long()]).unsqueeze(-1)

    def points(n: int) -> Tensor:
        numbers = torch.from_numpy(draw.uniform((0.0, 0.8), (2.0, 1.2), (n, 2)))
        codes = [torch.from_numpy(draw.integers(0, k, n)) for k in (3, 5)]
        return torch.cat([numbers, torch.stack(codes, -1).double()], -1)

    X, test = points(60), points(200)
    Y = truth(X) + 0.2 * torch.from_numpy(draw.normal(size=(60, 1)))
    transform = Categories([2], batches=[3]) if option else None
    line = X[:1].repeat(_LINE, 1)
    line[:, 0] = torch.linspace(0, 2, _LINE)
    alike = (X[:, 2:] == X[0, 2:]).all(-1)
    model = CKA(X, Y, physics=_head, input_transform=transform)
    line = torch.cat([line, truth(line)], -1)
    return _at(model, test, truth(test), line, (X[alike], Y[alike]))


def drift(option: bool, seed: int) -> Predicted:
    """Predict the head of a pump that wears; the option forgets as it is updated."""
    draw, steps, first = np.random.default_rng(seed), 360, 60
    flow, speed = draw.uniform(0.2, 1.2, steps), draw.uniform(0.7, 1.1, steps)
    worn = draw.uniform(0.04, 0.08) + 0.04 * np.arange(steps) / steps
    leak = 0.08 + 0.02 * (np.arange(steps) > draw.integers(200, 300))  # it breaks a little once
    head = 40 * (1 - worn) * speed**2 - 18 * (flow + leak * speed) ** 2
    X, truth = torch.from_numpy(np.stack([flow, speed], -1)), torch.from_numpy(head)[:, None]
    Y = truth + 0.2 * torch.from_numpy(draw.normal(size=(steps, 1)))
    model: Any = CKA(
        X[:first], Y[:first], physics=lambda X: 40 * X[..., 1:] ** 2 - 18 * X[..., :1] ** 2
    )
    seconds = fitted(model)
    if not option:
        mean, (low, high) = model.predict(X[first:]).mean, model.interval(X[first:])
    else:
        begin, rows, window = time.perf_counter(), [], Window(model, first)
        for x, y in zip(X[first:].split(1), Y[first:].split(1), strict=True):
            rows.append([window.predict(x).mean, *window.interval(x)])
            window.update(x, y)
        mean, low, high = (torch.cat(column) for column in zip(*rows, strict=True))
        seconds += time.perf_counter() - begin
    after = torch.arange(first, steps).double()
    lines = {"truth": truth[first:], "low": low, "high": high, "data_y": Y[first:]}
    lines = {name: line - mean for name, line in lines.items()} | {"x": after, "data_x": after}
    return Predicted(mean, low, high, truth[first:], lines, seconds)


def vanishing(option: bool, seed: int) -> Predicted:
    """Estimate gravity by a fall in air: f_p has no drag, which begins small; plain: free delta."""
    draw = np.random.default_rng(seed)
    height, drag, g = draw.uniform(40, 60), draw.uniform(0.002, 0.02), 9.81

    def truth(t: Tensor) -> Tensor:
        return height - (math.sqrt(g * drag) * t).cosh().log() / drag

    t = torch.linspace(0.05, 2, 20, dtype=torch.float64).unsqueeze(-1)
    Y = truth(t) + 0.05 * torch.from_numpy(draw.normal(size=(20, 1)))
    X = pd.DataFrame({"time": t[:, 0]})
    unknowns = {"g": Unknown(9.0, sd=2.0), "height": Unknown(50.0, sd=20.0)}
    law = FunctionPhysics(lambda X, p: p.height - 0.5 * p.g * X[:, 0].square(), unknowns=unknowns)
    kernel = Vanishing({"time": [0.0, 0.25, 0.5]}) if option else None
    model = PhysicsMeanGP(X, Y, physics=law, covar_module=kernel)
    found = _at(model, t, truth(t), _line(truth, 0.0, 2.0), (t, Y))
    known = model.physics_parameters
    low, high = (end[:1].view(1, 1) for end in known.interval())
    return found._replace(mean=known.mean[:1].view(1, 1), low=low, high=high,
                          truth=torch.tensor([[g]], dtype=torch.float64))  # fmt: skip


def emulated(option: bool, seed: int) -> Predicted:
    """Predict Currin's function, its low level by 40 runs; plain: their emulator is exact."""
    problem = PROBLEMS["currin"]
    X, runs = problem.points(10, seed), problem.points(40, 20_000 + seed)
    known = EmulatedPhysics(runs, problem.physics(runs))
    test = problem.points(400, 1)
    physics = known if option else FunctionPhysics(known)
    model = CKA(X, problem.truth(X), physics=physics)
    seconds = fitted(model)
    low, high = model.interval(test)
    return Predicted(model.predict(test).mean, low, high, problem.truth(test), {}, seconds)


_UNKNOWNS = {"C_D": Unknown(1.1, bounds=(0.2, 2.0)), "g": Unknown(10.0, bounds=(8.0, 12.0))}
_SOFTBALL = 0.0485  # m, its radius


def _drop_time(X: Tensor) -> Tensor:
    """Return the time by the runs' formula, drag and gravity at the middle of their priors."""
    k = 3 * 1.1 * 1.184 / (8 * X[:, 0] * X[:, 1])
    return torch.acosh((k * X[:, 2]).exp()) / (10.0 * k).sqrt()


def balldrop(option: bool, seed: int) -> Predicted:
    """Predict times of a softball, by those of three other balls and 80 runs of a simulator.

    Data, runs and priors are those of the documentation of SEPIA (lanl/SEPIA at 3098904, notebook
    `ball_drop_2`). Plain: their formula with guesses of drag and gravity, adjusted by CKA.
    """
    field, runs = pd.read_csv(DATA / "field.csv"), pd.read_csv(DATA / "runs.csv")
    inputs = runs[["R_ball", "rho_ball", "height", "C_D", "g"]].to_numpy(float)
    times = runs[["time"]].to_numpy(float)
    begin = time.perf_counter()
    physics: Any = _drop_time
    if option:
        physics = EmulatedPhysics(inputs, times, unknowns=_UNKNOWNS, fit_options={"seed": seed})
    seconds = time.perf_counter() - begin
    X, Y, sd = (
        torch.from_numpy(field[columns].to_numpy(dtype=float, copy=True))
        for columns in (["R_ball", "rho_ball", "height"], ["time"], ["sd"])
    )
    out = X[:, 0] == _SOFTBALL
    structure: Any = PhysicsMeanGP if option else CKA
    model = structure(X[~out], Y[~out], sd[~out].square(), physics=physics)
    seconds += fitted(model, seed=seed)
    height = torch.linspace(10, 60, _LINE, dtype=torch.float64)[:, None]
    ball = torch.cat([X[out][:1, :2].repeat(_LINE, 1), height], -1)
    mean, ends = model.predict(X[out]).mean, model.interval(ball)
    low, high = model.interval(X[out], observation_noise=True)
    lines = {"x": height, "truth": model.predict(ball).mean, "low": ends[0], "high": ends[1]}
    lines |= {"data_x": X[out][:, 2], "data_y": Y[out]}
    return Predicted(mean, low, high, Y[out], lines, seconds)


KINDS = {
    kind.__name__: kind
    for kind in (relative, outliers, noisy_inputs, links, categories, drift, vanishing, emulated)
} | {"balldrop": balldrop}
OPTIONS = {
    "relative": ("CKA", "noise=RelativeNoise()"),
    "outliers": ("CKA", "noise=HeavyTails()"),
    "noisy_inputs": ("CKA", "noise=NoisyInputs(X, Xvar)"),
    "links": ("CKA", "LinkedCKA(link='log')"),
    "categories": ("CKA, codes as numbers", "Categories([2], batches=[3])"),
    "drift": ("CKA, fitted once", "Window(CKA)"),
    "vanishing": ("a free delta", "covar_module=Vanishing(...)"),
    "emulated": ("CKA, its emulator as exact f_p", "EmulatedPhysics"),
    "balldrop": ("CKA, parameters at their guess", "EmulatedPhysics with unknowns, delta"),
}
"""Of each kind, what plain means, and the option."""


def run(experiment: Kinds, kind: str, learner: str, seed: int) -> Run:
    """Fit a learner to a data set of a kind; return error and coverage where the truth is known."""
    found = KINDS[kind](learner == "option", 500 + seed)
    scores = scores_of(found.mean, found.low, found.high, found.truth)
    results: Run = {
        "error": scores["rmse"],
        "coverage": scores["coverage"],
        "seconds": found.seconds,
    }
    if seed == experiment.seed and found.lines:
        results["lines"] = {name: part.flatten().tolist() for name, part in found.lines.items()}
    return results


def tables(runs: Sequence[Run], experiment: Kinds) -> dict[str, Table]:
    """Return a table with a row for each kind."""
    columns: dict[str, Cell] = {
        "plain": lambda part: OPTIONS[part["kind"].iloc[0]][0],
        "option": lambda part: f"`{OPTIONS[part['kind'].iloc[0]][1]}`",
        "median error, plain": of("error", "median", ".2g", learner="plain"),
        "median error, option": of("error", "median", ".2g", learner="option"),
        "error, option / plain": ratio_of("error", "option", "plain"),
        "option better": _better,
        "95 % coverage, plain": of("coverage", "mean", ".2f", learner="plain"),
        "95 % coverage, option": of("coverage", "mean", ".2f", learner="option"),
        "seconds, plain": of("seconds", "median", ".1f", learner="plain"),
        "seconds, option": of("seconds", "median", ".1f", learner="option"),
    }
    text = table(groups(frame(runs), "kind", experiment.axes["kind"]), columns, "data")
    return {"kinds": Table("Each kind of data, by its option and by plain CKA", text)}


def _better(part: pd.DataFrame) -> str:
    wide = part.pivot_table(index="seed", columns="learner", values="error").dropna()
    if len(wide.columns) < 2:
        return ""
    return f"{(wide['option'] < wide['plain']).sum()} of {len(wide)}"


_LOGARITHMIC = ("relative", "links")
_LESS_TRUTH = ("vanishing",)
_LINES = {"balldrop": "mean"}  # of measured data, whose truth is unknown
_AXES = {
    "links": ("voltage [V]", "current [A]"),
    "categories": ("flow, of one material on one rig", "head [m]"),
    "drift": ("step", "head less its prediction [m]"),
    "vanishing": ("time [s]", "height less its truth [m]"),
    "balldrop": ("height [m]", "drop time [s]"),
}


def draw(runs: Sequence[Run], experiment: Kinds) -> list[Path]:
    """Draw the first data set of each kind, a picture for each: intervals by both learners."""
    first = [run for run in runs if "lines" in run]
    pairs = {
        kind: {run["learner"]: run["lines"] for run in first if run["kind"] == kind}
        for kind in experiment.axes["kind"]
    }
    return [_drawn(kind, pair, experiment.folder) for kind, pair in pairs.items() if len(pair) == 2]


def _drawn(kind: str, pair: dict[str, dict[str, list[float]]], folder: Path) -> Path:
    figure, axes = panels([*OPTIONS[kind]], 2, (4.3, 3.0))
    for ax, learner, color in zip(axes, ("plain", "option"), ("0.5", "#D55E00"), strict=True):
        line = {name: np.array(values) for name, values in pair[learner].items()}
        if kind in _LESS_TRUTH:
            line["data_y"] -= np.interp(line["data_x"], line["x"], line["truth"])
            line |= {name: line[name] - line["truth"] for name in ("low", "high", "truth")}
        low = line["low"].clip(1e-9) if kind in _LOGARITHMIC else line["low"]
        ax.fill_between(line["x"], low, line["high"], color=color, alpha=0.4, lw=0, label="95 %")
        ax.plot(line["x"], line["truth"], color="0.1", lw=1, label=_LINES.get(kind, "truth"))
        ax.plot(line["data_x"], line["data_y"], ".", color="#0072B2", ms=4, label="observations")
        if kind in _LOGARITHMIC:
            least = min(line["truth"].min(), line["data_y"].clip(1e-9).min())
            ax.set(yscale="log", ylim=(0.3 * least, 5 * line["truth"].max()))
        x, y = _AXES.get(kind, ("input", "output"))
        ax.set(xlabel=x, ylabel=y)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return save(figure, folder / f"{kind}.png")
