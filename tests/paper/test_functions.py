"""The textbook functions, against other implementations of them."""

import numpy as np
import pytest
import torch
from botorch.test_functions import Branin, Hartmann, SixHumpCamel

from paper.forrester.problem import forrester
from paper.multifidelity.functions import FUNCTIONS, branin

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
    ("himmelblau", [-2.96, -1.52], 72.64195072, 142.178065166),
    ("himmelblau", [2.64, 0.56], 28.41702912, 94.5577528156),
    ("park91a", [0.13, 0.31, 0.52, 0.74], 10.7682265913, 11.5143195734),
    ("park91a", [0.83, 0.57, 0.41, 0.26], 6.57405506404, 6.39217521076),
    ("park91b", [0.13, 0.31, 0.52, 0.74], 1.18744684367, 0.424936212404),
    ("park91b", [0.83, 0.57, 0.41, 0.26], 3.00982821929, 2.61179386314),
    ("six_hump_camelback", [-1.48, -0.76], 2.33806929442, -11.8495418062),
    ("six_hump_camelback", [1.32, 0.28], 2.43795921101, -12.5052644752),
]


def inputs(name, n=100):
    """Uniform in the bounds, ``n x d``."""
    lower, upper = map(np.array, FUNCTIONS[name][2:])
    return lower + (upper - lower) * np.random.default_rng(0).random((n, len(lower)))


@pytest.mark.parametrize(("name", "x", "high", "low"), VALUES)
def test_values_are_those_of_another_package(name, x, high, low):
    found = FUNCTIONS[name]
    X = np.array([x, found.lower])
    assert found.high(X).shape == found.low(X).shape == (2,)
    assert found.high(X)[0] == pytest.approx(high, rel=1e-11)
    assert found.low(X)[0] == pytest.approx(low, rel=1e-11)


def test_each_function_has_values():
    assert {row[0] for row in VALUES} == set(FUNCTIONS)


def test_classical_functions_are_botorchs():
    X = torch.from_numpy(inputs("branin"))
    np.testing.assert_allclose(branin(X.numpy()), Branin(dtype=X.dtype)(X), rtol=1e-6)
    X = torch.from_numpy(inputs("six_hump_camelback"))
    expected = SixHumpCamel(dtype=X.dtype)(X)
    np.testing.assert_allclose(FUNCTIONS["six_hump_camelback"].high(X.numpy()), expected, rtol=1e-6)
    X = torch.from_numpy(inputs("hartmann6"))
    expected = (Hartmann(dtype=X.dtype)(X) - 2.58) / 1.94
    np.testing.assert_allclose(FUNCTIONS["hartmann6"].high(X.numpy()), expected, rtol=1e-6)


def test_forresters_is_that_of_the_experiment_of_its_name():
    X = inputs("forrester")
    expected = forrester(torch.from_numpy(X))[:, 0]
    np.testing.assert_allclose(FUNCTIONS["forrester"].high(X), expected, rtol=1e-12)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_at_the_bounds_are_finite(name):
    """Also of Currin's function at x2 = 0, where a quotient has no value, and of Park's."""
    bounds = np.array(FUNCTIONS[name][2:])
    assert np.isfinite(FUNCTIONS[name].high(bounds)).all()
    assert np.isfinite(FUNCTIONS[name].low(bounds)).all()


def test_currins_function_has_its_limit_where_a_quotient_has_no_value():
    zero, near = np.array([[0.3, 0.0]]), np.array([[0.3, 1e-3]])
    high = FUNCTIONS["currin"].high
    np.testing.assert_allclose(high(zero), high(near), rtol=1e-12)
