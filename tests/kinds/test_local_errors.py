"""Variances near what was missed when it was left out."""

import pytest
import torch
from gpytorch.kernels import LinearKernel

from gpadjust.core import CKA, GP, OfGPyTorch, Term, ZeroMeanGP
from gpadjust.kinds.links import LinkedCKA
from gpadjust.kinds.local_errors import LocalErrors
from tests.systems import drawn, line, refused, uniform


def physics(X):
    return X[..., :1].sin().expand(*X.shape[:-1], 2)


def test_the_formula():
    X = line(5)
    model = ZeroMeanGP(X, (X - 0.5).abs()).eval()
    errors = LocalErrors(model)
    mean, variance = model.left_out().prediction
    expected = ((model.data.Y - mean).square() / variance).mT
    torch.testing.assert_close(errors.squares, expected)
    errors.squares = torch.tensor([[9.0, 0.0, 1.0, 1.0, 0.5]]).double()
    x = torch.tensor([[0.0], [0.5], [100.0]], dtype=torch.float64)
    length = model.values["f.kernel.lengthscale"].item()
    near = (-0.5 * ((x - X.mT) / length).square()).exp()
    ratio = (1 + near @ errors.squares[0]) / (1 + near.sum(-1))
    torch.testing.assert_close(errors.factors(x)[:, 0], ratio.clamp_min(1.0))
    assert errors.factors(x)[0, 0] > 1.2
    assert errors.factors(x)[2, 0] == 1


def test_predictions_posteriors_and_noise_agree():
    X = uniform(20, 2, seed=4)
    plain = drawn(CKA(X, 1.2 * physics(X) + X, physics=physics), 1)
    wider, X = LocalErrors(plain), uniform(12, 2, seed=5)
    wider.squares[0] = 9.0
    factors = wider.factors(X)
    assert factors.max() > 1.3
    for asked in (False, True):  # learnt noise grows, too
        own, other = wider.marginals(X, asked), plain.marginals(X, asked)
        assert torch.equal(own.means, other.means)
        torch.testing.assert_close(own.variances, other.variances * factors)
    noise = torch.full((12, 2), 0.5).double()
    predicted, posterior = wider.predict(X, noise), wider.posterior(X, observation_noise=noise)
    torch.testing.assert_close(posterior.variance, predicted.variance)
    torch.testing.assert_close(predicted.variance - wider.predict(X).variance, noise)
    more = wider.condition_on_observations(X[:2], physics(X[:2]))
    assert torch.equal(more.factors(X), factors)
    assert (more.predict(X[:2]).variance < wider.predict(X[:2]).variance).all()


def test_links_keep_their_bounds():
    X = line(9)
    wider = LocalErrors(LinkedCKA(X, (X - 0.5).abs() + 0.01, physics=torch.ones_like, link="log"))
    (low, high), (lower, upper) = wider.interval(line(20)), wider.model.interval(line(20))
    assert (low > 0).all()
    assert (high.log() - low.log() >= (1 - 1e-9) * (upper.log() - lower.log())).all()
    assert (wider.posterior(X).rsample(torch.Size([3])) > 0).all()


def test_another_device_has_the_data_and_factors_too():
    wider = LocalErrors(ZeroMeanGP(line(5), line(5))).to("meta")
    assert all(each.is_meta for each in (wider.data.X, wider.points, wider.squares))


REFUSED = [
    (lambda X: LocalErrors("model"), TypeError, "model"),
    (lambda X: LocalErrors(GP(X, X, terms=[Term("f", OfGPyTorch(LinearKernel()))])), ValueError,
     "lengthscale"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input(call, error, words):
    refused(error, words, call, line(5))
