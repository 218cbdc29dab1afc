"""A file that loses no measurement."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

Record = dict[str, Any]


class MeasurementLog:
    """Records in a file, one line of JSON each, that are on the disk before anything else happens.

    Killing the process at any moment leaves a file that can be read again: of what was being
    written then, whole lines count, and a torn last line is removed.

    Args:
        path: The file; it and its folder are made with the first record.

    Example:
        >>> import tempfile
        >>> log = MeasurementLog(Path(tempfile.mkdtemp()) / "measurements.jsonl")
        >>> log.append([{"x": [0.5], "y": [1.25]}])
        >>> log.read()
        [{'x': [0.5], 'y': [1.25]}]
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def append(self, records: Iterable[Record]) -> None:
        """Write records at the end, and wait until they are on the disk.

        Raises:
            OSError: If they cannot be written.
        """
        new = not self.path.exists()
        if new:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        lines = "".join(json.dumps(record, allow_nan=False) + "\n" for record in records)
        with self.path.open("ab") as file:
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())
        if new and os.name == "posix":
            # The file's name is in its folder, which has to be on the disk, too.
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def read(self) -> list[Record]:
        """Return all records, after a repair of a torn last line; none if there is no file.

        Raises:
            ValueError: If another line is not a record.
        """
        if not self.path.exists():
            return []
        content = self.path.read_bytes()
        *lines, tail = content.split(b"\n")
        records = [self._record(line, number) for number, line in enumerate(lines, start=1)]
        if tail:
            try:
                records.append(self._record(tail, len(lines) + 1))
            except ValueError:
                with self.path.open("r+b") as file:
                    file.truncate(len(content) - len(tail))
                    os.fsync(file.fileno())
            else:
                with self.path.open("ab") as file:
                    file.write(b"\n")
                    os.fsync(file.fileno())
        return records

    def _record(self, line: bytes, number: int) -> Record:
        """Parse one line."""
        try:
            record = json.loads(line)
        except ValueError:
            record = None
        if not isinstance(record, dict):
            raise ValueError(
                f"Expected a JSON object in each line of {self.path}, found {line[:40]!r} in line "
                f"{number}. Remove that line, or name another file."
            )
        return record
