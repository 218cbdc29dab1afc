"""Runs what is missing of an experiment, in parallel processes, and shows what there is."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import joblib
import torch
from tqdm import tqdm

from paper.common.experiment import Case, Experiment, Run, Table
from paper.common.runs import RunsFile, commit_of, differences, rounded, versions
from paper.common.tables import as_document, markdown


class Refused(ValueError):  # noqa: N818 - it is no error of the program
    """What is asked cannot be done with what is there; the message says why."""


RUNS = "runs.jsonl"
PAPER = Path(__file__).parents[1]
STALE = PAPER / "stale.txt"
"""Learners whose runs today's code does not make again, a line each: experiment and learner."""


def runs_file(experiment: Experiment) -> RunsFile:
    """Return the file of the runs of an experiment."""
    return RunsFile(experiment.folder / RUNS, experiment.key)


def main(experiment: Experiment) -> None:
    """Run what is missing; write and print tables, and draw figures, of all that there is.

    Raises:
        Refused: If that cannot be.
    """
    if experiment.runs < 2:
        raise Refused(f"--runs: expected at least 2 (for a spread), got {experiment.runs}")
    if experiment.jobs < 1:
        raise Refused(f"--jobs: expected at least 1 process, got {experiment.jobs}")
    file = runs_file(experiment)
    if not experiment.only_tables:
        try:
            experiment.check()
            experiment.cases()
        except (ImportError, ValueError) as error:
            raise Refused(str(error)) from error
        run_missing(experiment)
    done = file.read()
    if not done:
        raise Refused(f"There are no results in {experiment.folder}.")
    if experiment.only_tables:
        with suppress(ImportError):  # of a simulator that tables do not need
            check_settings(file.path, done, experiment)
    runs = [*done.values()]
    for table in write_tables(experiment, runs).values():
        print(f"\n{table.title}\n\n{table.text}")
    print(experiment.folder / "tables.md", *experiment.draw(runs), sep="\n")


def write_tables(experiment: Experiment, runs: Sequence[Run]) -> dict[str, Table]:
    """Write the file of an experiment's tables; return these."""
    tables = tables_of(experiment, runs)
    (experiment.folder / "tables.md").write_text(as_document(tables))
    return tables


def tables_of(experiment: Experiment, runs: Sequence[Run]) -> dict[str, Table]:
    """Return settings and results, by the names of their markers, each with its stamp."""
    tables = experiment.tables(runs)
    if experiment.settings:
        rows = [[f"`{name}`", f"{value}"] for name, value in experiment.settings.items()]
        tables["settings"] = Table("Settings", markdown(["setting", "value"], rows))
    below = stamp(experiment, runs)
    return {
        f"{experiment.name}:{name}": table._replace(text=f"{table.text}\n\n{below}")
        for name, table in tables.items()
    }


def stamp(experiment: Experiment, runs: Sequence[Run]) -> str:
    """Return the commits that made the runs, with dates, and which learners are stale."""
    made = Counter((run.get("date") or "", (run.get("commit") or "")[:8]) for run in runs)
    parts = [
        f"{number} by {commit} of {date}" if commit else f"{number} by unrecorded code"
        for (date, commit), number in sorted(made.items(), reverse=True)
    ]
    learners = dict.fromkeys(str(run[experiment.key[-2]]) for run in runs)
    is_committed = experiment.out.resolve() == STALE.parent / "results"
    listed = stale_list() if is_committed else set()
    stale = [learner for learner in learners if f"{experiment.name} {learner}" in listed]
    if len(parts) > 3:
        parts[3:] = ["others earlier"]
    text = f"Runs: {'; '.join(parts)}."
    if stale:
        which = "" if len(stale) == len(learners) else f" ({', '.join(stale)})"
        text += f" Stale: today's code gives other numbers{which}."
    return f"*{text}*"


def stale_list() -> set[str]:
    """Return the lines of ``STALE``."""
    return {*STALE.read_text().splitlines()} if STALE.exists() else set()


def run_missing(experiment: Experiment) -> None:
    """Run the cases that there is no run of, and add them to the file.

    Raises:
        Refused: If the runs that are there were made with other settings; or by other versions or
            defaults, if there are more to be run.
    """
    file = runs_file(experiment)
    done, cases = file.read(), experiment.cases()
    check_settings(file.path, done, experiment)
    missing = [case for case in cases if case not in done]
    others = [differ for run in done.values() if (differ := made_otherwise(run, experiment))]
    if missing and others:
        raise Refused(
            f"{file.path} has runs that differ from those to come: {others[0]}. Choose another "
            "--out, or remove the file and run all again."
        )
    bar = tqdm(total=len(cases), initial=len(cases) - len(missing), unit="run", disable=not missing)
    with bar:
        calls = [joblib.delayed(run_one)(experiment, case) for case in missing]
        options: dict[str, Any] = {"batch_size": 1, "return_as": "generator_unordered"}
        for case in joblib.Parallel(n_jobs=experiment.jobs, **options)(calls):
            bar.update()
            bar.set_postfix_str("-".join(map(str, case)))


def run_one(experiment: Experiment, case: Case) -> Case:
    """Run a case and add it to the file; return it."""
    torch.set_num_threads(1)
    commit, date = commit_of(PAPER.parent) or (None, None)
    made_by = {
        "settings": _described(experiment, case[:-1]),
        "defaults": experiment.defaults(),
        "versions": versions(experiment.packages),
        "commit": commit,
        "date": date,
    }
    start = time.process_time()
    results = experiment.run(*case) | {"took": time.process_time() - start}
    named = dict(zip(experiment.key, case, strict=True))
    runs_file(experiment).append(named | made_by | rounded(results, experiment.digits))
    return case


def check_settings(path: Path, done: Mapping[Case, Run], experiment: Experiment) -> None:
    """Refuse runs of other settings, of whatever kind: their tables are one file, with one list.

    Settings that only one of them has are not meant: such a run is one of another version.
    """
    kinds = {case[:-1] for case in replace(experiment, only=()).cases()}
    for case in (case for case in done if case[:-1] in kinds):
        differ = differences(done[case]["settings"], _described(experiment, case[:-1]))
        if differ:
            raise Refused(
                f"{path}: {'-'.join(map(str, case))} was made with other settings: {differ}. "
                "Choose another --out, or the settings of the runs that are there."
            )


def made_otherwise(run: Run, experiment: Experiment) -> str:
    """Return the first package or default in which a run differs; empty if there is none."""
    if experiment.calls and not run.get("defaults"):
        return "the defaults of the library are not recorded with them"
    now = {"versions": versions(experiment.packages), "defaults": experiment.defaults()}
    return differences({name: run.get(name, {}) for name in now}, now)


@cache
def _described(experiment: Experiment, kind: Case) -> dict[str, Any]:
    """Return the settings of a kind of cases, as JSON has them."""
    described: dict[str, Any] = json.loads(json.dumps(experiment.describe(*kind)))
    return described
