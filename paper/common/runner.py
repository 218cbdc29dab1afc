"""Runs what is missing of an experiment, in parallel processes, and shows what there is."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import joblib
import torch
from filelock import FileLock, Timeout
from tqdm import tqdm

import gpadjust
from paper.common.commit import commit_of
from paper.common.experiment import Experiment, Record, Table, Task
from paper.common.runs_file import RunsFile
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
    if experiment.key[-1] != "seed":
        raise Refused(
            f"{experiment.name}: the last part of key must be 'seed', got {experiment.key}"
        )
    file = runs_file(experiment)
    if not experiment.only_tables:
        try:
            experiment.check()
        except (ImportError, ValueError) as error:
            raise Refused(str(error)) from error
        with _alone(experiment.out):
            run_missing(experiment)
    records = list(file.read().values())
    if not records:
        raise Refused(f"There are no results in {experiment.out}.")
    tables = tables_of(experiment, records)
    for table in tables.values():
        print(f"\n{table.title}\n\n{aligned(table.text)}")
    (experiment.out / TABLES).write_text(as_document(tables))
    print(experiment.out / TABLES, *experiment.draw(records), sep="\n")


def tables_of(experiment: Experiment, records: Sequence[Record]) -> dict[str, Table]:
    """Settings and results, by the names of their markers in the READMEs."""
    found = experiment.tables(records)
    settings = getattr(experiment, "settings", None)
    if settings is not None:
        found["settings"] = Table("Settings", settings_table({"value": asdict(settings)}))
    return {f"{experiment.name}:{name}": table for name, table in found.items()}


def run_missing(experiment: Experiment) -> None:
    """Run the tasks that there is no run of, and add them to the file.

    Raises:
        Refused: If the runs that are there were made with other settings; or by other versions,
            unless ``other_versions`` says what is to become of them.
    """
    file = runs_file(experiment)
    done, tasks = file.read(), [tuple(task) for task in experiment.tasks()]
    kinds = {task[:-1] for task in tasks}
    for task, record in done.items():
        if task[:-1] in kinds:
            check_settings(file.path, task, record["settings"], _described(experiment, task[:-1]))
    others = {task for task, record in done.items() if _by_others(record, experiment)}
    missing = [task for task in tasks if task not in done]
    if others and experiment.other_versions == "replace":
        missing = [task for task in tasks if task not in done or task in others]
    elif others and missing and experiment.other_versions == "refuse":
        task = next(iter(others))
        differ = _by_others(done[task], experiment)
        raise Refused(
            f"{file.path} has runs of other versions: {differ}. Pass --other-versions keep to add "
            "to them, --other-versions replace to run them again, or another --out."
        )
    elif others:
        print(f"{len(others)} of the runs were made by other versions of the packages.")
    shown = _first_look(experiment, done.values()) if missing else True
    bar = tqdm(total=len(tasks), initial=len(tasks) - len(missing), unit="run", disable=not missing)
    with bar, _backend(experiment.backend) as options:
        away = replace(experiment, out=experiment.out.absolute())
        calls = [joblib.delayed(run_one)(away, task) for task in missing]
        parallel = joblib.Parallel(n_jobs=experiment.jobs, batch_size=1, **options)
        for task in parallel(calls):
            bar.update()
            bar.set_postfix_str(_title(task))
            shown = shown or _first_look(experiment, file.read().values())


def run_one(experiment: Experiment, task: Task) -> Task:
    """Run a task and add it to the file; return it."""
    torch.set_num_threads(1)
    file = runs_file(experiment)
    unfinished = experiment.out / "unfinished" / _title(task)
    unfinished.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{unfinished}.lock")
    with lock:  # a worker may outlive a call that was killed
        before = file.read().get(task)
        if before is None or _by_others(before, experiment):
            named = dict(zip(experiment.key, task, strict=True))
            made_by = {
                "settings": _described(experiment, task[:-1]),
                "versions": versions(experiment.packages),
                "commit": commit_of(_ROOT),  # it does not decide whether a task is run again
            }
            found = experiment.run(*task, unfinished=unfinished)
            file.append({**named, **made_by, **rounded(found)})
        Path(lock.lock_file).unlink(missing_ok=True)
    return task


def _by_others(record: Record, experiment: Experiment) -> str:
    """In which version of a package that is still used a run differs; empty if in none."""
    now = versions(experiment.packages)
    found = {name: was for name, was in record["versions"].items() if name in experiment.packages}
    return differences(found, {name: now.get(name, "not there") for name in found})


def check_settings(
    path: Path, task: Task, found: Mapping[str, Any], expected: Mapping[str, Any]
) -> None:
    """Refuse a run that was made with other settings, and say which."""
    differ = differences(found, expected)
    if differ:
        raise Refused(
            f"{path}: {_title(task)} was made with other settings: {differ}. Choose another --out, "
            "or the settings of the runs that are there."
        )


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """The first entry that differs, in words; empty if there is none. Python's version may."""
    for name in {**found, **expected}:
        was, now = found.get(name, "not there"), expected.get(name, "not there")
        if isinstance(was, dict) and isinstance(now, dict):
            inner = differences(was, now)
            if inner:
                return f"{name}.{inner}"
        elif was != now and name != "python":
            return f"{name} was {was} and is now {now}"
    return ""


@cache
def versions(packages: Sequence[str]) -> dict[str, str]:
    """Of Python and of what the numbers come from."""
    found = {"python": platform.python_version()}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = gpadjust.__version__ if name == "gpadjust" else version(name)
    return found


def rounded(value: Any) -> Any:
    """Six significant digits of numbers, also in lists and dictionaries; None for nan."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(f"{value:.6g}")
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    return value


def _title(task: Task) -> str:
    return "-".join(map(str, task)).replace(" ", "_")


@cache
def _described(experiment: Experiment, kind: Task) -> dict[str, Any]:
    """The settings of a kind of tasks, as JSON has them."""
    try:
        described: dict[str, Any] = json.loads(json.dumps(experiment.describe(*kind)))
    except TypeError as error:
        raise Refused(
            f"{experiment.name}: describe() must return what JSON can hold: {error}"
        ) from None
    return described


def _first_look(experiment: Experiment, records: Any) -> bool:
    """Show a short table as soon as there are runs enough; tell whether there were."""
    text = experiment.first_look(list(records))
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


@contextmanager
def _backend(name: str) -> Iterator[dict[str, Any]]:
    """Choose joblib's backend; Ray's uses the cluster that is running, or starts a local one."""
    if name == "ray":
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise Refused(
                "--backend ray needs Ray; install it with `pip install gpadjust[ray]`"
            ) from error
        register_ray()
    with joblib.parallel_config(backend=name):
        # Ray cannot return results one by one.
        yield {"verbose": 10} if name == "ray" else {"return_as": "generator_unordered"}
