"""A physics that is known by its runs."""

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust.core import CKA, CalibratedPhysics, fit
from gpadjust.kinds.emulated import EmulatedPhysics
from gpadjust.kinds.links import LinkedCKA
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import line, normal, refused, uniform

MAP = {"method": "map"}
W = {"w": Unknown(2.0, bounds=(1.0, 3.0))}
FAR = torch.tensor([[1.9], [2.2]], dtype=torch.float64)


def wave(X):
    return torch.sin(3 * X[:, :1]) * X[:, :1]


def simulated(x, w):
    return torch.sin(w * x) * x + 0.2 * w


def functions(physics, X, number=4000, seed=0):
    """Outputs ``number x n x m`` of functions drawn by the prior."""
    return physics(X, normal(number, len(physics.unknowns), seed=seed))


def test_functions_have_the_mean_and_covariance_of_the_emulator():
    """Between runs and beyond them, with the derivatives by inputs and coordinates."""
    runs, X = 1.2 * line(6), torch.tensor([[0.1], [0.6], [1.1], [1.5], [2.4]], dtype=torch.float64)
    physics = EmulatedPhysics(runs, wave(runs), fit_options=MAP)
    torch.testing.assert_close(physics(X), physics.emulator.predict(X).mean)
    values, posterior = functions(physics, X)[..., 0], physics.emulator.posterior(X)
    sd = posterior.variance[:, 0].sqrt()
    assert ((values.mean(0) - posterior.mean[:, 0]).abs() < 0.1 * sd).all()
    expected = posterior.distribution.covariance_matrix
    assert ((values.T.cov() - expected).abs()[:3, :3] < 0.1 * sd[:3] * sd[:3, None]).all()
    torch.testing.assert_close(values.std(0), sd, rtol=0.1, atol=0.0)
    leaves = X.requires_grad_(), normal(3, 8, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(physics, leaves)


def test_several_outputs_have_errors_of_their_own_size():
    runs = 1.2 * line(6)
    both = torch.cat([wave(runs), 100 * runs.cos()], -1)
    physics = EmulatedPhysics(runs, both, fit_options=MAP, num_components=12)
    values = functions(physics, FAR[:1])[:, 0]
    sd = physics.emulator.predict(FAR[:1]).variance[0].sqrt()
    torch.testing.assert_close(values.std(0), sd, rtol=0.1, atol=0.0)
    assert abs(values.T.corrcoef()[0, 1]) < 0.2


@pytest.mark.slow
def test_unknown_parameters_are_inputs_of_the_runs():
    runs = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(40).double()
    runs = runs * torch.tensor([3.0, 2.0]) + torch.tensor([0.0, 1.0])
    options = {"unknowns": W, "fit_options": MAP, "num_components": 4}
    emulated = EmulatedPhysics(runs, simulated(*runs.split(1, -1)), **options)
    exact = FunctionPhysics(lambda X, p: simulated(X[:, 0], p.w), unknowns=W)
    X = 0.1 + 2.8 * line(12)
    draws = []
    for physics in (emulated, exact):
        Y = simulated(X, 1.6) + 0.02 * normal(*X.shape)
        model = CalibratedPhysics(X, Y, physics=physics)
        fit(model, num_draws=32)
        draws.append(model.physics_parameters["w"].flatten())
    one, two = draws
    assert abs(one.mean() - two.mean()) < 2 * one.std()
    assert 0.7 < one.std() / two.std() < 5
    assert abs(one.mean() - 1.6) < 0.05


def test_columns_of_a_frame_are_unknown_parameters_by_their_names():
    runs = pd.DataFrame({"w": 1 + 2 * np.linspace(0, 1, 9), "x": 3 * np.linspace(0, 1, 9) ** 2})
    Y = np.sin(runs.w * runs.x).to_frame("y")
    options = {"unknowns": W, "fit_options": MAP, "num_components": 1}
    physics = EmulatedPhysics(runs, Y, **options)
    x, p = torch.tensor([[3.0]]).double(), torch.tensor([3.0, 0.0]).double()
    assert physics.emulator.data.input_names == ("x", "w")
    assert abs(physics(x, p) - np.sin(9)) < 0.1
    with_units = runs.rename(columns={"w": "w [1/s]", "x": "x [s]"})
    torch.testing.assert_close(EmulatedPhysics(with_units, Y, **options)(x, p), physics(x, p))


def test_names_of_inputs_are_to_be_in_order():
    X = pd.DataFrame(uniform(6, 2).numpy(), columns=["a", "b"])
    physics = EmulatedPhysics(
        X, X[["a"]], fit_options=MAP, num_components=1,
        model_factory=lambda X, Y: CKA(X, Y, physics=lambda X: 1 + X[:, :1]),
    )  # fmt: skip
    assert isinstance(physics.emulator, CKA)
    refused(ValueError, "in this order", CKA, X[["b", "a"]], X[["a"]], physics=physics)
    turned = EmulatedPhysics(X, X[["a"]], inputs=[1, 0], fit_options=MAP, num_components=1)
    model = CKA(X[["b", "a"]], X[["a"]], physics=turned)
    assert abs(turned(model.data.X) - model.data.Y).max() < 0.1


@pytest.mark.parametrize(("call", "error", "words"), [
    (lambda X: EmulatedPhysics(X, X, inputs=[0, 0], fit_options=MAP)(X), ValueError, "1 columns"),
    (lambda X: EmulatedPhysics(X, X / X), ValueError, "remove these points"),
    (lambda X: EmulatedPhysics(pd.DataFrame({"x": [0.0, 1.0]}), np.zeros(2), unknowns=W),
     ValueError, "names w"),
    (lambda X: EmulatedPhysics(X, X, unknowns=W), ValueError, "and then 1 unknown"),
    (lambda X: EmulatedPhysics(X, X, unknowns={"emulator_1": W["w"]}), ValueError, "other names"),
    (lambda X: EmulatedPhysics(X, X, num_components=0), ValueError, "num_components"),
    (lambda X: EmulatedPhysics(X, X, model_factory=lambda X, Y: X), TypeError, "must be a GP"),
    (lambda X: EmulatedPhysics(X, X + 1, fit_options=MAP, model_factory=lambda X, Y: LinkedCKA(
        X, Y, physics=torch.exp, link="log")), ValueError, "without a link"),
    (lambda X: EmulatedPhysics(X, X.sin(), fit_options=MAP)(torch.zeros(3, 2).double()),
     ValueError, r"inputs=\[...\]"),
])  # fmt: skip
def test_bad_input(call, error, words):
    refused(error, words, call, line(5))
