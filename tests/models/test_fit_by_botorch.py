"""The models in BoTorch's own fitting, alone and in lists."""

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import ModelListGP
from botorch.models.transforms import Normalize, Standardize
from gpytorch.mlls import ExactMarginalLogLikelihood, SumMarginalLogLikelihood


def log_likelihood(model):
    model.train()
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    with torch.no_grad():
        value = mll(model(*model.train_inputs), model.train_targets, *model.train_inputs).sum()
    model.eval()
    return value.item()


@pytest.mark.parametrize("batch_shape", [(), (2,)], ids=["single", "batch"])
def test_the_likelihood_rises(data, build, costly_kind, num_outputs, batch_shape):
    X, Y = data(batch_shape=batch_shape, num_outputs=num_outputs)
    model = build(costly_kind, X, Y)
    before = log_likelihood(model)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    assert not model.training
    assert log_likelihood(model) > before + 0.01


@pytest.mark.parametrize("transform", ["none", "standardize"])
def test_with_transforms_and_known_noise(data, build, costly_kind, transform):
    X, Y = data()
    outcome = Standardize(1) if transform == "standardize" else None
    model = build(
        costly_kind,
        X,
        Y,
        torch.full_like(Y, 1e-3),
        outcome_transform=outcome,
        input_transform=Normalize(2),
    )
    before = log_likelihood(model)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    assert log_likelihood(model) > before


def test_in_a_model_list(data, build, costly_kind, uniform):
    X, Y = data(num_outputs=2)
    first, second = build(costly_kind, X, Y[:, :1]), build(costly_kind, X[2:], Y[2:, :1])
    model = ModelListGP(first, second)
    fit_gpytorch_mll(SumMarginalLogLikelihood(model.likelihood, model))
    Z = uniform(5, 4, 2)
    posterior = model.posterior(Z)
    assert posterior.mean.shape == (5, 4, 2)
    torch.testing.assert_close(posterior.mean[..., :1], first.posterior(Z).mean)
    torch.testing.assert_close(posterior.variance[..., 1:], second.posterior(Z).variance)
