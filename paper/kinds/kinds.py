"""A small problem of each kind of data, by the option that is for it and by plain CKA.

Each kind is a function that draws its data and returns the predictions of a learner at points where
the truth is known, and those along a line for a picture. The problems, their sizes and what plain
means were taken from nine earlier experiments (``earlier.md``), of other seeds.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import (
    CKA,
    EmulatedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    Unknown,
    fit,
)
from gpadjust.core import SamplingWarning
from gpadjust.kinds import (
    Categories,
    HeavyTails,
    LinkedCKA,
    NoisyInputs,
    RelativeNoise,
    Vanishing,
    Window,
)
from gpadjust.physics import PhysicsWarning
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import Cell, groups, number, table
from paper.common.verdicts import paired
from paper.functions.problems import PROBLEMS
from paper.kinds import Kinds

DATA = Path(__file__).parent / "data" / "ball_drop"
_LINE = 61  # points of a picture


class Predicted(NamedTuple):
    """Predictions of a learner.

    Attributes:
        mean: Means ``n x 1``, or medians, in units in which errors count.
        low: Lower ends of 95 % intervals.
        high: Upper ends.
        truth: True values, or measured ones.
        lines: For a picture: ``x``, ``truth``, ``low`` and ``high`` along a line, and the ``data``.
        seconds: Of the fit.
    """

    mean: Tensor
    low: Tensor
    high: Tensor
    truth: Tensor
    lines: dict[str, Tensor]
    seconds: float


def _fitted(model: Any, seed: int = 0) -> float:
    """Fit a model; return the seconds."""
    begin = time.perf_counter()
    fit(model, seed=seed)
    return time.perf_counter() - begin


def _at(model: Any, test: Tensor, truth: Tensor, line: Tensor, data: Any, **more: Any) -> Predicted:
    """Fit a model, and predict the function at test points and along a line.

    Args:
        model: The model, before its fit.
        test: Test points ``n x d``.
        truth: The truth there, ``n x 1``.
        line: Points of a picture, and the truth there, as its last column.
        data: Inputs and outputs of the picture.
        more: ``column`` of the input that the picture has, if not the first.
    """
    seconds = _fitted(model)
    points, of_line, x = line[:, :-1], line[:, -1:], line[:, more.get("column", 0)]
    with torch.no_grad():
        mean, (low, high) = model.predict(test).mean, model.interval(test)
        ends = model.interval(points)
    lines = {"x": x, "truth": of_line, "low": ends[0], "high": ends[1]}
    lines |= {"data_x": data[0][:, more.get("column", 0)], "data_y": data[1]}
    return Predicted(mean, low, high, truth, lines, seconds)


def _line(function: Callable[[Tensor], Tensor], low: float = 0.0, high: float = 1.0) -> Tensor:
    """Points of one input with the truth as a further column."""
    x = torch.linspace(low, high, _LINE, dtype=torch.float64).unsqueeze(-1)
    return torch.cat([x, function(x)], -1)


def relative(option: bool, seed: int) -> Predicted:
    """Noise of 5 % of an output that grows by three decades; errors are of its logarithm."""
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
    """Two of forty observations are off by 10 to 100 sd."""
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
    """Inputs with an error of 5 % of their range; test inputs are exact."""
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
    """The current of a diode with a leak and a series resistance; errors are of its logarithm."""
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
    """The head of a pump by flow, speed and material."""
    return 20 * X[:, 1].square() - 4 * _CONSTANTS[X[:, 2].long()] * X[:, 0].square()


def categories(option: bool, seed: int) -> Predicted:
    """Pumps of three materials on rigs with an offset each; plain: their codes as numbers."""
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
    """The head of a pump that wears; the option is updated with each observation and forgets."""
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
    seconds = _fitted(model)
    if not option:
        parts = [model.predict(X[first:]).mean, *model.interval(X[first:])]
    else:
        begin, rows, window = time.perf_counter(), [], Window(model, first)
        for i in range(first, steps):
            x, y = X[i : i + 1], Y[i : i + 1]
            rows.append([window.predict(x).mean, *window.interval(x)])
            window.update(x, y)
        parts = [torch.cat(column) for column in zip(*rows, strict=True)]
        seconds += time.perf_counter() - begin
    after = torch.arange(first, steps).double()
    lines = {"x": after, "truth": truth[first:] - parts[0]}
    lines |= {"low": parts[1] - parts[0], "high": parts[2] - parts[0]}
    lines |= {"data_x": after, "data_y": Y[first:] - parts[0]}
    return Predicted(parts[0], parts[1], parts[2], truth[first:], lines, seconds)


def vanishing(option: bool, seed: int) -> Predicted:
    """Gravity of a ball in air: f_p has no drag, which is small at first; plain: a free delta."""
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
    """Currin's function; its low level is known by 40 runs. Plain: their emulator is exact."""
    problem = PROBLEMS["currin"]
    X, runs = problem.points(10, seed), problem.points(40, 20_000 + seed)
    low = EmulatedPhysics(runs, problem.physics(runs))
    test = problem.points(400, 1)
    physics = low if option else FunctionPhysics(low)
    line = torch.full((_LINE, 2), 0.5, dtype=torch.float64)
    line[:, 0] = torch.linspace(0, 1, _LINE)
    line = torch.cat([line, problem.truth(line)], -1)
    model = CKA(X, problem.truth(X), physics=physics)
    return _at(model, test, problem.truth(test), line, (X[:0], X[:0, :1]))


