"""A log file that does not lose measurements."""

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
    """A log of measurements cannot be locked, read or written."""


class MeasurementLog:
    """Records in a file, one line of JSON each, which :meth:`append` writes to the disk at once.

    After the process is killed at any moment, the file can be read again: complete lines count, and
    a torn last line is removed before the next one is written. If records cannot be written, for
    example to a full disk, the file does not change.

    One log at a time holds a file, from :meth:`open` until it is closed or deleted, or its process
    ends. The lock is another file in the folder, ``<name>.lock``, which stays there. Copies and
    pickles of a log do not hold its file; their first :meth:`append` locks it, unless the file has
    changed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).resolve()
        self._size = 0  # of the records, in bytes
        self._missing_end = b""  # of the last line
        self._torn = False  # if part of a record may come after the records
        self._lock: BaseFileLock | None = None

    def open(self, bounds: list[list[float]]) -> list[Record]:
        """Lock the file and return its records; make a new file and its folder if needed.

        The first line has the bounds of the inputs, ``2 x d``. Raise a LogError if another log
        holds the file or it cannot be written, a ValueError if its content is of another kind.
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
            if _line(header).startswith(content):  # an empty file, or a torn header
                self._size = 0
                self._torn = True
                self.append([header])
                sync_folder(self.path.parent)
                return []
        # The tail is empty after a complete line, else a line without its end or a part of one.
        *lines, tail = content.split(b"\n")
        records = [self._record(line, number) for number, line in enumerate(lines, start=1)]
        self._size = len(content) - len(tail)
        self._missing_end = b""
        self._torn = bool(tail)
        with suppress(ValueError):  # of a torn last line, which does not count
            if tail:
                records.append(self._record(tail, len(lines) + 1))
                self._size = len(content)
                self._missing_end = b"\n"
                self._torn = False
        if not records or records[0].get("format") != _FORMAT:
            raise ValueError(f"{self.path} is not a log of measurements; name another file.")
        if records[0].get("bounds") != bounds:
            raise ValueError(
                f"The log {self.path} has measurements within the bounds "
                f"{records[0].get('bounds')}, got {bounds}; name another file, or take its bounds."
            )
        return records[1:]

    def append(self, records: Iterable[Record]) -> None:
        """Write records at the end, and wait until they are on the disk, or raise a LogError."""
        data = self._missing_end + b"".join(map(_line, records))
        way_out = "The new records are neither on the disk nor in the collection: make room, and "
        with self._explained("written", way_out + "tell it again."):
            self._hold()
            with self.path.open("r+b", buffering=0) as file:
                # Bytes after the records are our own torn record, or another program's.
                size = file.seek(0, os.SEEK_END)
                if size != self._size and not (self._torn and size > self._size):
                    self.close()
                    raise LogError(
                        f"Expected {self._size} bytes in the log {self.path}, found {size}: "
                        "something else has written to it. Make a new collection with it."
                    )
                try:
                    file.seek(self._size)
                    file.truncate()  # a torn record of before
                    rest = data
                    while rest:  # a write without buffer may write a part
                        rest = rest[file.write(rest) :]
                    os.fsync(file.fileno())
                except BaseException:
                    # Remove what was written; if that fails, too, the first error says why.
                    self._torn = True
                    with suppress(OSError):
                        file.truncate(self._size)
                        os.fsync(file.fileno())
                        self._torn = False
                    raise
        self._size += len(data)
        self._missing_end = b""
        self._torn = False

    def close(self) -> None:
        """Release the file."""
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
        path = Path(lock.lock_file)
        this_process = f"process {os.getpid()} on {platform.node()}"
        try:
            lock.acquire(timeout=0)
        except Timeout:
            # The lock file has the name of its holder, for this message alone.
            holder = "another process"
            with suppress(OSError, ValueError):
                holder = path.read_text().strip() or holder
            if holder == this_process:
                holder += ", this one"
            raise LogError(
                f"The log {self.path} is held by {holder}: two collections with one log would "
                "measure twice. Wait until the other one is done, close() it, or name another log."
            ) from None
        self._lock = lock
        if not isinstance(lock, SoftFileLock):  # a soft lock writes its file itself
            with suppress(OSError):
                path.write_text(this_process)

    @contextmanager
    def _explained(self, what: str, way_out: str) -> Iterator[None]:
        """Raise errors of the file system with the path of the log and the way out."""
        try:
            yield
        except LogError:
            raise
        except OSError as error:
            raise LogError(f"The log {self.path} cannot be {what}: {error}. {way_out}") from error

    def _record(self, line: bytes, number: int) -> Record:
        """Return the record in a line."""
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
    """Return the line of a record."""
    return json.dumps(record, allow_nan=False).encode() + b"\n"


def _refuse(constant: str) -> NoReturn:
    """Raise an error: Python's parser takes NaN and infinity, which are not in JSON."""
    raise ValueError(f"{constant} is not JSON")
