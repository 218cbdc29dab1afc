"""Smoke runs of the experiments on a physics that is known by its runs."""

import json

import pytest

from paper.__main__ import main

SMALL = {
    "emulated": ["--runs", "2", "--only", "booth", "--num-test", "50"],
    "balldrop": ["--runs", "2", "--only", "softball", "--num-runs", "8", "--heights", "20", "60"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["emulated", pytest.param("balldrop", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")
def test_it_runs(name, tmp_path, monkeypatch):
    out = tmp_path / name
    options = [*SMALL[name], "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["paper", name, *options])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert runs
    tables = (out / "tables.md").read_text()
    assert all(text in tables for text in ("95 %", "RMSE"))
    assert (out / f"{name}.png").exists()
