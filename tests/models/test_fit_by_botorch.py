"""The models in BoTorch's own fitting, alone and in lists."""

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import ModelListGP
from botorch.models.transforms import Normalize, Standardize
from gpytorch.mlls import ExactMarginalLogLikelihood, SumMarginalLogLikelihood

# The search may look at hyper-parameters of which a kernel is nearly singular; where, depends on
# the processor.
pytestmark = pytest.mark.filterwarnings("ignore:A not p.d., added jitter")


def log_likelihood(model):
    model.train()
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    with torch.no_grad():
        value = mll(model(*model.train_inputs), model.train_targets, *model.train_inputs).sum()
    model.eval()
    return value.item()


SETTINGS = {
    "plain": lambda Y: {},
    "raw units": lambda Y: {"outcome_transform": None, "input_transform": Normalize(2)},
    "standardize": lambda Y: {
        "outcome_transform": Standardize(Y.shape[-1], batch_shape=Y.shape[:-2])
    },
}


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("batch_shape", [(), (2,)], ids=["single", "batch"])
def test_the_likelihood_rises(data, build, costly_kind, num_outputs, setting, batch_shape):
    X, Y = data(batch_shape=batch_shape, num_outputs=num_outputs)
    Yvar = None if setting == "plain" else torch.full_like(Y, 1e-3)
    model = build(costly_kind, X, Y, Yvar, **SETTINGS[setting](Y))
    before = log_likelihood(model)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    assert not model.training
    assert log_likelihood(model) > before + 0.01


def test_in_a_model_list(data, build, costly_kind, uniform):
    X, Y = data(num_outputs=2)
    Y = Y + 0.01 * torch.randn_like(Y)  # variances of a list are BoTorch's, with its least one
    first, second = build(costly_kind, X, Y[:, :1]), build(costly_kind, X[2:], Y[2:, :1])
    model = ModelListGP(first, second)
    fit_gpytorch_mll(SumMarginalLogLikelihood(model.likelihood, model))
    Z = uniform(5, 4, 2)
    posterior = model.posterior(Z)
    assert posterior.mean.shape == (5, 4, 2)
    torch.testing.assert_close(posterior.mean[..., :1], first.posterior(Z).mean)
    torch.testing.assert_close(posterior.variance[..., 1:], second.posterior(Z).variance)
