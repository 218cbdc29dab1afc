import json
import math
import sys
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, ZeroMeanGP
from gpadjust.active import qAdjustmentInformationGain
from gpadjust.envs import REAL_CART_POLE, random_cart_pole_physics
from paper import __main__ as command_line
from paper import report
from paper.active import runs as runs_module
from paper.active.learners import LEARNERS, integrated_variance
from paper.active.problems import NAMES, problem
from paper.active.report import fragments
from paper.active.results import load, needed, tabulate, verdicts
from paper.active.runs import make_tasks, measured, path_of, run_one, scored
from paper.active.settings import SETTINGS

TINY = replace(
    SETTINGS["forrester"],
    budget=6,
    every=2,
    num_test=20,
    integration_points=4,
    raw_samples=4,
    num_restarts=1,
    maxiter=2,
    num_screened=4,
    num_starts=1,
    max_iterations=5,
)
# The tiny settings stop optimisations early.
quiet = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")
TINY_CART_POLE = replace(TINY, initial=6, budget=8)


@pytest.fixture(autouse=True)
def tiny_settings(monkeypatch):
    for name in SETTINGS:
        monkeypatch.setitem(SETTINGS, name, TINY_CART_POLE if name == "cartpole" else TINY)


def frame(**errors):
    """Runs of Forrester's function: learner=[errors after 1, 2, ... of a seed, ...]."""
    rows = [
        {"problem": "forrester", "learner": name, "seed": seed, "measurements": n, "nrmse": error}
        for name, by_seed in errors.items()
        for seed, curve in enumerate(by_seed)
        for n, error in enumerate(curve, 1)
    ]
    return pd.DataFrame(rows).assign(coverage=0.9, choice_seconds=1.0, score_seconds=2.0)


class TestProblems:
    @pytest.mark.parametrize("name", NAMES)
    def test_shapes_and_bounds(self, name):
        system = problem(name, 0)
        X = torch.cat([system.sobol(8, 1), system.uniform(8, 1), system.bounds])
        assert ((system.bounds[0] <= X) & (system.bounds[1] >= X)).all()
        Y = system.truth(X)
        assert Y.shape == (18, 4 if name == "cartpole" else 1)
        assert system.physics(X).shape == Y.shape
        assert system.physics(X).isfinite().all()
        assert (system.physics(X) - Y).abs().max() > 1e-3

    def test_gradients_at_the_corners(self):
        for name in ("currin", "park91a"):
            system = problem(name, 0)
            corners = torch.cartesian_prod(*system.bounds.T).requires_grad_()
            system.physics(corners).sum().backward()
            assert corners.grad.isfinite().all()

    def test_the_cart_pole_changes_as_its_equation_says(self):
        system = problem("cartpole", 3)
        X = torch.tensor([[0.3, 0.1, 0.2, -0.5, 4.0]], dtype=torch.float64)
        after = X[:, :4] + system.truth(X)
        slopes = [REAL_CART_POLE(state, X[:, 4:]) for state in (X[:, :4], after)]
        torch.testing.assert_close(system.truth(X), 0.05 * sum(slopes), rtol=0.05, atol=0.01)
        believed = random_cart_pole_physics(3)(X) - X[:, :4]
        torch.testing.assert_close(system.physics(X), believed)
        assert not torch.equal(problem("cartpole", 4).physics(X), system.physics(X))

    def test_the_model_of_the_cart_pole_knows_that_the_angle_is_one(self):
        system = problem("cartpole", 0)
        X = system.sobol(6, 0)
        for with_physics, kind in ((True, CKA), (False, ZeroMeanGP)):
            model = system.model(X, system.truth(X), with_physics)
            assert isinstance(model, kind)
            once_round = X + torch.tensor([0, 2 * math.pi, 0, 0, 0], dtype=torch.float64)
            here, there = (model.predict(x).mean for x in (X, once_round))
            torch.testing.assert_close(here, there)

    def test_unknown(self):
        with pytest.raises(ValueError, match="no problem 'forester'; there are forrester, currin"):
            problem("forester", 0)


