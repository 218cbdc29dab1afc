"""Six problems in the unit cube, the search for their optima, and regrets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from botorch.acquisition import qLogExpectedImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.model import Model
from botorch.models.transforms import Standardize
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import fit
from gpadjust.checks import seeded
from gpadjust.validation.comparison import relevance_of
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, frame, groups, markdown, of
from paper.functions.problems import Problem
from paper.misled import Misled

METHODS = Misled.axes["method"]
_FOUND = 1.0  # per cent: where the optimum counts as found
_LOST = 5.0  # per cent

_GRID = 2**16  # points at which the range is looked for


def _peak(X: Tensor, middle: list[float], widths: list[float], height: float) -> Tensor:
    away = (X - X.new_tensor(middle)) / X.new_tensor(widths)
    return height * (-0.5 * away.square().sum(-1)).exp()


def _reactor(X: Tensor, rate: float, loss: float, energy: float) -> Tensor:
    """Return the yield of B in A -> B -> C, in per cent, by time (0.2-5 h) and K (300-360)."""
    time, heat = 0.2 + 4.8 * X[:, 0], (X[:, 1] * 60 - 30) / 330
    one, two = rate * (4 * heat).exp(), loss * (energy * heat).exp()
    return 100 * one / (two - one) * ((-one * time).exp() - (-two * time).exp())


def _column(X: Tensor, shift: float, curvature: float) -> Tensor:
    """Return the profit of a column by reflux, feed and pressure."""
    best = X.new_tensor([0.35 + shift, 0.6 - shift, 0.75])
    return 20 - (curvature * (X - best).square() * X.new_tensor([40.0, 25.0, 30.0])).sum(-1)


# Functions and their physics map rows to n values.
PROBLEMS = {
    "moved peak": Problem(
        2,
        lambda X: _peak(X, [0.3, 0.7], [0.13, 0.15], 60) + 5 * X[:, 1],
        lambda X: _peak(X, [0.75, 0.3], [0.2, 0.2], 55) + 4 * X[:, 0],
        0.3,
    ),
    "moved ridge": Problem(
        2,
        lambda X: 30 * (-((X[:, 0] + X[:, 1] - 1.4) / 0.25).square()).exp() + 6 * X[:, 0],
        lambda X: 30 * (-((X[:, 0] - X[:, 1] + 0.3) / 0.3).square()).exp(),
        0.2,
    ),
    "unrelated": Problem(
        2,
        lambda X: 8 * (4 * X[:, 0] + 1).sin() * (3 * X[:, 1]).cos() + 6 * X[:, 0] * X[:, 1],
        lambda X: 9 * (8 * X[:, 0] * X[:, 1] + 2).cos() - 3 * X[:, 1],
        0.1,
    ),
    "reactor": Problem(
        2,
        lambda X: _reactor(X, 0.9, 0.25, 12.0) - 3 * (math.pi * X[:, 0]).sin(),
        lambda X: _reactor(X, 1.1, 0.2, 10.0),
        0.5,
    ),
    "column": Problem(
        3,
        lambda X: _column(X, 0.0, 1.0) + 1.5 * (5 * X[:, 0] + 2 * X[:, 2]).sin(),
        lambda X: _column(X, 0.08, 0.8),
        0.1,
    ),
    "mixture": Problem(
        4,
        lambda X: _peak(X, [0.7, 0.3, 0.5, 0.6], [0.35, 0.3, 0.4, 0.35], 40) + 4 * X[:, 3],
        lambda X: _peak(X, [0.64, 0.36, 0.55, 0.55], [0.4, 0.35, 0.4, 0.4], 33),
        0.2,
    ),
}


def run(experiment: Misled, problem: str, method: str, seed: int) -> Run:
    """Search for an optimum; regrets after each trial, in per cent of the function's range."""
    given = PROBLEMS[problem]
    d, generator = given.num_inputs, torch.Generator().manual_seed(seed)

    def observed(X: Tensor) -> Tensor:
        noise = torch.randn(len(X), generator=generator, dtype=X.dtype)
        return (given.truth(X) + given.noise * noise).unsqueeze(-1)

    sobol = SobolEngine(d, scramble=True, seed=seed)
    X = sobol.draw(experiment.initial, dtype=torch.float64)
    Y, best, size = observed(X), *_range(given)
    regrets, relevance = [], []
    bounds = torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, d)
    for trial in range(experiment.trials):
        model, weight = _fitted(method, X, Y, given)
        sampler = SobolQMCNormalSampler(torch.Size([experiment.mc_samples]), seed=trial)
        acquisition = qLogExpectedImprovement(model, Y.max(), sampler)
        with seeded(100 * seed + trial):
            chosen, _ = optimize_acqf(
                acquisition,
                bounds=bounds,
                q=1,
                num_restarts=experiment.restarts,
                raw_samples=experiment.raw_samples,
            )
        X, Y = torch.cat([X, chosen]), torch.cat([Y, observed(chosen)])
        regrets.append(100 * float(best - given.truth(X).max()) / size)
        relevance.append(weight)
    return {"regrets": regrets} | ({"relevance": relevance} if None not in relevance else {})


