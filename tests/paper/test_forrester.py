"""Forrester's function: the readings, a smoke run, and the claims."""

import pandas as pd
import pytest
import torch

from paper.common.runner import runs_file
from paper.forrester import Forrester
from paper.forrester.forrester import NAMES, judge
from paper.forrester.problem import CRUDE, POINTS, observations, truth
from paper.pages import PAPER

RESULTS = PAPER / "results"

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


def test_readings_of_the_crude_function():
    torch.testing.assert_close(truth(POINTS), 2 * CRUDE["B"](POINTS) - 5 * POINTS)
    torch.testing.assert_close(truth(POINTS), 8 * CRUDE["A"](POINTS) - 20 * POINTS)
    error = {r: (CRUDE[r](POINTS) - truth(POINTS)).square().mean().sqrt().item() for r in "AB"}
    assert error["A"] == pytest.approx(2.47, abs=0.01)
    assert error["B"] == pytest.approx(1.77, abs=0.01)
    X, Y = observations(3, 8)
    assert X.shape == Y.shape == (8, 1)
    assert ((X >= -0.6) & (X <= 1)).all()


@pytest.mark.slow
def test_smoke(tmp_path):
    """One data set for each protocol; the tables of the runs that are committed."""
    experiment = Forrester(out=tmp_path, steps=2, lengthscales=(0.5, 1.0), ridges=(0.01,))
    found = {
        protocol: experiment.run("B", protocol, 1)
        for protocol in ("gpadjust", "paper", "closed form")
    }
    assert [*found["closed form"]] == ["rmse"]
    assert len(found["closed form"]["rmse"]) == 1 + 2
    error = dict(zip(found["gpadjust"]["model"], found["gpadjust"]["rmse"], strict=True))
    assert error["CKA"] < 0.05 < error["Phy-mean GP"]
    assert error["Phy-mean GP"] == error["GP-bias"]
    records = list(runs_file(Forrester(out=RESULTS)).read().values())[:50]
    assert "F7 | RRA about 50 %" in Forrester().tables(records)["claims-B"].text


@pytest.mark.parametrize(
    ("claim", "rmse", "verdict"),
    [
        ("F1", {"Zero-mean GP": 0.9}, "reproduced"),
        ("F1", {"Zero-mean GP": 1.1}, "not reproduced"),
        ("F1", {"Zero-mean GP": 0.999}, "inconclusive"),
        ("F2", {"GP-scale": 0.9}, "reproduced"),
        ("F3", {"GP-bias": 1.1}, "not reproduced"),
        ("F4", {"GP-scale": 1.2}, "reproduced"),
        ("F4", {"GP-scale": 1.2, "AR1": 1.3}, "not reproduced"),
        ("F6", {"CKA": 0.7}, "reproduced"),
        ("F6", {"CKA": 0.9}, "not reproduced"),
        ("F6", {"CKA": 0.1}, "beaten"),
        ("F7", {"RRA": 0.5}, "reproduced"),
        ("F7", {"RRA": 0.5, "CKA": 0.4}, "not reproduced"),
    ],
)
def test_verdicts(claim, rmse, verdict):
    """Two runs of all models, whose differences vary by a hundredth."""
    runs = pd.DataFrame(
        {
            "seed": seed,
            "model": name,
            "rmse": rmse.get(name, 1) + seed * (0.3 if name == "GP-scale" else 0.1)
            - seed * 0.2 * (name == "GP-scale") + seed * 0.001 * NAMES.index(name),
        }
        for seed in (0, 1)
        for name in NAMES
    )  # fmt: skip
    f_p = pd.DataFrame({"seed": [0, 1], "model": "f_p", "rmse": [1.0, 1.101]})
    found = judge(pd.concat([runs, f_p]))
    assert next(c.verdict for c in found if c.id == claim) == verdict


def test_a_closed_form_that_gives_both_verdicts_leaves_the_claim_undetermined():
    rows = [("f_p", 1.0), *((name, 1.0) for name in NAMES)]
    runs = pd.DataFrame([{"seed": s, "model": m, "rmse": e} for s in (0, 1) for m, e in rows])
    cells = [{"model": "0.5, 0.01", "rmse": 0.5}, {"model": "1, 0.01", "rmse": 1.2}]
    cells.append({"model": "f_p", "rmse": 1.0})
    grid = pd.DataFrame(
        [{**c, "seed": s, "protocol": "closed form"} for s in (0, 1) for c in cells]
    )
    found = judge(runs, grid)[-1]
    assert found.verdict == "undetermined"
    assert "-50% to +20%" in found.measured
