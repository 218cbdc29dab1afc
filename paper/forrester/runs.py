"""All models on all data sets."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pandas as pd
import torch

from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.forrester.models import MODELS, Protocol, trained
from paper.forrester.problem import CRUDE, GRID, Reading, observations, truth
from paper.grid import run_grid


@cache
def _prepare() -> None:
    """Set a process up: one thread, and one fit that is not timed."""
    torch.set_num_threads(1)
    trained("CKA", "gpadjust", "B", *observations(0))


def run_one(reading: Reading, protocol: Protocol, seed: int) -> list[dict[str, Any]]:
    """Train all models on one data set; return a row of scores for each, and for f_p."""
    _prepare()
    X, Y = observations(seed)
    y = truth(GRID)
    which = {"reading": reading, "protocol": protocol, "seed": seed}
    rows: list[dict[str, Any]] = [
        {**which, "model": "f_p", "rmse": rmse(CRUDE[reading](GRID), y).item()}
    ]
    for name in MODELS:
        start = time.perf_counter()
        model = trained(name, protocol, reading, X, Y)
        seconds = time.perf_counter() - start
        with torch.no_grad():
            posterior = model.posterior(GRID, observation_noise=True)
            mean, variance = posterior.mean, posterior.variance
        scores = {
            "rmse": rmse(mean, y).item(),
            "nlpd": nlpd(mean, variance, y).item(),
            "crps": crps(mean, variance, y).item(),
            "coverage": coverage(mean, variance, y).item(),
        }
        rows.append({**which, "model": name, **scores, "seconds": seconds})
    return rows


def run_all(num_runs: int, first_seed: int, num_jobs: int, out: Path) -> pd.DataFrame:
    """Run both readings and protocols on ``num_runs`` data sets; see :func:`run_grid`."""
    tasks = [
        (reading, protocol, seed)
        for reading in sorted(CRUDE, reverse=True)
        for protocol in get_args(Protocol)
        for seed in range(first_seed, first_seed + num_runs)
    ]
    return run_grid(
        run_one,
        tasks,
        out,
        key=("reading", "protocol", "seed"),
        num_rows=1 + len(MODELS),
        num_jobs=num_jobs,
        ranks={"model": ("f_p", *MODELS)},
    )
