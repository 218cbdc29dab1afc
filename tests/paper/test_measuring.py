"""Where to measure: problems and learners."""

import math
from dataclasses import replace

import pandas as pd
import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.systems import cart_pole
from paper.common.runner import main
from paper.measuring import (
    HELPS,
    MISLEADS,
    Active,
    Misled,
    MisledSettings,
    Settings,
    misled,
)
from paper.measuring.active import CHOOSERS, integrated_variance, measured, needed, scored
from paper.measuring.problems import problem

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


TINY = Settings(
    budget=6,
    every=2,
    num_test=20,
    integration_points=4,
    raw_samples=4,
    num_restarts=1,
    maxiter=2,
)


def scores(**errors):
    """Runs of Forrester's function: learner=[errors after 1, 2, ... of a seed, ...]."""
    rows = [
        {"problem": "forrester", "learner": name, "seed": seed, "measurements": n, "nrmse": error}
        for name, by_seed in errors.items()
        for seed, curve in enumerate(by_seed)
        for n, error in enumerate(curve, 1)
    ]
    return pd.DataFrame(rows)


@pytest.mark.parametrize("name", ["forrester", "currin", "park91a", "cartpole"])
def test_problems(name):
    system = problem(name, 0)
    X = torch.cat([system.sobol(8, 1), system.uniform(8, 1), system.bounds])
    assert ((system.bounds[0] <= X) & (system.bounds[1] >= X)).all()
    assert system.truth(X).shape == (18, 4 if name == "cartpole" else 1)
    assert (system.physics(X) - system.truth(X)).abs().max() > 1e-3
    X.requires_grad_()
    system.physics(X).sum().backward()
    assert X.grad.isfinite().all()


def test_the_cart_pole():
    system, X = problem("cartpole", 3), torch.tensor([[0.3, 0.1, 0.2, -0.5, 4.0]]).double()
    believed = cart_pole(3).physics(X) - X[:, :4]
    torch.testing.assert_close(system.physics(X), believed)
    X = system.sobol(6, 0)
    for kind, expected in (("literal", CKA), ("phymean", PhysicsMeanGP), ("gp", ZeroMeanGP)):
        model = system.model(X, system.truth(X), kind)
        assert isinstance(model, expected)
        once_round = X + torch.tensor([0, 2 * math.pi, 0, 0, 0], dtype=torch.float64)
        torch.testing.assert_close(model.predict(X).mean, model.predict(once_round).mean)


@pytest.mark.parametrize("kind", ["literal", "gp"])
def test_integrated_variance_of_outputs_is_the_sum_in_their_units(kind):
    system = problem("cartpole", 0)
    X, points, x = system.sobol(7, 0), system.sobol(3, 5), system.sobol(1, 9)
    Y = system.truth(X)
    model = system.model(X, Y, kind)
    found = -integrated_variance(model, points)(x)
    with torch.no_grad():
        left = model.condition_on_observations(x, system.truth(x)).predict(points).variance
    expected = (left / Y.std(0).square()).sum(-1).mean()
    torch.testing.assert_close(found.detach(), expected.reshape(1), rtol=1e-3, atol=0)


@pytest.mark.slow
def test_all_learners_of_a_seed_begin_alike():
    system = problem("forrester", 0)
    points = {
        name: measured(system, learner, learner.model, TINY, 2)
        for name, learner in CHOOSERS.items()
        if learner.model is not None
    }
    assert all(torch.equal(X[:4], system.sobol(4, 2)) for X in points.values())
    assert all(X.shape == (6, 1) for X in points.values())
    assert torch.equal(points["sobol"], system.sobol(6, 2))
    assert not torch.equal(points["cka"][4:], points["gp"][4:])


def test_scores():
    system = problem("forrester", 0)
    found = scored(system, "literal", replace(Settings(), budget=6, every=2), system.sobol(6, 0))
    assert found["measurements"] == [4, 6]
    assert found["nrmse"][1] < found["nrmse"][0] < 2


@pytest.mark.slow
def test_smoke(tmp_path, capsys):
    experiment = Active(
        out=tmp_path,
        runs=2,
        jobs=1,
        only=("forrester", "f_p", "phy", "gp", "cka"),
        forrester=TINY,
    )
    main(experiment)
    assert "Measurements that reach the final error" in capsys.readouterr().out


def test_measurements_that_are_needed():
    runs = scores(gp=[[3.0, 2.0, 1.0]] * 2, cka=[[2.0, 1.0, 2.0], [2.0, 1.5, 1.1]])
    assert needed(runs, "cka").tolist() == [2, math.inf]
    assert needed(runs, "gp").tolist() == [3, 3]
    assert needed(runs[runs["learner"] == "cka"], "cka").empty


FEW = MisledSettings(initial=3, trials=1, restarts=1, raw_samples=4, mc_samples=8)


@pytest.mark.parametrize("name", MISLEADS + HELPS)
def test_where_the_physics_says_the_best_is(name):
    """Near the best of the function if it helps, at a regret above a fifth of the range if not."""
    given = misled.PROBLEMS[name]
    X = torch.rand(20_000, given.num_inputs, dtype=torch.float64)
    highest, size = misled._range(given)
    assert given.truth(X).max() <= highest + 1e-9
    regret = (highest - given.truth(X[given.physics(X).argmax()].unsqueeze(0)).item()) / size
    assert (regret > 0.2) == (name in MISLEADS)


def record(problem, method, seed, regrets):
    return {
        "problem": problem,
        "method": method,
        "seed": seed,
        "regrets": regrets,
        "relevance": [0.5 if method == "cka" else None] * len(regrets),
    }


def test_regrets_of_misled(tmp_path):
    records = [
        record(problem, method, seed, regrets)
        for problem in MISLEADS + HELPS
        for seed in range(3)
        for method, regrets in (
            ("stgp", [9.0, 3.0, 0.5, 0.4]),
            ("zero", [9.0, 3.0, 2.0, 0.43]),
            ("cka", [0.5, 0.5, 0.5, 0.5 if seed else 6.0]),
        )
    ]
    rows = misled.tables(records, Misled(out=tmp_path))["regrets"].text
    assert "| moved peak | SingleTaskGP | 3 | 0.4 | 0.4 | 0 | 3 |  |" in rows


@pytest.mark.slow
def test_a_run_of_few_trials(tmp_path):
    main(Misled(out=tmp_path, runs=2, jobs=1, only=("unrelated",), settings=FEW))
    text = (tmp_path / "tables.md").read_text()
    assert all(label in text for label in misled.METHODS.values())
