"""Dynamics by a model with inducing points."""

from functools import partial

import pytest
import torch

from gpadjust import VariationalCKA
from gpadjust.dynamics import LearnedDynamics, StateSpec
from tests.systems import normal, same

SPEC = StateSpec(["x", "v"], ["u"])


def step(X):
    x, v, u = X.unbind(-1)
    return torch.stack([x + 0.1 * v, 0.95 * v - 0.1 * x + 0.1 * u], dim=-1)


def transitions(n, seed=0):
    X = normal(n, 3, seed=seed)
    return X[:, :2], X[:, 2:], step(X) + 0.1 * X[:, :2].sin() + 0.01 * normal(n, 2, seed=seed + 50)


def make():
    return LearnedDynamics(SPEC, step, model=partial(VariationalCKA, num_inducing=12))


def test_means_by_inducing_points_of_each_output_are_those_of_predictions():
    X = torch.cat(transitions(60)[:2], -1)
    model = VariationalCKA(X, X[:, :2].sin(), physics=step, num_inducing=12)
    model.inducing = torch.stack([torch.arange(12), torch.arange(20, 32)])
    model.set_draws(model.u.detach())
    given, at = model.conditioning(), model.evaluate(X[:7] + 0.1)
    torch.testing.assert_close(given.mean_alone(at), given.mean(at)[0])


@pytest.mark.slow
def test_they_come_back_and_go_on():
    before, dynamics = make(), make()
    before.update(*transitions(100))
    dynamics.load_state_dict(before.state_dict())
    states, actions, next_states = transitions(50, seed=2)
    same(dynamics.predict(states, actions), before.predict(states, actions), rtol=1e-10, atol=0)
    dynamics.update(*transitions(60, seed=1))
    assert dynamics.num_transitions == 160
    mean, variance = dynamics.predict(states, actions)
    error = mean - next_states
    assert error.std() < 0.015
    assert ((error.square() / variance).mean() - 1).abs() < 0.5
    noise = dynamics.noise_variance(states, actions).sqrt()
    assert (noise - 0.01).abs().max() < 0.003
    assert dynamics.sample(states, actions).shape == (50, 2)
    functions = dynamics.sample_functions(4, seed=0)
    blocks = states.expand(4, -1, -1), actions.expand(4, -1, -1)
    assert (functions(*blocks) - mean).abs().max() < 0.1
    torch.testing.assert_close(dynamics.mean_function()(*blocks)[0], mean)
    run = dynamics.free_run(states, actions.unsqueeze(1))
    assert ((run.lower[:, 0] < next_states) & (next_states < run.upper[:, 0])).double().mean() > 0.8
