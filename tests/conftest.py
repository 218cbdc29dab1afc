"""Settings, data and the models under test, shared by all tests."""

import sys
from collections import defaultdict
from itertools import combinations

import pytest
import torch
from hypothesis import settings

from tests import systems
from tests.systems import truth

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


_LEFT = pytest.StashKey[list]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Of tests with three parameters or more, leave to the slow run what has no new pair."""
    cases, left = defaultdict(list), config.stash.setdefault(_LEFT, [])
    for item in items:
        if len(getattr(getattr(item, "callspec", None), "params", ())) > 2:
            cases[item.nodeid.partition("[")[0]].append(item)
    for several in cases.values():
        quick = [item for item in several if item.get_closest_marker("slow") is None]
        values = {item: [(n, id(v)) for n, v in item.callspec.params.items()] for item in quick}
        rest = {item: {*combinations(pairs, 2)} for item, pairs in values.items()}
        while any(rest.values()):
            best = max(rest, key=lambda item: len(rest[item]))  # the first of them
            found = rest.pop(best)
            rest = {item: pairs - found for item, pairs in rest.items()}
        for item in rest:
            item.add_marker("slow")
            left.append(item.nodeid)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """Tell the process that reports (of pytest-xdist) which cases were left to the slow run."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left"] = session.config.stash[_LEFT]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    if hasattr(node, "workeroutput"):
        node.config.stash[_LEFT] = node.workeroutput["left"]


def pytest_terminal_summary(terminalreporter, config):
    """Say how many cases were left to the slow run, and with `-v` which."""
    if (left := config.stash.get(_LEFT, [])) and config.option.markexpr == "not slow":
        terminalreporter.section("left to -m slow")
        terminalreporter.write_line(
            f"{len(left)} cases of tests with three parameters or more: each pair of their values "
            "occurs in a case that ran (-v names them)"
        )
        for nodeid in left if config.option.verbose > 0 else ():
            terminalreporter.write_line(nodeid)


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
    """Asserts the gradient of a function of few numbers, by central differences."""

    def gradient_is_right(function, X):
        leaf = X.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(function(leaf).sum(), leaf)
        steps = 1e-5 * torch.eye(X.numel(), dtype=torch.float64)
        with torch.no_grad():
            changes = [
                (function(X + h) - function(X - h)).item() / 2e-5
                for h in (step.reshape(X.shape) for step in steps)
            ]
        expected = torch.tensor(changes, dtype=torch.float64).reshape(X.shape)
        size = expected.abs().max().item()
        assert size > 0
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-4 * size)

    return gradient_is_right
