"""A structure of one's own: co-kriging with a season."""

import pickle

import pytest
import torch
from gpytorch.kernels import PeriodicKernel, ScaleKernel

from gpadjust import fit
from gpadjust.models import TermBuilder, TermsGP
from tests.systems import holding, refused


def season(num_inputs, batch_shape):
    """A periodic kernel of the first input."""
    base = PeriodicKernel(batch_shape=batch_shape, active_dims=(0,)).double()
    base.period_length = 0.5
    base.raw_period_length.requires_grad_(False)
    return ScaleKernel(base, batch_shape=batch_shape).double()


class Seasonal(TermsGP):
    def __init__(self, train_X, train_Y, train_Yvar=None, *, physics, **options):
        make = TermBuilder.of_adjustment(train_X, train_Y, train_Yvar, physics=physics, **options)
        super().__init__(make, [*make.rhos(), make.delta(), make.term("season", season)])


def physics(X):
    return torch.stack([2 + X.sum(-1), 3 - X[..., 0]], dim=-1)


def wave(X):
    return torch.sin(4 * torch.pi * X[..., :1]) * torch.tensor([1.0, 30.0], dtype=X.dtype)


@pytest.fixture
def problem(uniform):
    """Inputs on [0, 2] x [0, 1], targets, and others where the season goes on."""
    X, Z = uniform(30, 2), uniform(8, 2, seed=1)
    X[:, 0] *= 2
    Z[:, 0] += 2
    return X, 1.2 * physics(X) + wave(X), Z


def test_it_learns_the_season_and_is_a_model_like_others(problem, uniform, shuffle, same, close):
    X, Y, Z = problem
    model = Seasonal(X, Y, physics=physics)
    fit(model, "map", num_screened=16, num_starts=2)
    assert model.term_names == ("rho", "delta", "season")
    assert model.other_names == ("delta", "season")
    found, right = model.term("season", Z).mean.detach(), wave(Z)
    error = (found - found.mean(0)) - (right - right.mean(0))
    assert (error.abs().amax(0) < 0.1 * right.std(0)).all()
    model = shuffle(Seasonal(X, Y, physics=physics))
    parts = model.rho(Z).mean * physics(Z) + model.delta(Z).mean + model.term("season", Z).mean
    close(parts, model.posterior(Z).mean)
    new_X, new_Y = Z[:3] + 0.1, 1.2 * physics(Z[:3] + 0.1)
    rebuilt = Seasonal(torch.cat([X, new_X]), torch.cat([Y, new_Y]), physics=physics)
    rebuilt.load_state_dict(model.state_dict())
    same(model.condition_on_observations(new_X, new_Y), rebuilt.eval(), Z, 1e-7)
    same(pickle.loads(pickle.dumps(model)), model, Z, 1e-12)
    same(model.subset_output([1]), model, Z, 1e-9, [1])
    refused(NotImplementedError, "PeriodicKernel", model.sample_functions, 2)
    before = model.term("season", Z).variance
    holding(model, 0.0, 0.2)
    close(model.term("season", Z, mixed=False).variance[0], before)
