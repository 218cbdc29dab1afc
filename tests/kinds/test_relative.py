"""Noise that grows with the size of what is measured."""

import pytest
import torch

from gpadjust.core import CKA, GP, Term, ZeroMeanGP, fit, load, save
from gpadjust.kinds.relative import RelativeNoise
from tests.systems import drawn, line, normal, refused

X = line(40, 0.02)
ENDS = torch.tensor([[0.05], [0.95]], dtype=torch.float64)


def decades(X):
    return torch.exp(6 * X[..., :1] - 4)


def growing(relative=0.1, constant=0.02, seed=0):
    f = decades(X) * (1 + 0.2 * X)
    return f + (constant**2 + (relative * f).square()).sqrt() * normal(40, 1, seed=seed)


def noise_at(model, Z):
    """The variance of the noise that predictions add, ``q x m``."""
    return model.predict(Z, observation_noise=True).variance - model.predict(Z).variance


def test_both_numbers_are_found_in_the_user_s_units():
    model = CKA(X, 100 * growing(), physics=lambda X: 70 * decades(X), noise=RelativeNoise())
    fit(model)
    constant, relative = model.noise.standard_deviations(model)
    assert 1.0 < constant.median() < 4.0
    assert 0.06 < 0.7 * relative.median() < 0.16 * 1.2  # of f_p, which is less than f
    f = 70 * decades(ENDS)
    few, each = model.values, model.unit.square()
    expected = (few["noise.constant"][..., 0] + 1e-11) * each[0]
    size = (70 * decades(X)).square().mean()
    expected = expected + (few["noise.relative"][..., 0] + 1e-11) * f.mT.square() / size * each
    torch.testing.assert_close(noise_at(model, ENDS)[:, 0], expected.detach().mean(0))


def test_several_physics_count_by_their_prior_means():
    two = {"a": decades, "b": lambda X: X}
    model = drawn(CKA(X, growing(), physics=two, rho_mean=[2.0, -1.0], noise=RelativeNoise()))
    g = 2 * decades(ENDS) - ENDS
    size = (2 * decades(X) - X).square().mean()
    v = {name: value[..., 0] + 1e-11 for name, value in model.values.items()}
    variance = v["noise.constant"] + v["noise.relative"] * g.mT.square() / size
    expected = variance.mean(0) * model.unit[0].square()
    torch.testing.assert_close(noise_at(model, ENDS)[:, 0], expected.detach())


@pytest.mark.slow
def test_without_physics_sizes_are_those_of_the_posterior_mean(tmp_path):
    Y = torch.cat([growing(), growing(seed=1).flip(0)], -1)
    model = ZeroMeanGP(X, Y, noise=RelativeNoise())
    torch.testing.assert_close(*noise_at(model, ENDS))  # of one size before a fit
    fit(model, "map")
    first = noise_at(model, ENDS)
    ratio = (first[1] / first[0]).sqrt()
    assert ratio[0] > 8
    assert 1 / ratio[1] > 8
    logs, size = model.noise.sizes[1], model.noise.sizes[3]
    away = (logs.exp() * size * model.unit).mT - model.predict(X).mean.abs()
    assert away.abs().max() < 0.1 * model.predict(X).mean.max()
    torch.testing.assert_close(noise_at(model.subset_output([1]), ENDS), first[:, 1:])
    assert not save(model, tmp_path / "model.pt").missing
    torch.testing.assert_close(noise_at(load(tmp_path / "model.pt"), ENDS), first)
    fit(model, "map")
    assert torch.equal(noise_at(model, ENDS), first)


class Logarithm(GP):
    def on_gaussian_scale(self, Y):
        return Y.log()


REFUSED = [
    (lambda: CKA(X, growing(), 0.1, physics=decades, noise=RelativeNoise()), "found both"),
    (
        lambda: fit(Logarithm(X, decades(X), terms=[Term("f")], noise=RelativeNoise())),
        "without a link",
    ),
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_bad_input(call, words):
    refused(ValueError, words, call)
