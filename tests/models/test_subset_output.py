"""Subsets of a model's outputs."""

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models.transforms import Normalize, Standardize
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import fit
from tests.systems import crude, refused

KINDS = ["ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA", "AR1", "RRA", "RRA-paper"]
CASES = [(kind, indices) for kind in KINDS for indices in ([1], [2, 0])]
QUICK = [("CKA", [1]), ("CKA", [2, 0]), ("RRA", [2, 0])]


@pytest.fixture(params=["plain", "transformed", "known-noise", "batch"])
def three_outputs(request, data, build, kind, shuffle):
    """A model of three different outputs."""
    batch = (2,) if request.param == "batch" else ()
    X, Y = data(batch_shape=batch, num_outputs=2)
    Y = torch.cat([Y, Y[..., :1].sin() + 3], dim=-1)
    options = {}
    if kind != "ZeroMeanGP":

        def physics(X):
            f_p = crude(X)
            return torch.cat([f_p, f_p[..., :1].cos() + 3], dim=-1)

        options["physics"] = physics
    if request.param == "transformed":
        options["input_transform"] = Normalize(2)
        options["outcome_transform"] = Standardize(3)
    Yvar = 0.01 * torch.ones_like(Y) if request.param == "known-noise" else None
    return shuffle(build(kind, X, Y, Yvar, **options))


@pytest.mark.parametrize("indices", [[1], [2, 0], [-1]])
def test_the_posterior_is_that_of_the_whole(three_outputs, uniform, same, indices):
    Z = uniform(4, 2, high=2.0, seed=5)
    same(three_outputs.subset_output(indices), three_outputs, Z, 1e-9, indices)
    posterior = three_outputs.posterior(Z, output_indices=indices)
    expected = three_outputs.posterior(Z).mean[..., indices]
    torch.testing.assert_close(posterior.mean, expected)
    refused(ValueError, "numbers of outputs from 0 to 2", three_outputs.subset_output, [3])


# BoTorch's fit adds no nugget but after a warning.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A not p.d.")
@pytest.mark.parametrize(
    ("kind", "indices"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES],
)
def test_it_can_be_fitted_again(data, build, kind, uniform, indices):
    X, Y = data(num_outputs=2)
    # With noise, so that rounding errors do not decide which optimum is reached.
    Y = torch.cat([Y, Y[:, :1].sin() + 3], dim=-1) + 0.1 * uniform(len(X), 3, seed=5)
    options = {}
    if kind != "ZeroMeanGP":
        options["physics"] = lambda X: torch.cat([crude(X), crude(X)[..., :1].cos() + 3], dim=-1)
    whole = build(kind, X, Y, **options)
    part = whole.subset_output(indices)
    if kind != "ZeroMeanGP":
        # A subset still reads all columns of f_p.
        assert part.posterior(X).mean.shape == (len(X), len(indices))
    refitted = whole.subset_output(indices)
    from_there = {"num_screened": 0, "num_starts": 1}
    reached, expected = fit(refitted, "map", **from_there), fit(whole, "map", **from_there)
    part_of_whole = expected.log_likelihood[indices].reshape(reached.log_likelihood.shape)
    torch.testing.assert_close(reached.log_likelihood, part_of_whole, rtol=1e-3, atol=1e-3)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(part.likelihood, part))
    assert (part.posterior(X).mean - Y[:, indices]).abs().mean() < Y.std()


def test_the_whole_stays_as_it_is(three_outputs, uniform):
    Z = uniform(4, 2)
    before = three_outputs.posterior(Z).mean.detach()
    part = three_outputs.subset_output([1])
    with torch.no_grad():
        for parameter in part.parameters():
            parameter += 0.5
    three_outputs.train()
    torch.testing.assert_close(three_outputs.posterior(Z).mean.detach(), before)
