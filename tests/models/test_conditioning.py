"""Conditioning on further observations, and fantasies of them."""

import copy

import pytest
import torch
from botorch.models.transforms import Normalize
from botorch.sampling import SobolQMCNormalSampler

from gpadjust.models.exact_conditioning import batched_product
from tests.systems import crude, refused


def sampler(num_fantasies):
    return SobolQMCNormalSampler(torch.Size([num_fantasies]), seed=0)


@pytest.fixture
def low_level(kind, uniform, num_outputs):
    if kind != "AR1":
        return {}
    low_X = uniform(10, 2, high=2.0, seed=8)
    return {"low_X": low_X, "low_Y": crude(low_X)[:, :num_outputs]}


@pytest.mark.parametrize("sizes", [(3,), (2, 1)], ids=str)
@pytest.mark.parametrize("known", [False, True], ids=["learnt noise", "known noise"])
def test_conditioning_is_rebuilding(
    data, build, rebuild, kind, num_outputs, shuffle, uniform, same, low_level, known, sizes
):
    X, Y = data(num_outputs=num_outputs, n=12)
    options, Yvar = {**low_level}, uniform(*Y.shape, low=0.01, high=0.1, seed=2) if known else None
    if known:
        bounds = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
        options |= {"input_transform": Normalize(2, bounds=bounds), "outcome_transform": None}
    model = shuffle(build(kind, X[:9], Y[:9], Yvar[:9] if known else None, **options))
    conditioned, n, Z = model, 9, uniform(5, 2, high=2.0, seed=4)
    before = model.posterior(Z).mean
    for size in sizes:
        new = slice(n, n := n + size)
        noise = {"noise": Yvar[new]} if known else {}
        conditioned = conditioned.condition_on_observations(X[new], Y[new], **noise)
    same(conditioned, rebuild(kind, model, X, Y, Yvar, **options), Z, 1e-7)
    same(copy.deepcopy(conditioned), conditioned, Z, 1e-7)
    assert torch.equal(model.posterior(Z).mean, before)


@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
def test_known_noise_is_in_the_units_of_the_targets(data, build, kind, close):
    X, Y = data()
    model = build(kind, X, 100 * Y, 25.0).eval()
    noise = torch.full_like(Y[:2], 25.0)
    conditioned = model.condition_on_observations(X[:2] + 0.1, 100 * Y[:2], noise=noise)
    variances = conditioned.data()["train_Yvar"]
    close(variances, torch.full_like(variances, 25.0))


def test_the_noise_of_what_was_not_observed_makes_no_difference(data, build, uniform, close):
    X, Y = data(num_outputs=2)
    model, noise = build("CKA", X, Y, 0.1), torch.full((2, 2), 0.1, dtype=torch.float64)
    new_Y = Y[:2].clone()
    new_Y[0, 1] = torch.nan
    predicted = []
    for value in (0.1, 7.0, torch.nan):
        noise[0, 1] = value
        conditioned = model.condition_on_observations(X[:2] + 0.1, new_Y, noise=noise)
        predicted.append(torch.cat(conditioned.predict(X, True)))
    for each in predicted[1:]:
        close(each, predicted[0])


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_fantasies(data, build, kind, num_outputs, uniform, close, known_noise):
    X, Y = data(num_outputs=num_outputs)
    model = build(kind, X, Y, 0.01 * torch.ones_like(Y) if known_noise else None)
    new_X, Z = uniform(4, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, sampler(6))
    prediction, posterior = fantasy.predict(Z), fantasy.posterior(Z)
    assert posterior.mean.shape == prediction.mean.shape == (6, 4, 5, num_outputs)
    assert posterior.mean.std(0).max() > 1e-6
    close(prediction.mean, posterior.mean)
    close(prediction.variance, posterior.variance.expand(6, 4, 5, num_outputs))
    assert (fantasy.posterior(new_X).variance < model.posterior(new_X).variance + 1e-9).all()
    more_Y = torch.zeros(6, 4, 1, num_outputs, dtype=torch.float64)
    noise = {"noise": more_Y + 0.01} if known_noise else {}
    more = fantasy.condition_on_observations(Z[:1].expand(6, 4, 1, 2), more_Y, **noise)
    assert more.predict(Z).mean.shape == (6, 4, 5, num_outputs)


def test_fantasies_average_to_the_model(data, build, kind, uniform):
    model = build(kind, *data())
    new_X, Z = uniform(1, 1, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    average = model.fantasize(new_X, sampler(2048)).posterior(Z).mean.mean(0)
    torch.testing.assert_close(average, model.posterior(Z).mean[None], rtol=1e-2, atol=1e-2)


@pytest.mark.filterwarnings("ignore:Non-strict enforcement")
def test_no_new_points_and_batches_of_them(data, build, kind, num_outputs, uniform, close):
    model, Z = build(kind, *data(num_outputs=num_outputs)), uniform(5, 2)
    fantasy = model.fantasize(torch.empty(4, 0, 2, dtype=torch.float64), sampler(3))
    close(fantasy.predict(Z).mean, model.predict(Z).mean.expand(3, 4, 5, num_outputs))
    model = build(kind, *data(num_outputs=num_outputs)).eval()
    new_X, Z = uniform(3, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    new_Y = 4 + uniform(3, 2, num_outputs, seed=5)
    batch = model.condition_on_observations(new_X, new_Y).posterior(Z)
    assert batch.mean.shape == (3, 5, num_outputs)
    for i in range(3):
        single = model.condition_on_observations(new_X[i], new_Y[i]).posterior(Z)
        close(batch.mean[i], single.mean)


def test_gradient_to_the_new_inputs(data, build, kind, num_outputs, uniform):
    X, Y = data(num_outputs=num_outputs)
    model, Z = build(kind, X, Y).requires_grad_(False).eval(), uniform(2, 2, high=2.0)

    def predict(new_X):
        return model.condition_on_observations(new_X, Y[:2]).predict(Z)

    new_X = uniform(2, 2, high=2.0, seed=7).requires_grad_()
    assert torch.autograd.gradcheck(predict, new_X, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("lead", [(3,), (3, 2), ()], ids=str)
@pytest.mark.parametrize("batch", [(), (4,), (5, 4)], ids=str)
def test_a_batched_product(uniform, lead, batch):
    left, right = uniform(*lead, *batch, 2, 6), uniform(*batch, 6, 7, seed=1)
    torch.testing.assert_close(batched_product(left, right), left @ right)


@pytest.mark.parametrize("kind", ["CKA", "AR1"])
def test_bad_observations(data, build, kind):
    X, Y = data()
    condition = build(kind, X, Y).condition_on_observations
    for bad, found in ((float("inf"), "to be finite"), (float("nan"), "to hold an observation")):
        wrong = torch.tensor([[0.0], [bad]], dtype=torch.float64)
        refused(ValueError, rf"Expected Y {found}.*row 1", condition, X[:2], wrong)
        refused(ValueError, r"X to be finite.*row 1", condition, wrong.expand(2, 2), Y[:2])
    refused(ValueError, "with a row for each", condition, X[:2], Y[:3])
    refused(ValueError, r"Y of shape \.\.\. x k x 1", condition, X[:2], Y[:2].expand(2, 2))
    noise = torch.full_like(Y[:1], 0.1)
    refused(ValueError, "The model learns its noise", condition, X[:1], Y[:1], noise=noise)
    known = build(kind, X, Y, 0.1).condition_on_observations
    refused(ValueError, "pass `noise`", known, X[:1], Y[:1])
