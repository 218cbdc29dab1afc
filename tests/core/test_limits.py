"""What the models become where a part of them vanishes, or is chosen."""

import pytest
import torch

from gpadjust.core import CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from tests.systems import crude


@pytest.fixture
def Z(uniform):
    return uniform(6, 2, low=-1.0, high=3.0, seed=7)


@pytest.fixture
def pair(data):
    return data(num_outputs=2, n=11)


def test_a_nested_model_without_physics(pair, drawn, numbers, give, close, Z):
    """A Gaussian process around c."""
    X, Y = pair
    model = drawn(CKA(X, Y, physics=crude, center=2.0), choice=2)
    of_f = {n.replace("delta.", "f."): v for n, v in numbers(model).items()}
    without = give(ZeroMeanGP(X, Y - 2), of_f).predict(Z)
    close(model.predict(Z).mean, without.mean + 2, 1e-8)
    close(model.predict(Z).variance, without.variance, 1e-8)
    close(model.rho(Z).variance, torch.zeros(6, 2, dtype=torch.float64))


def test_a_nested_model_that_is_a_straight_line_of_the_physics(pair, drawn, numbers, close, Z):
    X, Y = pair
    model = drawn(CKA(X, Y, physics=crude), number=1, choice=1)
    single, found = model.predict(Z), numbers(model)
    for j in range(2):
        c, v = found["rho.center"][0, j], found["noise.variance"][0, j]
        kappas = torch.cat([found[f"{n}.constant"][0, j] for n in ("rho", "delta")])
        A, at = (torch.stack([crude(x)[:, j] - c, torch.ones_like(x[:, 0])], -1) for x in (X, Z))
        precision = A.mT @ A / v + (1 / kappas).diag()
        weights = torch.linalg.solve(precision, A.mT @ (Y - crude(X))[:, j] / v)
        variance = (at @ torch.linalg.inv(precision) @ at.mT).diagonal()
        close(single.mean[:, j], crude(Z)[:, j] + at @ weights, 1e-6)
        close(single.variance[:, j], variance, 1e-6)


def test_rra_tends_to_cka_as_features_grow(data, drawn, numbers, give, Z):
    X, Y = data()
    options = {"physics": lambda X: crude(X)[..., :1], "center": False, "nested": False}
    cka = drawn(CKA(X, Y, **options), spread=0.1)
    mean, variance = cka.predict(Z)

    def error(num_features):
        errors = []
        for seed in range(4):
            rra = give(RRA(X, Y, num_features=num_features, seed=seed, **options), numbers(cka))
            away = rra.predict(Z).mean - mean, rra.predict(Z).variance.sqrt() - variance.sqrt()
            errors.append(torch.stack([each.abs().mean() for each in away]))
        return torch.stack(errors).mean(0)

    few, many = error(20), error(1000)
    assert (many < 0.35 * few).all()
    assert (many < 0.1 * Y.std()).all()


@pytest.mark.parametrize("cls", [PhysicsMeanGP, ScaleGP, CKA, RRA])
def test_a_perfect_physics_is_left_alone(cls, data, drawn, close, Z):
    X, _ = data()

    def physics(X):
        return 2 + X.sum(-1, keepdim=True)

    model = drawn(cls(X, physics(X), physics=physics), choice=0)
    close(model.predict(Z).mean, physics(Z), 1e-10)
    if cls is not PhysicsMeanGP:
        close(model.rho(Z).mean, torch.ones(6, 1, dtype=torch.float64), 1e-8)
    if cls is not ScaleGP:
        assert model.delta(Z).mean.abs().max() < 1e-8


def test_an_input_without_effect(pair, drawn, numbers, give, alike, close, Z):
    """A long lengthscale is the model without the input, and a constant input changes nothing."""
    X, Y = pair
    long = drawn(ZeroMeanGP(X, Y))
    name, found = "f.kernel.lengthscale", numbers(long)
    found[name][..., 1] = 1e8
    give(long, found)
    short = give(ZeroMeanGP(X[:, :1], Y), found | {name: found[name][..., :1]})
    alike(long.predict(Z), short.predict(Z[:, :1]), 1e-6)
    constant = torch.cat([X, torch.full_like(X[:, :1], 3.0)], -1)
    model = ZeroMeanGP(constant, Y)
    give(model, found | {name: torch.cat([found[name], found[name][..., :1]], -1)})
    close(model.predict(constant).mean, long.predict(X).mean)
