"""Put one fault after the other into a copy of the repository, and see which test finds it.

A fault of faults.txt: its file and what goes wrong, lines that are once in the file, and theirs.

python tests/mutation                 # all of them
python tests/mutation active rl       # those of some rooms
python tests/mutation --check         # only see that they fit the code
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
_LIMIT = 1200  # seconds, after which a run that hangs counts as found


class Fault(NamedTuple):
    """A text of a file, the one that takes its place, and what goes wrong then."""

    file: str
    old: str
    new: str
    why: str

    @property
    def room(self) -> str:
        """The folder of the library that it is in, whose tests come first."""
        return self.file.split("/")[1]


def read() -> list[Fault]:
    """All faults."""
    faults = []
    for entry in Path(__file__).with_name("faults.txt").read_text().rstrip("\n").split("\n\n"):
        head, *lines = entry.split("\n")
        file, why = head.split(": ", 1)
        old, new = ("\n".join(line[1:] for line in lines if line[0] == mark) for mark in "-+")
        faults.append(Fault(file, old, new, why))
    return faults


def check() -> None:
    """Raise a ValueError unless each old text is in its file, once."""
    for fault in read():
        path = ROOT / fault.file
        found = path.read_text().count(fault.old) if path.exists() else 0
        if found != 1:
            raise ValueError(
                f"Expected to find {fault.old!r} once in {fault.file}, found it {found} times: "
                "write the fault for the code as it is."
            )


def found_by(copy: Path, fault: Fault, processes: int) -> str | None:
    """The first test that fails in a copy with the fault, or None: the room's, then quick ones."""
    path = copy / fault.file
    text = path.read_text()
    path.write_text(text.replace(fault.old, fault.new))
    folder = f"tests/{fault.room}"
    here = [folder] if (copy / folder).is_dir() else []
    tried = [[*here, "-m", "not slow"], [*here, "-m", "slow"]] if here else []
    try:
        for places in [*tried, [f"--ignore={folder}"] if here else []]:
            failed = first_failure(copy, places, processes)
            if failed:
                return failed
    finally:
        path.write_text(text)
    return None


def first_failure(copy: Path, places: list[str], processes: int) -> str | None:
    """The first test of some places that fails, or None."""
    options = ["-x", "-q", "-rfE", "--no-header", "--ignore=tests/mutation"]
    options += ["-p", "no:cacheprovider", "--numprocesses", str(processes)]
    command = [sys.executable, "-m", "pytest", *options, *places]
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        run = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=_LIMIT
        )
    except subprocess.TimeoutExpired:
        return f"(a run that took more than {_LIMIT} s)"
    if run.returncode == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", run.stdout, re.MULTILINE)
    if failed is None:
        raise RuntimeError(f"pytest did not run:\n{run.stdout[-2000:]}\n{run.stderr[-2000:]}")
    return failed[1]


def main() -> int:
    """Print a table of the faults; the number of those that no test finds is the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rooms", nargs="*", help="rooms of the library, or files; default: all")
    parser.add_argument("--check", action="store_true", help="see that the faults fit the code")
    parser.add_argument("--numprocesses", type=int, default=2, help="of pytest")
    arguments = parser.parse_args()
    check()
    if arguments.check:
        return 0
    asked = {*arguments.rooms}
    chosen = [fault for fault in read() if not asked or {fault.room, fault.file} & asked]
    missed = 0
    print("| fault | found by | s |\n|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        unneeded = shutil.ignore_patterns(".git", ".*_cache", "__pycache__", "_build")
        shutil.copytree(ROOT, copy, ignore=unneeded)
        broken = first_failure(copy, ["--collect-only"], 0)
        if broken:
            raise RuntimeError(f"The tests cannot be collected, without any fault: {broken}")
        for fault in chosen:
            start = time.perf_counter()
            test = found_by(copy, fault, arguments.numprocesses)
            missed += test is None
            seconds = time.perf_counter() - start
            what = f"`{fault.file.removeprefix('gpadjust/')}`: {fault.why}"
            print(f"| {what} | {test or '**not found**'} | {seconds:.0f} |", flush=True)
    print(f"\n{len(chosen) - missed} of {len(chosen)} found.")
    return missed


if __name__ == "__main__":
    sys.exit(main())
