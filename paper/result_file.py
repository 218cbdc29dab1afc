"""A finished run in a file of its own."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import joblib
from tqdm import tqdm

_PACKAGES = ("gpadjust", "torch", "gpytorch", "stable_baselines3", "opensim")


def result_path(out: Path, name: str, seed: int) -> Path:
    """The file of a finished run."""
    return out / "runs" / f"{name}-{seed}.json"


def write_result(path: Path, result: dict[str, Any]) -> None:
    """Write a result as JSON, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(result, separators=(",", ":")) + "\n")
    os.replace(temporary, path)


def check_settings(path: Path, found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Raise a ValueError if what is in a file was made with other settings."""
    if found != expected:
        differ = [k for k in {**found, **expected} if found.get(k) != expected.get(k)]
        raise ValueError(
            f"{path} was made with other settings: {differ[0]} was {found.get(differ[0])} and is "
            f"now {expected.get(differ[0])}. Remove it, or choose another --out."
        )


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str]:
    """Of Python and of what the numbers come from."""
    found = {"python": platform.python_version()}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def rounded(value: Any) -> Any:
    """Five significant digits of numbers, also in lists and dictionaries."""
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, list):
        return [rounded(entry) for entry in value]
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    return value


def run_with_progress(calls: Sequence[Any], num_done: int, num_jobs: int) -> None:
    """Make joblib's delayed calls, which return paths, in parallel, with a progress bar.

    Args:
        calls: What is to be run.
        num_done: How many runs there are already.
        num_jobs: Number of parallel processes.
    """
    parallel = joblib.Parallel(n_jobs=num_jobs, return_as="generator_unordered", batch_size=1)
    progress = tqdm(parallel(calls), total=num_done + len(calls), initial=num_done, unit="run")
    for path in progress:
        progress.set_postfix_str(path.stem)
