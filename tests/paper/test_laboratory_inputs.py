"""Smoke runs of the experiments on noisy inputs and repeated rows."""

import json

import pytest

from paper.__main__ import main


def run(monkeypatch, tmp_path, name, *options):
    out = tmp_path / name
    given = [name, "--runs", "2", "--jobs", "1", "--out", str(out), *options]
    monkeypatch.setattr("sys.argv", ["paper", *given])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    return runs, (out / "tables.md").read_text()


@pytest.mark.slow
def test_noisy_inputs(tmp_path, monkeypatch):
    options = ["--only", "wave", "decay", "--observations", "12", "--observations-of-law", "12"]
    runs, tables = run(monkeypatch, tmp_path, "noisyinputs", *options)
    assert len(runs) == 8
    assert "RMSE over that of ignoring it" in tables
    assert "held by 95 %" in tables


@pytest.mark.slow
def test_repeats(tmp_path, monkeypatch):
    runs, tables = run(monkeypatch, tmp_path, "repeats", "--only", "400", "copies", "map")
    assert len(runs) == 4
    assert runs[0]["off_given"] < 1e-8
    assert "Rows that stand twice" in tables
