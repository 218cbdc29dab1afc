"""All models on all data sets, in parallel processes, resumable."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pandas as pd
import torch
from joblib import Parallel, delayed
from tqdm import tqdm

from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.forrester.models import NAMES, Protocol, trained
from paper.forrester.problem import CRUDE, GRID, Reading, observations, truth

KEY = ["reading", "protocol", "seed"]


@cache
def _prepare() -> None:
    """Set a process up: one thread, and one fit that is not timed."""
    torch.set_num_threads(1)
    trained("CKA", "gpadjust", "B", *observations(0))


def run_one(reading: Reading, protocol: Protocol, seed: int) -> list[dict[str, Any]]:
    """Train the seven models on one data set; return a row of scores for each, and for f_p."""
    _prepare()
    X, Y = observations(seed)
    y = truth(GRID)
    which = {"reading": reading, "protocol": protocol, "seed": seed}
    rows: list[dict[str, Any]] = [
        {**which, "model": "f_p", "rmse": rmse(CRUDE[reading](GRID), y).item()}
    ]
    for name in NAMES:
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
    """Run both readings and protocols on ``num_runs`` data sets.

    Finished runs are appended to ``out/runs.partial.csv`` as they come, so that an interrupted
    call goes on where it stopped; at the end it becomes ``out/runs.csv``.
    """
    partial = out / "runs.partial.csv"
    done = pd.read_csv(partial) if partial.exists() else pd.DataFrame(columns=KEY)
    tasks = [
        (reading, protocol, seed)
        for reading in sorted(CRUDE, reverse=True)
        for protocol in get_args(Protocol)
        for seed in range(first_seed, first_seed + num_runs)
    ]
    counts = done.groupby(KEY).size()
    # An interruption may have cut a task's rows short.
    finished = set(counts[counts == 1 + len(NAMES)].index)
    missing = [task for task in tasks if task not in finished]
    results = Parallel(n_jobs=num_jobs, return_as="generator_unordered")(
        delayed(run_one)(*task) for task in missing
    )
    progress = tqdm(results, total=len(tasks), initial=len(tasks) - len(missing), unit="run")
    for rows in progress:
        frame = pd.DataFrame(rows)
        frame.to_csv(partial, mode="a", header=not partial.exists(), index=False)
    order = [*KEY, "model"]
    every = pd.read_csv(partial).drop_duplicates(order, keep="last")
    wanted = every[KEY].apply(tuple, axis=1).isin(tasks)
    frame = every[wanted].sort_values(order, key=_rank).reset_index(drop=True)
    frame.to_csv(out / "runs.csv", index=False, float_format="%.6g")
    if wanted.all():
        partial.unlink()
    else:  # the others belong to a larger call, which may go on
        every[~wanted].to_csv(partial, index=False)
    return frame


def _rank(column: pd.Series[Any]) -> pd.Series[Any]:
    """Sort models in the paper's order, the rest by value."""
    if column.name == "model":
        return column.map(["f_p", *NAMES].index)
    return column
