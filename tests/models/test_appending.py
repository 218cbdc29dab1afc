"""Points appended to the factors of the training covariance."""

import pytest
import torch
from botorch.sampling import SobolQMCNormalSampler

from gpadjust.models.cholesky_strategy import batched_product


def agree(a, b, Z, close):
    """Whether all that two models say at `Z` is the same to 1e-8."""
    for name in ("posterior", "predict", "rho", "delta"):
        if callable(getattr(a, name, None)):
            p, q = getattr(a, name)(Z), getattr(b, name)(Z)
            close(p.mean, q.mean)
            close(p.variance, q.variance)
    p, q = (model.posterior(Z).distribution.covariance_matrix for model in (a, b))
    close(p, q)


@pytest.fixture
def options(kind, uniform, crude_physics, num_outputs):
    if kind != "AR1":
        return {}
    low_X = uniform(10, 2, high=2.0, seed=8)
    return {"low_X": low_X, "low_Y": crude_physics(low_X)[:, :num_outputs]}


@pytest.mark.parametrize("sizes", [(3,), (1, 1, 1), (2, 1)], ids=str)
def test_rebuilding(
    data, build, rebuild, kind, num_outputs, shuffle, uniform, close, options, sizes
):
    X, Y = data(num_outputs=num_outputs, n=12)
    model = conditioned = shuffle(build(kind, X[:9], Y[:9], **options))
    n = 9
    for size in sizes:
        new = slice(n, n := n + size)
        conditioned = conditioned.condition_on_observations(X[new], Y[new])
    expected = rebuild(kind, model, X, Y, **options)
    agree(conditioned, expected, uniform(5, 2, high=2.0, seed=4), close)


def test_fantasies_of_fantasies(data, build, kind, num_outputs, uniform, close):
    model = build(kind, *data(num_outputs=num_outputs))
    sampler = SobolQMCNormalSampler(torch.Size([3]), seed=0)
    new_X, Z = uniform(4, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, sampler)
    prediction, posterior = fantasy.predict(Z), fantasy.posterior(Z)
    assert prediction.mean.shape == (3, 4, 5, num_outputs)
    close(prediction.mean, posterior.mean)
    close(prediction.variance, posterior.variance.expand(3, 4, 5, num_outputs))
    more = fantasy.condition_on_observations(
        Z[:1].expand(3, 4, 1, 2), torch.zeros(3, 4, 1, num_outputs, dtype=torch.float64)
    )
    assert more.predict(Z).mean.shape == (3, 4, 5, num_outputs)


def test_fantasies_share_the_base(data, build, num_outputs, uniform):
    model = build("CKA", *data(num_outputs=num_outputs))
    fantasy = model.fantasize(
        uniform(4, 1, 2), SobolQMCNormalSampler(torch.Size([3]), seed=0)
    ).prediction_strategy.factors()
    base = model.prediction_strategy.factors().base
    assert fantasy.base is base or fantasy.base.data_ptr() == base.data_ptr()
    outputs = () if num_outputs == 1 else (num_outputs,)
    assert fantasy.rows.shape == (4, *outputs, 1, 10)
    assert fantasy.alpha.shape == (3, 4, *outputs, 10)


# BoTorch warns about the shapes that it makes itself.
@pytest.mark.filterwarnings("ignore:Non-strict enforcement")
def test_no_new_points(data, build, kind, num_outputs, uniform, close):
    model = build(kind, *data(num_outputs=num_outputs))
    none = torch.empty(4, 0, 2, dtype=torch.float64)
    fantasy = model.fantasize(none, SobolQMCNormalSampler(torch.Size([3]), seed=0))
    Z = uniform(5, 2)
    close(fantasy.predict(Z).mean, model.predict(Z).mean.expand(3, 4, 5, num_outputs))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite(data, build, kind, bad):
    X, Y = data()
    model = build(kind, X, Y)
    wrong = torch.tensor([[0.0], [bad]], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"Expected Y to be finite.*row 1"):
        model.condition_on_observations(X[:2], wrong)
    with pytest.raises(ValueError, match=r"Expected X to be finite.*row 1"):
        model.condition_on_observations(wrong.expand(2, 2), Y[:2])


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


def test_known_noise_needs_that_of_new_observations(data, build, uniform):
    X, Y = data()
    model = build("CKA", X, Y, torch.full_like(Y, 1e-2))
    with pytest.raises(ValueError, match="pass `noise`"):
        model.condition_on_observations(uniform(1, 2), Y[:1])
    noise = torch.full_like(Y[:1], 1e-2)
    more = model.condition_on_observations(uniform(1, 2), Y[:1], noise=noise)
    assert more.train_targets.shape[-1] == len(X) + 1
