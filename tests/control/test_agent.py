"""Agents: they play an episode, learn the dynamics, and improve."""

import re
import sys
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.wrappers import TransformObservation
from stable_baselines3.common.evaluation import evaluate_policy

from gpadjust import ZeroMeanGP, progress
from gpadjust.control import Agent, MPCAgent, PolicySearchAgent, print_progress
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.physics import FunctionPhysics, PhysicsError, Unknown
from gpadjust.systems import cart_pole
from tests.control.conftest import KINDS, PLAN, Log
from tests.point import POINT_SPEC, Faulty

pytestmark = pytest.mark.filterwarnings("ignore:A step of the last real episode")
WHOLE = replace(PLAN, horizon=None)


# The loop


@pytest.mark.slow
def test_it_learns_the_system_and_brings_the_point_home(make_agent, kind, point_env):
    agent = make_agent(kind).learn(15)
    assert agent.task.dynamics.num_transitions == agent.num_timesteps == 15
    mean, _ = evaluate_policy(agent, point_env(), n_eval_episodes=2, warn=False)
    assert mean > -1.0  # to stay costs some 5


def test_the_first_episode_goes_by_the_physics(make_agent, kind):
    """Of the point's real cost the physics, a fifth too weak, saves most."""
    agent = make_agent(kind).learn(5)
    assert agent.recorded_episodes().rewards.sum() > -1.5


def test_without_a_physics_the_first_episode_is_random(make_agent, kind):
    """And keeps the limit of a rate of the actions, if the agent does."""
    fit = {"method": "map"}
    blind = LearnedDynamics(POINT_SPEC, model=ZeroMeanGP, fit_options=fit)
    limits = {MPCAgent: {"action_rate": 0.25}}.get(kind, {})
    agent = make_agent(kind, dynamics=blind, **limits)
    message = KINDS[kind].untrained
    with pytest.raises(RuntimeError, match=message) if message else nullcontext():
        agent.predict(np.ones(1, dtype=np.float32))
    changes = agent.learn(5).recorded_episodes().actions.diff(dim=0).abs()
    assert changes.max() > 0.1
    assert not limits or changes.max() <= 0.25 + 1e-6
    assert agent.promised_reward is None
    assert agent.model is not None
    assert len(agent.learn(5).recorded_episodes()) == 10


