"""Policies that gradients improve."""

from dataclasses import replace

import pytest
import torch

from gpadjust.control import (
    BoundedPolicy,
    PolicySearch,
    Return,
    Rollouts,
    Task,
)
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import BlackBoxPhysics, PhysicsError
from tests.point import linear

SPEC = StateSpec(["x"], ["v"])
BOUNDS = torch.tensor([[-1.0], [2.0]], dtype=torch.float64)
QUICK = {"method": "map"}


def to_zero(states, actions, next_states):
    return -next_states[:, 0].square()


def starts(n):
    return torch.randn(n, 1, dtype=torch.float64)


def step(X):
    return X[:, :1] + 0.5 * X[:, 1:]


def task_of(dynamics, **parts):
    return Task(dynamics, to_zero, initial_states=starts, episode_length=4, **parts)


@pytest.fixture(scope="module")
def learnt():
    """Dynamics that have learnt that the system moves twice as far as its physics says."""
    torch.manual_seed(0)
    x, v = torch.randn(2, 25, 1, dtype=torch.float64)
    dynamics = LearnedDynamics(SPEC, lambda X: X[:, :1] + 0.25 * X[:, 1:], fit_options=QUICK)
    dynamics.update(x, v, x + 0.5 * v)
    return dynamics


@pytest.mark.parametrize("make", [BoundedPolicy, linear])
def test_policies_keep_to_the_bounds_and_begin_where_they_are_told_to(make):
    policy = make(SPEC, BOUNDS, first_actions=[-0.8])
    policy.look_at(10 + starts(50))
    actions = policy(100 * starts(200))
    assert actions.shape == (200, 1)
    assert actions.min() >= -1
    assert actions.max() <= 2
    policy.body[-1].weight.data.zero_()
    torch.testing.assert_close(policy(starts(1)), torch.full((1, 1), -0.8).double())


def test_an_episode_that_runs_away_does_not_outweigh_the_others():
    """Of 21 starts one is where the physics is a thousand times as steep."""

    def steep(X):
        return torch.where(X[:, :1] > 5, 1e3 * (X[:, :1] - 5) + 5, X[:, :1]) + 0.5 * X[:, 1:]

    policy = linear(SPEC, BOUNDS)
    x = torch.linspace(-1, 1, 21, dtype=torch.float64).unsqueeze(-1)

    def slope(starts):
        policy.zero_grad()
        rollout = Rollouts(task_of(PhysicsDynamics(SPEC, steep)), None).act(starts, policy, 4)
        rollout.rewards.sum().backward()
        return policy.body[-1].weight.grad.clone()

    usual = slope(x)
    x[20] = 6.0
    assert slope(x).abs() < 20 * usual.abs()


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "physics",
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("black box", "learnt")),
        "mean of learnt",
    ],
)
def test_the_optimum_is_found(learnt, kind):
    """To bring x to 0 in steps of v / 2: -2 x, within the bounds."""
    torch.manual_seed(0)
    black_box = BlackBoxPhysics(lambda X: X[:, :1] + 0.5 * X[:, 1:])
    dynamics = {
        "physics": PhysicsDynamics(SPEC, step),
        "black box": PhysicsDynamics(SPEC, black_box),
    }.get(kind, learnt)
    policy = linear(SPEC, BOUNDS)
    functions = None if kind.startswith("mean") else 3
    search = PolicySearch(updates=120, num_functions=functions, learning_rate=0.05)
    result = search.improve(policy, task_of(dynamics))
    assert result.values.shape == (120,)
    assert result.left_bounds == 0
    action = policy(torch.tensor([[0.2], [-0.2]], dtype=torch.float64)).squeeze()
    assert action[0] < -0.2
    assert action[1] > 0.2


