"""The commit that code was checked out from."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path


@cache
def commit_of(root: Path) -> str | None:
    """The hash of a repository's current commit, read once per process.

    A ``"+"`` follows it if tracked files differ from it. Those in ``paper/results`` do not count,
    which runs themselves change.

    Args:
        root: The root of the repository.

    Returns:
        None if it is none (as in an unpacked archive), has no commit yet, or git does not answer.
    """
    found = _git(root, "rev-parse", "HEAD", "--show-prefix")
    if found is None:
        return None
    head, _, prefix = found.partition("\n")
    if prefix.strip():  # of a repository in which ours is but a folder
        return None
    changed = _git(
        root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!paper/results"
    )
    return head + "+" if changed else head


def _git(root: Path, *command: str) -> str | None:
    """What git prints, or None if it fails or is not installed."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *command], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout
