"""Smoke runs of the experiments on drift and on sister machines."""

import json

import pytest

from paper.__main__ import main


def ran(monkeypatch, out, name, *options):
    arguments = ["paper", name, "--runs", "2", "--jobs", "1", "--out", str(out), *options]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    return [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_sisters(tmp_path, monkeypatch):
    options = ["--only", "one", "--known", "8", "--tests", "20"]
    runs = ran(monkeypatch, tmp_path / "sisters", "sisters", *options)
    assert len(runs) == 2
    assert all(0 <= run["probability"] <= 1 for run in runs)
    assert "geometric mean" in (tmp_path / "sisters" / "tables.md").read_text()


@pytest.mark.slow
def test_drift(tmp_path, monkeypatch):
    options = ["--steps", "60", "--first", "24", "--num-features", "8", "--refit-every", "24"]
    runs = ran(monkeypatch, tmp_path / "drift", "drift", *options)
    assert len(runs) == 10
    assert all(run["rmse"] > 0 for run in runs)
    assert "coverage of observations" in (tmp_path / "drift" / "tables.md").read_text()
