"""Makes a cheap case of each learner again, and says which tables are stale."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from pkgutil import resolve_name
from typing import Any

import torch
from joblib import Parallel, delayed

from paper.common.experiment import Case, Experiment, Run
from paper.common.runner import (
    PAPER,
    STALE,
    made_otherwise,
    runs_file,
    stale_list,
    tables_of,
    write_tables,
)
from paper.common.runs import rounded
from paper.pages import QUOTING, report, results, wrong_quotes

CLOSE = 1e-3  # of numbers that count as the same
LONGEST = 60.0  # CPU seconds of a case that is made again


def check(experiments: dict[str, str], known: bool = True) -> dict[str, str]:
    """The learners whose numbers today's code does not make again, with the first difference.

    Args:
        experiments: Classes of the experiments, by name.
        known: Whether learners that the list of stale ones has are made again, too.
    """
    torch.set_num_threads(1)
    jobs = []
    stale: dict[str, str] = {}
    for kind in experiments.values():
        experiment = resolve_name(kind)(out=PAPER / "results", jobs=1)
        for learner, case, run in cheapest(experiment):
            name = f"{experiment.name} {learner}"
            if not known and name in stale_list():
                continue
            older = _older(run, experiment)
            if older:
                stale[name] = older
            elif run.get("took", math.inf) <= LONGEST or experiment.cheap:
                jobs.append((name, experiment, case, run))
    made = Parallel(n_jobs=os.cpu_count() or 1, return_as="generator")(
        delayed(_again)(*job) for job in jobs
    )
    for name, difference, seconds in made:
        print(f"{name}: {difference or 'the same'} ({seconds:.0f} s)", flush=True)
        if difference:
            stale[name] = difference
    return stale


def cheapest(experiment: Experiment) -> Iterator[tuple[str, Case, Run]]:
    """The recorded case of each learner that took least time."""
    done = runs_file(experiment).read()
    asked = {case[:-1] for case in experiment.cases()}
    of: dict[str, list[Case]] = {}
    for case in done:
        if case[:-1] in asked:
            of.setdefault(str(case[-2]), []).append(case)
    for learner, cases in of.items():
        case = min(cases, key=lambda case: done[case].get("took", math.inf))
        yield learner, case, done[case]


def _older(run: Run, experiment: Experiment) -> str:
    """Why a run is of other code, if that can be told without making it again."""
    if not run.get("commit"):
        return "its commit is not recorded"
    if "took" not in run:
        return "it was made before runs were checked"
    return made_otherwise({**run, "versions": {}}, experiment)


def _again(name: str, experiment: Experiment, case: Case, run: Run) -> tuple[str, str, float]:
    torch.set_num_threads(1)
    start = time.process_time()
    results = rounded(experiment.changed(experiment.cheap).run(*case))
    return name, difference(run, results), time.process_time() - start


def difference(old: Any, new: Any, place: str = "") -> str:
    """The first number that differs, with its place; empty if there is none.

    Times do not count, nor what a cheaper case has not: later elements of a list.
    """
    if isinstance(new, dict):
        for name, value in new.items():
            if "seconds" not in str(name):
                inner = difference(old.get(name), value, f"{place}.{name}".lstrip("."))
                if inner:
                    return inner
        return ""
    if isinstance(new, list | tuple):
        pairs = zip(old or [], new, strict=False)
        each = (difference(a, b, f"{place}[{i}]") for i, (a, b) in enumerate(pairs))
        return next((inner for inner in each if inner), "")
    is_number = isinstance(new, float | int) and isinstance(old, float | int)
    same = math.isclose(old, new, rel_tol=CLOSE, abs_tol=1e-9) if is_number else old == new
    return "" if same else f"{place} was {old} and is now {new}"


def main(experiments: dict[str, str], write: bool) -> None:
    """Print what is stale, and fail if that differs from the list; or write it and the pages."""
    stale = check(experiments)
    for name, reason in stale.items():
        print(f"stale: {name}: {reason}")
    if write:
        STALE.write_text("".join(f"{name}\n" for name in stale))
        for kind in experiments.values():
            experiment = resolve_name(kind)(out=PAPER / "results")
            runs = [*runs_file(experiment).read().values()]
            if runs:
                write_tables(experiment, tables_of(experiment, runs))
        report()
    tables = results(PAPER / "results")
    wrong = [f"{p.name}: {q}" for p in QUOTING for q in wrong_quotes(p.read_text(), tables)]
    if wrong or {*stale} != stale_list():
        lines = [f"not in {STALE.name}: {name}" for name in {*stale} - stale_list()]
        lines += [f"in {STALE.name}, and made again: {name}" for name in stale_list() - {*stale}]
        raise SystemExit("\n".join([*wrong, *lines, "python -m paper check --write"]))
