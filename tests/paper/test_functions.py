"""Functions of high and low fidelity, data sets of them, and the pump."""

import math

import numpy as np
import pytest
import torch
from botorch.test_functions import Branin, Hartmann

from paper.forrester.problem import forrester
from paper.published.rivals import SMTModel
from paper.structures import ROWS
from paper.structures.data import of_pair, pump
from paper.structures.functions import PAIRS, branin, low_inputs, observations


@pytest.mark.parametrize(
    ("name", "x", "high", "low"),
    [
        ("booth", [1.0, 3.0], 0.0, 11.9),
        ("bohachevsky", [0.0, 0.0], 0.0, -12.0),
        ("currin", [0.5, 0.5], (1 - math.exp(-1)) * 1868.5 / 159.5, 7.4425),
    ],
)
def test_pairs_have_known_values(name, x, high, low):
    given, X = PAIRS[name], torch.tensor([x], dtype=torch.float64)
    assert given.truth(X).item() == pytest.approx(high, abs=1e-4)
    assert given.physics()(X).item() == pytest.approx(low, abs=1e-4)


def test_data():
    given = PAIRS["branin"]
    X, Y = observations(given, 10, 3)
    cells = (10 * (X - given.bounds[0]) / (given.bounds[1] - given.bounds[0])).floor()
    for column in cells.sort(0).values.T:
        assert torch.equal(column, torch.arange(10.0, dtype=torch.float64))
    assert torch.equal(Y, given.truth(X))
    low_X = low_inputs(given, X, 40, 0)
    assert low_X.shape == (40, 2)
    assert torch.equal(low_X[:10], X)


@pytest.mark.slow
def test_mfk_predicts_in_the_units_of_the_data():
    given = PAIRS["booth"]
    X, Y = observations(given, 10, 0)
    low_X = low_inputs(given, X, 40, 0)
    posterior = SMTModel(low_X, given.physics()(low_X), X, Y).posterior(X)
    torch.testing.assert_close(posterior.mean, Y, rtol=1e-2, atol=1e-2)
    assert (posterior.variance > 0).all()


# By the package mf2, version 2022.6.0: name, inputs, high, low.
VALUES = [
    ("bohachevsky", [-3.7, -1.9], 21.7717101571, 9.30945988136),
    ("bohachevsky", [3.3, 0.7], 12.6082898429, -2.05751817367),
    ("booth", [-7.4, -3.8], 1040.96, 572.636),
    ("booth", [6.6, 1.4], 97.92, 17.164),
    ("branin", [-3.05, 4.65], -49.3385511481, 19.3951038769),
    ("branin", [7.45, 8.55], -126.226696729, 1247.18114438),
    ("currin", [0.13, 0.31], 10.1252792148, 9.56727815299),
    ("currin", [0.83, 0.57], 6.07538764049, 6.09820585144),
    ("forrester", [0.13], -0.960665451521, -9.18033272576),
    ("forrester", [0.83], -2.82031350215, -3.11015675107),
    ("hartmann6", [0.22, 0.38, 0.57, 0.77, 0.89, 0.32], -1.38680949166, -1.37639285338),
    ("hartmann6", [0.85, 0.61, 0.47, 0.33, 0.25, 0.94], -1.48222694772, -1.41397199569),
    ("park91a", [0.13, 0.31, 0.52, 0.74], 10.7682265913, 11.5143195734),
    ("park91a", [0.83, 0.57, 0.41, 0.26], 6.57405506404, 6.39217521076),
]


def inputs(name, n=100):
    """Uniform in the bounds, ``n x d``."""
    lower, upper = PAIRS[name].bounds.numpy()
    return lower + (upper - lower) * np.random.default_rng(0).random((n, len(lower)))


@pytest.mark.parametrize(("name", "x", "high", "low"), VALUES)
def test_values_are_those_of_another_package(name, x, high, low):
    found = PAIRS[name]
    X = np.array([x, found.bounds[0].tolist()])
    assert found.high(X).shape == found.low(X).shape == (2,)
    assert found.high(X)[0] == pytest.approx(high, rel=1e-11)
    assert found.low(X)[0] == pytest.approx(low, rel=1e-11)


def test_each_function_has_values():
    assert {row[0] for row in VALUES} == {*PAIRS} == {row[0] for row in ROWS}


def test_classical_functions_are_botorchs():
    X = torch.from_numpy(inputs("branin"))
    np.testing.assert_allclose(branin(X.numpy()), Branin(dtype=X.dtype)(X), rtol=1e-6)
    X = torch.from_numpy(inputs("hartmann6"))
    expected = (Hartmann(dtype=X.dtype)(X) - 2.58) / 1.94
    np.testing.assert_allclose(PAIRS["hartmann6"].high(X.numpy()), expected, rtol=1e-6)


def test_forresters_is_that_of_the_experiment_of_its_name():
    X = inputs("forrester")
    expected = forrester(torch.from_numpy(X))[:, 0]
    np.testing.assert_allclose(PAIRS["forrester"].high(X), expected, rtol=1e-12)


@pytest.mark.parametrize("name", PAIRS)
def test_values_at_the_bounds_are_finite(name):
    """Also of Currin's function at x2 = 0, where a quotient has no value, and of Park's."""
    bounds = PAIRS[name].bounds.numpy()
    assert np.isfinite(PAIRS[name].high(bounds)).all()
    assert np.isfinite(PAIRS[name].low(bounds)).all()


def test_currins_function_has_its_limit_where_a_quotient_has_no_value():
    zero, near = np.array([[0.3, 0.0]]), np.array([[0.3, 1e-3]])
    high = PAIRS["currin"].high
    np.testing.assert_allclose(high(zero), high(near), rtol=1e-12)


def test_there_are_sixteen_kinds_and_the_noise_is_what_it_says():
    assert len(ROWS) == 16
    clean, noisy = (of_pair("branin", 500, noise, 10, 0) for noise in (0, 0.05))
    assert torch.equal(clean.X, noisy.X)
    assert (noisy.Y - clean.Y).std().item() == pytest.approx(noisy.noise.item(), rel=0.1)
    assert noisy.noise.item() == pytest.approx(0.05 * noisy.truth.std().item())


def test_the_pump_has_outputs_of_very_different_units():
    data = pump(12, 0)
    assert data.Y.shape == (12, 2)
    size = data.truth.std(0)
    assert size[0] / size[1] > 1e6
    wrong = data.physics(data.points) - data.truth
    assert (wrong.square().mean(0).sqrt() > 3 * data.noise).all()
