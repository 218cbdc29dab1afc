"""Unknown parameters: priors, values by name, and physics that are called with them."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    ParameterValues,
    PhysicsError,
    Unknown,
)
from gpadjust.physics.parameters import PhysicsParameters
from tests.systems import normal, refused

A, B = Unknown(1.0, sd=0.5), Unknown(2.0, factor=1.5)


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


def wave(X, p):
    """`[a x_0 + sin(b x_1), a b]` by columns or by single numbers."""
    left = p.a * X[..., 0] + (p["b"] * X[..., 1]).sin()
    return torch.stack([left, p.a * p.b + 0 * left], -1)


def wave_at(X, values):
    """The same at vectors of parameters, `... x 2`, by broadcasting."""
    a, b = values.unsqueeze(-2).unbind(-1)
    left = a * X[..., 0] + (b * X[..., 1]).sin()
    return torch.stack(torch.broadcast_tensors(left, a * b), -1)


def numpy_wave(x, p):
    left = p.a * x[..., 0] + np.sin(p["b"] * x[..., 1])
    return np.stack([left, p.a * p.b + 0 * left], -1)


AB = {"a": A, "b": B}
MAKE = {
    "function": lambda **o: FunctionPhysics(wave, unknowns=AB, **o),
    "black box": lambda **o: BlackBoxPhysics(numpy_wave, unknowns=AB, **o),
    "rows": lambda **o: BlackBoxPhysics(numpy_wave, unknowns=AB, batched=False, **o),
}


def cut(prior, low, high):
    """The quantiles of a prior between bounds, by its own."""
    below, above = prior.cdf(low), prior.cdf(high)
    return lambda q: prior.ppf(below + (above - below) * q)


LOG = stats.lognorm(math.log(1.5), scale=2.0)
INF = math.inf
PRIORS = {
    "normal": (Unknown(9.8, sd=0.2), stats.norm(9.8, 0.2).ppf),
    "log-normal": (Unknown(2.0, factor=1.5), LOG.ppf),
    "uniform": (Unknown(0.2, bounds=(-1.0, 3.0)), stats.uniform(-1.0, 4.0).ppf),
    "cut normal": (
        Unknown(1.0, sd=2.0, bounds=(0.0, 1.5)),
        stats.truncnorm(-0.5, 0.25, 1.0, 2.0).ppf,
    ),
    "positive": (Unknown(1, sd=2, bounds=(0, INF)), stats.truncnorm(-0.5, INF, 1.0, 2.0).ppf),
    "below": (Unknown(1, sd=2, bounds=(-INF, 2)), stats.truncnorm(-INF, 0.5, 1.0, 2.0).ppf),
    "cut log-normal": (Unknown(2.0, factor=1.5, bounds=(1.0, 2.5)), cut(LOG, 1.0, 2.5)),
    "not cut": (Unknown(2.0, factor=1.5, bounds=(-1.0, INF)), LOG.ppf),
}


@pytest.mark.parametrize("name", PRIORS)
def test_values_are_quantiles_of_the_prior(name):
    unknown, quantile = PRIORS[name]
    q = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 0.999])
    z = torch.from_numpy(stats.norm.ppf(q))
    torch.testing.assert_close(unknown.value(z), torch.from_numpy(quantile(q)))


@st.composite
def unknowns(draw):
    """Unknown parameters of any prior, with and without bounds."""
    guess = draw(st.floats(-1e3, 1e3))
    size = draw(st.floats(0.01, 1e3)) * max(abs(guess), 1)
    kind = draw(st.sampled_from(["sd", "factor", None]))
    guess = abs(guess) + 1e-3 if kind == "factor" else guess
    ends = [guess - size * draw(st.floats(0.01, 5)), guess + size * draw(st.floats(0.01, 5))]
    if kind is not None:
        ends = [draw(st.sampled_from([ends[0], -INF])), draw(st.sampled_from([ends[1], INF]))]
    spread = {"sd": size, "factor": 1 + draw(st.floats(0.01, 9))}
    return Unknown(guess, bounds=tuple(ends), **({kind: spread[kind]} if kind else {}))


@given(unknown=unknowns(), z=st.floats(-3, 3), far=st.floats(-100, 100))
def test_coordinates_reverse_values_which_are_within_bounds(unknown, z, far):
    low, high = unknown.bounds
    values = unknown.value(numbers(z, far))
    assert low <= values.min() <= values.max() <= high
    assert unknown.coordinate(values)[0] == pytest.approx(z, abs=1e-5)
    guess = unknown.value(unknown.coordinate(numbers(unknown.guess)))
    assert guess.item() == pytest.approx(unknown.guess, abs=1e-6)


BAD = [
    (("one",), {"sd": 1.0}, TypeError, "guess must be a number; found 'one'"),
    ((1.0,), {"bounds": (0, 1, 2)}, ValueError, r"bounds as two numbers.*found \(0, 1, 2\)"),
    ((3.0,), {"bounds": (0, 2)}, ValueError, r"inside of the bounds.*found Unknown\(3.0, bo"),
    ((1.0,), {"sd": 0.0}, ValueError, "sd must be finite and above 0; found 0.0"),
    ((1.0,), {"factor": 1.0}, ValueError, "factor must be finite and above 1; found 1.0"),
    ((-1.0,), {"factor": 1.5}, ValueError, r"above 0 with a factor.*found Unknown\(-1.0"),
    ((1.0,), {"factor": 1.5, "sd": 1.0}, ValueError, "one prior: sd.*sd=1.0, factor=1.5"),
    ((1.0,), {"bounds": (0.0, INF)}, ValueError, "one prior: sd.*two finite bounds; found"),
]


NAMED = r"name that can.*found {!r}"
LEADS = r"has 2 unknown parameter\(s\) a, b; expected parameters of shape ... x 2, found"
OTHERS = [  # of what a function takes
    (lambda X: X[:, 0], {"a": A}, r"takes 1 positional.*with unknowns=\['a'\]"),
    (lambda X, p: p.a * X[:, 0], {}, r"missing 1.*with unknowns=\[\]"),
    (lambda X, p: p.b * X[:, 0], {"a": A}, r"parameter 'b'; expected one of a\."),
]


def test_what_is_refused():
    for guess, options, error, message in BAD:
        refused(error, message, Unknown, *guess, **options)
    for name in ("two words", "_hidden", "lambda", "rows", "keys", 3):
        words = NAMED.format(name)
        refused(ValueError, words, FunctionPhysics, wave, unknowns={name: A})
    for none in ({"mass": 1.0}, ["mass"], A):
        refused(TypeError, r"Unknown\(guess, sd=", FunctionPhysics, wave, unknowns=none)
    X, physics = normal(5, 2), FunctionPhysics(wave, unknowns=AB)
    for values in (torch.ones(3), torch.ones(()), 1.0):
        refused(ValueError, LEADS, physics, X, values)
    refused(ValueError, r"'sin' has 0 unknown", FunctionPhysics(torch.sin), X, torch.ones(2))
    for function, unknowns, words in OTHERS:
        refused(PhysicsError, words, FunctionPhysics(function, unknowns=unknowns), X)


def test_numbers_of_numpy_are_plain_ones():
    """A program or a fingerprint has their repr."""
    plain = {"factor": 1.5, "function_of": "v", "between": (0.0, 3.0), "lengthscale": 1.0}
    one = np.float64
    others = {"factor": one(1.5), "between": (one(0), np.int64(3)), "lengthscale": np.int64(1)}
    assert repr(Unknown(one(0.3), **plain | others)) == repr(Unknown(0.3, **plain))
    bounded = Unknown(np.int64(1), sd=one(0.1), bounds=np.array([0.0, 2.0]))
    assert repr(bounded) == "Unknown(1.0, sd=0.1, bounds=(0.0, 2.0))"


def test_values_are_a_mapping_with_attributes():
    rows = numbers(1.0, 2.0, 3.0, 4.0).reshape(2, 2)
    values = ParameterValues(("mass", "length"), rows)
    assert [*values] == ["mass", "length"]
    assert torch.equal(values.mass, rows[:, 0])
    for again in (copy.deepcopy(values), pickle.loads(pickle.dumps(values))):
        assert again["length"].tolist() == [2.0, 4.0]
        assert torch.equal(again.rows, rows)
    assert ParameterValues(values, rows[1]).mass == 3.0
    refused(AttributeError, "parameter 'drag'.*mass, length", getattr, values, "drag")


@pytest.mark.parametrize("name", MAKE)
def test_guesses_columns_and_precision(name):
    X = normal(4, 3).float()
    found = MAKE[name](inputs=[2, 0])(X)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, wave_at(X[:, [2, 0]], numbers(1.0, 2.0).float()))


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("lead", [(), (3,), (1,)], ids=str)
@pytest.mark.parametrize("batch", [(), (3,), (3, 1), (4, 3)], ids=str)
def test_values_and_gradients_of_any_shape(name, lead, batch):
    X, values = normal(*batch, 5, 2).requires_grad_(), normal(*lead, 2, seed=1)
    expected, physics = wave_at(X, values), MAKE[name]()
    for _ in range(2):  # the second time it remembers them
        found = physics(X, values)
        torch.testing.assert_close(found, expected)
    torch.testing.assert_close(physics.or_nan(X, values), expected.detach())
    weights = normal(*expected.shape, seed=2)
    slopes = [torch.autograd.grad((weights * Y).sum(), X)[0] for Y in (found, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-6, atol=1e-7)


def test_equal_parameters_are_evaluated_once():
    asked = []
    physics = FunctionPhysics(lambda X, p: asked.append(len(X)) or wave(X, p), unknowns=AB)
    X, values = normal(5, 2), normal(3, 2, seed=1)
    found = physics(X.expand(4, 3, 5, 2), values)
    torch.testing.assert_close(found, wave_at(X, values).expand(4, 3, 5, 2))
    assert asked == [15]


def test_gradients_in_parameters_and_pickles():
    physics, X, values = MAKE["function"](), normal(4, 2), normal(3, 2, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda values: physics(X, values), values)
    again = pickle.loads(pickle.dumps(physics))
    assert {**again.unknowns} == AB
    torch.testing.assert_close(again(X, values), physics(X, values))


def root(x, p):
    """NaN, or of single rows an error, below zero."""
    if x.ndim == 1 and x[0] < p.low:
        raise ArithmeticError("below zero")
    return (x[..., 0] - p.low) ** 0.5


def fragile(X, p):
    """An error for all rows if one of them is below zero."""
    if (X[:, 0] < p.low).any():
        raise ArithmeticError("below zero")
    return root(X, p)


LOW = {"low": Unknown(0.0, sd=1.0)}
ROOTS = {
    "NaN": lambda: FunctionPhysics(root, unknowns=LOW),
    "error": lambda: FunctionPhysics(fragile, unknowns=LOW),
    "rows": lambda: BlackBoxPhysics(root, unknowns=LOW, batched=False),
}


@pytest.mark.parametrize("name", ["NaN", "rows"])
@pytest.mark.parametrize("grad", [False, True])
def test_failures_name_rows_with_their_parameters(name, grad):
    physics = ROOTS[name]()
    X = numbers(1.0, 2.0).unsqueeze(-1).requires_grad_(grad)
    with pytest.raises(PhysicsError) as caught:
        physics(X, numbers(0.0, 1.5, 1.0).unsqueeze(-1))
    assert caught.value.rows == (2,)
    assert caught.value.inputs.tolist() == [[1.0, 1.5]]
    with pytest.raises(PhysicsError) as caught:  # of X that is expanded, too
        physics(X.expand(2, 2, 1), numbers(1.5))
    assert caught.value.rows == (0, 2)


@pytest.mark.parametrize("name", ROOTS)
def test_or_nan(name):
    physics, X = ROOTS[name](), numbers(1.0, 2.0, 3.0).unsqueeze(-1)
    physics(X)
    low = numbers(0.0, 1.5, 4.0, -1.0)
    found = physics.or_nan(X, low.unsqueeze(-1)).squeeze(-1)
    expected = (X.squeeze(-1) - low.unsqueeze(-1)).sqrt()
    if name == "error":  # it does not say in which rows
        expected[1] = torch.nan
    torch.testing.assert_close(found, expected, equal_nan=True)
    assert physics.or_nan(X, numbers(5.0)).isnan().all()
    assert not physics.or_nan(X, numbers(0.5).expand(2, 1)).isnan().any()


def test_or_nan_of_nothing_else_runs_a_simulation_once():
    X = numbers(1.0).unsqueeze(-1)
    assert ROOTS["NaN"]().or_nan(X, numbers(2.0)).isnan().all()  # its shape is known
    for name in ("error", "rows"):
        both = numbers(2.0, 3.0).unsqueeze(-1)
        refused(PhysicsError, "below zero", ROOTS[name]().or_nan, X, both)
    no_tensor = FunctionPhysics(lambda X, p: [1.0], unknowns=LOW)
    args = torch.ones(2, 1), torch.zeros(1)
    refused(PhysicsError, "list, expected a real tensor", no_tensor.or_nan, *args)
    asked = []

    def simulate(x, p):
        asked.append((x[0], float(p.low)))
        return root(x, p)

    physics = BlackBoxPhysics(simulate, unknowns=LOW, batched=False)
    physics.or_nan(numbers(1.0, 2.0).unsqueeze(-1), numbers(0.0, 1.5).unsqueeze(-1))
    assert asked == [(1.0, 0.0), (2.0, 0.0), (1.0, 1.5), (2.0, 1.5)]


@pytest.mark.parametrize(
    ("middle", "spread", "is_untold"),
    [(0.0, 1.0, True), (0.1, 0.9, True), (0.0, 0.5, False), (1.0, 1.0, False), (0.0, 0.0, False)],
)
@pytest.mark.parametrize("unknown", [A, B, Unknown(1.0, bounds=(0.0, 3.0))])
def test_a_parameter_is_untold_where_its_posterior_is_its_prior(unknown, middle, spread, is_untold):
    z = middle + spread * torch.special.ndtri(torch.linspace(0.005, 0.995, 100).double())
    parameters = PhysicsParameters({"p": unknown}, [unknown.value(z)])
    assert parameters.untold == ["p"] * is_untold
    assert PhysicsParameters({"p": unknown}, [unknown.value(z[:1])]).untold == []
