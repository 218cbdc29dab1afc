"""Runs what is missing of an experiment, in parallel processes, and shows what there is."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import joblib
import torch
from filelock import FileLock, Timeout
from tqdm import tqdm

from paper.common.experiment import Case, Experiment, Run, Table, title
from paper.common.runs import RunsFile, commit_of, differences, rounded, versions
from paper.common.tables import aligned, as_document, settings_table


class Refused(ValueError):  # noqa: N818 - it is no error of the program
    """What is asked cannot be done with what is there; the message says why."""


RUNS = "runs.jsonl"
TABLES = "tables.md"
_ROOT = Path(__file__).parents[2]


def runs_file(experiment: Experiment) -> RunsFile:
    """Where the runs of an experiment are."""
    return RunsFile(experiment.out / RUNS, experiment.key)


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
        with _alone(experiment.out):
            run_missing(experiment)
    done = file.read()
    runs = list(done.values())
    if not runs:
        raise Refused(f"There are no results in {experiment.out}.")
    if experiment.only_tables:
        with suppress(ImportError):  # of a simulator that tables do not need
            check_all(file.path, done, experiment)
    tables = tables_of(experiment, runs)
    for table in tables.values():
        print(f"\n{table.title}\n\n{aligned(table.text)}")
    (experiment.out / TABLES).write_text(as_document(tables))
    print(experiment.out / TABLES, *experiment.draw(runs), sep="\n")


def tables_of(experiment: Experiment, runs: Sequence[Run]) -> dict[str, Table]:
    """Settings and results, by the names of their markers in the pages."""
    found = experiment.tables(runs)
    settings = getattr(experiment, "settings", None)
    if settings is not None:
        found["settings"] = Table("Settings", settings_table({"value": asdict(settings)}))
    return {f"{experiment.name}:{name}": table for name, table in found.items()}


def run_missing(experiment: Experiment) -> None:
    """Run the cases that there is no run of, and add them to the file.

    Raises:
        Refused: If the runs that are there were made with other settings; or by other versions or
            defaults, unless ``other_versions`` says what is to become of them.
    """
    file = runs_file(experiment)
    done, cases = file.read(), experiment.cases()
    kinds = {case[:-1] for case in cases}
    check_all(file.path, done, experiment)
    others = {
        case: differ
        for case, run in done.items()
        if (differ := _by_others(run, experiment, case[:-1] in kinds))
    }
    missing = [case for case in cases if case not in done]
    if others and missing and experiment.other_versions == "refuse":
        raise Refused(
            f"{file.path} has runs that differ from those to come: {next(iter(others.values()))}. "
            "Pass --other-versions keep to add to them, or another --out."
        )
    if others:
        print(
            f"{len(others)} of the runs were made by other versions, defaults or settings, or do "
            "not say by which."
        )
    shown = _first_look(experiment, done.values()) if missing else True
    bar = tqdm(total=len(cases), initial=len(cases) - len(missing), unit="run", disable=not missing)
    with bar:
        calls = [joblib.delayed(run_one)(experiment, case) for case in missing]
        options: dict[str, Any] = {"batch_size": 1, "return_as": "generator_unordered"}
        for case in joblib.Parallel(n_jobs=experiment.jobs, **options)(calls):
            bar.update()
            bar.set_postfix_str(title(case))
            shown = shown or _first_look(experiment, file.read().values())


def run_one(experiment: Experiment, case: Case) -> Case:
    """Run a case and add it to the file; return it."""
    torch.set_num_threads(1)
    file = runs_file(experiment)
    unfinished = experiment.unfinished(*case)
    unfinished.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{unfinished}.lock")
    with lock:  # a worker may outlive a call that was killed
        if case not in file.read():
            named = dict(zip(experiment.key, case, strict=True))
            made_by = {
                "settings": _described(experiment, case[:-1]),
                "defaults": experiment.defaults(),
                "versions": versions(experiment.packages),
                "commit": commit_of(_ROOT),  # it does not decide whether a case is run again
            }
            file.append({**named, **made_by, **rounded(experiment.run(*case))})
        Path(lock.lock_file).unlink(missing_ok=True)
    return case


def check_all(path: Path, done: Mapping[Case, Run], experiment: Experiment) -> None:
    """Refuse runs of other settings, of whatever kind: their tables are one file, with one list."""
    cases = [*replace(experiment, only=()).cases(), *experiment.cases()]
    kinds = {case[:-1] for case in cases}
    for case, run in done.items():
        if case[:-1] in kinds:
            check_settings(path, case, run, experiment)


def check_settings(path: Path, case: Case, run: Run, experiment: Experiment) -> None:
    """Refuse a run that was made with other settings, and say which.

    Settings that only one of them has are not meant: such a run is one of another version.
    """
    differ = differences(run["settings"], _described(experiment, case[:-1]), of_both=True)
    if differ:
        raise Refused(
            f"{path}: {title(case)} was made with other settings: {differ}. Choose another --out, "
            "or the settings of the runs that are there."
        )


def _by_others(run: Run, experiment: Experiment, asked: bool = True) -> str:
    """The first version, default or setting in which a run differs; empty if there is none.

    Of the packages, those count that are still used; of the settings, those of kinds of cases that
    are asked for.
    """
    now = versions(experiment.packages)
    found = {name: was for name, was in run["versions"].items() if name in experiment.packages}
    differ = differences(found, {name: now.get(name, "not there") for name in found})
    if not differ and experiment.calls:
        if not run.get("defaults"):
            return "the defaults of the library are not said of them"
        differ = differences(run["defaults"], experiment.defaults())
    if differ or not asked:
        return differ
    kind = tuple(run[name] for name in experiment.key[:-1])
    return differences(run["settings"], _described(experiment, kind))


@cache
def _described(experiment: Experiment, kind: Case) -> dict[str, Any]:
    """The settings of a kind of cases, as JSON has them."""
    try:
        described: dict[str, Any] = json.loads(json.dumps(experiment.describe(*kind)))
    except TypeError as error:
        raise Refused(
            f"{experiment.name}: describe() must return what JSON can hold: {error}"
        ) from None
    return described


def _first_look(experiment: Experiment, runs: Any) -> bool:
    """Show a short table as soon as there are runs enough; tell whether there were."""
    text = experiment.first_look(list(runs))
    if text:
        tqdm.write(f"\n{aligned(text)}\n")
    return bool(text)


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Be the only process that adds to a folder."""
    (out / "unfinished").mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(FileLock(out / "unfinished" / "process.lock", timeout=0))
        except Timeout:
            raise Refused(
                f"Another process adds runs to {out}. Wait until it has ended, or choose another "
                "--out; --only-tables shows what there is."
            ) from None
        yield
