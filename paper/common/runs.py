"""Finished runs in one file, a line of JSON each, and what identifies them."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from filelock import FileLock

from paper.common.experiment import Case, Run

IDENTIFYING = ("settings", "defaults", "versions", "commit", "date")
"""Entries of a run that say how it was made."""


class RunsFile:
    """A file to which runs are added, by any number of processes, and from which none is lost.

    What identifies runs, as their settings and versions, has a line of its own, before the first
    of the runs that were made so, and a number by which they name it.

    A line counts once its end is written. A process that dies while it writes leaves a torn line,
    which no one reads and the next to write removes; one that cannot write (a full disk) takes
    back what it has written and raises an error. Of a case that is there twice the last counts.

    Args:
        path: The file; it is made with the first run.
        key: The entries that name a case.
    """

    def __init__(self, path: Path, key: Sequence[str]) -> None:
        self.path = path
        self.key = tuple(key)

    def append(self, run: Run) -> None:
        """Write a run, and wait until it is on the disk.

        Raises:
            OSError: If it cannot be written.
        """
        made = {name: run[name] for name in IDENTIFYING if name in run}
        rest = {name: value for name, value in run.items() if name not in made}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{self.path}.lock"), open(self.path, "ab", buffering=0) as file:
            whole = self._whole()
            file.truncate(len(whole))
            ways = [json.loads(line) for line in whole.splitlines() if b'"identifying"' in line]
            name = next((way["made_by"] for way in ways if way["identifying"] == made), len(ways))
            line = _line({"made_by": name, **rest} if made else rest)
            if made and name == len(ways):
                line = _line({"identifying": made, "made_by": name}) + line
            try:
                while line:  # a full disk takes some of it
                    line = line[file.write(line) :]
                os.fsync(file.fileno())
            except OSError as error:
                file.truncate(len(whole))
                raise OSError(
                    error.errno, f"{error.strerror}; the run is not written, all before it are"
                ) from error

    def read(self) -> dict[Case, Run]:
        """Return all runs, by case; nothing is changed.

        Raises:
            ValueError: If a line that is whole is none of a run.
        """
        runs: dict[Case, Run] = {}
        made: dict[Any, Run] = {None: {}}
        for number, line in enumerate(self._whole().splitlines(), start=1):
            try:
                run = json.loads(line)
                if "identifying" in run:
                    made[run["made_by"]] = run["identifying"]
                    continue
                run |= made[run.pop("made_by", None)]
                case = tuple(run[name] for name in self.key)
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"Expected a run in each line of {self.path}, found {line[:40]!r} in line "
                    f"{number}. Remove that line, or name another folder."
                ) from error
            runs[case] = run
        return runs

    def _whole(self) -> bytes:
        """Return the file without a torn last line."""
        content = self.path.read_bytes() if self.path.exists() else b""
        return content[: content.rfind(b"\n") + 1]


def _line(entries: Run) -> bytes:
    return json.dumps(entries, separators=(",", ":")).encode() + b"\n"


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return the first entry that both have and that differs, in words; empty if there is none."""
    for name in (name for name in old if name in new):
        was, now = old[name], new[name]
        if isinstance(was, dict) and isinstance(now, dict):
            inner = differences(was, now)
            if inner:
                return f"{name}.{inner}"
        elif was != now:
            return f"{name} was {was} and is now {now}"
    return ""


@cache
def versions(packages: Sequence[str]) -> dict[str, str]:
    """Return the versions of Python and of packages."""
    numbers = {"python": platform.python_version()}
    for name in packages:
        with suppress(PackageNotFoundError):
            numbers[name] = version(name)
    return numbers


def rounded(value: Any, digits: int) -> Any:
    """Round numbers to significant digits, also in lists and dictionaries; nan becomes None."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(f"{value:.{digits}g}")
    if isinstance(value, list | tuple):
        return [rounded(entry, digits) for entry in value]
    if isinstance(value, dict):
        return {key: rounded(entry, digits) for key, entry in value.items()}
    return value


@cache
def commit_of(root: Path) -> tuple[str, str] | None:
    """Return the hash of a repository's current commit and its date, read once per process.

    A ``"+"`` follows the hash if tracked files differ from it. Those in ``paper/results`` do not
    count, which runs themselves change.

    Args:
        root: The root of the repository.

    Returns:
        None if it is none (as in an unpacked archive), has no commit yet, or git does not answer.
    """
    shown = git(root, "show", "--no-patch", "--format=%H %cs", "HEAD")
    if shown is None or not (root / ".git").exists():  # ours is but a folder of another's
        return None
    command = ("status", "--porcelain", "--untracked-files=no", "--", ".", ":!paper/results")
    commit, date = shown.split()
    return f"{commit}+" if git(root, *command) else commit, date


def git(root: Path, *command: str) -> str | None:
    """Return the output of a git command; None if it fails or git is not installed."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *command], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout
