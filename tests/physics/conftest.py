"""Settings and fixtures shared by the tests of the physics."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from tests.systems import normal

torch.set_num_threads(1)


class RowCounter:
    """A torch function `x -> [sum(x^2), sin(x_0)]` that records the rows it is asked for."""

    def __init__(self):
        self.rows = []

    def __call__(self, X):
        self.rows += [tuple(row) for row in X.detach().tolist()]
        return self.formula(X)

    @staticmethod
    def formula(X):
        return torch.stack([X.square().sum(-1), X[..., 0].sin()], dim=-1)


class NumpyRowCounter:
    """The same function for a batch of NumPy rows, or for one."""

    def __init__(self):
        self.rows = []

    def __call__(self, X):
        self.rows += [tuple(row) for row in np.atleast_2d(X).tolist()]
        return np.stack([np.square(X).sum(-1), np.sin(X[..., 0])], axis=-1)


@pytest.fixture
def counter():
    return RowCounter()


@pytest.fixture
def numpy_counter():
    return NumpyRowCounter()


@pytest.fixture
def points():
    """Draws standard normal float64 numbers of a shape, the same ones each time."""

    def draw(*shape, seed=0):
        return normal(*shape, seed=seed)

    return draw


@pytest.fixture
def in_threads():
    """Calls a function with 0, ..., 7, each in a thread, and switches between these often."""

    def run(function):
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(function, range(8)))

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield run
    sys.setswitchinterval(interval)
