"""Conditioning on further observations, and fantasies of them."""

import pytest
import torch
from botorch.models.transforms import Normalize
from botorch.sampling import SobolQMCNormalSampler


@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "normalize"])
@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_conditioning_is_rebuilding(
    data, build, rebuild, kind, num_outputs, shuffle, uniform, crude_physics, known_noise, normalize
):
    X, Y = data(num_outputs=num_outputs, n=12)
    options = {}
    if kind == "AR1":
        low_X = uniform(10, 2, high=2.0, seed=8)
        options = {"low_X": low_X, "low_Y": crude_physics(low_X)[:, :num_outputs]}
    if normalize:
        bounds = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
        options["input_transform"] = Normalize(2, bounds=bounds)
    if known_noise:
        options["outcome_transform"] = None
    Yvar = uniform(*Y.shape, low=0.01, high=0.1, seed=2) if known_noise else None
    first = None if Yvar is None else Yvar[:9]
    model = shuffle(build(kind, X[:9], Y[:9], first, **options))
    kwargs = {} if Yvar is None else {"noise": Yvar[9:]}
    conditioned = model.condition_on_observations(X[9:], Y[9:], **kwargs)
    expected = rebuild(kind, model, X, Y, Yvar, **options)
    Z = uniform(5, 2, high=2.0, seed=4)
    for name in ("posterior", "rho", "delta"):
        if callable(getattr(model, name, None)):
            a, b = getattr(conditioned, name)(Z), getattr(expected, name)(Z)
            torch.testing.assert_close(a.mean, b.mean, rtol=1e-6, atol=1e-7)
            torch.testing.assert_close(a.variance, b.variance, rtol=1e-6, atol=1e-7)


def test_the_model_itself_stays(data, build, kind, num_outputs, uniform):
    X, Y = data(num_outputs=num_outputs, n=12)
    model = build(kind, X[:9], Y[:9]).eval()
    Z = uniform(5, 2, seed=4)
    before = model.posterior(Z).mean.detach()
    model.condition_on_observations(X[9:], Y[9:] + 1)
    torch.testing.assert_close(model.posterior(Z).mean.detach(), before)


def test_conditioning_twice(data, build, kind, num_outputs, shuffle, uniform):
    X, Y = data(num_outputs=num_outputs, n=12)
    model = shuffle(build(kind, X[:8], Y[:8]))
    once = model.condition_on_observations(X[8:], Y[8:])
    twice = model.condition_on_observations(X[8:10], Y[8:10])
    twice = twice.condition_on_observations(X[10:], Y[10:])
    Z = uniform(5, 2, seed=4)
    torch.testing.assert_close(
        once.posterior(Z).mean, twice.posterior(Z).mean, rtol=1e-6, atol=1e-7
    )


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_fantasies(data, build, kind, num_outputs, uniform, known_noise):
    X, Y = data(num_outputs=num_outputs)
    model = build(kind, X, Y, 0.01 * torch.ones_like(Y) if known_noise else None)
    new_X, Z = uniform(4, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, SobolQMCNormalSampler(torch.Size([6]), seed=0))
    posterior = fantasy.posterior(Z)
    assert posterior.mean.shape == (6, 4, 5, num_outputs)
    assert posterior.mean.std(0).max() > 1e-6
    at_new = fantasy.posterior(new_X).variance
    assert (at_new < model.posterior(new_X).variance + 1e-9).all()


def test_fantasies_average_to_the_model(data, build, kind, uniform):
    X, Y = data()
    model = build(kind, X, Y)
    if kind == "RRA-paper":
        pytest.skip("its covariance is not that of its own update")
    new_X, Z = uniform(1, 1, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, SobolQMCNormalSampler(torch.Size([2048]), seed=0))
    average = fantasy.posterior(Z).mean.mean(0)
    torch.testing.assert_close(average, model.posterior(Z).mean[None], rtol=1e-2, atol=1e-2)


def test_a_batch_of_observations(data, build, kind, num_outputs, uniform):
    X, Y = data(num_outputs=num_outputs)
    model = build(kind, X, Y).eval()
    new_X = uniform(3, 2, 2, high=2.0, seed=3)
    new_Y = 4 + uniform(3, 2, num_outputs, seed=5)
    Z = uniform(5, 2, high=2.0, seed=4)
    batch = model.condition_on_observations(new_X, new_Y).posterior(Z)
    assert batch.mean.shape == (3, 5, num_outputs)
    for i in range(3):
        single = model.condition_on_observations(new_X[i], new_Y[i]).posterior(Z)
        torch.testing.assert_close(batch.mean[i], single.mean, rtol=1e-7, atol=1e-8)
