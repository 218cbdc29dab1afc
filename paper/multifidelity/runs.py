"""All methods on all data sets."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from torch import Tensor

from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.grid import run_grid
from paper.multifidelity.models import METHODS, trained
from paper.multifidelity.problem import observations, pair, test_points

_CHUNK = 50  # points predicted jointly, for the sake of memory
SIZES = (5, 10)  # observations per input


@cache
def _prepare(method: str) -> None:
    """Set a process up: one thread, and one fit of the method that is not timed."""
    torch.set_num_threads(1)
    forrester = pair("forrester")
    trained(method, forrester, *observations(forrester, 5, 0), 0)


def run_one(name: str, per_input: int, seed: int, method: str) -> list[dict[str, Any]]:
    """Train a method on a data set; return the row of its scores, in units of the truth's sd."""
    _prepare(method)
    problem = pair(name)
    X, Y = observations(problem, per_input * problem.d, seed)
    test_X, test_Y = test_points(problem)
    start = time.perf_counter()
    model, chosen = trained(method, problem, X, Y, seed)
    seconds = time.perf_counter() - start
    mean, variance, mixture_dim = _predictions(model, test_X)
    prediction = (mean, variance, test_Y)
    sd = test_Y.std().item()
    row = {
        "pair": name,
        "per_input": per_input,
        "seed": seed,
        "method": method,
        "N": len(X),
        "nrmse": rmse(mean, test_Y, mixture_dim=mixture_dim).item() / sd,
        "nlpd": nlpd(*prediction, mixture_dim=mixture_dim).item() - math.log(sd),
        "crps": crps(*prediction, mixture_dim=mixture_dim).item() / sd,
        "coverage": coverage(*prediction, mixture_dim=mixture_dim).item(),
        "seconds": seconds,
        "chosen": chosen,
    }
    return [row]


def _predictions(model: Any, X: Tensor) -> tuple[Tensor, Tensor, int | None]:
    """Means and variances of new observations, and the dimension of a mixture's components."""
    with torch.no_grad():
        parts = [model.posterior(part, observation_noise=True) for part in X.split(_CHUNK)]
    mean, variance = (
        torch.cat([getattr(part, name) for part in parts], dim=-2) for name in ("mean", "variance")
    )
    is_mixture = isinstance(parts[0], GaussianMixturePosterior)
    return mean, variance, MCMC_DIM if is_mixture else None


def run_all(
    names: Sequence[str],
    methods: Sequence[str],
    num_runs: int,
    first_seed: int,
    num_jobs: int,
    out: Path,
) -> pd.DataFrame:
    """Run methods on ``num_runs`` data sets of each pair and size; see :func:`run_grid`."""
    tasks = [
        (name, per_input, seed, method)
        for name in names
        for per_input in SIZES
        for seed in range(first_seed, first_seed + num_runs)
        for method in methods
    ]
    return run_grid(
        run_one,
        tasks,
        out,
        key=("pair", "per_input", "seed", "method"),
        num_rows=1,
        num_jobs=num_jobs,
        ranks={"pair": names, "method": METHODS},
    )
