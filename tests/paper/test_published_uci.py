"""The experiment on published regression tables: its splits, its formulas, and a smoke run."""

import pandas as pd
import pytest
import torch

from paper.published import TABLES, Uci
from paper.published.rivals import fitted_formula
from paper.published.uci import PUBLISHED
from paper.published.uci_tables import DATA, physics, split


@pytest.mark.parametrize("table", TABLES)
def test_splits_are_the_usual_ones(table):
    rows, test = (pd.read_csv(DATA / f"{table}{end}.csv") for end in ("", "_test"))
    for number in (0, 19):
        full, few = split(table, 0.9, number), split(table, 0.1, number)
        held = test[f"split_{number}"] == 1
        assert len(full.points) == held.sum()
        assert len(full.X) == len(rows) - held.sum()
        assert len(few.X) == round(0.1 * len(rows))
        assert torch.equal(few.points, full.points)
        every = {tuple(row) for row in torch.cat([full.X, full.Y], -1).tolist()}
        assert {tuple(row) for row in torch.cat([few.X, few.Y], -1).tolist()} <= every


@pytest.mark.filterwarnings("ignore:.*equal an earlier row")  # the table of concrete is so
@pytest.mark.parametrize("table", TABLES)
def test_formula_explains_most_of_the_output(table):
    X, Y, points, expected = split(table, 0.25, 0)
    with torch.no_grad():
        mean = fitted_formula(X, Y, physics(table)).predict(points).mean
    assert (mean - expected).square().mean() < 0.5 * (expected - Y.mean()).square().mean()


def test_published_rows_are_of_all_tables():
    assert all(len(row.rmse) == len(row.density) == len(TABLES) for row in PUBLISHED.values())


def test_there_are_twenty_splits():
    with pytest.raises(ValueError, match="twenty splits"):
        Uci(runs=2, seed=19).check()


@pytest.mark.slow
@pytest.mark.parametrize("method", [("cka", "gp", "ensemble"), ("formula", "single", "feature")])
def test_uci(method, ran, tmp_path, monkeypatch):
    monkeypatch.setattr("paper.published.rivals._STEPS", 200)
    runs, tables = ran("uci", "--only", "yacht", "0.1", *method)
    assert {run["method"] for run in runs} == {*method}
    assert all(0 < run["rmse"] < 5 for run in runs)
    assert "WGBoost" in tables
    assert (tmp_path / "uci.png").exists()
