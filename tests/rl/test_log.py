"""What callbacks and the logger are told."""

import csv
import re

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import (
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from gpadjust.control import print_progress
from gpadjust.dynamics import PhysicsDynamics
from tests.point import POINT_SPEC
from tests.rl.conftest import model_rows


def test_metrics_of_the_model_are_logged(point_agent, learnt_dynamics, tmp_path):
    agent = point_agent(dynamics=learnt_dynamics())
    agent.set_logger(configure(str(tmp_path), ["csv"]))
    agent.learn(20, log_interval=1)
    agent.logger.close()
    with open(tmp_path / "progress.csv") as file:
        last = [*csv.DictReader(file)][-1]
    shares = [float(last[f"model/share_{part}"]) for part in ("fit", "rollout", "update")]
    assert sum(shares) == pytest.approx(1, abs=1e-3)
    for name in ("nlpd", "coverage", "rmse/x", "fit_seconds", "ep_rew_mean"):
        assert np.isfinite(float(last[f"model/{name}"]))
    assert float(last["model/left_bounds"]) == 0


def test_particles_that_left_the_bounds_are_logged_once(point_agent):
    def runaway(X):
        return X[:, :1] + torch.where(X[:, :1] > 1.0, 1e6, 0.0)

    starts = torch.tensor([[0.6], [1.4], [0.8]])
    options = {"model_episodes": 3, "updates_per_model_step": 1}
    options |= {"initial_states": lambda n: starts[:n]}
    agent = point_agent(dynamics=PhysicsDynamics(POINT_SPEC, runaway), **options).learn(5)
    assert agent.logger.name_to_value["model/left_bounds"] == 1
    assert model_rows(agent) == 1 + 2 * 5
    assert agent._n_updates == 5 + 1 + 2 * 5
    rows = agent.replay_buffer.model_buffer
    left = rows.next_observations[:, 0, 0] == np.float32(1.4)
    assert rows.timeouts[left, 0].all()
    assert rows.rewards[left, 0] <= rows.rewards[:11, 0].min()


def test_callbacks_of_stable_baselines(point_agent, normalised, point_env, tmp_path):
    evaluated, path = VecNormalize(make_vec_env(point_env), training=False), str(tmp_path)
    evaluation = EvalCallback(evaluated, n_eval_episodes=1, eval_freq=10, log_path=path, verbose=0)
    saving = CheckpointCallback(10, path, "agent", save_replay_buffer=True, save_vecnormalize=True)
    agent = point_agent(normalised())
    agent.learn(100, [evaluation, saving, StopTrainingOnMaxEpisodes(4)])
    assert agent.num_timesteps == 20
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    for name in ("10_steps.zip", "replay_buffer_20_steps.pkl", "vecnormalize_20_steps.pkl"):
        assert (tmp_path / f"agent_{name}").exists()


def test_fits_are_told_and_an_error_there_learns_nothing_twice(point_agent, learnt_dynamics):
    fits = []

    def note(agent, event, values):
        if event == "fit":
            fits.append(values)
            if len(fits) == 3:
                raise OSError("full")

    options = {"model_episodes": 3, "num_particles": 2, "refresh_model_data": False}
    agent = point_agent(dynamics=learnt_dynamics(), **options).learn(10, note)
    assert [*fits[0]] == ["fit_seconds"]
    assert fits[1].keys() >= {"fit_seconds", "nlpd", "coverage"}
    assert all(np.isfinite([*metrics.values()]).all() for metrics in fits)
    rewards = agent.replay_buffer.model_buffer.rewards[15:30, 0]  # of the last three episodes
    expected = pytest.approx(rewards.sum() / 3, rel=1e-5)
    assert agent.logger.name_to_value["model/ep_rew_mean"] == expected
    with pytest.raises(OSError, match="full"):
        agent.learn(5, note, reset_num_timesteps=False)
    agent.learn(5, reset_num_timesteps=False)
    assert agent.task.dynamics.num_transitions == 20


@pytest.mark.slow
def test_scores_of_trajectories_are_logged_and_change_nothing(
    point_agent, learnt_dynamics, assert_same
):
    one, other = (
        point_agent(dynamics=learnt_dynamics(), score_horizons=horizons).learn(15, log_interval=9)
        for horizons in ((1, 5), ())
    )
    found, without = (agent.logger.name_to_value for agent in (one, other))
    assert {*found} - {*without} == {
        f"model/{name}_{k}" for name in ("nlpd", "coverage", "energy") for k in (1, 5)
    }
    assert_same(one, other)
    assert "DynaSAC(Point, LearnedDynamics, 3 episodes learnt, 15 steps, last " in repr(one)
    one.task = None
    assert repr(one) == "DynaSAC(Point, no task)"


def test_callbacks_of_agents_are_called(point_agent, capsys):
    events = []
    point_agent().learn(10, [print_progress, lambda agent, event, values: events.append(event)])
    assert events == [*["episode", "trial", "fit"] * 2, "done"]
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" ")[0] for line in lines] == ["trial:", "fit:"] * 2
    assert re.match(r"trial: number 2, steps 5, reward -\d\S*, seconds ", lines[2])
    with pytest.warns(match="rich is experimental"):
        point_agent().learn(10, [print_progress], progress_bar=True)
    assert "10/10" in capsys.readouterr().out
