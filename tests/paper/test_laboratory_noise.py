"""Smoke runs of the experiments on relative noise and on outliers."""

import json

import pytest

from paper.__main__ import main


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "number"),
    [
        ("relative", ["--only", "rate", "CKA"], 4),
        ("outliers", ["--only", "good", "20"], 2),
    ],
)
def test_noise(name, options, number, tmp_path, monkeypatch):
    out = tmp_path / name
    options = [*options, "--runs", "2", "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["paper", name, *options])
    main()
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert len(runs) == number
    assert "0.93" in (out / "tables.md").read_text()
    assert (out / f"{name}.png").exists()
