"""Runs of experiments by their command."""

import json

import pytest

from paper.__main__ import main


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Runs an experiment with two runs of each kind; returns these and its tables."""

    def command(name, *options):
        given = [name, "--runs", "2", "--jobs", "1", "--out", str(tmp_path), *options]
        monkeypatch.setattr("sys.argv", ["paper", *given])
        main()
        lines = (tmp_path / name / "runs.jsonl").read_text().splitlines()
        runs = [run for run in map(json.loads, lines) if "identifying" not in run]
        return runs, (tmp_path / name / "tables.md").read_text()

    return command
