"""The paper's models by two protocols; the paper's claims, and its figure 1.

"Slightly" is within 20 %, "about 30 %" 20 to 40 %, "about 50 %" 40 to 60 %; beyond, in the claim's
favor, a claim of "about" is beaten, and one of "slightly" is not reproduced. Differences are paired
by data set and relative to the mean of what they are compared with; a claim is inconclusive if its
bound lies in their 95 % interval (of Student's t; of spreads by the bootstrap). Best is who is not
above the lowest mean by more than this interval. The paper does not
say what it took for its settings: F6 is undetermined under its protocol if other steps and noise
variances give other verdicts, F7 if the closed form does with the lengthscales and ridges of its
grid. U1 is the claim of the paper's abstract, by the distance of coverage from 95 %.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from botorch.models import SingleTaskGP
from botorch.models.model import Model
from botorch.settings import validate_input_scaling
from gpytorch.kernels import Kernel, RBFKernel, RFFKernel, ScaleKernel
from gpytorch.means import ZeroMean
from gpytorch.mlls import ExactMarginalLogLikelihood
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch import Tensor
from torch.nn import functional

from gpadjust import RRA, fit
from gpadjust.gpytorch import PhysicsMean, PhysicsScaledKernel
from gpadjust.validation import Scores
from paper.common.experiment import Run, Table
from paper.common.figures import save, strips
from paper.common.learners import LEARNERS, LITERAL
from paper.common.tables import across, claims_table, frame, groups, markdown, of, table
from paper.common.verdicts import Difference, Judged, Verdict, all_of, bootstrap, reproduced, within
from paper.forrester import GRID, OTHER, PROTOCOLS, READINGS, Forrester
from paper.forrester.paper_rra import PaperRRA
from paper.forrester.problem import CRUDE, LOWER, POINTS, UPPER, observations, truth

MODELS = {
    "Zero-mean GP": "gp",
    "Phy-mean GP": "phymean",
    "GP-bias": "bias",
    "GP-scale": "scale",
    "AR1": "ar1",
    "CKA": "literal",
    "RRA": "rra",
}
"""By the paper's names, those of the registry."""
NAMES = [*MODELS]
FIRST_LOOK = 3  # data sets
_SCORES = ("nlpd", "crps", "coverage")
_ABOUT_HALF = (0.4, 0.6)  # below the physics mean
_EXACT = 1e-5  # the noise of the low level of AR1, a share of its variance
_STEPS, _NOISES = (25, 50, 100), (1e-4, 1e-2)  # of the other settings


@cache
def _prepare(settings: Forrester) -> None:
    """Set a process up: one fit that is not timed."""
    trained("CKA", "gpadjust", "B", *observations(0, settings.observations), settings)


def run(experiment: Forrester, reading: str, protocol: str, seed: int) -> Run:
    """Train all models of a protocol on a data set.

    Returns:
        For each model, and for f_p, its name, its scores and the seconds that it took.
    """
    settings = experiment
    _prepare(settings)
    X, Y = observations(seed, settings.observations)
    y = truth(POINTS)
    rows: list[dict[str, Any]] = [
        {"model": "f_p", "rmse": (CRUDE[reading](POINTS) - y).square().mean().sqrt().item()}
        | dict.fromkeys([*_SCORES, "seconds"])
    ]
    for name, model, seconds in _models(reading, protocol, X, Y, settings):
        with torch.no_grad():
            posterior = model.posterior(POINTS, observation_noise=True)
            scores = Scores.compute(posterior.mean, posterior.variance, y)
        shown = ("rmse", *_SCORES) if protocol in PROTOCOLS else ("rmse",)
        judged = dict.fromkeys(_SCORES) | {name: getattr(scores, name).item() for name in shown}
        rows.append({"model": name, **judged, "seconds": seconds})
    return {column: [row[column] for row in rows] for column in rows[0]}


def _models(
    reading: str, protocol: str, X: Tensor, Y: Tensor, settings: Forrester
) -> Iterator[tuple[str, Model, float]]:
    """Each model of a protocol, its name first, and the seconds that it took."""
    if protocol == GRID:
        for lengthscale in settings.lengthscales:
            for ridge in settings.ridges:
                model = closed_form(reading, X, Y, (lengthscale, lengthscale), ridge)
                yield f"{lengthscale:g}, {ridge:g}", model, 0.0
        return
    if protocol == OTHER:
        for steps, noise in product(_STEPS, _NOISES):
            changed = replace(settings, steps=steps, noise=noise)
            for name in ("Phy-mean GP", "CKA"):
                model = trained(name, "paper", reading, X, Y, changed)
                yield f"{name}, {steps}, {noise:g}", model, 0.0
        return
    for name in MODELS:
        start = time.perf_counter()
        model = trained(name, protocol, reading, X, Y, settings)
        yield name, model, time.perf_counter() - start


