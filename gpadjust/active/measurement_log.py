"""A file that loses no measurement."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from gpadjust.files.sync_folder import sync_folder

Record = dict[str, Any]

_FORMAT = "gpadjust measurements, version 1"


class LogError(OSError):
    """A log of measurements cannot be held, read or written."""


class MeasurementLog:
    """Records in a file, one line of JSON each, that are on the disk before anything else happens.

    Killing the process at any moment leaves a file that can be read again: of what was being
    written then, whole lines count, and a torn last line is removed before the next is written.
    Records that cannot be written, as the disk is full, say, leave nothing behind.

    One log at a time holds a file: from :meth:`open` on, until it is closed or deleted, or its
    process ends, be it killed. What it locks is a file beside it, ``<name>.lock``, that stays there
    and says nothing by itself. Copies and pickles of a log do not hold its file; an :meth:`append`
    takes it again, if nobody else has written to it.

    Args:
        path: The file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "measurements.jsonl"
        >>> log = MeasurementLog(path)
        >>> log.open([[0.0], [1.0]])
        []
        >>> log.append([{"x": [0.5], "y": [1.25]}])
        >>> log.close()
        >>> MeasurementLog(path).open([[0.0], [1.0]])
        [{'x': [0.5], 'y': [1.25]}]
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).resolve()
        self._size = 0  # of the records, in bytes
        self._glue = b""  # what they lack to end a line
        self._torn = False  # whether part of a record may come after them
        self._lock: BaseFileLock | None = None

    def open(self, bounds: list[list[float]]) -> list[Record]:
        """Hold the file, and return its records; a new file and its folder are made.

        Args:
            bounds: Bounds of the inputs, ``2 x d``, which the first line of the file tells.

        Raises:
            LogError: If the file is held already, or cannot be opened for writing.
            ValueError: If it is of other bounds, or a line is not a record.
        """
        header = {"format": _FORMAT, "bounds": bounds}
        with self._explained("opened", "Name a file in a folder where you may write."):
            if self.path.is_dir():
                raise IsADirectoryError("it is a folder")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._hold()
            with self.path.open("a+b") as file:
                file.seek(0)
                content = file.read()
            if _line(header).startswith(content):
                self._size, self._torn = 0, True
                self.append([header])
                sync_folder(self.path.parent)
                return []
        *lines, tail = content.split(b"\n")
        records = [self._record(line, number) for number, line in enumerate(lines, start=1)]
        self._size, self._glue, self._torn = len(content), b"\n" if tail else b"", False
        if tail:
            try:
                records.append(self._record(tail, len(lines) + 1))
            except ValueError:
                self._size, self._glue, self._torn = len(content) - len(tail), b"", True
        if not records or records[0].get("format") != _FORMAT:
            raise ValueError(f"{self.path} is no log of measurements; name another file.")
        if records[0].get("bounds") != bounds:
            raise ValueError(
                f"The log {self.path} is of measurements within the bounds "
                f"{records[0].get('bounds')}, got {bounds}; name another file, or take those."
            )
        return records[1:]

    def append(self, records: Iterable[Record]) -> None:
        """Write records at the end, and wait until they are on the disk.

        Raises:
            LogError: If they cannot be written; then none of them is in the file. Or if another
                holds it, or has written to it.
        """
        data = self._glue + b"".join(map(_line, records))
        way_out = (
            "What it held is safe; what it was to take now is not on the disk, and the collection "
            "has not taken it either. Make room, and tell it again."
        )
        with self._explained("written", way_out):
            self._hold()
            with self.path.open("r+b", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                if size != self._size and not (self._torn and size > self._size):
                    self.close()
                    raise LogError(
                        f"Expected {self._size} bytes in the log {self.path}, found {size}: "
                        "something else has written to it. Make a new collection with it."
                    )
                try:
                    file.seek(self._size)
                    file.truncate()
                    left = data
                    while left:
                        left = left[file.write(left) :]
                    os.fsync(file.fileno())
                except BaseException:
                    self._torn = True
                    with suppress(OSError):  # of the two errors, the first tells more
                        file.truncate(self._size)
                        os.fsync(file.fileno())
                        self._torn = False
                    raise
        self._size, self._glue, self._torn = self._size + len(data), b"", False

    def close(self) -> None:
        """Let others hold the file."""
        self._torn = False
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy or a pickle, which does not hold the file."""
        return {**self.__dict__, "_torn": False, "_lock": None}

    def _hold(self) -> None:
        """Lock the file, unless this log has done so."""
        if self._lock is not None and self._lock.is_locked:
            return
        lock = FileLock(f"{self.path}.lock", thread_local=False)
        me, path = f"process {os.getpid()} on {platform.node()}", Path(lock.lock_file)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            holder = "another process"
            with suppress(OSError, ValueError):
                holder = path.read_text().strip() or holder
            raise LogError(
                f"The log {self.path} is held by {holder}{', this one' if holder == me else ''}: "
                "two collections with one log would measure twice. Wait until the other one is "
                "done, close() it, or name another log."
            ) from None
        self._lock = lock
        if not isinstance(lock, SoftFileLock):  # the file of that one is its own
            with suppress(OSError):
                path.write_text(me)

    @contextmanager
    def _explained(self, what: str, way_out: str) -> Iterator[None]:
        """Say what an error of the file system is about."""
        try:
            yield
        except LogError:
            raise
        except OSError as error:
            raise LogError(f"The log {self.path} cannot be {what}: {error}. {way_out}") from error

    def _record(self, line: bytes, number: int) -> Record:
        """Parse one line."""
        try:
            record = json.loads(line, parse_constant=_refuse)
        except (ValueError, RecursionError):
            record = None
        if not isinstance(record, dict):
            raise ValueError(
                f"Expected a JSON object in each line of {self.path}, found {line[:80]!r} in line "
                f"{number}. Remove that line, or name another file."
            )
        return record


def _line(record: Record) -> bytes:
    return json.dumps(record, allow_nan=False).encode() + b"\n"


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")
