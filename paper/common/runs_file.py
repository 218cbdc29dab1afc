"""Finished runs in one file, a line of JSON each."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock


class RunsFile:
    """A file to which runs are added, by any number of processes, and from which none is lost.

    A line counts once its end is written. A process that dies while it writes leaves a torn line,
    which no one reads and the next to write removes; one that cannot write (a full disk) takes
    back what it has written and raises an error. Of a task that is there twice the last counts.

    Args:
        path: The file; it is made with the first run.
        key: The entries that name a task.
    """

    def __init__(self, path: Path, key: Sequence[str]) -> None:
        self.path = path
        self.key = tuple(key)

    def append(self, record: dict[str, Any]) -> None:
        """Write a run, and wait until it is on the disk.

        Raises:
            OSError: If it cannot be written.
        """
        line = json.dumps(record, separators=(",", ":")).encode() + b"\n"
        locks = self.path.parent / "unfinished"
        locks.mkdir(parents=True, exist_ok=True)
        with FileLock(locks / "append.lock"), open(self.path, "ab", buffering=0) as file:
            end = self._whole()
            file.truncate(end)
            try:
                while line:  # a full disk takes some of it
                    line = line[file.write(line) :]
                os.fsync(file.fileno())
            except OSError as error:
                file.truncate(end)
                raise OSError(
                    error.errno, f"{error.strerror}; the run is not written, all before it are"
                ) from error

    def read(self) -> dict[tuple[Any, ...], dict[str, Any]]:
        """All runs, by task; nothing is changed.

        Raises:
            ValueError: If a line that is whole is none of a run.
        """
        if not self.path.exists():
            return {}
        found = {}
        lines = self.path.read_bytes()[: self._whole()].splitlines()
        for number, line in enumerate(lines, start=1):
            try:
                record = json.loads(line)
                task = tuple(record[name] for name in self.key)
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"Expected a run in each line of {self.path}, found {line[:40]!r} in line "
                    f"{number}. Remove that line, or name another folder."
                ) from error
            found[task] = record
        return found

    def _whole(self) -> int:
        """The length of the file without a torn last line."""
        return self.path.read_bytes().rfind(b"\n") + 1
