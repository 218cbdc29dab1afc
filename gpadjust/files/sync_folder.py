"""Names of files on the disk."""

from __future__ import annotations

import os
from pathlib import Path


def sync_folder(path: Path) -> None:
    """Wait until the names of the files in a folder are on the disk, where the system supports it.

    A file that was written and synchronised is else lost with its name when the power is cut.
    """
    if os.name == "posix":
        folder = os.open(path, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
