"""Policies that gradients improve."""

from dataclasses import replace

import pytest
import torch

from gpadjust.control import BoundedPolicy, PolicySearch, Return, Rollouts
from gpadjust.dynamics import LearnedDynamics
from gpadjust.physics import BlackBoxPhysics
from tests.control.conftest import BOUNDS, fails_beyond, half_step, point_of
from tests.point import POINT_SPEC, linear
from tests.systems import line, normal


def to_zero(states, actions, next_states):
    return -next_states[:, 0].square()


def starts(n):
    return torch.randn(n, 1, dtype=torch.float64)


def task_of(physics=half_step, reward=to_zero, **parts):
    return point_of(physics, reward, **{"initial_states": starts, "episode_length": 4, **parts})


@pytest.fixture(scope="module")
def learnt():
    """A task whose dynamics have learnt that it moves twice as far as the physics says."""
    x, v = normal(2, 25, 1)
    physics, fit = (lambda X: X[:, :1] + 0.25 * X[:, 1:]), {"method": "map"}
    dynamics = LearnedDynamics(POINT_SPEC, physics, fit_options=fit)
    dynamics.update(x, v, x + 0.5 * v)
    return replace(task_of(), dynamics=dynamics)


@pytest.mark.parametrize("make", [BoundedPolicy, linear])
def test_policies_keep_to_the_bounds_and_begin_in_the_middle(make):
    policy = make(POINT_SPEC, BOUNDS)
    policy.look_at(10 + starts(50))
    actions = policy(100 * starts(200))
    assert ((actions >= BOUNDS[0]) & (actions <= BOUNDS[1])).all()
    policy.body[-1].weight.data.zero_()
    torch.testing.assert_close(policy(starts(1)), torch.full((1, 1), 0.5).double())


def test_an_episode_that_runs_away_does_not_outweigh_the_others():
    """Of 21 starts one is where the physics is a thousand times as steep."""

    def steep(X):
        return torch.where(X[:, :1] > 5, 1e3 * (X[:, :1] - 5) + 5, X[:, :1]) + 0.5 * X[:, 1:]

    policy = linear(POINT_SPEC, BOUNDS)
    x = line(21, -1.0)

    def slope(starts):
        policy.zero_grad()
        Rollouts(task_of(steep), None).act(starts, policy, 4).rewards.sum().backward()
        return policy.body[-1].weight.grad.clone()

    usual = slope(x)
    x[20] = 6.0
    assert slope(x).abs() < 20 * usual.abs()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["black box", "learnt", "mean of learnt"])
def test_the_optimum_is_found(learnt, kind):
    """To bring x to 0 in steps of v / 2: -2 x, within the bounds."""
    task = task_of(BlackBoxPhysics(half_step)) if kind == "black box" else learnt
    policy = linear(POINT_SPEC, BOUNDS)
    functions = None if kind.startswith("mean") else 3
    search = PolicySearch(updates=120, num_functions=functions, learning_rate=0.05)
    result = search.improve(policy, task)
    assert result.values.shape == (120,)
    assert result.left_bounds == 0
    action = policy(torch.tensor([[0.2], [-0.2]], dtype=torch.float64)).squeeze()
    assert action[0] < -0.2
    assert action[1] > 0.2


def test_gradients_are_those_of_finite_differences(learnt):
    policy = linear(POINT_SPEC, BOUNDS)
    torch.manual_seed(0)
    rollouts, at = Rollouts(learnt, 2), starts(3)
    score = Return().make_score(learnt)

    def value(weight):
        policy.body[0].weight.data.copy_(weight)
        return score(rollouts.act(at, policy, 3)).sum()

    weight = torch.tensor([[0.3]], dtype=torch.float64)
    value(weight).backward()
    slope = policy.body[0].weight.grad.item()
    with torch.no_grad():
        expected = (value(weight + 1e-4) - value(weight - 1e-4)).item() / 2e-4
    assert slope == pytest.approx(expected, rel=1e-6)


def test_runaways_and_failures_cost_those_particles_only():
    def physics(X):
        return fails_beyond(1.5)(X) + (X[:, :1].abs() + 1e-300).sqrt().log() * 0

    policy = linear(POINT_SPEC, BOUNDS)
    result = PolicySearch(updates=30, learning_rate=0.05).improve(policy, task_of(physics))
    assert result.values.isfinite().all()
    assert 0 < result.left_bounds < 1
    assert all(p.isfinite().all() for p in policy.parameters())
    assert policy.body[0].weight.item() < -0.05


def test_an_error_leaves_the_policy_as_it_was():
    policy = linear(POINT_SPEC, BOUNDS)
    before = policy.body[0].weight.clone()

    def reward(*transitions):
        if not torch.equal(policy.body[0].weight, before):  # after an update
            raise KeyboardInterrupt
        return to_zero(*transitions)

    with pytest.raises(KeyboardInterrupt):
        PolicySearch(updates=5).improve(policy, task_of(reward=reward))
    assert torch.equal(policy.body[0].weight, before)


@pytest.mark.slow
def test_a_policy_comes_back_from_the_bounds():
    """The reward lies beyond them; within, the nearest is best."""
    torch.manual_seed(0)
    task = task_of(
        reward=lambda states, actions, next_states: -(next_states[:, 0] - 3).square(),
        initial_states=lambda n: starts(n) / 4,
        episode_length=5,
        state_bounds=torch.tensor([[-1.0], [1.0]]),
    )
    policy = BoundedPolicy(POINT_SPEC, BOUNDS, (16,))
    PolicySearch(updates=120, num_functions=None, learning_rate=0.02).improve(policy, task)
    with torch.no_grad():
        rollout = Rollouts(task, None).act(task.draw_initial_states(64), policy, 5)
    assert rollout.left_bounds.any(-1).double().mean() < 0.3
    assert rollout.rewards.mean() > -6  # to stay where it is costs 9


def test_a_search_that_does_harm_keeps_the_policy_that_it_began_with():
    """In one step -2 x is the optimum; updates of this size throw it far away."""
    policy = linear(POINT_SPEC, torch.tensor([[-1e3], [1e3]], dtype=torch.float64))
    with torch.no_grad():
        policy.body[0].weight.fill_(-2e-3)
        policy.body[0].bias.zero_()
    before = {name: t.clone() for name, t in policy.state_dict().items()}
    result = PolicySearch(updates=5, learning_rate=1.0).improve(policy, task_of())
    torch.testing.assert_close(policy.state_dict(), before, rtol=0, atol=0)
    assert result.reward == pytest.approx(0, abs=1e-6)
    assert result.values[-1] < -1


def test_the_result_is_that_of_the_policy_that_is_kept():
    fixed = line(24, -1.0)
    task = task_of(initial_states=lambda n: fixed[:n])
    policy = linear(POINT_SPEC, BOUNDS)
    result = PolicySearch(updates=7, learning_rate=0.1).improve(policy, task)
    with torch.no_grad():
        rewards = Rollouts(task, None).act(fixed, policy, 4).rewards
    assert result.reward == pytest.approx(rewards.mean().item(), rel=1e-12)
    assert result.reward > result.values[0]
