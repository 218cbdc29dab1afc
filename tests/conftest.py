"""Settings and data, shared by all tests."""

import sys

import pytest
import torch
from hypothesis import settings

from tests import systems
from tests.systems import slopes, truth

torch.set_num_threads(1)
settings.register_profile("unhurried", deadline=None)  # a busy machine is no failure
settings.load_profile("unhurried")


@pytest.fixture(autouse=True)
def close_figures():
    """Close the figures of a test, of which Matplotlib keeps every one until then."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def pytest_ignore_collect(collection_path, config):
    """Leave benchmarks alone unless they are asked for."""
    if collection_path.name == "benchmarks" and not config.getoption("benchmark_only"):
        return True
    return None


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture
def uniform():
    """`systems.uniform`, which draws the same numbers for a seed."""
    return systems.uniform


@pytest.fixture
def forrester():
    """Forrester's pair, f_true = 2 f_p - 5 x: `forrester.data(seed)`, `.crude(X)`, `.truth(X)`."""

    class Forrester:
        @staticmethod
        def truth(X):
            return (6 * X - 2) ** 2 * (12 * X - 4).sin() / 4

        @staticmethod
        def crude(X):
            return 0.25 * ((6 * X - 2) ** 2 * (12 * X - 4).sin() / 2 + 10 * (X - 0.5) + 5)

        def data(self, seed, num_points=8):
            X = systems.uniform(num_points, 1, low=-0.6, seed=seed)
            return X, self.truth(X)

        @property
        def test_X(self):
            return systems.line(40, -0.6)

    return Forrester()


@pytest.fixture(params=[1, 2], ids=["1-output", "2-outputs"])
def num_outputs(request):
    return request.param


@pytest.fixture
def data():
    """Makes inputs on [0, 2]^2 and targets: `data(batch_shape=(), n=9, num_outputs=1)`."""

    def make(batch_shape=(), n=9, num_outputs=1, seed=0):
        X = systems.uniform(*batch_shape, n, 2, high=2.0, seed=seed)
        return X, truth(X)[..., :num_outputs]

    return make


@pytest.fixture
def close():
    """Asserts equality to 1e-8 of the largest number expected."""

    def close(actual, expected, tolerance=1e-8):
        assert actual.shape == expected.shape
        size = expected.abs().max().item() if expected.numel() else 0.0
        torch.testing.assert_close(
            actual.detach(), expected.detach(), rtol=tolerance, atol=tolerance * size
        )

    return close


@pytest.fixture
def gradient_is_right():
    """Asserts the gradient of a function of few numbers, by differences."""

    def gradient_is_right(function, X):
        leaf = X.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(function(leaf).sum(), leaf)
        with torch.no_grad():
            flat = slopes(lambda x: function(x.reshape(X.shape)).sum(), X.flatten(), 1e-5)
        expected = flat.reshape(X.shape)
        size = expected.abs().max().item()
        assert size > 0
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-4 * size)

    return gradient_is_right
