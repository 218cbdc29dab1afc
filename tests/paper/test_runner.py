"""How runs are made and kept, whatever the experiment."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest
from cloudpickle import register_pickle_by_value, unregister_pickle_by_value

from paper.common import runner
from paper.common.experiment import Axes, Experiment
from paper.common.runner import Refused, main, run_missing, runs_file
from paper.common.runs import RunsFile, commit_of, versions
from tests.paper import toy
from tests.paper.toy import Toy

ROOT = Path(__file__).parents[2]


def calls(out):
    return (out / "log").read_text().splitlines()


def test_all_tasks_are_run_once_and_shown(tmp_path, capsys):
    squares = Toy(out=tmp_path)
    main(squares)
    assert "Runs\n\n6\n" in capsys.readouterr().out
    assert "<!-- toy:runs -->\n6\n\n*Runs: 6 by" in (tmp_path / "toy" / "tables.md").read_text()
    assert calls(tmp_path)[0] == "('a', 0)"
    record = runs_file(squares).read()["b", 2]
    assert (record["value"], record["nothing"]) == (4, None)
    assert record["settings"] == {"scale": 1.0, "inner": {"kind": "b"}}
    assert record["versions"] == versions(Toy.packages)
    assert (record["commit"], record["date"]) == (commit_of(ROOT) or (None, None))
    assert record["took"] >= 0
    main(squares)
    main(replace(squares, only_tables=True, runs=4))
    assert len(calls(tmp_path)) == 6


def test_an_interrupted_call_goes_on_and_a_larger_one_adds(tmp_path):
    (tmp_path / "stop").touch()
    with pytest.raises(KeyboardInterrupt):
        main(Toy(out=tmp_path))
    assert len(calls(tmp_path)) == 2
    (tmp_path / "stop").unlink()
    main(Toy(out=tmp_path))
    main(Toy(out=tmp_path, runs=4))
    assert len(calls(tmp_path)) == len(set(calls(tmp_path))) == 8


@pytest.mark.slow
def test_runs_in_other_processes(tmp_path):
    register_pickle_by_value(toy)  # which they cannot import
    try:
        main(Toy(out=tmp_path, jobs=2, runs=2))
    finally:
        unregister_pickle_by_value(toy)
    assert len(runs_file(Toy(out=tmp_path)).read()) == 4


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"runs": 0}, "--runs: expected at least"),
        ({"jobs": 0}, "--jobs: expected at least"),
        ({"only": ("c",)}, "--only: there is no 'c'"),
        ({"only_tables": True}, "There are no results"),
        ({"missing": True}, "It needs a simulator"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_run(tmp_path, options, said):
    with pytest.raises(Refused, match=said):
        main(replace(Toy(out=tmp_path), **options))
    assert not list(tmp_path.iterdir())


@dataclass(frozen=True, kw_only=True)
class More(Toy):
    """With another inner setting, and one that it did not have."""

    def describe(self, *kind):
        return {"inner": {"kind": "c", "more": 1}, "sort": "new"}


More.name = Toy.name  # it reads the same file


def test_runs_of_other_settings_are_refused(tmp_path):
    """Settings that only one of them has are those of another version, and do not count."""
    main(Toy(out=tmp_path))
    with pytest.raises(Refused, match=r"a-0 was made with other settings: scale was 1\.0 and is "):
        main(Toy(out=tmp_path, scale=2.0))
    with pytest.raises(Refused, match=r"inner\.kind was a and is now c"):
        main(More(out=tmp_path))
    with pytest.raises(Refused, match="a-0 was made with other settings"):
        main(Toy(out=tmp_path, only_tables=True, only=("b",), scale=7.0))
    assert len(calls(tmp_path)) == 6


def test_runs_of_other_versions_are_not_added_to(tmp_path, monkeypatch):
    main(Toy(out=tmp_path))
    later = {**versions(Toy.packages), "numpy": "99"}
    monkeypatch.setattr(runner, "versions", lambda packages: later)
    main(Toy(out=tmp_path))  # nothing is missing
    with pytest.raises(Refused, match=r"versions\.numpy was .* and is now 99\. Choose another"):
        main(Toy(out=tmp_path, runs=4))
    assert len(calls(tmp_path)) == 6


@dataclass(frozen=True, kw_only=True)
class Pairs(Experiment):
    """Kinds by two learners, of which one has fewer seeds, and one no pair."""

    axes: ClassVar[Axes] = {
        "name": {"x": "x", "y": "y"},
        "n": {1: "1", 2: "2"},
        "learner": {"cka": "CKA", "gp": "GP"},
    }
    single: ClassVar[tuple[str, ...]] = ("gp",)

    def seeds_of(self, *kind):
        return () if kind[:2] == ("y", 2) else super().seeds_of(*kind)


def test_cases_follow_from_the_axes():
    assert Pairs.key == ("name", "n", "learner", "seed")
    cases = Pairs(runs=2, seed=5).cases()
    assert cases[:4] == [
        ("x", 1, "cka", 5),
        ("x", 1, "gp", 5),
        ("x", 1, "cka", 6),
        ("x", 2, "cka", 5),
    ]
    assert len(cases) == 9
    assert Pairs(runs=1, only=("y", "gp")).cases() == [("y", 1, "gp", 0)]
    assert Pairs(runs=1, only=("1", "gp")).cases() == [("x", 1, "gp", 0), ("y", 1, "gp", 0)]
    with pytest.raises(ValueError, match=r"there is no 'z', but .* name: x, y; n: 1, 2; learner"):
        Pairs(only=("z",)).cases()


def test_a_commit_is_that_of_the_repository_and_says_if_files_are_changed(tmp_path):
    def git(*command):
        name = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        run = ["git", "-C", str(tmp_path), *name, *command]
        return subprocess.run(run, check=True, capture_output=True, text=True).stdout.strip()

    def found(folder=tmp_path):
        commit_of.cache_clear()
        return commit_of(folder)

    results = tmp_path / "paper" / "results"
    results.mkdir(parents=True)
    assert found() is None
    git("init")
    assert found() is None  # there is no commit
    for file in (tmp_path / "code.py", results / "runs.jsonl"):
        file.write_text("1\n")
    git("add", ".")
    git("commit", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert found() == (head, git("show", "-s", "--format=%cs"))
    assert found(results) is None  # a folder in another's repository
    (tmp_path / "untracked").write_text("")
    (results / "runs.jsonl").write_text("2\n")
    assert found()[0] == head
    (tmp_path / "code.py").write_text("2\n")
    assert found()[0] == head + "+"


def test_a_torn_line_is_not_read_and_not_glued_to_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr("time.process_time", lambda: 0.0)
    squares = Toy(out=tmp_path, runs=2)
    run_missing(squares)
    path = squares.folder / runner.RUNS
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    for cut in (1, 10, len(lines[-1]) - 1):  # of the last run
        path.write_bytes(whole[: -len(lines[-1])] + lines[-1][:cut])
        assert len(runs_file(squares).read()) == 3
        run_missing(squares)
        assert path.read_bytes() == whole


def test_other_lines_are_an_error(tmp_path):
    path = tmp_path / "runs.jsonl"
    path.write_text('{"kind": "a", "seed": 0}\nnonsense\n')
    with pytest.raises(ValueError, match=r"found b'nonsense' in line 2\. Remove that line"):
        RunsFile(path, Toy.key).read()


def test_a_full_disk_loses_only_what_is_being_written(tmp_path, monkeypatch):
    file = RunsFile(tmp_path / "runs.jsonl", ("seed",))
    file.append({"seed": 0})
    before = file.path.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device; the run is not written"):
        file.append({"seed": 1})
    assert file.path.read_bytes() == before


def test_how_runs_were_made_is_written_once(tmp_path):
    """In files that name it by a text, too, as until November 2026."""
    file = RunsFile(tmp_path / "runs.jsonl", ("seed",))
    made = {"settings": {"scale": 1}, "commit": None}
    lines = [{"made_by": "8f0c", "identifying": made}, {"made_by": "8f0c", "seed": 0}]
    file.path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    runs = [{"seed": 0, **made}, {"seed": 1, "x": 0.5, **made}]
    runs += [{"seed": seed, "settings": {"scale": 2}, "commit": None} for seed in (2, 3)]
    for run in runs[1:]:
        file.append(run)
    assert list(file.read().values()) == runs
    assert file.path.read_text().count("scale") == 2
    assert len(file.path.read_text().splitlines()) == 6


def test_help_is_quick_and_imports_nothing_slow():
    code = (
        "import sys\nsys.argv = ['paper', 'arm', '--help']\nfrom paper.__main__ import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "slow = {'torch', 'smt', 'opensim', 'pandas', 'gpadjust'} & {*sys.modules}\n"
        "assert not slow, slow\n"
    )
    made = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert "--gamma" in made.stdout
    assert "--evaluate-every" in made.stdout
