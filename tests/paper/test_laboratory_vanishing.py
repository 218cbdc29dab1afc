"""Smoke run of the experiment on what vanishes where the formula is right."""

import json

import pytest

from paper.__main__ import main


@pytest.mark.slow
def test_vanishing(tmp_path, monkeypatch):
    out = tmp_path / "vanishing"
    options = ["--runs", "2", "--only", "ball", "misplaced", "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["paper", "vanishing", *options])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert len(runs) == 10
    assert all(low < high for low, high in (run["interval"] for run in runs))
    assert "true value held" in (out / "tables.md").read_text()
