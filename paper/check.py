"""Makes a cheap case of each learner again, and says which tables are stale."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from pkgutil import resolve_name
from tempfile import TemporaryDirectory
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
from paper.common.runs import git, rounded
from paper.pages import QUOTING, report, results, wrong_quotes

CLOSE = 1e-3  # of numbers that count as the same
ROOT = Path(__file__).parents[1]
_CASE = """
import json, pathlib, pkgutil, sys, torch
torch.set_num_threads(1)
kind, changes, case = json.loads(sys.argv[1])
experiment = pkgutil.resolve_name(kind)(out=pathlib.Path()).changed(changes)
print(json.dumps(experiment.run(*case)))
"""


def check(
    experiments: dict[str, str], known: bool = True, budget: float = math.inf
) -> dict[str, str]:
    """Return the learners whose numbers today's code does not make again, with the reason.

    Args:
        experiments: Classes of the experiments, by name.
        known: Whether learners that the list of stale ones has are made again, too.
        budget: Seconds of CPU, as recorded, of all cases that are made again, the cheapest first.
    """
    stale: dict[str, str] = {}
    jobs = []
    for kind in experiments.values():
        experiment = resolve_name(kind)(out=PAPER / "results", jobs=1)
        for learner, case, run in cheapest(experiment):
            name = f"{experiment.name} {learner}"
            if not known and name in stale_list():
                continue
            older, missing = _older(run, experiment), _missing(experiment)
            if older:
                stale[name] = older
            elif missing:
                print(f"{name}: {missing}, not made again")
            else:
                jobs.append((_cost(run, experiment), name, experiment, case, run))
    jobs.sort(key=lambda job: job[:2])
    spent = [*accumulate(cost for cost, *_ in jobs)]
    chosen = [job[1:] for job, until in zip(jobs, spent, strict=True) if until <= budget]
    for _, name, *_ in jobs[len(chosen) :]:
        print(f"{name}: beyond the budget, not made again")
    made = Parallel(n_jobs=os.cpu_count() or 1, return_as="generator")(
        delayed(_again)(*job) for job in chosen
    )
    for name, reason, found in made:
        print(f"{name}: {found}", flush=True)
        if reason:
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
    commit = run.get("commit") or "+"
    if commit.endswith("+"):  # as of a changed working tree
        return "its code was not committed"
    if "took" not in run:
        return "it was made before runs were checked"
    return made_otherwise({**run, "versions": {}}, experiment)


def _missing(experiment: Experiment) -> str:
    """Return what an experiment needs and is not installed; empty if it is."""
    try:
        experiment.check()
    except ImportError as error:
        return str(error).splitlines()[0].rstrip(".")
    return ""


def _again(name: str, experiment: Experiment, case: Case, run: Run) -> tuple[str, str, str]:
    """Make a case again; return its name, why it is stale (empty if it is not), and what is found.

    Another processor gives other numbers, too. So the code that made the record decides, on this
    machine: a case is stale if that code and today's differ here.
    """
    torch.set_num_threads(1)
    made = rounded(experiment.changed(experiment.cheap).run(*case), experiment.digits)
    differs = difference(run, made)
    if not differs:
        return name, "", "the same"
    recorded = by_code_of(run["commit"], experiment, case)
    if recorded is None:
        return name, "", f"{differs}; this clone does not have the record's commit {run['commit']}"
    stale = difference(recorded, made)
    return name, stale, stale or f"{differs}; on this machine the record's code gives the same"


def by_code_of(commit: str, experiment: Experiment, case: Case) -> Run | None:
    """Return a cheap case by the code of a commit; nothing if that fails; None without a commit."""
    kind = f"{type(experiment).__module__}:{type(experiment).__qualname__}"
    arguments = json.dumps([kind, dict(experiment.cheap), case])
    with TemporaryDirectory() as folder:
        if git(ROOT, "archive", f"--output={folder}/code.tar", commit.rstrip("+")) is None:
            return None
        with tarfile.open(f"{folder}/code.tar") as code:
            code.extractall(folder, filter="data")
        command = [sys.executable, "-c", _CASE, arguments]
        done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        return {}
    made: Run = rounded(json.loads(done.stdout.splitlines()[-1]), experiment.digits)
    return made


def difference(old: Any, new: Any, place: str = "") -> str:
    """Return the first number that differs, with its place; empty if there is none.

    Times do not count, nor what a cheaper case has not: later elements of a list.
    """
    if isinstance(new, dict) and isinstance(old, dict):
        names = (name for name in new if "seconds" not in str(name))
        each = (difference(old.get(n), new[n], f"{place}.{n}".lstrip(".")) for n in names)
        return next((inner for inner in each if inner), "")
    if isinstance(new, list | tuple) and isinstance(old, list | tuple):
        pairs = zip(old, new, strict=False)
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