def closed_form(
    reading: str, X: Tensor, Y: Tensor, lengthscales: tuple[float, float], ridge: float
) -> PaperRRA:
    """RRA as printed, with nothing learnt, by the lengthscales of rho and delta."""
    model = PaperRRA(X, Y, torch.full_like(Y, ridge), physics=CRUDE[reading])
    names = ("rho.kernel.lengthscale", "delta.kernel.lengthscale")
    values = {name: X.new_tensor(each) for name, each in zip(names, lengthscales, strict=True)}
    model.set_draws(model.table.with_values(model.u.detach(), values))
    return model


def trained(
    name: str, protocol: str, reading: str, X: Tensor, Y: Tensor, settings: Forrester
) -> Model:
    """Build one of the models and train it by a protocol."""
    if protocol == "paper":
        return _by_gpytorch(name, reading, X, Y, settings)
    options: dict[str, Any] = {"low_X": POINTS} if name == "AR1" else {}
    options |= LITERAL if name == "RRA" else {}
    model: Any = LEARNERS[MODELS[name]].make(X, Y, physics=CRUDE[reading], **options)
    fit(model, "map")
    return model


def _by_gpytorch(name: str, reading: str, X: Tensor, Y: Tensor, settings: Forrester) -> Model:
    """Train a model of plain GPyTorch: its initial values, y as it is."""
    one, other = (ScaleKernel(RBFKernel()) for _ in range(2))
    if name == "RRA":
        one, other = (RFFKernel(64, num_dims=1) for _ in range(2))
        printed: Any = closed_form(reading, X, Y, (1.0, 1.0), settings.noise)
        for kernel, term in zip((one, other), printed.terms, strict=True):
            kernel.randn_weights = term.kernel.frequencies
    physics, variances = CRUDE[reading], torch.full_like(Y, settings.noise)
    scaled = PhysicsScaledKernel(one, physics)
    kernels = {"GP-scale": scaled, "CKA": scaled + other, "RRA": scaled + other}
    options = {
        "covar_module": kernels.get(name, one),
        "mean_module": ZeroMean() if name in ("Zero-mean GP", "RRA") else PhysicsMean(physics),
        "outcome_transform": None,
    }
    if name == "AR1":
        options |= {"covar_module": _Levels(one, other), "mean_module": ZeroMean()}
        low, high = (functional.pad(x, (0, 1), value=v) for x, v in ((POINTS, 0.0), (X, 1.0)))
        low_Y = physics(POINTS)
        X, Y = torch.cat([low, high]), torch.cat([low_Y, Y])
        variances = torch.cat([(_EXACT * low_Y.var()).expand_as(low_Y), variances])
    with validate_input_scaling(False):
        model = (_AR1 if name == "AR1" else SingleTaskGP)(X, Y, variances, **options)
    mll = ExactMarginalLogLikelihood(model.likelihood, model.double()).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.rate)
    for _ in range(settings.steps):
        optimizer.zero_grad()
        loss = -mll(model(*model.train_inputs), model.train_targets)
        loss.backward()
        optimizer.step()
    if name == "RRA":
        lengthscales = (one.lengthscale.item(), other.lengthscale.item())
        return closed_form(reading, X, Y, lengthscales, settings.noise)
    return model.eval()


class _Levels(Kernel):
    """The kernel of AR1 of inputs with their level, 0 or 1, as last column."""

    def __init__(self, low: Kernel, delta: Kernel) -> None:
        super().__init__()
        self.low, self.delta = low, delta
        self.rho = torch.nn.Parameter(torch.ones(()))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **_: Any) -> Tensor:
        (x1, level1), (x2, level2) = ((x[..., :-1], x[..., -1:]) for x in (x1, x2))
        K: Tensor = self.rho**level1 * self.low(x1, x2).to_dense() * (self.rho**level2).mT
        K = K + level1 * self.delta(x1, x2).to_dense() * level2.mT
        return K.diagonal(dim1=-1, dim2=-2) if diag else K


