"""Calibration and seeds: the data sets, smoke runs, and the targets."""

import math

import pandas as pd
import pytest
import torch

from paper.calibration import (
    LONG,
    METHODS,
    PUMP,
    ROWS,
    SETS,
    SHORT,
    SMOOTH,
    Calibration,
    Seeds,
    SeedsSettings,
    Settings,
)
from paper.calibration.calibration import of_pair, pump, targets
from paper.calibration.seeds import tables
from paper.common.runner import main

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


@pytest.mark.slow
def test_smoke(tmp_path):
    settings = Settings(num_test=20)
    experiment = Calibration(out=tmp_path, settings=settings)
    kinds = [("forrester", 5, 0.0), ("branin", 2, 0.05), PUMP]
    records = [
        dict(zip(experiment.key, (*kind, method, 0), strict=True))
        | experiment.run(*kind, method, 0)
        for kind in kinds
        for method in ("map", "default")
    ]
    assert all(0 <= r["half"] <= r["coverage"] <= 1 for r in records)
    found = experiment.tables(records)
    assert "pump, N = 12, noisy" in found["coverage"].text
    assert "| default |" in found["summary"].text
    assert found["targets"].text.count("**not run**") == 2


@pytest.mark.parametrize("worst", [0.9, 0.8])
def test_targets(tmp_path, worst):
    """The rows of a trial in which all but two methods of one row are alike."""
    scores = {"nlpd": 0.0, "half": 0.5, "seconds": 1.0, "warned": False}
    kinds = [(*row, method) for row in (*ROWS, PUMP) for method in METHODS]
    records = [
        {"problem": name, "per_input": size, "noise": noise, "method": method, "seed": 0,
         "N": size, "nrmse": 2.0 if (name, method) == ("booth", "compare") else 1.0,
         "coverage": worst if name == "currin" else 0.95, **scores}
        for name, size, noise, method in kinds
    ]  # fmt: skip
    runs = pd.DataFrame(records)
    rows = runs[(runs["method"] == "map") & (runs["problem"] != "pump")]
    singles = pd.concat([rows.assign(method="cka"), rows.assign(method="SMT MFK")])
    found = {each.id: each for each in targets(runs, singles)}
    assert (found["D2"].verdict, found["D2"].measured) == (
        ("met", "none")
        if worst > 0.85
        else ("missed", "currin, N = 5: 0.800; currin, N = 10: 0.800")
    )
    assert (found["D4"].verdict, found["D6"].verdict) == ("met", "missed")
    assert found["R4"].verdict == "met"
    assert found["R4"].measured.startswith("in 14 of 16;")
    runs = Calibration(out=tmp_path / "calibration").tables(records)["targets"].text
    assert "no results of structures" in runs


def test_there_are_sixteen_kinds_and_the_noise_is_what_it_says():
    assert len(ROWS) == 16
    clean, noisy = (of_pair("branin", 500, noise, 10, 0) for noise in (0, 0.05))
    assert torch.equal(clean.X, noisy.X)
    assert (noisy.Y - clean.Y).std().item() == pytest.approx(noisy.noise.item(), rel=0.1)
    assert noisy.noise.item() == pytest.approx(0.05 * noisy.truth.std().item())


def test_the_pump_has_outputs_of_very_different_units():
    data = pump(12, 0)
    assert data.Y.shape == (12, 2)
    size = data.truth.std(0)
    assert size[0] / size[1] > 1e6
    wrong = data.physics(data.points) - data.truth
    assert (wrong.square().mean(0).sqrt() > 3 * data.noise).all()


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
def test_targets_of_seeds(tmp_path, is_good):
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


@pytest.mark.slow
def test_a_run_of_few_fits(tmp_path, monkeypatch):
    for name in ("SETS", "SMOOTH"):
        monkeypatch.setattr(f"paper.calibration.{name}", SETS[:1])
        monkeypatch.setattr(f"paper.calibration.seeds.{name}", SETS[:1])
    settings = SeedsSettings(points=5, effort=1, samples=8)
    main(Seeds(out=tmp_path, runs=2, jobs=1, long_runs=1, smooth_sets=1, settings=settings))
    assert str(SETS[0]) in (tmp_path / "tables.md").read_text()
