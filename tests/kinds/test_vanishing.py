"""A formula that is right somewhere: processes that are zero there."""

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import MaternKernel, ScaleKernel

from gpadjust.core import CKA, MATERN52, PhysicsMeanGP, Stationary
from gpadjust.kinds.categories import Categories
from gpadjust.kinds.vanishing import Vanishing
from gpadjust.physics import FormulaPhysics
from tests.systems import drawn, normal, refused, uniform

OPEN = Vanishing({"valve": 1.0})
X = uniform(16, 2, low=0.2)
Y = 2 * X[:, 1:] ** 2 + 0.5 * (1 / X[:, :1] - 1) * X[:, 1:] ** 2 + 0.01 * normal(16, 1, seed=3)
FRAME = pd.DataFrame(X.numpy(), columns=["valve", "flow"])
AT_OPEN = torch.cat([torch.ones(7, 1).double(), uniform(7, 1)], -1)
SQUARE = FormulaPhysics("flow**2", ["valve", "flow"])


def same(actual, expected, tolerance=1e-8):
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("where", [{0: 1.0}, {"x1": [0.5, 1.0]}, {0: [0.5, 1.0], 1: [0.3, 0.4]}])
def test_the_covariance_is_that_of_a_process_that_was_seen_to_be_zero(where):
    """Conditioning on zeros in dense algebra, of hyperplanes at the other inputs of the points."""
    kernel = Vanishing(where)
    model = drawn(PhysicsMeanGP(X, Y, physics=SQUARE, covar_module=kernel, constants=False), 1)
    Z = uniform(5, 2, high=1.5, seed=5)
    places = kernel.values
    if places.shape[-1] == 1:
        rest = torch.cat([X, Z])[:, 1]
        places = torch.stack([places.repeat(1, len(rest)).flatten(), rest.repeat(len(places))], -1)

    def k(A, B):
        away = (A[:, None] - B) / model.values["delta.kernel.lengthscale"][0, 0]
        return model.values["delta.kernel.outputscale"] * (-away.square().sum(-1) / 2).exp()

    inverse = torch.linalg.pinv(k(places, places)[0], rtol=1e-12)
    expected = k(X, Z)[0] - k(X, places)[0] @ inverse @ k(places, Z)[0]
    x, z = model.evaluate(X), model.evaluate(Z)
    same(x.cross(z)[0, 0], expected, 1e-6)
    assert k(X, Z)[0].sub(expected).abs().max() > 1e-3
    same(x.variance(), x.cross(x).diagonal(dim1=-1, dim2=-2))
    assert torch.linalg.eigvalsh(x.cross(x)).min() > -1e-9


@pytest.mark.parametrize("kernel", [None, Stationary(MATERN52)])
def test_features_have_the_covariance(kernel):
    where = {0: 1.0} if kernel is None else {0: 1.0, 1: 0.4}
    model = drawn(PhysicsMeanGP(X, Y, physics=SQUARE, covar_module=Vanishing(where, kernel)))
    (term,) = model.terms[-1:]
    own = model.evaluate(X).own(term)
    phi = term.kernel.features(own, 20000, torch.Generator().manual_seed(0))(X[None, None])
    expected = term.kernel.covariance(own, X[None, None])
    assert (phi @ phi.mT - expected).abs().max() < 0.05 * own["outputscale"].max()
    there = torch.tensor([[1.0, 0.4]]).double()
    assert term.kernel.features(own, 64, torch.Generator())(there).abs().max() < 1e-7


def test_delta_and_rho_are_right_there():
    both = CKA(FRAME, Y, physics=SQUARE, rho_covar_module=OPEN, delta_covar_module=OPEN)
    mean, variance = drawn(both).predict(AT_OPEN)
    same(mean, AT_OPEN[:, 1:] ** 2, 1e-7)
    assert variance.max() < 1e-9
    rho = both.rho(AT_OPEN)
    same(rho.mean, torch.ones(7, 1).double())
    assert rho.variance.max() < 1e-9
    assert both.rho(AT_OPEN - torch.tensor([0.5, 0.0])).variance.min() > 1e-6
    for center in (True, 0.0):  # rho alone may be another factor
        model = CKA(FRAME, Y, physics=SQUARE, delta_covar_module=OPEN, center=center)
        delta = model.delta(AT_OPEN)
        assert torch.cat([delta.mean, delta.variance]).abs().max() < 1e-9
        assert (model.predict(AT_OPEN).mean / AT_OPEN[:, 1:] ** 2 - 1).abs().min() > 0.05
    # It is the kernel of the term that it is in.
    plain = CKA(FRAME, Y, physics=SQUARE)
    for name in ("rho.kernel.outputscale", "delta.kernel.outputscale"):
        same(both.table.values(0 * both.u[:1])[name], plain.table.values(0 * plain.u)[name])