class _AR1(SingleTaskGP):
    """AR1 of plain GPyTorch, which predicts the level 1."""

    def posterior(self, X: Tensor, *args: Any, **options: Any) -> Any:
        return super().posterior(functional.pad(X, (0, 1), value=1.0), *args, **options)


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """The scores: a row for each reading, protocol, seed and model."""
    columns = ("rmse", *_SCORES, "seconds")
    return frame(runs, ("model", *columns)).astype(dict.fromkeys(columns, float))


def first_look(runs: Sequence[Run]) -> str | None:
    """The errors on the first data sets."""
    found = load(runs)
    found = found[(found["reading"] == "B") & found["protocol"].isin([*PROTOCOLS])]
    sets = found.groupby("protocol")["seed"].nunique()
    if len(sets) < 2 or sets.min() < FIRST_LOOK:
        return None
    return f"The first {sets.min()} data sets, reading B\n\n" + errors(found)


def tables(runs: Sequence[Run], experiment: Forrester) -> dict[str, Table]:
    """All tables, by name."""
    scored = load(runs)
    of_both = scored[scored["protocol"].isin([*PROTOCOLS])]
    there = [name for name in READINGS if name in {*of_both["reading"]}]
    by_reading = {reading: scored[scored["reading"] == reading] for reading in there}
    grids = [scored[scored["protocol"] == name] for name in (GRID, OTHER)]
    found = {
        "rmse": Table("Reading B, mean / median RMSE", errors(scored[scored["reading"] == "B"]))
    }
    columns = {
        "RMSE mean": of("rmse"),
        "sd": of("rmse", "std"),
        "median": of("rmse", "median"),
        "NLPD": of("nlpd"),
        "CRPS": of("crps"),
        "coverage": of("coverage"),
        "fit, s": of("seconds", "median"),
    }
    for reading, part in by_reading.items():
        for protocol in _there(part):
            title = f"Reading {reading} of the crude function, protocol {protocol}"
            own = part[part["protocol"] == protocol]
            found[f"{reading}:{protocol}"] = Table(title, table(groups(own, "model"), columns))
    for reading, part in by_reading.items():
        judged = {
            f"protocol {p}": judge(
                part[part["protocol"] == p], *(grids if (reading, p) == ("B", "paper") else ())
            )
            for p in _there(part)
        }
        title = f"Claims, on reading {reading}"
        found[f"claims-{reading}"] = Table(title, claims_table("claim", judged))
    title = "The closed form of RRA, reading B: mean RMSE less that of Phy-mean GP"
    of_paper = _wide(scored[scored["reading"] == "B"], "paper")
    found["grid"] = Table(title, _grid(_closed_form(of_paper, grids[0])))
    title = "CKA under the paper's protocol, reading B: mean RMSE less that of Phy-mean GP"
    found["settings-of-CKA"] = Table(title, _grid(_other_settings(grids[1]), "steps", "noise"))
    return found


def _there(runs: pd.DataFrame) -> list[str]:
    """The protocols that there are runs of."""
    return [name for name in PROTOCOLS if name in {*runs["protocol"]}]


def errors(runs: pd.DataFrame) -> str:
    """Mean and median errors of one reading, a column for each protocol."""

    def both(part: pd.DataFrame) -> str:
        return f"{part['rmse'].mean():.3g} / {part['rmse'].median():.3g}"

    known = runs[runs["protocol"].isin([*PROTOCOLS])]
    columns = across(known, "protocol", PROTOCOLS, both)
    return table(groups(known, "model"), columns, "mean / median RMSE")


