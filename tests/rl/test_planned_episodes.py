"""Agents whose first episodes go by plans."""

import io

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import CrossEntropy, Information, Plan, Planner
from gpadjust.dynamics import LearnedDynamics
from gpadjust.models import PaperRRA
from gpadjust.rl import DynaOptions, DynaSAC, EpisodeCheckpoint, resume

FEW = Planner(
    Information(), CrossEntropy(1, num_elites=2), num_random=6, num_policy=3, num_functions=2
)
TOTAL = 20  # four episodes of the point


class PowerCut(Exception):  # noqa: N818
    pass


class Watches(BaseCallback):
    """Remembers which actions were planned, and may cut the power."""

    def __init__(self, cut=None):
        super().__init__()
        self.cut = cut
        self.actions, self.stored, self.plans = [], [], []

    def _on_step(self):
        self.actions.append(self.locals["actions"].copy())
        self.stored.append(self.locals["buffer_actions"].copy())
        episodes = self.model.planned.under_way
        self.plans.append([episodes.get(i) is not None for i in range(self.training_env.num_envs)])
        if self.num_timesteps == self.cut:
            raise PowerCut
        return True


def planned_episodes(watched, length=5):
    return [any(steps) for steps in np.array(watched.plans)[:, 0].reshape(-1, length)]


@pytest.mark.parametrize(
    ("options", "planned"),
    [
        ({"explore_episodes": 2}, [False, True, True, False]),
        ({"explore_episodes": 9}, [False, True, True, True]),
        ({"explore_episodes": 0}, [False] * 4),
        ({"explore_episodes": 9, "last_model_episode": 2}, [False, True, False, False]),
    ],
)
def test_the_episodes_after_the_first_are_planned(point_agent, learnt_dynamics, options, planned):
    watched = Watches()
    agent = point_agent(dynamics=learnt_dynamics(), exploration=FEW, **options)
    agent.learn(TOTAL, watched)
    assert planned_episodes(watched) == planned
    assert agent.planned.num_planned == sum(planned)
    assert (agent.wall_time["plan"] > 0) == any(planned)
    assert agent.num_episodes == 4


def test_planned_actions_are_taken_and_stored_in_sb3s_scale(
    point_agent, learnt_dynamics, monkeypatch
):
    chosen = torch.tensor([[-2.0], [2.0], [1.0], [0.25], [5.0]], dtype=torch.float64)
    seen = []

    def plan(self, task, state, bounds, num_steps, **others):
        seen.append((state, num_steps, bounds, others))
        return Plan(chosen, 1.0, torch.zeros(5), 0.0, torch.ones(5))

    monkeypatch.setattr(Planner, "plan", plan)
    watched = Watches()
    agent = point_agent(dynamics=learnt_dynamics(), exploration=FEW, explore_episodes=1)
    agent.learn(10, watched)
    taken = np.concatenate(watched.actions[5:]).ravel()
    np.testing.assert_allclose(taken, [-2, 2, 1, 0.25, 2], atol=1e-6)
    np.testing.assert_allclose(np.concatenate(watched.stored[5:]).ravel(), taken / 2, atol=1e-6)
    ((state, num_steps, bounds, others),) = seen
    episodes = agent.recorded_episodes()
    torch.testing.assert_close(state, episodes.states[5])
    assert num_steps == 5
    assert bounds.tolist() == [[-2], [2]]
    assert others["past"] is None
    assert others["policy"](torch.zeros(3, 1, dtype=torch.float64)).shape == (3, 1)


def test_an_episode_can_be_planned_anew(point_agent, learnt_dynamics, monkeypatch):
    calls = []
    plan = Planner.plan

    def watched(self, task, state, bounds, num_steps, **others):
        past, known = others["past"], others["known"]
        calls.append((num_steps, past and len(past[0]), known is not None and len(known)))
        return plan(self, task, state, bounds, num_steps, **others)

    monkeypatch.setattr(Planner, "plan", watched)
    options = Planner(Information(), CrossEntropy(0), num_random=3, num_policy=0, replan_every=2)
    point_agent(dynamics=learnt_dynamics(), exploration=options, explore_episodes=1).learn(15)
    assert calls == [(5, None, False), (3, 2, 3), (1, 4, 1)]


def test_without_exploration_nothing_changes(point_agent, learnt_dynamics, assert_same):
    plain = point_agent(dynamics=learnt_dynamics()).learn(10)
    none = point_agent(dynamics=learnt_dynamics(), exploration=None, explore_episodes=7).learn(10)
    never = point_agent(dynamics=learnt_dynamics(), exploration=FEW, explore_episodes=0).learn(10)
    assert_same(plain, none)
    assert_same(plain, never)


@pytest.mark.slow
def test_two_runs_are_the_same_and_not_those_of_the_policy(
    point_agent, learnt_dynamics, assert_same
):
    one, other = (
        point_agent(dynamics=learnt_dynamics(), exploration=FEW).learn(15) for _ in range(2)
    )
    assert_same(one, other)
    plain = point_agent(dynamics=learnt_dynamics()).learn(10)
    rows = slice(0, 5), slice(5, 10)
    for row, same in zip(rows, (True, False), strict=True):
        actions = (agent.replay_buffer.actions[row] for agent in (one, plain))
        assert np.array_equal(*actions) == same


