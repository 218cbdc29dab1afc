"""What predictions rest on: the physics, the data, or neither."""

from functools import partial

import matplotlib as mpl
import numpy as np
import pytest
import torch

from gpadjust.core import CKA, RRA, PhysicsMeanGP, ScaleGP, fit
from gpadjust.kinds.links import LinkedCKA
from gpadjust.validation import Trust, trust
from gpadjust.validation.plots import plot_trust
from gpadjust.validation.trust import prior_mean
from tests.systems import crude, line, wave

mpl.use("Agg")


def bend(X):
    """A physics that is right up to 0.5, and wrong beyond, lacks this."""
    return (X - 0.5).clamp_min(0.0).square()


@pytest.fixture(scope="module")
def half():
    """A model of such a physics, from data on [0, 1]."""
    X = line(20)
    model = CKA(X, wave(X) + bend(X), physics=wave)
    fit(model, seed=0)
    return model


def test_the_definition_by_hand(half):
    Z = torch.tensor([[-2.0], [0.1], [0.3], [0.8], [0.95]]).double()
    found = trust(half, Z, level=0.9)
    mean, variance = half.predict(Z)
    least = 1e-3 * half.data.Y.std(correction=0).item()
    w = (1.6448536269514722 * variance.sqrt()).clamp_min(least)
    discrepancy = (half.data.Y - wave(half.data.X)).square().mean().sqrt()
    torch.testing.assert_close(found.override, (mean - wave(Z)).abs() / w)
    torch.testing.assert_close(found.doubt, w / discrepancy)
    assert found.side[:, 0].tolist() == [2, 0, 0, 1, 1]
    assert (found.physics.item(), found.data.item(), found.neither.item()) == (0.4, 0.4, 0.2)


@pytest.mark.parametrize(
    ("truth", "X", "points", "side"),
    [
        (wave, line(9), line(50, -1, 2), "physics"),
        (lambda X: 2 * wave(X) + 3, line(12), None, "data"),
        (lambda X: wave(X) + (40 * X).sin(), line(12, 0, 0.2), line(20, 3, 4), "neither"),
    ],
    ids=["perfect", "wrong throughout", "a large discrepancy elsewhere"],
)
def test_limiting_cases(truth, X, points, side):
    model = CKA(X, truth(X), physics=wave)
    fit(model)
    shares = trust(model, points)
    assert getattr(shares, side).item() == 1
    if points is None:
        assert shares.X.shape == (512, 1)
        assert ((shares.X >= 0) & (shares.X <= 1)).all()


@pytest.mark.slow
def test_units_make_no_difference():
    X, Z = line(20), line(50, -0.5, 1.5)
    bases = []
    for scale, size, shift in ((1, 1, 0), (50, 1e6, 1e3)):
        physics = partial(lambda X, k, c, b: c * (wave(X / k) + b), k=scale, c=size, b=shift)
        model = PhysicsMeanGP(scale * X, size * (wave(X) + bend(X) + shift), physics=physics)
        fit(model)
        bases.append(trust(model, scale * Z))
    torch.testing.assert_close(bases[0].doubt, bases[1].doubt, rtol=1e-2, atol=1e-3)
    assert (bases[0].side != bases[1].side).sum() <= 1


def test_outputs_are_judged_one_by_one(data):
    X, Y = data(num_outputs=2)
    Y[:3, 0] = torch.nan
    model = CKA(X, Y, physics=crude)
    found = trust(model, 3 * torch.rand(16, 2, dtype=torch.float64))
    assert found.side.shape == found.override.shape == found.doubt.shape == (16, 2)
    torch.testing.assert_close(found.physics + found.data + found.neither, torch.ones(2).double())
    second = trust(model.subset_output([1]), found.X)
    torch.testing.assert_close(second.override, found.override[:, 1:])
    torch.testing.assert_close(second.doubt, found.doubt[:, 1:])


def test_the_prior_mean_is_the_physics_also_of_draws_without_it(data):
    X, Y = data()
    Z = 3 * torch.rand(7, 2, dtype=torch.float64)
    f_p = lambda X: 5 + crude(X)[..., :1]  # noqa: E731
    for kind in (CKA, PhysicsMeanGP, ScaleGP, RRA, LinkedCKA):
        model = kind(X, 5 + Y, physics=f_p)
        if model.table.choices:
            u = torch.cat([model.table.with_choice(model.u.detach(), k) for k in range(3)])
            model.set_draws(u)
        torch.testing.assert_close(prior_mean(model, Z), f_p(Z))
    both = CKA(X, Y, physics=[f_p, lambda X: X[..., :1]], rho_mean=(1.0, 0.5), delta_mean=2.0)
    torch.testing.assert_close(prior_mean(both, Z), f_p(Z) + 0.5 * Z[:, :1] + 2)


@pytest.fixture
def basis():
    """Nine points of two inputs and two outputs, whose sides are known."""
    side = torch.tensor([0, 1, 2] * 3)
    X = torch.stack([torch.arange(9.0), side.double()], -1).double()
    override = torch.stack([(side == 1) * 2.0, torch.zeros(9)], -1).double()
    doubt = torch.stack([(side == 2) * 2.0, torch.zeros(9)], -1).double()
    return Trust(X, override, doubt, ("speed [m/s]", "x2"), ("lift", "drag"))


def test_shares_along_each_input(basis, monkeypatch):
    monkeypatch.setattr("gpadjust.validation.plots._BINS", 3)
    axes = plot_trust(basis)
    assert axes.shape == (2,)
    assert [ax.get_xlabel() for ax in axes] == ["speed [m/s]", "$x_{2}$"]
    for container, kind in zip(axes[0].containers, ("physics", "data", "neither"), strict=True):
        assert container.get_label() == f"{kind}: 33 %"
        np.testing.assert_allclose([bar.get_height() for bar in container], [1 / 3] * 3)
    heights = [[bar.get_height() for bar in container] for container in axes[1].containers]
    np.testing.assert_allclose(heights, np.eye(3))
    assert axes[1].get_legend().get_title().get_text() == "lift rests on"
    second = plot_trust(basis, output=1)[0]
    assert second.containers[0].get_label() == "physics: 100 %"


def test_an_input_that_never_changed(basis):
    basis.X[:, 1] = 2.0
    axes = plot_trust(basis)
    assert sum(bar.get_height() for c in axes[1].containers for bar in c) == pytest.approx(1)