_UNKNOWNS = {"C_D": Unknown(1.1, bounds=(0.2, 2.0)), "g": Unknown(10.0, bounds=(8.0, 12.0))}
_SOFTBALL = 0.0485  # m, its radius


def _drop_time(X: Tensor) -> Tensor:
    """The formula that the runs follow, with drag and gravity at the middle of their priors."""
    k = 3 * 1.1 * 1.184 / (8 * X[:, 0] * X[:, 1])
    return torch.acosh((k * X[:, 2]).exp()) / (10.0 * k).sqrt()


def balldrop(option: bool, seed: int) -> Predicted:
    """Times of a softball, by those of three other balls and 80 runs of a simulator.

    Data, runs and priors are those of the documentation of SEPIA (lanl/SEPIA at 3098904, notebook
    `ball_drop_2`). Plain: their formula with guesses of drag and gravity, adjusted by CKA.
    """
    field, design = pd.read_csv(DATA / "field.csv"), pd.read_csv(DATA / "design.csv").head(80)
    times, heights = pd.read_csv(DATA / "runs.csv").to_numpy(), range(10, 61, 10)
    rows = [[d.R_ball, d.rho_ball, h, d.C_D, d.g] for d in design.itertuples() for h in heights]
    outputs = [[times[h, i]] for i in range(len(design)) for h in heights]
    begin = time.perf_counter()
    physics: Any = _drop_time
    if option:
        physics = EmulatedPhysics(
            np.array(rows), np.array(outputs), unknowns=_UNKNOWNS, fit_options={"seed": seed}
        )
    seconds = time.perf_counter() - begin
    X, Y, sd = (
        torch.from_numpy(field[columns].to_numpy(dtype=float, copy=True))
        for columns in (["R_ball", "rho_ball", "height"], ["time"], ["sd"])
    )
    out = X[:, 0] == _SOFTBALL
    structure: Any = PhysicsMeanGP if option else CKA
    model = structure(X[~out], Y[~out], sd[~out].square(), physics=physics)
    seconds += _fitted(model, seed)
    height = torch.linspace(10, 60, _LINE, dtype=torch.float64)[:, None]
    ball = torch.cat([X[out][:1, :2].repeat(_LINE, 1), height], -1)
    with torch.no_grad():
        parts = [model.predict(X[out]).mean, *model.interval(X[out], observation_noise=True)]
        ends, mean = model.interval(ball), model.predict(ball).mean
    lines = {"x": height, "truth": mean, "low": ends[0], "high": ends[1]}
    lines |= {"data_x": X[out][:, 2], "data_y": Y[out]}
    return Predicted(parts[0], parts[1], parts[2], Y[out], lines, seconds)


