"""Shapes of posteriors, for every model."""

import pytest
import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize

from tests.systems import crude, refused


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("batch_shape", [(), (3,)], ids=["single", "batch"])
@pytest.mark.parametrize("units", ["default", "raw", "standardize and normalize"])
def test_posterior(data, build, uniform, kind, num_outputs, units, batch_shape, known_noise):
    X, Y = data(batch_shape=batch_shape, num_outputs=num_outputs)
    Yvar = 0.01 * torch.ones_like(Y) if known_noise else None
    options = {"outcome_transform": None} if units == "raw" else {}
    if units == "standardize and normalize":
        outcome = Standardize(num_outputs, batch_shape=torch.Size(batch_shape))
        options = {"outcome_transform": outcome, "input_transform": Normalize(2)}
    model = build(kind, X, Y, Yvar, **options)
    assert isinstance(model, SingleTaskGP)
    assert model.num_outputs == num_outputs
    assert model.batch_shape == batch_shape
    for leading in ((), (5, *batch_shape), (2, 5, *batch_shape)):
        Z = uniform(*leading, 4, 2)
        posterior = model.posterior(Z)
        noisy = model.posterior(Z, observation_noise=True)
        expected = torch.Size([*(leading or batch_shape), 4, num_outputs])
        assert posterior.mean.shape == posterior.variance.shape == expected
        assert posterior.rsample(torch.Size([6])).shape == (6, *expected)
        torch.testing.assert_close(noisy.mean, posterior.mean)
        assert (noisy.variance > posterior.variance).all()
    if not batch_shape:  # batched inputs are predicted apart
        one = model.posterior(Z[1, 2])
        torch.testing.assert_close(one.mean, posterior.mean[1, 2])
        torch.testing.assert_close(one.variance, posterior.variance[1, 2])


def test_a_batched_input_transform(data, build, uniform, kind):
    X, Y = data(batch_shape=(3,))
    X = X * torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64).reshape(3, 1, 1)
    normalize = Normalize(2, batch_shape=torch.Size([3]))
    physics = {} if kind == "ZeroMeanGP" else {"physics": lambda X: 2 + X[..., 0].sin()}
    if kind == "AR1":
        low_X = uniform(3, 12, 2, high=2.0, seed=1)
        physics = {"low_X": low_X, "low_Y": 2 + low_X[..., :1].sin()}
    model = build(kind, X, Y, input_transform=normalize, **physics)
    Z = uniform(4, 2, high=2.0, seed=3)
    one_by_one = torch.stack([model.posterior(Z.expand(3, 4, 2)).mean[i] for i in range(3)])
    torch.testing.assert_close(model.posterior(Z).mean, one_by_one)


def test_outputs_are_independent_and_data_are_met(data, build, kind, uniform, num_outputs):
    X, Y = data(num_outputs=2)
    pair = build(kind, X, Y)
    changed = build(kind, X, torch.cat([Y[:, :1], Y[:, 1:].flip(0)], dim=-1))
    Z = uniform(4, 2)
    torch.testing.assert_close(pair.posterior(Z).mean[:, 0], changed.posterior(Z).mean[:, 0])
    assert not torch.allclose(pair.posterior(Z).mean[:, 1], changed.posterior(Z).mean[:, 1])
    X, Y = data(num_outputs=num_outputs)
    options = {"num_features": 200} if kind.startswith("RRA") else {}
    model = build(kind, X, Y, 1e-4 * torch.ones_like(Y), **options)
    error = (model.posterior(X).mean - Y).abs().max()
    assert error < 0.1 * Y.std(0).max()


# Subsets of a model's outputs


def three(X):
    """Three outputs of the crude physics."""
    return torch.cat([crude(X), crude(X)[..., :1].cos() + 3], dim=-1)


@pytest.fixture(params=["plain", "transformed", "known-noise", "batch"])
def three_outputs(request, data, build, kind, shuffle):
    """A model of three different outputs."""
    batch = (2,) if request.param == "batch" else ()
    X, Y = data(batch_shape=batch, num_outputs=2)
    Y = torch.cat([Y, Y[..., :1].sin() + 3], dim=-1)
    options = {} if kind == "ZeroMeanGP" else {"physics": three}
    if request.param == "transformed":
        options["input_transform"] = Normalize(2)
        options["outcome_transform"] = Standardize(3)
    Yvar = 0.01 * torch.ones_like(Y) if request.param == "known-noise" else None
    return shuffle(build(kind, X, Y, Yvar, **options))


@pytest.mark.parametrize("indices", [[1], [2, 0], [-1]])
def test_a_subset_is_the_whole_posterior_and_leaves_the_whole(
    three_outputs, uniform, same, indices
):
    Z = uniform(4, 2, high=2.0, seed=5)
    same(three_outputs.subset_output(indices), three_outputs, Z, 1e-9, indices)
    posterior = three_outputs.posterior(Z, output_indices=indices)
    expected = three_outputs.posterior(Z)
    torch.testing.assert_close(posterior.mean, expected.mean[..., indices])
    torch.testing.assert_close(posterior.variance, expected.variance[..., indices])
    refused(ValueError, "numbers of outputs from 0 to 2", three_outputs.subset_output, [3])
    Z = uniform(4, 2)
    before = three_outputs.posterior(Z).mean.detach()
    part = three_outputs.subset_output([1])
    with torch.no_grad():
        for parameter in part.parameters():
            parameter += 0.5
    three_outputs.train()
    torch.testing.assert_close(three_outputs.posterior(Z).mean.detach(), before)
