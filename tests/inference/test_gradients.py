"""Gradients by hand against autograd through the model's own modules."""

import pytest
import torch
from gpytorch.kernels import MaternKernel, PeriodicKernel, RBFKernel, ScaleKernel
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.gp.noise import Noise
from gpadjust.inference.distributions import ByModules, StationaryTerms
from gpadjust.inference.targets import LogLikelihood, Target
from tests.systems import normal, same

D = 2
SEEDS = st.integers(0, 2**31)


def crude(X):
    return torch.stack([2 + (3 * X[..., 0]).sin(), X.sum(-1), (1 + X[..., 1]).exp()], dim=-1)


def draw(seed, n=9, m=1, batch=()):
    """Inputs, and targets that the physics nearly explains."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(*batch, n, D, generator=generator, dtype=torch.float64)
    noise = torch.randn(*batch, n, m, generator=generator, dtype=torch.float64)
    return X, 1.3 * crude(X)[..., :m] + X[..., :1].square() + 0.1 * noise


def physics(m):
    return lambda X: crude(X)[..., :m]


def kernel(smoothness, ard, batch=()):
    """The user's own, with GPyTorch's default constraints."""
    shape = torch.Size(batch)
    options = {"ard_num_dims": D if ard else None, "batch_shape": shape}
    base = MaternKernel(smoothness, **options) if smoothness else RBFKernel(**options)
    return ScaleKernel(base, batch_shape=shape).double()


def assert_equal_to_autograd(model, seed, tolerance=1e-6, kind=LogLikelihood, rows=None):
    by_hand, reference = kind(model, rows), kind(model, rows)
    assert isinstance(by_hand.distribution, StationaryTerms)
    kept = slice(None) if rows is None else rows
    noise = Noise(model.likelihood).known
    noise = None if noise is None else noise[..., kept]
    inputs = model.transform_inputs(model.train_inputs[0])[..., kept, :]
    args = reference.parameters, inputs, noise, kind.random_means, kept
    reference.distribution = ByModules(model, *args)
    current = by_hand.parameters.current()
    vectors = current + 0.5 * normal(3, *current.shape[1:], seed=seed)
    values, gradient = by_hand.value_and_gradient(vectors)
    expected_values, expected = reference.value_and_gradient(vectors)
    assert values.isfinite().all()
    torch.testing.assert_close(values, expected_values, rtol=tolerance, atol=tolerance)
    size = expected.abs().amax(-1, keepdim=True)
    error = (gradient - expected).abs() / size.clamp_min(1.0)
    assert error.max() < tolerance
    torch.testing.assert_close(by_hand(vectors), values, rtol=1e-10, atol=1e-10)


BOUNDS = torch.tensor([[0.0] * D, [1.0] * D], dtype=torch.float64)


def of(cls, **options):
    return lambda X, Y, m: cls(X, Y, physics=physics(m), **options)


MODELS = {
    "CKA": of(CKA),
    "ScaleGP": of(ScaleGP),
    "ZeroMeanGP": lambda X, Y, m: ZeroMeanGP(X, Y),
    "known noise": lambda X, Y, m: CKA(X, Y, torch.full_like(Y, 0.01), physics=physics(m)),
    "center": of(CKA, center="learn"),
    "both means": of(CKA, center="mean", rho_mean="learn", delta_mean="learn"),
    "two physics": lambda X, Y, m: CKA(
        X, Y, physics=[physics(m), lambda X: X[..., :1] + physics(m)(X).sin()], center="mean"
    ),
    "AR1": of(AR1, num_low=8, bounds=BOUNDS),
    "rho mean alone": of(PhysicsMeanGP, rho_mean="learn"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MODELS))
@settings(max_examples=5, deadline=None, derandomize=True)
@given(seed=SEEDS, m=st.sampled_from([1, 3]), batch=st.sampled_from([(), (2,)]))
def test_every_model(name, seed, m, batch):
    assert_equal_to_autograd(MODELS[name](*draw(seed, m=m, batch=batch), m), seed)


@pytest.mark.parametrize("smoothness", [None, 0.5, 1.5, 2.5], ids=["RBF", "1/2", "3/2", "5/2"])
@pytest.mark.parametrize("ard", [True, False], ids=["ARD", "one lengthscale"])
@settings(max_examples=5, deadline=None, derandomize=True)
@given(seed=SEEDS, m=st.sampled_from([1, 3]), learn=st.booleans())
def test_every_kernel(smoothness, ard, seed, m, learn):
    batch = (3,) if m > 1 else ()
    model = CKA(
        *draw(seed, m=m),
        physics=physics(m),
        rho_covar_module=kernel(smoothness, ard, batch),
        delta_covar_module=kernel(None, not ard, batch),
        rho_mean="learn" if learn else 1.0,
        center="mean" if learn else "learn",
    )
    assert_equal_to_autograd(model, seed)


@pytest.mark.parametrize("free", range(5))
def test_one_parameter_alone(free):
    model = CKA(*draw(free, m=3), physics=physics(3))
    learnt = [p for p in model.parameters() if p.requires_grad]
    for i, parameter in enumerate(learnt):
        parameter.requires_grad_(i == free)
    assert_equal_to_autograd(model, free)


@pytest.mark.parametrize("kind", [LogLikelihood, Target])
@pytest.mark.parametrize("rows", [None, [0, 2, 3, 5, 7, 8]])
@pytest.mark.parametrize("name", ["CKA", "both means", "known noise", "two physics"])
def test_missing_targets_and_some_rows(name, kind, rows):
    X, Y = draw(3, m=2)
    Y[2, 0] = Y[5:7, 1] = torch.nan
    rows = None if rows is None else torch.tensor(rows)
    assert_equal_to_autograd(MODELS[name](X, Y, 2), 3, kind=kind, rows=rows)


@pytest.mark.parametrize("smoothness", [None, 0.5, 1.5, 2.5], ids=["RBF", "1/2", "3/2", "5/2"])
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-4])
def test_near_duplicate_inputs(smoothness, gap):
    X, Y = draw(0)
    X = torch.cat([X, X[:3] + gap])
    Y = torch.cat([Y, Y[:3] + 1e-3])
    made = kernel(smoothness, True)
    model = CKA(X, Y, physics=physics(1), delta_covar_module=made)
    # A distance of 1e-8 is known to about half of the digits, by either way.
    assert_equal_to_autograd(model, 0, tolerance=1e-6 if smoothness != 0.5 else 3e-5)


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_inputs_far_from_zero(offset):
    X, Y = draw(0)
    near, far = (LogLikelihood(ZeroMeanGP(X + away, Y)) for away in (0.0, offset))
    point = near.parameters.current()
    pair = near.value_and_gradient(point), far.value_and_gradient(point)
    same(*pair, rtol=1e-6, atol=1e-6)


def test_other_forms_fall_back_to_autograd():
    kernels = ScaleKernel(PeriodicKernel()), RBFKernel() * RBFKernel(), RBFKernel(active_dims=[0])
    makers = [of(CKA, delta_covar_module=kernel.double()) for kernel in kernels]
    for make in (*makers, of(RRA, num_features=8)):
        objective = LogLikelihood(make(*draw(0), 1))
        assert isinstance(objective.distribution, ByModules)
        _, gradient = objective.value_and_gradient(objective.parameters.current())
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0
