"""A ridge regression adjustment as a Pyro model."""

import pytest
import torch

from gpadjust.core import RRA, fit
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.kinds.pyro_model import pyro_model
from gpadjust.kinds.updates import Weights
from tests.systems import line, refused, wave

pyro = pytest.importorskip("pyro")


@pytest.fixture(scope="module")
def model():
    X = line(9)
    Y = torch.cat([2 * wave(X) + X, X], -1)
    Y[4, 1] = torch.nan

    def physics(X):
        return torch.cat([wave(X), X], -1)

    made = RRA(X, Y + 0.01 * torch.cos(99 * X), physics=physics, num_features=6)
    fit(made, "map")
    return made


def test_the_joint_density_is_that_of_the_regression(model):
    torch.manual_seed(1)
    trace = pyro.poutine.trace(pyro_model).get_trace(model)
    weights, function = trace.nodes["_RETURN"]["value"]
    # Mean and precision of the weights, by the gradient of the joint density.
    posterior = Weights.condition(model)

    def log_density(w):
        known = pyro.condition(pyro_model, {"weights": w})
        return pyro.poutine.trace(known).get_trace(model).log_prob_sum()

    w = posterior.mean[0].detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(log_density(w), w)
    assert slope.abs().max() < 1e-6 * posterior.precision.abs().max()
    H = torch.autograd.functional.hessian(lambda w: log_density(w), w.detach())
    p = w.shape[-1]
    for j in range(2):
        torch.testing.assert_close(-H[j, :, j].reshape(p, p), posterior.precision[0, j])
    torch.testing.assert_close(function.shape, torch.Size([9, 2]))
    assert weights.shape == (2, p)


def test_it_samples_at_new_inputs(model):
    X = line(4) + 0.03
    trace = pyro.poutine.trace(pyro_model).get_trace(model, X)
    assert trace.nodes["Y"]["value"].shape == (2, 4)
    mean = Weights.condition(model).mean[0]
    _, function = pyro.condition(pyro_model, {"weights": mean})(model, X)
    torch.testing.assert_close(function, model.predict(X).mean, rtol=1e-5, atol=1e-7)


def test_bad_input(model):
    refused(ValueError, "Expected X", pyro_model, model, Y=model.data.Y)
    refused(ValueError, "draw", pyro_model, model, draw=1)


def test_what_noise_adds_to_the_targets_in_the_mean_is_no_observation():
    noisy = NoisyInputs(line(9), 1e-4, moved=torch.full((1, 9), 0.5).double())
    model = RRA(noisy.X, wave(line(9)), physics=wave, num_features=6, noise=noisy)
    observed = pyro.poutine.trace(pyro_model).get_trace(model).nodes["Y"]["value"]
    torch.testing.assert_close(observed, model.data.Y.mT - 0.5 * model.unit)
