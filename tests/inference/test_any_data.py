"""Whatever the data: a sensible model, or an error of our own."""

from functools import partial

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gpadjust import CKA, PhysicsMeanGP, fit
from tests.systems import refused

pytestmark = [
    pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.OptimizationWarning"),
    pytest.mark.filterwarnings("ignore:.* rows? equals? an earlier row"),
]
FIT = {"num_screened": 16, "num_starts": 2, "max_iterations": 60}
BUILD = {
    "CKA": CKA,
    "PhysicsMeanGP": PhysicsMeanGP,
    "CKA, centerd, rho mean": partial(CKA, center="mean", rho_mean="learn"),
    "CKA, both means": partial(CKA, rho_mean="learn", delta_mean="learn"),
}
# Points that are needed at least.
FEWEST = dict.fromkeys(BUILD, 2) | {"CKA, centerd, rho mean": 3, "CKA, both means": 4}


def wave(X):
    return (3 * X).sin().sum(-1, keepdim=True) + 1.5


# What the physics makes of the inputs, in the units of a plain one.
PHYSICS = {
    "plain": wave,
    "a million times too large": lambda X: 1e6 * wave(X),
    "a million times too small": lambda X: 1e-6 * wave(X),
    "constant": lambda X: torch.full_like(X[:, :1], 2.0),
    "zero": lambda X: torch.zeros_like(X[:, :1]),
    "of a huge offset": lambda X: wave(X) + 1e8,
    "of the other sign": lambda X: -wave(X),
}
# What the targets are, given inputs and the plain physics.
TARGETS = {
    "adjusted": lambda X: 1.3 * wave(X) + X[:, :1].square(),
    "equal to the physics": wave,
    "noisy": lambda X: wave(X) + torch.randn_like(X[:, :1]),
    "constant": lambda X: torch.full_like(X[:, :1], 3.0),
    "zero": lambda X: torch.zeros_like(X[:, :1]),
    "of a huge offset": lambda X: wave(X) + 1e8,
    "one outlier": lambda X: wave(X).index_fill(0, torch.tensor([0]), 1e6),
}
# Pairs of inputs that are close, at a distance, with targets that differ by a number or not.
REPEATS = st.tuples(
    st.sampled_from([0.0, 1e-15, 1e-12, 1e-9, 1e-6]), st.sampled_from([None, 0.0, 1e-9, 1.0])
)


@st.composite
def problems(draw):
    """Inputs, targets, the physics and points to predict at."""
    n, d = draw(st.integers(2, 12)), draw(st.integers(1, 3))
    torch.manual_seed(draw(st.integers(0, 2**31)))
    X = torch.rand(n, d, dtype=torch.float64)
    repeat = draw(st.none() | REPEATS)
    if repeat is not None:
        X = torch.cat([X, X[: n // 2 + 1] + repeat[0]])
    if draw(st.booleans()):
        X[:, -1] = 0.3  # one input that never changes
    targets = draw(st.sampled_from(list(TARGETS)))
    Y = TARGETS[targets](X)
    if repeat is not None and repeat[1] is not None:
        Y[n:] = Y[: n // 2 + 1] + repeat[1]
    kind = draw(st.sampled_from(list(PHYSICS)))
    x_unit, y_unit = (draw(st.sampled_from([1.0, 1e-9, 1e9])) for _ in range(2))
    several = n >= 6 and draw(st.booleans())
    if several:  # a second output, which is missing in some rows
        Y = torch.cat([Y, Y.flip(0) + X[:, :1]], -1)
        Y[::3, 1] = torch.nan

    def physics(X):
        return (y_unit * PHYSICS[kind](X / x_unit)).expand(*X.shape[:-1], 1 + several)

    Z = torch.cat([2 * torch.rand(4, d, dtype=torch.float64) - 0.5, X[:2]])
    return x_unit * X, y_unit * Y, physics, x_unit * Z


def check(kind, problem):
    X, Y, physics, Z = problem
    if len(X) < FEWEST[kind]:
        refused(ValueError, "constant means", BUILD[kind], X, Y, physics=physics)
        return
    model = BUILD[kind](X, Y, physics=physics)
    fit(model, "map", **FIT)
    with torch.no_grad():
        posteriors = [model.posterior(Z)]
        if isinstance(model, CKA):
            posteriors += [model.rho(Z), model.delta(Z)]
        for posterior in posteriors:
            assert posterior.mean.isfinite().all()
            assert posterior.variance.isfinite().all()
            assert (posterior.variance >= 0).all()
        mean, variance = model.predict(Z)
        assert mean.isfinite().all()
        assert (variance >= 0).all()
        # Of the size of targets and physics; or else, far from the data, known to be unsure.
        size = max(Y.nan_to_num().abs().max(), physics(X).abs().max(), physics(Z).abs().max())
        assert (mean.abs() <= 1e3 * size + 10 * variance.sqrt()).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
@given(kind=st.sampled_from(list(BUILD)), problem=problems())
def test_any_data(kind, problem):
    check(kind, problem)


@pytest.mark.parametrize("kind", list(BUILD))
@pytest.mark.parametrize("targets", ["adjusted", "equal to the physics", "constant"])
def test_the_fewest_points_are_interpolated(kind, targets, uniform):
    X = uniform(FEWEST[kind], 1)
    Y = TARGETS[targets](X)
    model = BUILD[kind](X, Y, physics=wave)
    fit(model, "map", **FIT)
    mean = model.posterior(X).mean.detach()
    # At worst noise and function are not told from one another.
    assert ((mean - Y).abs() <= (Y - wave(X)).abs().max() + 1e-9).all()


@pytest.mark.parametrize("kind", list(BUILD))
def test_an_exact_physics_is_left_as_it_is(kind, uniform):
    X, Z = uniform(8, 1), uniform(20, 1, seed=1)
    model = BUILD[kind](X, wave(X), physics=wave)
    fit(model, "map", **FIT)
    torch.testing.assert_close(model.posterior(Z).mean, wave(Z), rtol=0, atol=1e-5)