def judge(
    runs: pd.DataFrame, grid: pd.DataFrame | None = None, other: pd.DataFrame | None = None
) -> list[Judged]:
    """Judge the claims on the runs of one reading and protocol.

    Args:
        runs: Of all models.
        grid: Of the closed form, if it is to be judged whether F7 is determined.
        other: Of other settings, if it is to be judged whether F6 is.
    """
    rmse = runs.pivot(index="seed", columns="model", values="rmse")
    mean, sd = rmse.mean(), rmse.std()

    def change(model: str, reference: str = "Phy-mean GP") -> Difference:
        return Difference.of(rmse[model] - rmse[reference]) / mean[reference]

    def below(found: Difference, least: float, most: float) -> Verdict:
        verdict = within(found, high=-least)
        return "beaten" if verdict == "reproduced" and found.mean < -most else verdict

    def wider(model: str, reference: str) -> Verdict:
        if sd[model] == 0 or sd[reference] == 0 or len(rmse) < 4:
            return reproduced(sd[model] > sd[reference])
        low, high = bootstrap(
            [rmse[model], rmse[reference]],
            lambda x, y, axis: np.std(x, axis=axis, ddof=1) - np.std(y, axis=axis, ddof=1),
            paired=True,
        )
        return "reproduced" if low > 0 else "not reproduced" if high < 0 else "inconclusive"

    gap = (rmse["GP-bias"] - rmse["Phy-mean GP"]).abs().max()
    best = mean[NAMES].idxmin()
    among_best = best == "RRA" or Difference.of(rmse["RRA"] - rmse[best]).low <= 0
    f7 = below(change("RRA"), *_ABOUT_HALF) if among_best else "not reproduced"
    f7_text = f"{change('RRA').text('.1%')}; the best is {best}"
    if best != "RRA" and among_best:
        f7_text += ", within the interval of their difference"
    if grid is not None and len(grid):
        changes = [part.mean for part in _closed_form(rmse, grid).values()]
        f7_text += f"; the closed form gives {min(changes):+.0%} to {max(changes):+.0%} on the grid"
        if min(changes) <= -_ABOUT_HALF[0] <= max(changes):
            f7 = "undetermined"
    f6, f6_text = below(change("CKA"), 0.2, 0.4), change("CKA").text(".1%")
    if other is not None and len(other):
        each = _other_settings(other)
        means = [difference.mean for difference in each.values()]
        f6_text += f"; {max(means):+.0%} to {min(means):+.0%} with other steps and noise"
        if any(below(difference, 0.2, 0.4) != f6 for difference in each.values()):
            f6 = "undetermined"
    zero, scaled = change("Zero-mean GP", "f_p"), change("GP-scale", "Zero-mean GP")
    spread = f"sd {sd['GP-scale']:.3g} against {sd['Zero-mean GP']:.3g}"
    return [
        Judged(
            "F1",
            "zero-mean GP slightly below f_p",
            within(zero, -0.2, 0),
            f"{zero.text('.1%')} of f_p's RMSE",
        ),
        Judged(
            "F2",
            "GP-scale slightly below zero-mean GP, with the larger spread",
            all_of(within(scaled, -0.2, 0), wider("GP-scale", "Zero-mean GP")),
            f"{scaled.text('.1%')}, {spread}",
        ),
        Judged(
            "F3",
            "Phy-mean GP and GP-bias are the same model",
            reproduced(bool(gap <= 1e-9)),
            f"RMSEs differ by {gap:.1g} at most (an identity of the two models)",
        ),
        Judged(
            "F4",
            "Phy-mean GP and AR1 below GP-scale",
            all_of(*(within(change(m, "GP-scale"), high=0) for m in ("Phy-mean GP", "AR1"))),
            f"{mean['Phy-mean GP']:.3g} and {mean['AR1']:.3g} against {mean['GP-scale']:.3g}",
        ),
        Judged(
            "F5",
            "AR1 has the largest spread of Phy-mean GP, GP-bias and AR1",
            wider("AR1", "Phy-mean GP"),
            f"sd {sd['AR1']:.3g} against {sd['Phy-mean GP']:.3g}",
        ),
        Judged("F6", "CKA about 30 % below Phy-mean GP", f6, f6_text),
        Judged("F7", "RRA about 50 % below Phy-mean GP, the best", f7, f7_text),
        *_uncertainty(runs),
    ]


def _uncertainty(runs: pd.DataFrame) -> list[Judged]:
    """U1, if there are the scores that it is about."""
    if not {"coverage", "nlpd"} <= {*runs}:
        return []
    coverage, density = (
        runs.pivot(index="seed", columns="model", values=score) for score in ("coverage", "nlpd")
    )
    away, found, said = (coverage - 0.95).abs(), [], []
    for ours in ("CKA", "RRA"):
        for name, label in (("Zero-mean GP", "GP"), ("AR1", "AR1")):
            nearer = Difference.of(away[ours] - away[name])
            found.append(within(nearer, high=0))
            less = Difference.of(density[ours] - density[name])
            said.append(f"{ours} - {label} {nearer.text()} (NLPD {less.text('.2f')})")
    text = "CKA and RRA quantify uncertainty more accurately than GP and AR1"
    return [
        Judged("U1", text, all_of(*found), f"distance of coverage from 95 %: {', '.join(said)}")
    ]


def _wide(runs: pd.DataFrame, protocol: str) -> pd.DataFrame:
    """The errors of a protocol: a row for each seed, a column for each model."""
    chosen = runs[runs["protocol"] == protocol]
    return chosen.pivot(index="seed", columns="model", values="rmse")