def test_gradients_are_those_of_finite_differences(learnt):
    policy = linear(SPEC, BOUNDS)
    torch.manual_seed(0)
    rollouts, at = Rollouts(task_of(learnt), 2), starts(3)
    score = Return().of(task_of(learnt))

    def value(weight):
        found = torch.func.functional_call(policy, {"body.0.weight": weight}, at)
        del found
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
        bad = (X[:, 0].abs() > 1.5).nonzero().flatten().tolist()
        if bad:
            raise PhysicsError("too far", rows=bad)
        return (X[:, :1].abs() + 1e-300).sqrt().log() * 0 + step(X)

    torch.manual_seed(0)
    policy = linear(SPEC, BOUNDS)
    result = PolicySearch(updates=30, learning_rate=0.05).improve(
        policy, task_of(PhysicsDynamics(SPEC, physics))
    )
    assert result.values.isfinite().all()
    assert 0 < result.left_bounds < 1
    assert all(p.isfinite().all() for p in policy.parameters())
    assert policy.body[0].weight.item() < -0.05


def test_an_error_leaves_the_policy_as_it_was():
    policy = linear(SPEC, BOUNDS)
    before = policy.body[0].weight.clone()

    def stop(update, value):
        if update == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        PolicySearch(updates=5).improve(policy, task_of(PhysicsDynamics(SPEC, step)), progress=stop)
    assert torch.equal(policy.body[0].weight, before)


def test_rewards_without_gradient_are_told():
    task = Task(
        PhysicsDynamics(SPEC, step),
        lambda s, a, n: -n[:, 0].detach().square(),
        initial_states=starts,
        episode_length=3,
    )
    with pytest.raises(RuntimeError, match="Write the reward in torch"):
        PolicySearch(updates=1).improve(linear(SPEC, BOUNDS), task)


@pytest.mark.slow
def test_a_policy_comes_back_from_the_bounds():
    """The reward lies beyond them; within, the nearest is best."""
    torch.manual_seed(0)
    task = Task(
        PhysicsDynamics(SPEC, step),
        lambda states, actions, next_states: -(next_states[:, 0] - 3).square(),
        initial_states=lambda n: starts(n) / 4,
        episode_length=5,
        state_bounds=torch.tensor([[-1.0], [1.0]]),
    )
    policy = BoundedPolicy(SPEC, BOUNDS, (16,))
    search = PolicySearch(updates=120, num_functions=None, learning_rate=0.02)
    search.improve(policy, task)
    with torch.no_grad():
        rollout = Rollouts(task, None).act(task.draw_initial_states(64), policy, 5)
    assert rollout.left_bounds.any(-1).double().mean() < 0.3
    assert rollout.rewards.mean() > -6  # to stay where it is costs 9


def test_a_search_that_does_harm_keeps_the_policy_that_it_began_with():
    """In one step -2 x is the optimum; updates of this size throw it far away."""
    policy = linear(SPEC, torch.tensor([[-1e3], [1e3]], dtype=torch.float64))
    with torch.no_grad():
        policy.body[0].weight.fill_(-2e-3)
        policy.body[0].bias.zero_()
    before = {name: t.clone() for name, t in policy.state_dict().items()}
    task = task_of(PhysicsDynamics(SPEC, step))
    result = PolicySearch(updates=5, learning_rate=1.0).improve(policy, task)
    torch.testing.assert_close(policy.state_dict(), before, rtol=0, atol=0)
    assert result.reward == pytest.approx(0, abs=1e-6)
    assert result.values[-1] < -1


def test_the_result_is_that_of_the_policy_that_is_kept():
    fixed = torch.linspace(-1, 1, 24, dtype=torch.float64).unsqueeze(-1)
    task = replace(task_of(PhysicsDynamics(SPEC, step)), initial_states=lambda n: fixed[:n])
    policy = linear(SPEC, BOUNDS)
    result = PolicySearch(updates=7, learning_rate=0.1).improve(policy, task)
    with torch.no_grad():
        rewards = Rollouts(task, None).act(fixed, policy, 4).rewards
    assert result.reward == pytest.approx(rewards.mean().item(), rel=1e-12)
    assert result.reward > result.values[0]
