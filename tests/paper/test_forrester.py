import sys

import pandas as pd
import pytest
import torch

from paper import __main__ as command_line
from paper.forrester import runs as runs_module
from paper.forrester.claims import judge
from paper.forrester.models import MODELS as TRAINED
from paper.forrester.problem import CRUDE, GRID, observations, truth

MODELS = ["f_p", *TRAINED]


def test_truth_is_linear_in_both_readings_of_the_crude_function():
    torch.testing.assert_close(truth(GRID), 2 * CRUDE["B"](GRID) - 5 * GRID)
    torch.testing.assert_close(truth(GRID), 8 * CRUDE["A"](GRID) - 20 * GRID)


def test_crude_functions_have_the_errors_of_the_literature():
    error = {r: (CRUDE[r](GRID) - truth(GRID)).square().mean().sqrt().item() for r in "AB"}
    assert error["A"] == pytest.approx(2.47, abs=0.01)
    assert error["B"] == pytest.approx(1.77, abs=0.01)


def test_observations_are_seeded_and_in_range():
    X, Y = observations(3)
    assert X.shape == Y.shape == (8, 1)
    assert ((X >= -0.6) & (X <= 1)).all()
    assert torch.equal(X, observations(3)[0])
    assert not torch.equal(X, observations(4)[0])


def test_command_writes_table_claims_and_figures(tmp_path, monkeypatch, capsys):
    arguments = ["paper", "forrester", "--runs", "2", "--jobs", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    command_line.main()
    table = pd.read_csv(tmp_path / "table.csv")
    assert len(table) == 2 * 2 * len(MODELS)
    adjusted = table[table["model"].isin(["CKA", "RRA"]) & (table["protocol"] == "gpadjust")]
    assert (adjusted["rmse_mean"] < 0.05).all()
    claims = pd.read_csv(tmp_path / "claims.csv")
    assert len(claims) == 2 * 2 * 7
    assert (claims[claims["id"] == "F3"]["verdict"] == "reproduced").all()
    for protocol in ("paper", "gpadjust"):
        assert (tmp_path / f"forrester_{protocol}.png").stat().st_size > 20_000
    assert not (tmp_path / "runs.partial.csv").exists()
    assert "CKA" in capsys.readouterr().out


@pytest.mark.parametrize(("option", "value"), [("--runs", "1"), ("--jobs", "0")])
def test_options_out_of_range(tmp_path, monkeypatch, option, value):
    arguments = ["paper", "forrester", option, value, "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match=f"{option}: expected at least"):
        command_line.main()
    assert not list(tmp_path.iterdir())


def fake_run(reading, protocol, seed):
    which = {"reading": reading, "protocol": protocol, "seed": seed}
    return [
        {**which, "model": m, "rmse": 1.0, "nlpd": 0.0, "crps": 0.0, "coverage": 1.0, "seconds": 0}
        for m in MODELS
    ]


def test_interrupted_runs_go_on_where_they_stopped(tmp_path, monkeypatch):
    calls = []

    def stops_after_five(*task):
        if len(calls) == 5:
            raise KeyboardInterrupt
        calls.append(task)
        return fake_run(*task)

    monkeypatch.setattr(runs_module, "run_one", stops_after_five)
    with pytest.raises(KeyboardInterrupt):
        runs_module.run_all(3, 0, 1, tmp_path)

    def goes_on(*task):
        calls.append(task)
        return fake_run(*task)

    monkeypatch.setattr(runs_module, "run_one", goes_on)
    frame = runs_module.run_all(3, 0, 1, tmp_path)
    assert len(calls) == len(set(calls)) == 2 * 2 * 3
    assert len(frame) == len(calls) * len(MODELS)


def test_a_smaller_call_leaves_the_progress_of_a_larger_one(tmp_path, monkeypatch):
    def stops(*task):
        if task[2] == 3:
            raise KeyboardInterrupt
        return fake_run(*task)

    monkeypatch.setattr(runs_module, "run_one", stops)
    with pytest.raises(KeyboardInterrupt):
        runs_module.run_all(5, 0, 1, tmp_path)
    runs_module.run_all(2, 0, 1, tmp_path)
    calls = []

    def counts(*task):
        calls.append(task)
        return fake_run(*task)

    monkeypatch.setattr(runs_module, "run_one", counts)
    runs_module.run_all(3, 0, 1, tmp_path)
    assert ("B", "paper", 2) not in calls


def test_rows_cut_short_are_run_again(tmp_path, monkeypatch):
    pd.DataFrame(fake_run("B", "paper", 0)[:3]).to_csv(tmp_path / "runs.partial.csv", index=False)
    monkeypatch.setattr(runs_module, "run_one", fake_run)
    frame = runs_module.run_all(2, 0, 1, tmp_path)
    assert len(frame) == 2 * 2 * 2 * len(MODELS)


def scores(**rmse):
    """Two runs of every model, with the given mean RMSEs and a standard deviation of 0.1 each."""
    rows = []
    for model in MODELS:
        center = rmse.get(model.replace("-", "_").replace(" ", "_"), 1.0)
        half = 0.1 / 2**0.5 if model != "GP-scale" else 0.2
        rows += [{"seed": s, "model": model, "rmse": center + (2 * s - 1) * half} for s in (0, 1)]
    return pd.DataFrame(rows)


def verdict(claim, **rmse):
    return next(c.verdict for c in judge(scores(**rmse)) if c.id == claim)


def test_verdicts_follow_the_numbers():
    assert verdict("F1", Zero_mean_GP=0.9) == "reproduced"
    assert verdict("F1", Zero_mean_GP=1.1) == "not reproduced"
    assert verdict("F2", GP_scale=0.9) == "reproduced"
    assert verdict("F3") == "reproduced"
    assert verdict("F3", GP_bias=1.1) == "not reproduced"
    assert verdict("F4", GP_scale=1.2) == "reproduced"
    assert verdict("F4", GP_scale=1.2, AR1=1.3) == "not reproduced"
    assert verdict("F5") == "not reproduced"
    assert verdict("F6", CKA=0.7) == "reproduced"
    assert verdict("F6", CKA=0.9) == "not reproduced"
    assert verdict("F6", CKA=0.1) == "beaten"
    assert verdict("F7", RRA=0.5) == "reproduced"
    assert verdict("F7", RRA=0.5, CKA=0.4) == "not reproduced"
    assert verdict("F7", RRA=0.1) == "beaten"
