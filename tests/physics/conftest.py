"""Settings and fixtures shared by the tests of the physics."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

torch.set_num_threads(1)


class NumpyRowCounter:
    """A function `x -> [sum(x^2), sin(x_0)]` of rows or one row, that records them."""

    def __init__(self):
        self.rows = []

    def __call__(self, X):
        self.rows += [tuple(row) for row in np.atleast_2d(X).tolist()]
        return np.stack([np.square(X).sum(-1), np.sin(X[..., 0])], axis=-1)


@pytest.fixture
def numpy_counter():
    return NumpyRowCounter()


class Scale(torch.nn.Module):
    """`x_0 -> gain * x_0 + offset`, with a parameter and a buffer."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.register_buffer("offset", torch.tensor(0.0, dtype=torch.float64))
        self.calls = 0

    def forward(self, X):
        self.calls += 1
        return self.gain * X[:, 0] + self.offset


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
