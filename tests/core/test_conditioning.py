"""Conditioning on further observations, fantasies of them, and targets that are missing."""

import copy
import pickle

import pytest
import torch
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.kernels import MaternKernel

from gpadjust.core import CKA, MATERN52, RRA, Stationary
from gpadjust.physics import FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.systems import crude


def unknown(*data):
    def law(X, p):
        return torch.stack([p.a * y + X[..., 0].pow(p.b) for y in crude(X).mT], -1)

    unknowns = {"a": Unknown(1.0, sd=0.5), "b": Unknown(2.0, factor=1.5)}
    return CKA(*data, physics=FunctionPhysics(law, unknowns=unknowns))


KINDS = {
    "CKA": lambda *data: CKA(*data, physics=crude),
    "RRA, known noise": lambda X, Y: RRA(X, Y, 0.01 + 0.02 * X, physics=crude),
    "relative noise": lambda *data: CKA(*data, physics=crude, noise=Relative()),
    "unknown parameters": unknown,
}


def sampler(number):
    return SobolQMCNormalSampler(torch.Size([number]), seed=0)


@pytest.mark.parametrize("sizes", [(3,), (2, 1)], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_conditioning_is_a_model_of_all_rows(
    kind, sizes, data, drawn, numbers, give, same, uniform
):
    X, Y = data(num_outputs=2, n=12)
    Y[4, 0] = Y[10, 1] = torch.nan
    model, Z = drawn(KINDS[kind](X[:9], Y[:9])), uniform(5, 2, high=2.0, seed=4)
    conditioned, n, before = model, 9, model.predict(Z).mean
    is_known = model.data.Yvar is not None
    for size in sizes:
        new = slice(n, n := n + size)
        noise = 0.01 + 0.02 * X[new] if is_known else None
        conditioned = conditioned.condition_on_observations(X[new], Y[new], noise)
    whole = give(KINDS[kind](X, Y), numbers(model))
    same(conditioned, whole, Z, 1e-7, noise=not is_known)
    for own, other in zip(conditioned.left_out(), whole.left_out(), strict=True):
        same_there = ~Y.isnan().expand_as(own)
        torch.testing.assert_close(own[same_there], other[same_there], rtol=1e-6, atol=1e-9)
    conditioned.set_draws(model.u[:1])  # and once more from the beginning
    same(conditioned, whole.subset_draws(torch.tensor([0])), Z, 1e-7, noise=not is_known)
    assert torch.equal(model.predict(Z).mean, before)


def test_batches_of_observations(data, drawn, uniform, close):
    X, Y = data(num_outputs=2)
    model = drawn(CKA(X, Y, 0.01, physics=crude))
    new_X, Z = uniform(3, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    new_Y = 4 + uniform(4, 3, 2, 2, seed=5)
    new_Y[2, 1, 0, 1] = torch.nan
    batch = model.condition_on_observations(new_X, new_Y)
    twice = batch.condition_on_observations(new_X[:, :1] + 0.1, new_Y[:, :, :1])
    for i in range(3):
        one = model.condition_on_observations(new_X[i], new_Y[2, i])
        two = one.condition_on_observations(new_X[i, :1] + 0.1, new_Y[2, i, :1])
        for found, single in ((batch, one), (twice, two)):
            for ask in ("predict", "posterior", "rho", "delta"):
                many, expected = getattr(found, ask)(Z), getattr(single, ask)(Z)
                assert many.mean.shape == (4, 3, 5, 2)
                close(many.mean[2, i], expected.mean)
                close(many.variance.expand(4, 3, 5, 2)[2, i], expected.variance)
            close(found.interval(Z)[0][2, i], single.interval(Z)[0])
            own = found.predict(Z + torch.arange(3).reshape(3, 1, 1)).mean[2, i]
            close(own, single.predict(Z + i).mean)
    assert batch.posterior(Z).rsample(torch.Size([6])).shape == (6, 4, 3, 5, 2)
    assert batch.sample_functions(7, seed=0)(Z).shape == (7, 4, 3, 5, 2)


@pytest.mark.parametrize("m", [1, 2])
def test_fantasies(m, data, drawn, uniform, close):
    X, Y = data(num_outputs=m)
    model = drawn(CKA(X, Y, 0.01, physics=lambda X: crude(X)[..., :m]))
    new_X, Z = uniform(4, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, sampler(6))
    prediction, posterior = fantasy.predict(Z), fantasy.posterior(Z)
    assert posterior.mean.shape == prediction.mean.shape == (6, 4, 5, m)
    assert posterior.mean.std(0).max() > 1e-6
    close(prediction.variance.expand(6, 4, 5, m), posterior.variance.expand(6, 4, 5, m))
    noise = torch.full((4, 2, m), 0.3, dtype=torch.float64)
    assert model.fantasize(new_X, sampler(6), observation_noise=noise).batch_shape == (6, 4)
    one = model.subset_draws(torch.tensor([0]))  # each draw averages by itself
    average = one.fantasize(new_X[:1, :1], sampler(2048)).posterior(Z).mean.mean(0)
    torch.testing.assert_close(average, one.posterior(Z).mean[None], rtol=1e-3, atol=1e-3)
    nothing = model.fantasize(new_X[:, :0], sampler(3))
    close(nothing.predict(Z).mean, model.predict(Z).mean.expand(3, 4, 5, m))


def test_gradients_to_new_inputs_and_targets(data, drawn, uniform):
    X, Y = data(num_outputs=2)
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(2, 2, high=2.0)

    def after_another(new_X, new_Y):
        later = model.condition_on_observations(new_X, new_Y)
        return later.condition_on_observations(Z + 0.1, Y[:2]).predict(Z)

    new = uniform(2, 2, high=2.0, seed=7).requires_grad_(), Y[:2].clone().requires_grad_()
    assert torch.autograd.gradcheck(after_another, new, rtol=1e-3, atol=1e-4)


@pytest.fixture
def gaps(data):
    X, Y = data(n=14, num_outputs=2)
    Y[2:5, 0] = Y[7, 1] = Y[12, 0] = torch.nan
    return X, Y


@pytest.mark.parametrize("kernel", [None, Stationary(MATERN52), MaternKernel()], ids=repr)
def test_means_alone_are_those_with_covariances(kernel, gaps, drawn, close, uniform):
    """Also with a graph, of batches of inputs, and of a model that was pickled."""
    model = drawn(CKA(*gaps, physics=crude, delta_covar_module=kernel))
    Z = uniform(3, 5, 2, high=2.0, seed=4)
    for each in (model, pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        given = each.conditioning()
        for X in (Z[0], Z, Z.clone().requires_grad_()):
            close(given.mean_alone(each.evaluate(X)), given.mean(each.evaluate(X))[0])


def test_nothing_new_is_learnt_of_what_is_missing(gaps, drawn, same, close, uniform):
    X, Y = gaps
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(5, 2, seed=4)
    nothing = torch.full((2, 2), torch.nan, dtype=torch.float64)
    same(model.condition_on_observations(X[:2] + 0.1, nothing), model, Z)
    functions = model.sample_functions(3, seed=0)
    assert functions(Z).isfinite().all()
    known = CKA(X, Y, 0.1, physics=crude)
    new_Y, noise = crude(X[:2]), torch.full((2, 2), 0.1, dtype=torch.float64)
    new_Y[0, 1] = torch.nan
    predicted = []
    for value in (0.1, 7.0, torch.nan):
        noise[0, 1] = value
        predicted.append(known.condition_on_observations(X[:2] + 0.1, new_Y, noise).predict(Z))
    close(predicted[1].variance, predicted[0].variance)
    close(predicted[2].mean, predicted[0].mean)
