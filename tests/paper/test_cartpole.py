"""The cart-pole's chapter."""

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust.control.episodes import generators
from gpadjust.rl import DynaSAC
from paper.cartpole import CartPole
from paper.cartpole.claims import CLAIMS
from paper.cartpole.control import foresight, load
from paper.cartpole.system import evaluate, fixed_starts
from paper.common.runner import main, runs_file
from paper.common.verdicts import Curves, judge

SHORT = {
    "episodes": 3,
    "episode_length": 10,
    "model_episodes": 2,
    "batch_size": 16,
    "net_arch": (16,),
}
TINY = {**SHORT, "last_model_episode": 2, "later_updates": 5, "updates_per_model_step": 0.2}


def test_what_identifies_a_run_holds_what_the_settings_do_not_say():
    experiment = CartPole(**TINY)
    found = experiment.describe("gp-paper")
    assert found["target"] == "absolute"
    assert found["task"]["dynamics.model"] == "ZeroMeanGP"
    assert "task" not in experiment.describe("mf")
    defaults = experiment.defaults()
    assert defaults["gpadjust.rl.DynaOptions"]["real_fraction"] == pytest.approx(1 / 11)
    assert defaults["stable_baselines3.SAC"]["buffer_size"] == 1_000_000


class TestCartPole:
    @pytest.mark.slow
    def test_smoke(self, tmp_path, capsys):
        experiment = CartPole(out=tmp_path, runs=2, jobs=1, only=("mf", "phy", "cka"), **TINY)
        main(experiment)
        assert "Cost, sampled actions" in capsys.readouterr().out
        assert (tmp_path / "cartpole" / "figure2.png").exists()
        found = runs_file(experiment).read()
        episodes = {name: found[name, 1]["episodes"] for name in experiment.only}
        assert [value is None for value in episodes["cka"]["nlpd"]] == [True, False, True]
        assert len(episodes["cka"]["rmse"][1]) == len(episodes["phy"]["rmse"][1]) == 4
        assert all(0 < cost <= 1 for of in episodes.values() for cost in of["cost"])

    @pytest.mark.slow
    def test_each_episode_is_followed_by_its_updates(self, monkeypatch):
        updates, train = [], DynaSAC.train

        def counted(agent, gradient_steps, **options):
            updates.append(gradient_steps)
            train(agent, gradient_steps, **options)

        monkeypatch.setattr(DynaSAC, "train", counted)
        CartPole(**TINY).run("mf", 0)
        assert updates == [10 + 4, 10 + 4, 5]

    def test_an_evaluation_draws_no_random_number(self):
        experiment = CartPole(**TINY)
        setup = experiment.setup("gp-paper", 0)
        agent = DynaSAC("MlpPolicy", setup.env, setup.task, seed=0, device="cpu")
        before = generators()
        first = evaluate(agent, experiment.settings_of("gp-paper"))
        after = generators()
        assert torch.equal(after[2], before[2])
        assert np.array_equal(after[1][1], before[1][1])
        assert evaluate(agent, experiment.settings_of("gp-paper")) == first
        assert 0.8 < first <= 1
        assert torch.equal(fixed_starts(3), fixed_starts(20)[:3])

    def test_learners_of_a_seed_share_physics_and_updates(self):
        experiment = CartPole()
        phy, cka = (experiment.setup(name, 4).task.dynamics.physics.rhs for name in ("phy", "cka"))
        assert phy == cka
        settings = experiment
        for episode in (1, 25, 26, 50):
            in_model = 0 if episode > 25 else settings.updates_in_model()
            of_others = settings.updates_after(episode, model_free=False)
            assert settings.updates_after(episode, model_free=True) == in_model + of_others

    @pytest.mark.parametrize("errors", [{}, {"rmse": [None, [0.1] * 4]}])
    def test_runs_without_models_or_variances_have_tables(self, errors):
        runs = [{"scenario": "phy", "seed": 0, "episodes": {"cost": [0.9, 0.8], **errors}}]
        text = foresight(load(runs, "episodes", CartPole()), CartPole())
        assert ("| Dyna-Phy |  |  | 0.1 |" in text) == bool(errors)

    def test_verdicts(self):
        found = judged(
            CLAIMS,
            {
                "mf": lambda e: 0.9 if e < 30 else 0.39,
                "phy": lambda e: 0.49 if e < 9 else 0.7,
                "gp-paper": lambda e: 0.9,
                "cka": lambda e: 0.9 if e < 6 else 0.45 if e < 12 else 0.39,
                "rra-paper": lambda e: 0.8 if e < 26 else 0.45,
            },
        )
        verdicts = {name: claim.verdict for name, claim in found.items()}
        assert [verdicts[f"P{i}"] for i in (1, 2, 3, 4)] == ["reproduced"] * 4, found
        assert found["P5"].verdict == "not reproduced"  # always 0.06 above CKA
        assert found["P6"].measured == "no results of gp"

    def test_a_bound_within_the_interval_over_the_runs_is_inconclusive(self):
        """The mean curves alone would say: does not learn, and reaches 0.5."""
        curves = {"gp-paper": lambda e: 0.3, "phy": lambda e: 0.1, "mf": lambda e: 0.02}
        found = judged(CLAIMS, curves, spread=0.3)  # 0.3 to 1.2, 0.1 to 1.0, 0.02 to 0.92
        assert {found[name].verdict for name in ("P1", "P2", "P3")} == {"inconclusive"}
        found = judged(CLAIMS, curves, spread=0.01)
        assert [found[f"P{i}"].verdict for i in (1, 3)] == ["beaten", "not reproduced"]


def judged(claims, curves, num_runs=4, num_episodes=50, spread=1e-9):
    """Verdicts on curves that are given as functions of the episode."""
    rows = [
        {"learner": name, "seed": seed, "episode": e, "cost": curve(e) + seed * spread}
        for name, curve in curves.items()
        for seed in range(num_runs)
        for e in range(1, num_episodes + 1)
    ]  # fmt: skip
    curves = Curves(pd.DataFrame(rows), "cost")
    return {claim.id: claim for claim in judge(claims, curves, num_episodes)}
