"""Names of files on the disk."""

from __future__ import annotations

import os
from pathlib import Path


def sync_folder(path: Path) -> None:
    """Wait until the names of the files in a folder are on the disk, if the system supports it.

    Without this, a power cut may remove the name of a file whose content is on the disk.
    """
    if os.name == "posix":
        folder = os.open(path, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
