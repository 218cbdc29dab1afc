"""The experiment on formulas and what is made of them: its cells, and a smoke run."""

import math

import pytest

from paper.published import Formula
from paper.published.formula import cells

RUN = {"group": "kinds", "problem": "decay", "size": 5, "noise": 0.0, "held": [0.9]}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [("kinds", "decay"), ("right", "lens"), ("laws", "creep"), ("functions", "forrester")]
)
def test_formula(kind, ran, tmp_path):
    runs, tables = ran("formula", "--only", *kind)
    assert {(run["group"], run["problem"]) for run in runs} == {kind}
    assert all(0 < run["ours"][0] < 10 * run["formula"][0] for run in runs)
    assert (tmp_path / "formula.png").exists()
    assert "worst cell" in tables


def test_ratios(tmp_path):
    experiment = Formula(out=tmp_path / "formula")
    runs = [{**RUN, "ours": [a], "formula": [1.0]} for a in (0.5, 2.0)]
    runs += [{**RUN, "size": 10, "ours": [1.05, 1.05], "formula": [1.0, 1.0]}] * 2
    found = cells(runs, experiment)
    assert found.groupby("cell")["gap"].mean().tolist() == pytest.approx([math.log(1.05), 0.0])
    assert "| all | 2 | 1.02 " in experiment.tables(runs)["groups"].text
