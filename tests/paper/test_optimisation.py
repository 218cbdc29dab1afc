"""The experiment on Ax: its problems, its tables, and a run of few trials."""

import numpy as np
import pytest
import torch

from paper.common.runner import main
from paper.optimisation import PROBLEMS, Optimisation, Settings
from paper.optimisation.problems import problem, scale
from paper.optimisation.reactor import textbook, truth
from paper.optimisation.tables import load, regrets, verdicts


def test_the_best_of_forrester_is_known():
    best, distance = scale("forrester", 256)
    assert best == pytest.approx(-6.020740, abs=1e-5)
    assert distance > 4


@pytest.mark.parametrize("name", PROBLEMS)
def test_f_p_is_not_the_truth_but_like_it(name):
    system = problem(name)
    X = system.points(128)
    for metric, physics in system.physics.items():
        columns = X.unbind(-1) if name == "reactor" else [X]
        crude, true = physics(*columns).flatten(), system.truth(X)[metric]
        assert torch.corrcoef(torch.stack([crude, true]))[0, 1] > 0.1
        assert not torch.allclose(crude, true, rtol=0.02)


def test_the_reactor_keeps_its_mass():
    X = problem("reactor").points(64)
    for b, c in (truth(*X.unbind(-1)), textbook(*X.unbind(-1))):
        assert (b >= 0).all()
        assert (c >= -1e-9).all()
        assert (b + c <= 1 + 1e-9).all()


def test_a_trial_beyond_the_limit_counts_for_nothing():
    system = problem("reactor")
    assert system.values({"output": 0.9, "impurity": 0.5}) == np.inf
    assert system.values({"output": 0.5, "impurity": 0.01}) == -0.5


def record(learner, seed, trials, values):
    return {
        "problem": "forrester",
        "learner": learner,
        "seed": seed,
        "trials": trials,
        "seconds": 1.0,
        "regrets": values,
    }


def test_a_run_that_never_comes_near_counts_as_longer_than_all():
    ours = [record("cka", seed, 6, [None, 0.5, 0.2, 0.1, 0.1, 0.004]) for seed in range(3)]
    theirs = [record("ax", seed, None, [0.5] * 12) for seed in range(3)]
    runs = load(ours + theirs)
    (judged,) = verdicts(runs, most=12)
    assert judged.verdict == "met"
    assert "6, Ax's default more than 12" in judged.measured
    (judged,) = verdicts(
        runs, most=10
    )  # 6 is more than half of 11, but may be less than their half
    assert judged.verdict == "inconclusive"
    (judged,) = verdicts(load([*ours, *(record("ax", s, 11, [0.0] * 11) for s in range(3))]), 12)
    assert judged.verdict == "missed"
    curve = regrets(ours, 12)
    assert len(curve) == 36
    assert curve.groupby("trial")["regret"].median()[[1, 12]].tolist() == [np.inf, 0.004]


@pytest.mark.slow
def test_a_run(tmp_path):
    settings = Settings(trials=7, num_random=64)
    main(Optimisation(out=tmp_path, runs=2, jobs=1, problems=("forrester",), settings=settings))
    text = (tmp_path / "tables.md").read_text()
    assert "needs at most half the trials" in text
    assert (tmp_path / "regrets.png").exists()