class TestLearners:
    @pytest.mark.parametrize("with_physics", [True, False])
    def test_integrated_variance_of_outputs_is_the_sum_in_their_units(self, with_physics):
        system = problem("cartpole", 0)
        X, points = system.sobol(7, 0), system.sobol(3, 5)
        Y, x = system.truth(X), system.sobol(1, 9)
        model = system.model(X, Y, with_physics)
        found = -integrated_variance(model, points)(x)
        with torch.no_grad():
            left = model.condition_on_observations(x, system.truth(x)).predict(points).variance
        expected = (left / Y.std(0).square()).sum(-1).mean()
        torch.testing.assert_close(found.detach(), expected.reshape(1), rtol=1e-3, atol=0)

    def test_information(self):
        system = problem("forrester", 0)
        X = system.sobol(4, 0)
        model = system.model(X, system.truth(X), True)
        for about in ("both", "rho"):
            function = LEARNERS[about].acquisition(model, X)
            assert isinstance(function, qAdjustmentInformationGain)
            assert function.about == about

    @quiet
    def test_all_learners_of_a_seed_begin_alike(self, tmp_path):
        system = problem("forrester", 0)
        points = {
            name: measured(system, learner, TINY, 2, tmp_path / f"{name}.jsonl")
            for name, learner in LEARNERS.items()
        }
        first = system.sobol(4, 2)
        assert all(torch.equal(X[:4], first) for X in points.values())
        assert all(X.shape == (6, 1) for X in points.values())
        assert torch.equal(points["sobol"], system.sobol(6, 2))
        assert not torch.equal(points["cka"][4:], points["gp"][4:])