class Farthest(Agent):
    """A user's own: it takes the action from which the model moves farthest to the left."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        task, choices = self.newest_model, torch.linspace(-2, 2, 9).double().unsqueeze(-1)
        states = task.dynamics.spec.decode(torch.as_tensor(observation).double().reshape(1, -1))
        found = task.dynamics.predict(states.expand(9, -1), choices).mean[:, 0]
        return choices[found.argmin()].numpy(), state


def test_an_agent_of_ones_own_needs_predict_alone(make_agent):
    agent = make_agent(Farthest)
    assert agent.predict(np.ones(1))[0] == -2  # by the physics
    assert (agent.learn(10).recorded_episodes().actions == -2).all()
    assert agent.num_episodes == 2


@pytest.mark.parametrize(
    ("name", "answer", "error", "words"),
    [
        ("predict", np.zeros(1), ValueError, r"must return the action, .*\(1,\)"),
        ("predict", (np.zeros((1, 1)), None), ValueError, r"must return the action, .*\(1,\)"),
        ("predict", (np.full(1, np.nan), None), ValueError, r"must return the action, .*\(1,\)"),
        ("promise", 3.0, TypeError, r"must be a dictionary .* found 3\.0"),
        ("improve", None, TypeError, "must be True if .*found None"),
        ("predict", (torch.zeros(1).double(), None), None, ""),
    ],
)
def test_what_an_agent_of_ones_own_answers_is_checked_before_a_real_step(
    make_agent, name, answer, error, words
):
    agent = make_agent(type("Own", (Farthest,), {name: lambda *given: answer}))
    with pytest.raises(error, match=f"Own.{name} {words}") if error else nullcontext():
        agent.learn(5)
    assert agent.num_timesteps == (0 if error else 5)


@pytest.mark.slow
def test_episodes_are_played_to_their_end_and_told(make_agent, kind, capsys):
    events, agent = [], make_agent(kind)
    agent.learn(7, [lambda agent, event, values: events.append(event), print_progress])
    search = KINDS[kind].events
    episode = ["episode", "plan", *["step"] * 5, "trial", "fit", *search]
    assert events == [*search, *episode, *episode, "done"]
    episodes = agent.recorded_episodes()
    assert episodes.steps.tolist() == 2 * [1, 2, 3, 4, 5]
    assert torch.equal(episodes.states[1:5], episodes.next_states[:4])
    assert torch.equal(agent.recorded_episodes(newest=3).states, episodes.states[7:])
    begin = f"{kind.__name__}(Point, LearnedDynamics, 2 episodes learnt, 10 steps"
    reward = f"{episodes.rewards[5:].mean():.3g}"
    assert repr(agent) == f"{begin}, last reward {reward} a step)"
    printed = capsys.readouterr().out
    shown = [event for event in events if event not in ("step", "episode", "done")]
    assert [line.partition(":")[0] for line in printed.splitlines()] == shown
    assert re.search(r"\ntrial: number 2, steps 5, reward -\S+, seconds ", printed)


def test_scores_of_each_new_episode_are_told(make_agent):
    log = Log("fit")
    make_agent(MPCAgent, score_horizons=(4, 2)).learn(10, log)
    assert {*log[0]} == {"fit_seconds", "real_reward"}
    assert {"nlpd", "coverage", "rmse/x", "energy_2", "coverage_4"} <= {*log[1]}
    assert all(np.isfinite([*each.values()]).all() for each in log)


def test_episodes_end_at_the_tasks_length_or_that_of_the_environment(make_agent, point_env):
    agent = make_agent(MPCAgent, point_env().env, episode_length=4).learn(8)
    assert agent.recorded_episodes().episode.tolist() == 4 * [0] + 4 * [1]
    assert make_agent(MPCAgent, episode_length=None).learn(5).num_episodes == 1


# Promises


@pytest.mark.parametrize("first", [PLAN, WHOLE])
def test_the_promise_is_of_the_episode_that_was_learnt(make_agent, first):
    """Plans of a part of the episode promise nothing of it."""
    agent, plans, fits = make_agent(MPCAgent, first=first), Log("plan"), Log("fit")
    agent.learn(10, [plans, fits])
    promises = [values.get("promised_reward") for values in plans]
    assert promises == [values.get("promised_reward") for values in fits] == agent.promises
    assert agent.promised_reward == promises[1]
    assert (promises == [None, None]) == (first is PLAN)


@pytest.mark.slow
def test_a_searched_policy_promises_what_its_last_search_found(make_agent):
    searches = Log("search")
    agent = make_agent(PolicySearchAgent).learn(5, searches)
    assert agent.promised_reward == searches[0]["reward"] != searches[1]["reward"]


def test_the_real_reward_is_of_new_episodes_though_fresh_dynamics_learn_all(
    make_agent, learnt_dynamics
):
    log, agent = Log("fit"), make_agent(MPCAgent).learn(5)
    agent.task = replace(agent.task, dynamics=learnt_dynamics())
    assert agent.learn(5, log).task.dynamics.num_transitions == 10
    newest = agent.recorded_episodes(newest=5).rewards.mean()
    assert log[-1]["real_reward"] == pytest.approx(float(newest))


def test_promises_are_of_the_steps_that_are_made(make_agent):
    """Each step costs 1 until the point is home, which ends the episode; no warning is given."""
    agent = make_agent(
        MPCAgent,
        reward=lambda states, actions, next_states: -torch.ones(len(states)).double(),
        reward_tolerance=None,
        first=WHOLE,
    )
    agent.task = replace(agent.task, terminated=lambda states: states[:, 0].abs() < 0.5)
    assert agent.learn(5).promised_reward == pytest.approx(-1)


# The first physics says that any action helps, but the system goes the other way.
WRONG = PhysicsDynamics(POINT_SPEC, lambda X: X[:, :1] - 0.9 * X[:, 1:])
AWAY = PhysicsDynamics(POINT_SPEC, lambda X: X[:, :1] + 3.0)
NARROW = {
    "state_bounds": torch.tensor([[0.99], [1.01]], dtype=torch.float64),
    "initial_states": lambda n: torch.ones(n, 1).double(),
}


@pytest.mark.parametrize(
    ("kind", "parts", "message"),
    [
        (PolicySearchAgent, {"dynamics": WRONG}, "where the model promised .* do not trust"),
        (
            MPCAgent,
            {"dynamics": AWAY, "state_bounds": torch.tensor([[-2.0], [2.0]])},
            "100% of the functions .* leave the bounds of the states",
        ),
        (PolicySearchAgent, NARROW, "of the policy leave the bounds of the states in the model"),
    ],
)
def test_what_cannot_be_trusted_is_told(make_agent, kind, parts, message):
    with pytest.warns(UserWarning, match=message):
        make_agent(kind, **parts).learn(5)


def test_a_default_bound_that_may_have_held_an_episode_is_told(make_agent, monkeypatch):
    bounds = torch.tensor([[-0.1], [9.0]], dtype=torch.float64)
    monkeypatch.setattr("gpadjust.control.episodes.far_bounds", lambda *given: bounds)
    with pytest.warns(UserWarning, match=r"came to x = .* beyond -0.1: a default bound"):
        make_agent(MPCAgent).learn(10)
    make_agent(MPCAgent, state_bounds=bounds).learn(10)


# Errors lose nothing


@pytest.mark.slow
def test_an_error_loses_no_episode_nor_is_one_learnt_twice(make_agent, kind, point_reward):
    def full(agent, event, values):
        if event == "fit":
            raise OSError("full")

    agent = make_agent(kind, reward=lambda s, a, n: -3 * n[:, 0].square())
    with pytest.raises(ValueError, match="is not the environment's"):
        agent.learn(5)
    agent.task = replace(agent.task, reward=point_reward)
    with pytest.raises(OSError, match="full"):
        agent.learn(5, full)
    assert agent.learn(5).task.dynamics.num_transitions == 10
    assert agent.num_episodes == 2
    assert agent.model is not None


@pytest.mark.filterwarnings("ignore:.*promised", "ignore::gpadjust.control.FailedStepWarning")
def test_an_episode_without_a_step_counts_for_nothing(make_agent, point_env):
    """Else later episodes would have its number, and its promise."""

    class Boasts(Farthest):
        def promise(self, state):
            return {"promised_reward": 100.0 if self.num_timesteps == 5 else -1.0}

    trials, env = Log("trial"), Faulty(point_env(), {6: "raises"})
    agent = make_agent(Boasts, env, reward_tolerance=None).learn(11, trials)
    assert agent.num_episodes == 2
    assert [values["number"] for values in trials] == [1, 2]
    assert agent.promised_reward == -1.0


def test_a_physics_that_is_to_be_fitted_learns_all_episodes(make_agent, point_task):
    agent = make_agent(MPCAgent).learn(5)
    physics = FunctionPhysics(
        lambda X, p: (X[:, 0] + p.gain * X[:, 1]).unsqueeze(-1),
        unknowns={"gain": Unknown(0.4, factor=1.5)},
    )
    agent.task = point_task(dynamics=PhysicsDynamics(POINT_SPEC, physics))
    agent.learn(5)
    assert len(agent.task.dynamics.state_dict()["fitted"]["transitions"]["states"]) == 10
    assert abs(agent.task.dynamics.physics_parameters.mean.item() - 0.5) < 0.05


def test_a_physics_that_fails_for_a_while_loses_no_transition(make_agent, crude_dynamics):
    broken = []

    def physics(X):
        if broken:
            raise PhysicsError("the simulator's licence has expired")
        return X[:, :1] + 0.4 * X[:, 1:]

    def breaks(agent, event, values):
        broken.extend([True] * (event == "step" and agent.num_timesteps == 10))

    agent = make_agent(MPCAgent, dynamics=crude_dynamics(physics)).learn(5)
    with pytest.raises(PhysicsError, match="licence"):
        agent.learn(5, breaks)
    broken.clear()
    assert agent.task.dynamics.num_transitions == 5
    assert agent.learn(5).task.dynamics.num_transitions == 15


def test_observations_in_another_order_cost_no_episode():
    system, order = cart_pole(), [0, 3, 1, 2, 4]
    env = system.make()
    shuffled = TransformObservation(env, lambda seen: seen[order], env.observation_space)
    agent = MPCAgent(shuffled, system.task(), PLAN, first=PLAN, seed=0)
    with pytest.raises(ValueError, match="sine and cosine of the angle 'theta'"):
        agent.learn(25)
    assert agent.num_timesteps == 0


def test_what_is_recorded_is_read_once_an_episode(make_agent, monkeypatch):
    """To plan a step does not go through all that was recorded before it."""
    read, whole = [], MPCAgent.recorded_episodes
    monkeypatch.setattr(
        MPCAgent, "recorded_episodes", lambda self, *given: read.append(1) or whole(self, *given)
    )
    make_agent(MPCAgent).learn(10)
    assert len(read) <= 5  # before the first, and two of each


def test_long_learning_shows_bars_where_somebody_sees_them(make_agent, kind, monkeypatch, capsys):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    agent, counted = make_agent(kind), []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("gpadjust.control.agent.tick", counted.append)
    agent.learn(5)
    assert counted == ["steps"] * 5
    text = capsys.readouterr().err
    for part in ("learn", " steps", "fit", "plan" if kind is MPCAgent else "search"):
        assert part in text
