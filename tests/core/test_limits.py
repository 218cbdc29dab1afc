"""What the models become where a part of them vanishes, or is chosen."""

import pytest
import torch

from gpadjust.core import CKA, RRA, PhysicsMeanGP, ScaleGP, Stationary, ZeroMeanGP
from tests.systems import crude

NOTHING = 1e-16  # a variance that switches a kernel off


@pytest.fixture
def Z(uniform):
    return uniform(6, 2, low=-1.0, high=3.0, seed=7)


@pytest.fixture
def pair(data):
    return data(num_outputs=2, n=11)


def renamed(numbers, old, new):
    return {n.replace(f"{old}.", f"{new}."): v for n, v in numbers.items()}


def test_without_physics_rho_or_delta(pair, drawn, numbers, give, alike, close, Z):
    def agree(a, b):
        alike(a.predict(Z), b.predict(Z))
        alike(a.posterior(Z), b.posterior(Z))

    plain = {"physics": crude, "nested": False, "center": False}
    model = drawn(CKA(*pair, physics=lambda X: 0 * crude(X), nested=False))
    agree(model, give(ZeroMeanGP(*pair), renamed(numbers(model), "delta", "f")))
    model = drawn(CKA(*pair, **plain))
    off = torch.full((1, 2, 1), NOTHING, dtype=torch.float64)
    found = numbers(model)
    give(model, found | {"rho.kernel.outputscale": off, "rho.constant": off})
    agree(model, give(PhysicsMeanGP(*pair, physics=crude), found))
    give(model, found | {"delta.kernel.outputscale": off, "delta.constant": off})
    scale = give(ScaleGP(*pair, physics=crude), found)
    agree(model, scale)
    close(model.rho(Z).variance, scale.rho(Z).variance)


@pytest.mark.parametrize("choice", [1, 2])
def test_nested_models(choice, pair, drawn, numbers, give, close, Z):
    """A straight line of the physics, or a Gaussian process around c without it."""
    X, Y = pair
    if choice == 2:
        model = drawn(CKA(X, Y, physics=crude, center=2.0), choice=2)
        without = give(ZeroMeanGP(X, Y - 2), renamed(numbers(model), "delta", "f")).predict(Z)
        close(model.predict(Z).mean, without.mean + 2, 1e-8)
        close(model.predict(Z).variance, without.variance, 1e-8)
        close(model.rho(Z).variance, torch.zeros(6, 2, dtype=torch.float64))
        return
    model = drawn(CKA(X, Y, physics=crude), choice=choice)
    found = numbers(model)
    for s in range(3):
        single = model.subset_draws(torch.tensor([s])).predict(Z)
        for j in range(2):
            c, v = found["rho.center"][s, j], found["noise.variance"][s, j]
            kappas = torch.cat([found[f"{n}.constant"][s, j] for n in ("rho", "delta")])
            A = torch.stack([crude(X)[:, j] - c, torch.ones(len(X)).double()], -1)
            at = torch.stack([crude(Z)[:, j] - c, torch.ones(len(Z)).double()], -1)
            precision = A.mT @ A / v + (1 / kappas).diag()
            weights = torch.linalg.solve(precision, A.mT @ (Y - crude(X))[:, j] / v)
            variance = (at @ torch.linalg.inv(precision) @ at.mT).diagonal()
            close(single.mean[:, j], crude(Z)[:, j] + at @ weights, 1e-6)
            close(single.variance[:, j], variance, 1e-6)


@pytest.mark.parametrize("cls", [PhysicsMeanGP, ScaleGP, CKA])
def test_the_physics_far_from_the_data_and_before_them(cls, pair, close, Z):
    model = cls(*pair, physics=crude, constants=False).eval()
    far = torch.tensor([[500.0, -300.0], [-400.0, 100.0]], dtype=torch.float64)
    close(model.posterior(far).mean, crude(far), 1e-10)
    close(model.mean_module(Z).reshape(2, 6).mT, crude(Z), 1e-12)
    variance = model.evaluate(far).variance().squeeze(0).mT * model.unit.square().mT
    close(model.predict(far).variance, variance, 1e-10)


def test_the_physics_mean_gp_is_a_gp_of_the_residual(pair, drawn, numbers, give, alike, Z):
    X, Y = pair
    model = drawn(PhysicsMeanGP(X, Y, physics=crude))
    residual = give(ZeroMeanGP(X, Y - crude(X)), renamed(numbers(model), "delta", "f")).predict(Z)
    alike(model.delta(Z), residual)
    alike(model.predict(Z), residual._replace(mean=residual.mean + crude(Z)))


def test_rra_tends_to_cka_as_features_grow(data, drawn, numbers, give, Z):
    X, Y = data()
    options = {"physics": lambda X: crude(X)[..., :1], "center": False, "nested": False}
    cka = drawn(CKA(X, Y, **options), spread=0.1)
    expected = cka.predict(Z)

    def error(num_features):
        errors = []
        for seed in range(4):
            rra = RRA(X, Y, num_features=num_features, seed=seed, **options)
            mean, variance = give(rra, numbers(cka)).predict(Z)
            away = (variance.sqrt() - expected.variance.sqrt()).abs().mean()
            errors.append(torch.stack([(mean - expected.mean).abs().mean(), away]))
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
    found = numbers(long)
    found["f.kernel.lengthscale"][..., 1] = 1e8
    give(long, found)
    short = found | {"f.kernel.lengthscale": found["f.kernel.lengthscale"][..., :1]}
    alike(long.predict(Z), give(ZeroMeanGP(X[:, :1], Y), short).predict(Z[:, :1]), 1e-6)
    constant = torch.cat([X, torch.full_like(X[:, :1], 3.0)], -1)
    length = found["f.kernel.lengthscale"]
    more = found | {"f.kernel.lengthscale": torch.cat([length, length[..., :1]], -1)}
    model = give(ZeroMeanGP(constant, Y, covar_module=Stationary()), more)
    close(model.predict(constant).mean, long.predict(X).mean)