class TestRuns:
    @quiet
    def test_scores(self):
        system = problem("forrester", 0)
        X = system.sobol(6, 0)
        scores = scored(system, LEARNERS["random"], SETTINGS["forrester"], X)
        assert scores["measurements"] == [4, 6]
        assert scores["nrmse"][1] < scores["nrmse"][0] < 2
        assert all(0 <= share <= 1 for share in scores["coverage"])

    def test_a_result_is_made_once(self, tmp_path, monkeypatch):
        path = run_one("forrester", "random", 1, tmp_path)
        assert path == path_of(tmp_path, "forrester", "random", 1)
        result = json.loads(path.read_text())
        assert result["settings"] == asdict(TINY)
        assert result["scores"]["measurements"] == [4, 6]
        written = path.read_bytes()
        monkeypatch.setattr(runs_module, "measured", None)
        run_one("forrester", "random", 1, tmp_path)
        assert path.read_bytes() == written
        with pytest.raises(ValueError, match="other settings: budget was 6 and is now 8"):
            run_one("forrester", "random", 1, tmp_path, replace(TINY, budget=8))

    def test_an_interrupted_run_goes_on(self, tmp_path, monkeypatch):
        whole = json.loads(run_one("forrester", "both", 0, tmp_path / "whole").read_text())
        out = tmp_path / "cut"
        asked = []

        def interrupted(name, seed):
            system = real(name, seed)

            def truth(X):
                if len(X) == 1:
                    asked.append(X)
                    if len(asked) == 5:
                        raise KeyboardInterrupt
                return system.truth(X)

            return replace(system, truth=truth)

        real = problem
        monkeypatch.setattr(runs_module, "problem", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_one("forrester", "both", 0, out)
        assert list((out / "unfinished").iterdir())
        again = json.loads(run_one("forrester", "both", 0, out).read_text())
        assert again["scores"] == whole["scores"]
        assert again["choice_seconds"] is None
        assert len(asked) == 7  # the one it was interrupted at twice
        assert torch.equal(asked[4], asked[5])
        assert not list((out / "unfinished").iterdir())

    def test_tasks_are_seed_by_seed(self):
        tasks = make_tasks(["currin"], ["gp", "cka"], 2, 5)
        assert tasks == [("currin", learner, seed) for seed in (5, 6) for learner in ("gp", "cka")]

    def test_half_the_budget_is_scored(self):
        for settings in SETTINGS.values():
            assert settings.budget in settings.counts()


class TestResults:
    def test_measurements_that_are_needed(self):
        runs = frame(gp=[[3.0, 2.0, 1.0], [3.0, 2.0, 1.0]], cka=[[2.0, 1.0, 2.0], [2.0, 1.5, 1.1]])
        assert needed(runs, "cka").tolist() == [2, np.inf]
        assert needed(runs, "gp").tolist() == [3, 3]
        assert needed(runs[runs["learner"] == "cka"], "cka").empty

    def test_table(self):
        runs = frame(gp=[[3.0, 1.0], [4.0, 2.0]], cka=[[1.0, 0.5], [1.0, 0.1]])
        table = tabulate(runs).set_index("learner")
        assert table.loc["gp", "nrmse_median"] == 1.5
        assert table.loc["cka", "needed"] == 1
        assert table.loc["cka", "reached"] == 2
        assert table.loc["cka", "choice_seconds"] == 1

    @pytest.mark.parametrize(
        ("cka", "verdict", "measured"),
        [
            ([[2.0, 1.0, 1.0, 1.0]] * 2, "met", "2 runs: with 2 of 4 (median), in 2 of them"),
            ([[2.0, 2.0, 1.0, 1.0]] * 2, "missed", "with 3 of 4"),
            ([[2.0, 2.0, 2.0, 2.0]] * 2, "missed", "never of 4 (median), in 0 of them"),
            ([[2.0, 1.0, 1.0, 1.0]], "not run", "too few runs"),
        ],
    )
    def test_verdicts(self, cka, verdict, measured):
        runs = frame(gp=[[3.0, 2.0, 1.5, 1.0]] * 2, cka=cka)
        (claim,) = verdicts(runs).to_dict("records")
        assert (claim["id"], claim["verdict"]) == ("M1", verdict)
        assert measured in claim["measured"]

    def test_no_results(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="no results"):
            load(tmp_path)


def command(monkeypatch, out, *options):
    arguments = ["paper", "active", "--runs", "2", "--jobs", "1", "--out", str(out), *options]
    monkeypatch.setattr(sys, "argv", arguments)
    command_line.main()


def test_command_writes_tables_and_a_figure(tmp_path, monkeypatch, capsys):
    # With one job joblib runs in this process, which has the tiny settings.
    command(
        monkeypatch, tmp_path, "--problems", "forrester,cartpole", "--learners", "random,gp,cka"
    )
    assert len(list((tmp_path / "runs").iterdir())) == 12
    assert (tmp_path / "errors.png").stat().st_size > 10_000
    table = pd.read_csv(tmp_path / "table.csv")
    assert len(table) == 6
    assert list(pd.read_csv(tmp_path / "claims.csv")["id"]) == ["M1", "M4"]
    first = capsys.readouterr().out
    assert "cartpole:" in first
    command(monkeypatch, tmp_path, "--only-tables", "--learners", "sobol")
    assert capsys.readouterr().out == first
    found = fragments(tmp_path)
    assert "| CKA, random points |" in found["active:errors"]
    assert "**met**" in found["active:claims"] or "**missed**" in found["active:claims"]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--runs", "1", "--runs: expected at least 2"),
        ("--problems", "curin", "no problem 'curin', but there are forrester, currin"),
        ("--learners", "cka,cka", "expected each learner once"),
    ],
)
def test_bad_options(tmp_path, monkeypatch, option, value, message):
    with pytest.raises(SystemExit, match=message):
        command(monkeypatch, tmp_path, option, value)
    assert not list(tmp_path.iterdir())


def test_without_results_the_readme_has_the_settings():
    found = fragments(report.PAPER / "nowhere")
    assert "| `budget` |" in found["active:settings"]
    assert found["active:claims"] == "No results yet."
