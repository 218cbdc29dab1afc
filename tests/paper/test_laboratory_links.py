"""Smoke runs of the experiments on links and on categories."""

import json

import pytest

from paper.__main__ import main


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "only", "number"),
    [("links", ["rate", "pump", "linked", "default"], 8), ("categories", ["each", "ours"], 4)],
)
def test_it_runs(name, only, number, tmp_path, monkeypatch):
    out = tmp_path / name
    options = ["--runs", "2", "--only", *only, "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["paper", name, *options])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert len(runs) == number
    assert all(run["rmse"] > 0 for run in runs)
    assert "coverage of 95 %" in (out / "tables.md").read_text()