KINDS: Mapping[str, Callable[[bool, int], Predicted]] = {
    "relative": relative,
    "outliers": outliers,
    "noisy_inputs": noisy_inputs,
    "links": links,
    "categories": categories,
    "drift": drift,
    "vanishing": vanishing,
    "emulated": emulated,
    "balldrop": balldrop,
}
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
    for category in (SamplingWarning, PhysicsWarning):
        warnings.simplefilter("ignore", category)
    found = KINDS[kind](learner == "option", 500 + seed)
    off = found.mean - found.truth
    inside = (found.low <= found.truth) & (found.truth <= found.high)
    results: Run = {
        "error": off.square().mean().sqrt().item(),
        "coverage": inside.double().mean().item(),
        "width": (found.high - found.low).mean().item(),
        "seconds": found.seconds,
    }
    if seed == experiment.seed:
        results["lines"] = {name: part.flatten().tolist() for name, part in found.lines.items()}
    return results


def tables(runs: Sequence[Run], experiment: Kinds) -> dict[str, Table]:
    """A row for each kind."""
    found = pd.DataFrame([{k: v for k, v in run.items() if k != "lines"} for run in runs])

    def of(column: str, learner: str, how: str, form: str) -> Cell:
        return lambda part: number(part[part["learner"] == learner][column].agg(how), form)

    def ratio(part: pd.DataFrame) -> str:
        return paired(part, "error", "learner", "option", "plain", ratio=True).ratio()

    def better(part: pd.DataFrame) -> str:
        wide = part.pivot_table(index="seed", columns="learner", values="error").dropna()
        if len(wide.columns) < 2:
            return ""
        return f"{(wide['option'] < wide['plain']).sum()} of {len(wide)}"

    columns: dict[str, Cell] = {
        "plain": lambda part: OPTIONS[part["kind"].iloc[0]][0],
        "option": lambda part: f"`{OPTIONS[part['kind'].iloc[0]][1]}`",
        "median error, plain": of("error", "plain", "median", ".2g"),
        "median error, option": of("error", "option", "median", ".2g"),
        "error, option / plain": ratio,
        "option better": better,
        "95 % hold, plain": of("coverage", "plain", "mean", ".2f"),
        "95 % hold, option": of("coverage", "option", "mean", ".2f"),
        "seconds, plain": of("seconds", "plain", "median", ".1f"),
        "seconds, option": of("seconds", "option", "median", ".1f"),
    }
    text = table(groups(found, "kind", experiment.axes["kind"]), columns, "data")
    return {"kinds": Table("Each kind of data, by its option and by plain CKA", text)}


_LOGARITHMIC = ("relative", "links")
_AXES = {
    "links": ("voltage [V]", "current [A]"),
    "categories": ("flow, of one material on one rig", "head [m]"),
    "drift": ("step", "head less its prediction [m]"),
    "vanishing": ("time [s]", "height [m]"),
    "balldrop": ("height [m]", "drop time [s]"),
}


def draw(runs: Sequence[Run], experiment: Kinds) -> list[Path]:
    """Draw the first data set of each kind, a picture for each: intervals by both learners."""
    files = []
    for kind in experiment.axes["kind"]:
        shown = {
            run["learner"]: run["lines"] for run in runs if run["kind"] == kind and "lines" in run
        }
        if len(shown) < 2:
            continue
        figure, axes = panels([*OPTIONS[kind]], 2, (4.3, 3.0))
        for ax, learner, color in zip(axes, ("plain", "option"), ("0.5", "#D55E00"), strict=True):
            of = {name: np.array(values) for name, values in shown[learner].items()}
            least = 1e-9 if kind in _LOGARITHMIC else -np.inf
            ax.fill_between(of["x"], of["low"].clip(least), of["high"], color=color, alpha=0.4,
                            lw=0, label="95 %")  # fmt: skip
            ax.plot(of["x"], of["truth"], color="0.1", lw=1, label="truth")
            ax.plot(of["data_x"], of["data_y"], ".", color="#0072B2", ms=4, label="observations")
            if kind in _LOGARITHMIC:
                low = min(of["truth"].min(), of["data_y"].clip(1e-9).min())
                ax.set(yscale="log", ylim=(0.3 * low, 5 * of["truth"].max()))
            x, y = _AXES.get(kind, ("input", "output"))
            ax.set(xlabel=x, ylabel=y)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        files.append(save(figure, experiment.folder / f"{kind}.png"))
    return files
