"""A grid of independent runs, in parallel processes, resumable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Parallel, delayed
from tqdm import tqdm


def run_grid(
    run: Callable[..., list[dict[str, Any]]],
    tasks: Sequence[tuple[Any, ...]],
    out: Path,
    *,
    key: Sequence[str],
    num_rows: int,
    num_jobs: int,
    ranks: Mapping[str, Sequence[str]],
) -> pd.DataFrame:
    """Call ``run(*task)`` for every task; write ``out/runs.csv``.

    Finished tasks are appended to ``out/runs.partial.csv`` as they come, so that an interrupted
    call goes on where it stopped; at the end it becomes ``runs.csv``.

    Args:
        run: Returns the rows of a task.
        tasks: The arguments of ``run``.
        out: Folder of the results.
        key: The columns that name a task, in the order of its arguments.
        num_rows: How many rows a task has.
        num_jobs: Number of parallel processes.
        ranks: Columns that are not sorted by value but as listed. Beside ``key`` they name a row.

    Returns:
        The rows of the tasks, sorted.
    """
    key = list(key)
    partial = out / "runs.partial.csv"
    done = pd.read_csv(partial) if partial.exists() else pd.DataFrame(columns=key)
    counts = done.groupby(key).size()
    # An interruption may have cut a task's rows short.
    finished = set(counts[counts == num_rows].index)
    missing = [task for task in tasks if task not in finished]
    results = Parallel(n_jobs=num_jobs, return_as="generator_unordered")(
        delayed(run)(*task) for task in missing
    )
    progress = tqdm(results, total=len(tasks), initial=len(tasks) - len(missing), unit="run")
    for rows in progress:
        frame = pd.DataFrame(rows)
        frame.to_csv(partial, mode="a", header=not partial.exists(), index=False)

    def rank(column: pd.Series[Any]) -> pd.Series[Any]:
        return column.map(list(ranks[column.name]).index) if column.name in ranks else column

    order = list(dict.fromkeys([*key, *ranks]))
    every = pd.read_csv(partial).drop_duplicates(order, keep="last")
    wanted = every[key].apply(tuple, axis=1).isin(tasks)
    frame = every[wanted].sort_values(order, key=rank).reset_index(drop=True)
    frame.to_csv(out / "runs.csv", index=False, float_format="%.6g")
    if wanted.all():
        partial.unlink()
    else:  # the others belong to a larger call, which may go on
        every[~wanted].to_csv(partial, index=False)
    return frame
