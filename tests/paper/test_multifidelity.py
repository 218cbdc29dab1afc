import math
import sys

import pandas as pd
import pytest
import torch

from paper import __main__ as command_line
from paper.multifidelity import problem
from paper.multifidelity import runs as runs_module
from paper.multifidelity.mfk import SMTModel
from paper.report import _cells, _scores_of, _short


@pytest.mark.parametrize(
    ("name", "x", "high", "low"),
    [
        ("booth", [1.0, 3.0], 0.0, 11.9),
        ("bohachevsky", [0.0, 0.0], 0.0, -12.0),
        ("hartmann6", [0.20169, 0.150011, 0.476874, 0.275332, 0.311652, 0.6573], -3.0425, -1.9052),
        ("currin", [0.5, 0.5], (1 - math.exp(-1)) * 1868.5 / 159.5, 7.4425),
    ],
)
def test_pairs_have_known_values(name, x, high, low):
    pair, X = problem.pair(name), torch.tensor([x], dtype=torch.float64)
    assert pair.truth(X).item() == pytest.approx(high, abs=1e-4)
    assert pair.physics()(X).item() == pytest.approx(low, abs=1e-4)


def test_observations_are_a_seeded_latin_hypercube_in_the_bounds():
    pair = problem.pair("branin")
    X, Y = problem.observations(pair, 10, 3)
    cells = (10 * (X - pair.bounds[0]) / (pair.bounds[1] - pair.bounds[0])).floor()
    assert torch.equal(cells.sort(0).values[:, 0], torch.arange(10.0, dtype=torch.float64))
    assert torch.equal(cells.sort(0).values[:, 1], torch.arange(10.0, dtype=torch.float64))
    assert torch.equal(Y, pair.truth(X))
    assert torch.equal(X, problem.observations(pair, 10, 3)[0])
    assert not torch.equal(X, problem.observations(pair, 10, 4)[0])


def test_low_level_is_nested():
    pair = problem.pair("currin")
    X, _ = problem.observations(pair, 10, 0)
    low_X = problem.low_inputs(pair, X, 0)
    assert low_X.shape == (40, 2)
    assert torch.equal(low_X[:10], X)


def test_mfk_predicts_in_the_units_of_the_data():
    pair = problem.pair("booth")
    X, Y = problem.observations(pair, 10, 0)
    low_X = problem.low_inputs(pair, X, 0)
    model = SMTModel(low_X, pair.physics()(low_X), X, Y)
    posterior = model.posterior(X)
    assert posterior.mean.shape == posterior.variance.shape == (10, 1)
    torch.testing.assert_close(posterior.mean, Y, rtol=1e-2, atol=1e-2)
    assert (posterior.variance > 0).all()
    test_X = pair.sobol(50, seed=1)
    test_Y = pair.truth(test_X)
    error = (model.posterior(test_X).mean - test_Y).square().mean().sqrt()
    assert error < 0.1 * test_Y.std()


def command(monkeypatch, out, *options):
    monkeypatch.setattr(
        sys,
        "argv",
        ["paper", "multifidelity", "--runs", "2", "--jobs", "1", "--out", str(out), *options],
    )
    command_line.main()


def test_command_writes_tables_and_figures(tmp_path, monkeypatch, capsys):
    command(monkeypatch, tmp_path, "--pairs", "forrester,booth", "--methods", "GP,CKA")
    runs = pd.read_csv(tmp_path / "runs.csv")
    assert len(runs) == 2 * 2 * 2 * 2
    assert set(runs["N"]) == {5, 10, 20}
    table = pd.read_csv(tmp_path / "table.csv")
    assert list(table["method"].unique()) == ["GP", "CKA"]
    adjusted = table[(table["method"] == "CKA") & (table["N"] == 10)]
    assert (adjusted["nrmse_median"] < 0.1).all()
    for column in ("nrmse", "nlpd", "coverage"):
        assert (tmp_path / f"{column}.png").stat().st_size > 10_000
    assert not (tmp_path / "runs.partial.csv").exists()
    assert "forrester, 5 observations" in capsys.readouterr().out
    assert "booth, N = 10 |" in _scores_of(table, "nrmse_median")
    assert "mean coverage" in _short(table)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--runs", "1", "--runs: expected at least 2"),
        ("--jobs", "0", "--jobs: expected at least 1"),
        ("--pairs", "curin", "no pair 'curin', but there are bohachevsky, .*currin"),
        ("--pairs", "booth,booth", "each pair once"),
        ("--methods", "CKA,MFK", "no method 'MFK', but there are GP, .*SMT MFK"),
    ],
)
def test_bad_options(tmp_path, monkeypatch, option, value, message):
    with pytest.raises(SystemExit, match=message):
        command(monkeypatch, tmp_path, option, value)
    assert not list(tmp_path.iterdir())


def test_unknown_pair_is_an_error():
    with pytest.raises(ValueError, match="mf2 has no pair 'curin'"):
        problem.pair("curin")


def test_all_methods_see_the_same_data_and_an_interrupted_call_goes_on(tmp_path, monkeypatch):
    seen = []

    class Trained(Exception):  # noqa: N818
        pass

    def spy(method, pair, X, Y, seed):
        if len(seen) == 5:
            raise Trained
        seen.append((method, pair.name, len(X), seed, X.sum().item()))
        return real(method, pair, X, Y, seed)

    real = runs_module.trained
    monkeypatch.setattr(runs_module, "_prepare", lambda method: None)
    monkeypatch.setattr(runs_module, "trained", spy)
    with pytest.raises(Trained):
        runs_module.run_all(["forrester"], ["GP", "Phy"], 2, 0, 1, tmp_path)
    assert len(pd.read_csv(tmp_path / "runs.partial.csv")) == 5
    half, seen = seen, []
    frame = runs_module.run_all(["forrester"], ["GP", "Phy"], 2, 0, 1, tmp_path)
    assert len(seen) == 3
    assert len(frame) == 8
    data = pd.DataFrame(half + seen, columns=["method", "pair", "n", "seed", "X"])
    assert (data.groupby(["n", "seed"])["X"].nunique() == 1).all()
    assert data["X"].nunique() == 4


def test_best_is_bold():
    assert _cells(pd.Series([0.121, 0.119, 0.5]), mark_best=True) == ["**0.12**", "**0.12**", "0.5"]
    assert _cells(pd.Series([0.1, 0.5]), mark_best=False) == ["0.1", "0.5"]
