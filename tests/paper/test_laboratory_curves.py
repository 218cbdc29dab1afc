"""Smoke run of the experiment on outputs that are a curve."""

import json

import pytest

from paper.__main__ import main


@pytest.mark.slow
def test_curves(tmp_path, monkeypatch):
    out = tmp_path / "curves"
    only = ["diffusion", "physics", "coupled", "components"]
    options = ["--runs", "2", "--only", *only, "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["paper", "curves", *options])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert len(runs) == 6
    by = {run["model"]: run["error"] for run in runs}
    assert by["coupled"] < 0.2 * by["physics"]
    assert "whole curves held" in (out / "tables.md").read_text()
