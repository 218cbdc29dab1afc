"""Shapes of posteriors, for every model."""

import pytest
import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize


def options(transform, normalize, m, batch_shape=()):
    shape = torch.Size(batch_shape)
    chosen = {"default": {}, "none": {"outcome_transform": None}}.get(transform)
    if chosen is None:
        chosen = {"outcome_transform": Standardize(m, batch_shape=shape)}
    if normalize:
        chosen["input_transform"] = Normalize(2, batch_shape=shape)
    return chosen


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "normalize"])
@pytest.mark.parametrize("transform", ["default", "none", "standardize"])
@pytest.mark.parametrize("batch_shape", [(), (3,)], ids=["single", "batch"])
def test_posterior(
    data, build, uniform, kind, num_outputs, batch_shape, transform, normalize, known_noise
):
    if kind == "RRA-paper" and transform == "standardize":
        pytest.skip("is refused")
    X, Y = data(batch_shape=batch_shape, num_outputs=num_outputs)
    Yvar = 0.01 * torch.ones_like(Y) if known_noise else None
    model = build(kind, X, Y, Yvar, **options(transform, normalize, num_outputs, batch_shape))
    assert model.num_outputs == num_outputs
    assert model.batch_shape == batch_shape
    for leading in ((), (5, *batch_shape), (2, 5, *batch_shape)):
        posterior = model.posterior(uniform(*leading, 4, 2))
        noisy = model.posterior(uniform(*leading, 4, 2), observation_noise=True)
        expected = torch.Size([*(leading or batch_shape), 4, num_outputs])
        assert posterior.mean.shape == posterior.variance.shape == expected
        assert posterior.rsample(torch.Size([6])).shape == (6, *expected)
        torch.testing.assert_close(noisy.mean, posterior.mean)
        assert (noisy.variance > posterior.variance).all()


def test_is_a_single_task_gp(data, build, kind):
    assert isinstance(build(kind, *data()), SingleTaskGP)


def test_one_posterior_for_some_outputs(data, build, kind, uniform):
    model = build(kind, *data(num_outputs=2))
    Z = uniform(4, 2)
    full, second = model.posterior(Z), model.posterior(Z, output_indices=[1])
    torch.testing.assert_close(second.mean, full.mean[:, 1:])
    torch.testing.assert_close(second.variance, full.variance[:, 1:])


def test_outputs_are_independent(data, build, kind, uniform):
    X, Y = data(num_outputs=2)
    pair = build(kind, X, Y)
    changed = build(kind, X, torch.cat([Y[:, :1], Y[:, 1:].flip(0)], dim=-1))
    Z = uniform(4, 2)
    torch.testing.assert_close(pair.posterior(Z).mean[:, 0], changed.posterior(Z).mean[:, 0])
    assert not torch.allclose(pair.posterior(Z).mean[:, 1], changed.posterior(Z).mean[:, 1])


def test_batched_inputs_are_predicted_apart(data, build, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs))
    Z = uniform(5, 4, 2, high=2.0, seed=3)
    batch = model.posterior(Z)
    for i in range(5):
        single = model.posterior(Z[i])
        torch.testing.assert_close(batch.mean[i], single.mean)
        torch.testing.assert_close(batch.variance[i], single.variance)


@pytest.mark.parametrize("name", ["rho", "delta"])
@pytest.mark.parametrize("batch_shape", [(), (3,)], ids=["single", "batch"])
def test_rho_and_delta(data, build, kind, num_outputs, batch_shape, uniform, name):
    if kind == "AR1":
        pytest.skip("rho is a constant there")
    X, Y = data(batch_shape=batch_shape, num_outputs=num_outputs)
    model = build(kind, X, Y)
    if not hasattr(model, name):
        pytest.skip("has no such adjustment")
    for leading in ((), (5, *batch_shape)):
        posterior = getattr(model, name)(uniform(*leading, 4, 2))
        expected = (*(leading or batch_shape), 4, num_outputs)
        assert posterior.mean.shape == posterior.variance.shape == expected


def test_the_data_are_met_where_the_noise_is_small(data, build, kind, num_outputs):
    X, Y = data(num_outputs=num_outputs)
    options = {"num_features": 200} if kind.startswith("RRA") else {}
    model = build(kind, X, Y, 1e-4 * torch.ones_like(Y), **options)
    error = (model.posterior(X).mean - Y).abs().max()
    assert error < 0.1 * Y.std(0).max()