@pytest.mark.parametrize(
    ("step", "normalised"),
    [
        (8, False),
        (13, True),
        pytest.param(8, True, marks=pytest.mark.slow),
        pytest.param(13, False, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(
    point_agent, point_env, learnt_dynamics, point_task, assert_same, tmp_path, step, normalised
):
    def env():
        return VecNormalize(DummyVecEnv([point_env])) if normalised else point_env()

    path = tmp_path / "run.ckpt"
    whole = point_agent(env(), dynamics=learnt_dynamics(), exploration=FEW).learn(TOTAL)
    first = point_agent(env(), dynamics=learnt_dynamics(), exploration=FEW)
    with pytest.raises(PowerCut):
        first.learn(TOTAL, [EpisodeCheckpoint(path), Watches(cut=step)])
    torch.manual_seed(99)
    second = resume(path, env(), point_task(dynamics=learnt_dynamics()))
    assert second.options.exploration == FEW
    second.learn(TOTAL - second.num_timesteps, reset_num_timesteps=False)
    assert_same(whole, second)
    assert second.planned.num_planned == whole.planned.num_planned == 3


def test_a_run_that_was_interrupted_within_plans(
    point_agent, point_env, sampled_dynamics, point_task, assert_same, tmp_path
):
    """Of two environments whose episodes end at once, checkpoints lie in the middle of them."""

    def make():
        env = DummyVecEnv([point_env, point_env])
        options = Planner(
            Information(), CrossEntropy(0), num_random=4, num_policy=2, replan_every=2
        )
        return point_agent(
            env, dynamics=sampled_dynamics(), exploration=options, train_freq=(3, "step")
        )

    path, watched = tmp_path / "run.ckpt", Watches()
    whole = make().learn(36, watched)
    assert [True, True] in watched.plans
    with pytest.raises(PowerCut):
        make().learn(36, [EpisodeCheckpoint(path), Watches(cut=28)])
    env = DummyVecEnv([point_env, point_env])
    second = resume(path, env, point_task(dynamics=sampled_dynamics()))
    assert second.num_timesteps == 24
    assert any(episode is not None for episode in second.planned.under_way.values())
    second.learn(12, reset_num_timesteps=False)
    assert_same(whole, second)


def test_a_run_that_was_stopped_within_a_plan_begins_another_episode(point_agent, learnt_dynamics):
    agent = point_agent(dynamics=learnt_dynamics(), exploration=FEW, explore_episodes=1)
    with pytest.raises(PowerCut):
        agent.learn(TOTAL, Watches(cut=7))
    watched = Watches()
    agent.learn(TOTAL, watched)
    assert agent.planned.num_planned == 1
    assert planned_episodes(watched) == [False] * 4


def test_the_options_are_saved_with_the_agent(point_agent, learnt_dynamics, point_env, point_task):
    agent = point_agent(dynamics=learnt_dynamics(), exploration=FEW, explore_episodes=2).learn(10)
    file = io.BytesIO()
    agent.save(file)
    known = {"env": point_env(), "task": point_task(dynamics=learnt_dynamics())}
    loaded = DynaSAC.load(file, **known)
    assert loaded.options.exploration == FEW
    assert loaded.planned.num_planned == 1
    file.seek(0)
    watched = Watches()
    DynaSAC.load(file, **known, options=DynaOptions(model_episodes=2)).learn(
        10, watched, reset_num_timesteps=False
    )
    assert planned_episodes(watched) == [False, False]


def test_exploration_that_is_asked_for_later_is_timed(
    point_agent, learnt_dynamics, point_env, point_task
):
    file = io.BytesIO()
    point_agent(dynamics=learnt_dynamics()).learn(5).save(file)
    known = {"env": point_env(), "task": point_task(dynamics=learnt_dynamics())}
    loaded = DynaSAC.load(file, **known, options=DynaOptions(exploration=FEW))
    loaded.learn(5, reset_num_timesteps=False)
    assert loaded.wall_time["plan"] > 0


def test_the_information_is_logged(point_agent, learnt_dynamics):
    agent = point_agent(dynamics=learnt_dynamics(), exploration=FEW)
    agent.learn(10, log_interval=100)
    assert agent.logger.name_to_value["model/planned_value"] > 0


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"exploration": "random"}, TypeError, "exploration must be .* found 'random'"),
        ({"exploration": FEW, "explore_episodes": -1}, ValueError, "explore_episodes .* least 0"),
        ({"exploration": FEW, "explore_episodes": 0.5}, TypeError, "explore_episodes .* whole"),
        ({"exploration": FEW}, TypeError, "found PhysicsDynamics"),
    ],
)
def test_bad_options_are_refused(point_agent, options, error, message):
    with pytest.raises(error, match=message):
        point_agent(**options)


def test_dynamics_without_a_posterior_are_refused(point_agent, point_dynamics):
    paper = LearnedDynamics(point_dynamics.spec, point_dynamics.physics, model=PaperRRA)
    with pytest.raises(TypeError, match="PaperRRA"):
        point_agent(dynamics=paper, exploration=FEW)