def test_transforms_and_categories():
    wide = PhysicsMeanGP(
        FRAME * [10.0, 1.0], Y, physics=SQUARE, covar_module=Vanishing({"valve": 10.0}),
        input_transform=Normalize(2),
    )  # fmt: skip
    there = AT_OPEN * torch.tensor([10.0, 1.0])
    assert wide.delta(there).variance.max() < 1e-9
    assert wide.delta(there - 1).variance.min() > 1e-6
    metals = FRAME.assign(metal=["brass", "steel", "iron", "steel"] * 4)
    physics = {"physics": lambda X: X[:, 1] ** 2, "input_transform": Categories()}
    for where, right in (({"valve": 1.0}, {"valve": 1.0}), ({"metal": 2}, {"metal": "steel"})):
        model = PhysicsMeanGP(metals, Y, **physics, covar_module=Vanishing(where))
        assert model.delta(metals.assign(**right)).variance.max() < 1e-9
        assert model.delta(metals).variance.max() > 1e-5


def test_numbers_without_a_covariance_are_impossible():
    model = PhysicsMeanGP(X, Y, physics=SQUARE, covar_module=Vanishing({0: 1.0}))
    values = {n.removeprefix("delta.kernel."): v for n, v in model.values.items()}
    values["outputscale"] = values["outputscale"] * torch.nan
    assert model.terms[1].kernel.covariance(values, X[None, None]).isnan().all()
    u = torch.cat([model.u.detach(), model.u.detach() + 1e4])
    value, gradient = model.log_likelihood(u)
    assert value.isfinite().tolist() == [[True], [False]]
    assert gradient.isfinite().all()


@pytest.mark.parametrize(("where", "expected"), [
    ({"flow": [0.0, 1.0]}, [[-1.0, 0.0], [-1.0, 1.0]]),
    ({1: 0.0, "valve": 2}, [[2.0, 0.0]]),
    ({-1: 3}, [[-1.0, 3.0]]),
    (pd.DataFrame({"flow": [4.0]}), [[-1.0, 4.0]]),
])  # fmt: skip
def test_places(where, expected):
    model = PhysicsMeanGP(FRAME, Y, physics=SQUARE, covar_module=Vanishing(where))
    assert model.terms[1].kernel.places.nan_to_num(nan=-1.0).tolist() == expected
    again = Vanishing(**Vanishing(where).settings)
    assert torch.equal(again.values, Vanishing(where).values)


class Turned(Normalize):
    def transform(self, X):
        return X @ torch.tensor([[0.6, 0.8], [-0.8, 0.6]]).to(X)


REFUSED = [  # places, a kernel and a transform
    (np.zeros((1, 2)), {}, "values of columns, .* or a frame"),
    ({}, {}, "number for each column"),
    ({"valve": [0.0, 1.0], "flow": [1.0, 2.0, 3.0]}, {}, "equally many numbers for each"),
    ({"valve": float("nan")}, {}, "finite"),
    ({"metal": "steel"}, {}, "category.*level"),
    ({"vane": 1.0}, {}, "`where` by names or numbers of the inputs valve, flow; found 'vane'"),
    ({2: 1.0}, {}, "numbers of the inputs valve, flow; found 2"),
    ({0: 1.0}, {"kernel": Stationary(MATERN52)}, "a product over the inputs"),
    ({0: 1.0}, {"kernel": ScaleKernel(MaternKernel())}, "a product over the inputs"),
    ({0: 1.0}, {"input_transform": Turned(2)}, "mixes columns"),
]


@pytest.mark.parametrize(("where", "options", "words"), REFUSED)
def test_bad_places_kernels_and_transforms(where, options, words):
    def call():
        kernel = Vanishing(where, options.get("kernel"))
        transform = options.get("input_transform")
        PhysicsMeanGP(FRAME, Y, physics=SQUARE, covar_module=kernel, input_transform=transform)

    refused((TypeError, ValueError), words, call)