def _closed_form(rmse: pd.DataFrame, grid: pd.DataFrame) -> dict[str, Difference]:
    """The change of each cell of the grid from the physics mean."""
    if grid.empty or rmse.empty:
        return {}
    cells = _wide(grid, GRID).drop(columns="f_p")
    reference = rmse["Phy-mean GP"]
    return {str(cell): Difference.of(cells[cell] - reference) / reference.mean() for cell in cells}


def _other_settings(runs: pd.DataFrame) -> dict[str, Difference]:
    """The change of CKA from the physics mean with each of the other settings."""
    rmse = _wide(runs, OTHER) if len(runs) else pd.DataFrame()
    pairs = {name.removeprefix("CKA, "): name for name in rmse if name.startswith("CKA, ")}
    beside = {cell: rmse[f"Phy-mean GP, {cell}"] for cell in pairs}
    return {
        cell: Difference.of(rmse[name] - beside[cell]) / beside[cell].mean()
        for cell, name in pairs.items()
    }


def _grid(found: dict[str, Difference], row: str = "lengthscale", column: str = "ridge") -> str:
    """A table of changes, whose names are those of a row and of a column."""
    if not found:
        return "No results yet."
    names = sorted((cell.split(", ") for cell in found), key=lambda name: [*map(float, name)])
    columns = list(dict.fromkeys(second for _, second in names))
    rows = [
        [first, *(found[f"{first}, {second}"].text(".0%") for second in columns)]
        for first in dict.fromkeys(first for first, _ in names)
    ]
    return markdown([row, *(f"{column} {second}" for second in columns)], rows)


def draw(runs: Sequence[Run], experiment: Forrester) -> list[Path]:
    """Draw the paper's figure, of its protocol and reading B: six fits, and all errors."""
    scored = load(runs)
    own = scored[(scored["protocol"] == "paper") & (scored["reading"] == "B")]
    if own.empty:
        return []
    figure = Figure(figsize=(13, 6), layout="constrained")
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [["a", "b", "c", "g"], ["d", "e", "f", "g"]], width_ratios=[1, 1, 1, 1.2]
    )
    names = [name for name in NAMES if name != "GP-bias"]
    for letter, name in zip("abcdef", names, strict=True):
        _fit_panel(axes[letter], name, "paper", experiment)
        axes[letter].set_title(f"({letter}) {name}", loc="left")
        axes[letter].set(xlabel="x" * (letter in "def"), ylabel="y" * (letter in "ad"))
    figure.legend(*axes["a"].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    rows = {name: part["rmse"] for name, part in groups(own, "model").items()}
    strips(axes["g"], rows, "tab:blue")
    axes["g"].set_xscale("log")
    axes["g"].xaxis.set_minor_formatter(NullFormatter())
    axes["g"].set_xlabel("RMSE; each run, median and quartiles")
    axes["g"].set_title(f"(g) {own['seed'].nunique()} runs", loc="left")
    return [save(figure, experiment.folder / "forrester_paper.png")]


def _fit_panel(ax: Axes, name: str, protocol: str, settings: Forrester, seed: int = 3) -> None:
    """Draw one model of the data set of a seed."""
    x = torch.linspace(LOWER, UPPER, 200, dtype=torch.float64).unsqueeze(-1)
    X, Y = observations(seed, settings.observations)
    model = trained(name, protocol, "B", X, Y, settings)
    with torch.no_grad():
        posterior = model.posterior(x, observation_noise=True)
        mean, sd = posterior.mean.squeeze(-1), posterior.variance.sqrt().squeeze(-1)
    ax.fill_between(
        x.squeeze(-1), mean - 2 * sd, mean + 2 * sd, color="navy", alpha=0.15, lw=0, label="2 sd"
    )
    if isinstance(model, RRA):
        torch.manual_seed(seed)
        functions = model.sample_functions(20)(x).squeeze(-1)
        ax.plot(x.squeeze(-1), functions.mT, color="navy", lw=0.4, alpha=0.6)
    ax.plot(x, CRUDE["B"](x), color="black", ls="--", lw=1, label="f_p")
    ax.plot(x.squeeze(-1), mean, color="tab:blue", lw=3.5, label="mean")
    ax.plot(x, truth(x), color="black", lw=1, label="truth")
    ax.plot(X, Y, "o", color="red", ms=4, label="data")
    ax.set_ylim(-9, 9)