def _range(problem: Problem) -> tuple[float, float]:
    """Return the largest value of a function, and how far it is above the least."""
    engine = SobolEngine(problem.num_inputs, scramble=True, seed=0)
    X = engine.draw(_GRID, dtype=torch.float64)
    values = problem.truth(X)
    best, spread = X[values.argmax()], 0.05
    for _ in range(6):  # ever nearer to it
        near = (best + spread * (X - 0.5)).clamp(0, 1)
        found = problem.truth(near)
        if found.max() > problem.truth(best.unsqueeze(0)):
            best = near[found.argmax()]
        spread *= 0.3
    highest = float(problem.truth(best.unsqueeze(0)))
    return highest, highest - float(values.min())


def _fitted(method: str, X: Tensor, Y: Tensor, problem: Problem) -> tuple[Model, float | None]:
    """Return a model, and the probability that its physics is of use, if it has one."""
    if method == "stgp":
        plain = SingleTaskGP(X, Y, outcome_transform=Standardize(1))
        fit_gpytorch_mll(ExactMarginalLogLikelihood(plain.likelihood, plain))
        return plain, None
    name = {"zero": "gp", "physics-mean": "phymean"}.get(method, method)
    made = LEARNERS[name].make(X, Y, physics=lambda X: problem.physics(X).unsqueeze(-1))
    relevance = relevance_of(made, fit(made))
    return made, relevance[0] if relevance else None


def tables(runs: Sequence[Run], experiment: Misled) -> dict[str, Table]:
    """Return all tables, by name."""
    found = frame(runs)
    found["last"] = [regrets[-1] for regrets in found["regrets"]]
    # A search without a trial below 1 % finds the optimum never.
    found["found"] = [
        next((i + 1.0 for i, each in enumerate(regrets) if each < _FOUND), math.inf)
        for regrets in found["regrets"]
    ]
    found["use"] = [run.get("relevance", [None])[-1] for run in runs]
    columns: dict[str, Cell] = {
        "runs": len,
        "median regret, %": of("last", "median", ".2g"),
        "worst, %": of("last", "max", ".2g"),
        "above 5 %": lambda own: (own["last"] > _LOST).sum(),
        "trials to 1 %": lambda own: of("found", "median", "g")(own).replace("inf", "never"),
        "use": of("use", "median", ".2g"),
    }
    rows: list[list[str]] = []
    for problem, part in groups(found, "problem", Misled.axes["problem"]).items():
        for method, own in groups(part, "method", METHODS).items():
            label = "" if problem in (row[0] for row in rows) else problem
            rows.append([label, method, *(str(cell(own)) for cell in columns.values())])
    return {"regrets": Table("Regret after all trials", markdown(["", "", *columns], rows))}
