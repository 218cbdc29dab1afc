"""Makes a cheap case of each learner again, and says which tables are stale."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from itertools import accumulate
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
    write_tables,
)
from paper.common.runs import processor, rounded
from paper.pages import QUOTING, report, results, wrong_quotes

CLOSE = 1e-3  # of numbers that count as the same
BUDGET = 400.0  # CPU seconds of all cases that are made again: 200 s of two cores


def check(experiments: dict[str, str], known: bool = True) -> dict[str, str]:
    """Return the learners whose numbers today's code does not make again, with the reason.

    Args:
        experiments: Classes of the experiments, by name.
        known: Whether learners that the list of stale ones has are made again, too.
    """
    stale: dict[str, str] = {}
    jobs = []
    for kind in experiments.values():
        experiment = resolve_name(kind)(out=PAPER / "results", jobs=1)
        for learner, case, run in cheapest(experiment):
            name = f"{experiment.name} {learner}"
            if not known and name in stale_list():
                continue
            older, hindrance = _older(run, experiment), _hindrance(run, experiment)
            if older:
                stale[name] = older
            elif hindrance:
                print(f"{name}: {hindrance}, not made again")
            else:
                jobs.append((_cost(run, experiment), name, experiment, case, run))
    jobs.sort(key=lambda job: job[:2])
    spent = [*accumulate(cost for cost, *_ in jobs)]
    chosen = [job[1:] for job, until in zip(jobs, spent, strict=True) if until <= BUDGET]
    # Older runs have no processor, by which alone numbers are the same.
    decided = {name for name, _, _, run in chosen if run.get("processor")}
    for _, name, *_ in jobs[len(chosen) :]:
        print(f"{name}: takes too long, not made again")
    made = Parallel(n_jobs=os.cpu_count() or 1, return_as="generator")(
        delayed(_again)(*job) for job in chosen
    )
    for name, reason, seconds in made:
        print(f"{name}: {reason or 'the same'} ({seconds:.0f} s)", flush=True)
        if reason and name in decided:
            stale[name] = reason
    return stale


def _cost(run: Run, experiment: Experiment) -> float:
    """Return the CPU seconds of a case that is made again, or of its beginning."""
    shares = [value / experiment.settings[name] for name, value in experiment.cheap.items()]
    seconds: float = run["took"] * min([1.0, *shares])
    return seconds


def cheapest(experiment: Experiment) -> Iterator[tuple[str, Case, Run]]:
    """Yield the recorded case of each learner that took least time."""
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
    """Return why a run is stale, if that is known without making it again."""
    if not run.get("commit"):
        return "its commit is not recorded"
    if "took" not in run:
        return "it was made before runs were checked"
    return made_otherwise({**run, "versions": {}}, experiment)


def _hindrance(run: Run, experiment: Experiment) -> str:
    """Return why a run cannot be made again here; empty if it can."""
    try:
        experiment.check()
    except ImportError as error:
        return str(error).splitlines()[0].rstrip(".")
    by = run.get("processor", processor())
    return "was made by another processor" if by != processor() else ""


def _again(name: str, experiment: Experiment, case: Case, run: Run) -> tuple[str, str, float]:
    torch.set_num_threads(1)
    start = time.process_time()
    results = experiment.changed(experiment.cheap).run(*case)
    made = difference(run, rounded(results, experiment.digits))
    return name, made, time.process_time() - start


def difference(old: Any, new: Any, place: str = "") -> str:
    """Return the first number that differs, with its place; empty if there is none.

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
                write_tables(experiment, runs)
        report()
    tables = results(PAPER / "results")
    wrong = [f"{p.name}: {q}" for p in QUOTING for q in wrong_quotes(p.read_text(), tables)]
    if wrong or {*stale} != stale_list():
        lines = [f"not in {STALE.name}: {name}" for name in {*stale} - stale_list()]
        lines += [f"in {STALE.name}, and made again: {name}" for name in stale_list() - {*stale}]
        raise SystemExit("\n".join([*wrong, *lines, "python -m paper check --write"]))
