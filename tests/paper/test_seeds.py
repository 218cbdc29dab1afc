"""The experiment on seeds of a fit: its tables, and a run of few fits."""

import math

import pytest

from paper.common.runner import main
from paper.seeds import LONG, SETS, SHORT, SMOOTH, Seeds, Settings
from paper.seeds.tables import tables


def record(data, fit, seed, mean, warned=False, width=0.0, held=1.0):
    return {
        "data": str(data),
        "fit": fit,
        "seed": seed,
        "mean": [mean, mean],
        "sd": [2.0, 2.0],
        "log_width": width,
        "held": held,
        "error": 0.0,
        "seconds": 0.1,
        "warned": warned,
    }


@pytest.mark.parametrize("is_good", [False, True])
def test_targets(tmp_path, is_good):
    size = 0.1 if is_good else 2.0
    records = [
        record(data, SHORT, seed, size * (seed - 1), seed != 1 and not is_good, 0.02 * size * seed)
        for data in SETS
        for seed in range(3)
    ]
    records += [record(data, LONG, 0, 0.0) for data in SETS]
    records += [
        record(data, "other data", 0, 0.0, held=0.91 if is_good else 0.89) for data in SMOOTH
    ]
    found = tables(records, Seeds(out=tmp_path))
    rows = found["targets"].text.splitlines()[2:]
    verdicts = [line.split("**")[1] for line in rows]
    # Warnings are right both times.
    widths = "met" if math.exp(0.04 * size) < 1.1 else "missed"
    assert verdicts == (["met"] * 4 if is_good else ["missed", widths, "missed", "met"])
    assert f"| {SETS[0]} | {size / 2:.2f} |" in found["seeds"].text


def test_a_run_of_few_fits(tmp_path, monkeypatch):
    for name in ("SETS", "SMOOTH"):
        monkeypatch.setattr(f"paper.seeds.{name}", SETS[:1])
    settings = Settings(points=5, effort=1, samples=8)
    main(Seeds(out=tmp_path, runs=2, jobs=1, long_runs=1, smooth_sets=1, settings=settings))
    assert str(SETS[0]) in (tmp_path / "tables.md").read_text()
