"""Where to measure: problems, learners, interruptions, and the verdicts."""

import math
from dataclasses import replace

import pandas as pd
import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.systems import cart_pole
from paper.active import Active
from paper.active import Settings as ActiveSettings
from paper.active import run as active_run
from paper.active.problems import problem
from paper.active.run import LEARNERS, integrated_variance, measured, scored
from paper.active.tables import needed, verdicts
from paper.common.runner import main, run_missing, runs_file

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


TINY = ActiveSettings(
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
    for kind, expected in (("CKA", CKA), ("physics mean", PhysicsMeanGP), ("GP", ZeroMeanGP)):
        model = system.model(X, system.truth(X), kind)
        assert isinstance(model, expected)
        once_round = X + torch.tensor([0, 2 * math.pi, 0, 0, 0], dtype=torch.float64)
        torch.testing.assert_close(model.predict(X).mean, model.predict(once_round).mean)


@pytest.mark.parametrize("kind", ["CKA", "GP"])
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


def test_all_learners_of_a_seed_begin_alike(tmp_path):
    system = problem("forrester", 0)
    points = {
        name: measured(system, learner, learner.model, TINY, 2, tmp_path / f"{name}.jsonl")
        for name, learner in LEARNERS.items()
        if learner.model is not None
    }
    assert all(torch.equal(X[:4], system.sobol(4, 2)) for X in points.values())
    assert all(X.shape == (6, 1) for X in points.values())
    assert torch.equal(points["sobol"], system.sobol(6, 2))
    assert not torch.equal(points["cka"][4:], points["gp"][4:])


def test_scores():
    system = problem("forrester", 0)
    found = scored(system, "CKA", replace(ActiveSettings(), budget=6, every=2), system.sobol(6, 0))
    assert found["measurements"] == [4, 6]
    assert found["nrmse"][1] < found["nrmse"][0] < 2


@pytest.mark.slow
def test_smoke(tmp_path, capsys):
    experiment = Active(
        out=tmp_path,
        runs=2,
        jobs=1,
        problems=("forrester",),
        learners=("f_p", "phy", "gp", "cka"),
        forrester=TINY,
    )
    main(experiment)
    assert "M1" in capsys.readouterr().out
    assert (tmp_path / "errors.png").stat().st_size > 10_000
    assert not list((tmp_path / "unfinished").glob("*.jsonl"))


def test_an_interrupted_run_goes_on(tmp_path, monkeypatch):
    whole, cut = (
        Active(out=tmp_path / name, runs=1, jobs=1, problems=("forrester",), learners=("both",),
               forrester=TINY) for name in ("whole", "cut")
    )  # fmt: skip
    run_missing(whole)
    asked = []

    def interrupted(name, seed):
        system = problem(name, seed)

        def measure(X):
            if len(X) == 1:
                asked.append(X)
                if len(asked) == 5:
                    raise KeyboardInterrupt
            return system.truth(X)

        return replace(system, truth=measure)

    monkeypatch.setattr(active_run, "problem", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_missing(cut)
    run_missing(cut)
    expected, found = (
        next(iter(runs_file(experiment).read().values())) for experiment in (whole, cut)
    )
    assert found["scores"] == expected["scores"]
    assert found["choice_seconds"] is None
    assert len(asked) == 7  # the one it was interrupted at twice
    assert torch.equal(asked[4], asked[5])


def test_measurements_that_are_needed():
    runs = scores(gp=[[3.0, 2.0, 1.0]] * 2, cka=[[2.0, 1.0, 2.0], [2.0, 1.5, 1.1]])
    assert needed(runs, "cka").tolist() == [2, math.inf]
    assert needed(runs, "gp").tolist() == [3, 3]
    assert needed(runs[runs["learner"] == "cka"], "cka").empty


@pytest.mark.parametrize(
    ("cka", "verdict", "said"),
    [
        ([[2.0, 1.0, 1.0, 1.0]] * 2, "met", "2 runs: with 2 of 4 (median), in 2 of them"),
        ([[2.0, 2.0, 1.0, 1.0]] * 2, "missed", "with 3 of 4"),
        ([[2.0, 2.0, 2.0, 2.0]] * 2, "missed", "never of 4 (median), in 0 of them"),
        ([[2.0, 1.0, 1.0, 1.0]], "not run", "too few runs"),
    ],
)
def test_verdicts(cka, verdict, said):
    (claim,) = verdicts(scores(gp=[[3.0, 2.0, 1.5, 1.0]] * 2, cka=cka))
    assert (claim.id, claim.verdict) == ("M1", verdict)
    assert said in claim.measured
