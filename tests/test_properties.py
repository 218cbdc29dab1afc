"""What is true of every model and kind of data, whatever the data: two outputs, one value missing.

Draws are from the prior, so that no fit is needed, but in the last test.
"""

from functools import cache

import pytest
import torch
from botorch.models.transforms.input import InputTransform
from hypothesis import given, settings
from hypothesis import strategies as st

import gpadjust
from gpadjust import kinds
from gpadjust.core import (
    CKA,
    MATERN52,
    RRA,
    CalibratedPhysics,
    Kernel,
    Noise,
    PhysicsMeanGP,
    Predictive,
    ScaleGP,
    StackedGP,
    Stationary,
    ZeroMeanGP,
    fit,
    load,
    save,
)
from gpadjust.kinds import (
    AR1,
    Categories,
    EmulatedPhysics,
    HeavyTails,
    Kalman,
    LinkedCKA,
    LinkedRRA,
    LinkedZeroMeanGP,
    LocalErrors,
    NoisyInputs,
    RelativeNoise,
    Vanishing,
    Window,
)
from gpadjust.many import VariationalCKA
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import drawn, line, normal, same, slopes, uniform

N = 14
x = uniform(N, 1, seed=1)
Y = torch.cat([2.4 + (5 * x).sin() + 0.3 * x, 3.0 - (4 * x).cos()], -1) + 0.05 * normal(N, 2)
Y[3, 1] = torch.nan
LOW, Z = line(9), line(5, 0.03, 1.2)
ADDED = torch.zeros(2, N, dtype=torch.float64)
ADDED[0, 1] = 40.0  # of an outlier


def f_p(X):
    return torch.cat([2 + (5 * X[..., :1]).sin(), 2 + (4 * X[..., :1]).cos()], -1)


def ramp(X):
    return torch.cat([X[..., :1], 1 + X[..., :1]], -1)


def law(X, p):
    return f_p(p.rate[:, None] * X[:, :1])


class Problem:
    """The data, some rows of them, in units of x and y that are 1 / a and 1 / b times as large."""

    def __init__(self, rows=None, a=1.0, b=1.0):
        self.rows = torch.arange(N) if rows is None else rows
        self.a, self.b = a, b
        self.X, self.Y = a * x[self.rows], b * Y[self.rows]
        self.f, self.ramp, self.law = (self.in_units(f) for f in (f_p, ramp, law))
        self.data = {"train_X": self.X, "train_Y": self.Y}
        self.all = self.data | {"physics": self.f}
        self.physics = self.f  # of the model

    def in_units(self, f):
        if self.a == self.b == 1:
            return f  # a file has its name
        return lambda X, *parameters: self.b * f(X / self.a, *parameters)

    def leveled(self, X):
        """Inputs with a column of levels, which are a function of x."""
        return torch.cat([X, (7 * X / self.a).floor() % 3], -1)

    def uncertain(self):
        unknowns = {"rate": Unknown(1.0, factor=1.2)}
        self.physics = FunctionPhysics(self.law, unknowns=unknowns)
        return self.data | {"physics": self.physics}

    def emulated(self):
        options = {"fit_options": {"method": "map"}, "num_components": 2}
        self.physics = EmulatedPhysics(self.a * LOW, self.f(self.a * LOW), **options)
        return self.data | {"physics": self.physics}

    def noisy(self):
        noise = NoisyInputs(self.X, 0.01**2 * self.a**2, added=ADDED[:, self.rows] / 9)
        return PhysicsMeanGP(noise.X, self.Y, physics=self.f, noise=noise)


MODELS = {
    "CKA": lambda p: CKA(**p.all),
    "without nested models": lambda p: CKA(**p.all, nested=False, center=0.0),
    "two physics": lambda p: CKA(**p.data, physics={"f": p.f, "g": p.ramp}),
    "known noise": lambda p: CKA(**p.all, train_Yvar=(0.1 * p.b) ** 2),
    "RRA": lambda p: RRA(**p.all, num_features=16),
    "PhysicsMeanGP": lambda p: PhysicsMeanGP(**p.all, covar_module=Stationary(MATERN52)),
    "ScaleGP": lambda p: ScaleGP(**p.all),
    "ZeroMeanGP": lambda p: ZeroMeanGP(**p.data),
    "CalibratedPhysics": lambda p: CalibratedPhysics(**p.uncertain()),
    "unknown parameters": lambda p: CKA(**p.uncertain()),
    "AR1": lambda p: AR1(**p.data, low_X=p.a * LOW, low_Y=p.b * f_p(LOW)),
    "HeavyTails": lambda p: CKA(**p.all, noise=HeavyTails(added=ADDED[:, p.rows])),
    "HeavyTails, known noise": lambda p: CKA(
        **p.all, train_Yvar=(0.1 * p.b) ** 2, noise=HeavyTails(added=ADDED[:, p.rows])
    ),
    "RelativeNoise": lambda p: CKA(**p.all, noise=RelativeNoise()),
    "both": lambda p: CKA(**p.all, noise=HeavyTails(base=RelativeNoise(), added=ADDED[:, p.rows])),
    "both, without physics": lambda p: ZeroMeanGP(
        **p.data, noise=HeavyTails(base=RelativeNoise(), added=ADDED[:, p.rows])
    ),
    "NoisyInputs": Problem.noisy,
    "log": lambda p: LinkedCKA(**p.all, link="log"),
    "bounds": lambda p: LinkedRRA(**p.all, num_features=16, link=(0.0, 5.0 * p.b)),
    "log, known noise": lambda p: LinkedZeroMeanGP(**p.data, train_Yvar=(0.1 * p.b) ** 2),
    "Vanishing": lambda p: CKA(**p.all, delta_covar_module=Vanishing({0: 0.3 * p.a})),
    "EmulatedPhysics": lambda p: PhysicsMeanGP(**p.emulated()),
    "Categories": lambda p: CKA(p.leveled(p.X), p.Y, physics=p.f, input_transform=Categories([1])),
    "batches": lambda p: RRA(
        p.leveled(p.X), p.Y, physics=p.f, num_features=16, input_transform=Categories([], [1])
    ),
    "VariationalCKA": lambda p: VariationalCKA(**p.all, num_inducing=N),
}
WRAPPERS = {
    "LocalErrors": lambda p: LocalErrors(drawn(MODELS["CKA"](p))),
    "Window": lambda p: Window(drawn(MODELS["CKA"](p)), 9),
    "Kalman": lambda p: Kalman(drawn(MODELS["RRA"](p)), forget=9.0),
    "StackedGP": lambda p: StackedGP(
        {"a": drawn(MODELS["CKA"](p)), "b": drawn(MODELS["ZeroMeanGP"](p))}, [0.5, 0.5], 4
    ),
    "StackedGP, log": lambda p: StackedGP({"a": drawn(MODELS["log"](p))}, [1.0], 4),
}
ALL = {**MODELS, **WRAPPERS}
# Levels have no slopes; medians between two draws far apart are rounded (tests/kinds/test_links).
WITHOUT_SLOPE = {"Categories", "batches", "log", "StackedGP, log"}


@cache
def made(name, rows=None, a=1.0, b=1.0):
    """A model, and what its inputs are made of."""
    problem = Problem(None if rows is None else torch.tensor(rows), a, b)
    model = ALL[name](problem)
    return (model if name in WRAPPERS else drawn(model)), problem


def inputs(name, problem, X):
    return problem.leveled(X) if name in ("Categories", "batches") else X


def answers(model, X):
    """Moments of the function, of observations, and of what is jointly so."""
    return [*model.predict(X), *model.predict(X, True), model.posterior(X).variance]


every = pytest.mark.parametrize("name", ALL)
each_model = pytest.mark.parametrize("name", MODELS)


def test_every_model_and_kind_has_a_row():
    public = {name: getattr(room, name) for room in (gpadjust, kinds) for name in room.__all__}
    parts = (Predictive, Noise, Kernel, InputTransform)
    classes = {
        name for name, it in public.items() if isinstance(it, type) and issubclass(it, parts)
    }
    assert len(classes) > 15
    assert classes <= globals().keys()  # and what is imported is used


@every
@settings(max_examples=4)
@given(at=st.lists(st.floats(-2, 3), min_size=1, max_size=3), level=st.floats(0.9, 0.999))
def test_a_prediction_lies_within_its_interval(name, at, level):
    model, problem = made(name)
    X = inputs(name, problem, torch.tensor(at, dtype=torch.float64).unsqueeze(-1))
    X[..., 1:] = 1.0  # a level
    for noise in (False, True):
        mean, variance = model.predict(X, noise)
        lower, upper = model.interval(X, level, noise)
        inner = model.interval(X, 0.5, noise)
        assert ((lower <= mean) & (mean <= upper)).all()
        assert ((lower <= inner[0]) & (inner[1] <= upper)).all()
        assert (lower.isfinite() & upper.isfinite() & (variance >= 0)).all()
        posterior = model.posterior(X, observation_noise=noise)
        same((posterior.mean, posterior.variance), (mean, variance), rtol=1e-6, atol=1e-12)


# Of some rows a VariationalCKA is exact: tests/many.
@pytest.mark.parametrize("name", sorted({*MODELS} - {"VariationalCKA"}))
def test_conditioning_is_a_refit_with_the_same_numbers(name):
    model, problem = made(name)
    X = inputs(name, problem, problem.a * Z)
    first, late = torch.arange(N - 4), slice(N - 4, None)
    noise = None if model.data.Yvar is None else model.data.Yvar[late]
    few = model.subset_rows(first)
    same(few.data[:2], [v[first] for v in model.data[:2]], rtol=0, atol=0, equal_nan=True)
    later = few.condition_on_observations(model.data.X[late], model.data.Y[late], noise)
    same(answers(later, X), answers(model, X), rtol=1e-6, atol=1e-9)
    if name != "CalibratedPhysics":  # of given parameters nothing is left to condition
        assert not torch.allclose(few.predict(X).mean, model.predict(X).mean, rtol=1e-4)


@every
@pytest.mark.parametrize(("a", "b"), [(1e-6, 1e-7), (1e5, 1e6)])
def test_units_do_not_matter(name, a, b):
    (model, problem), (other, scaled) = made(name), made(name, None, a, b)
    ours = answers(model, inputs(name, problem, Z))
    theirs = answers(other, inputs(name, scaled, a * Z))
    powers = [1, 2, 1, 2, 2]
    same([v / b**n for v, n in zip(theirs, powers, strict=True)], ours, rtol=1e-5, atol=1e-9)


@every
def test_the_order_of_rows_does_not_matter(name):
    order = torch.randperm(N, generator=torch.Generator().manual_seed(0))
    if name == "Window":  # but of the last ones
        order[-9:] = order[-9:].sort().values
        order = torch.cat([torch.arange(N - 9), N - 9 + torch.randperm(9)])
    (model, problem), (other, _) = made(name), made(name, tuple(order.tolist()))
    X = inputs(name, problem, Z)
    same(answers(other, X), answers(model, X), rtol=1e-6, atol=1e-9)


@every
def test_outputs_are_predicted_by_themselves(name):
    model, problem = made(name)
    X = inputs(name, problem, Z)
    part = model.subset_output([1])
    same(answers(part, X), [v[:, 1:] for v in answers(model, X)], rtol=1e-9, atol=1e-12)
    if name in MODELS:
        ours, theirs = part.left_out().prediction, model.left_out().prediction
        same(ours, [v[:, 1:] for v in theirs], rtol=1e-6, atol=1e-9, equal_nan=True)


@each_model
def test_the_gradient_is_that_of_the_likelihood(name):
    model, _ = made(name)
    u = model.u.detach()
    expected = slopes(lambda u: model.log_likelihood(u, False)[0], u)
    gradient = model.log_likelihood(u)[1]
    if expected.dim() < gradient.dim():
        expected = expected.unsqueeze(1)
    rtol = 1e-3 if name == "batches" else 1e-4  # without noise differences are rounded
    torch.testing.assert_close(gradient, expected, rtol=rtol, atol=1e-3)


@pytest.mark.parametrize("name", sorted({*ALL} - WITHOUT_SLOPE))
def test_slopes_of_predictions_are_those_of_differences(name, gradient_is_right):
    model, _ = made(name)
    gradient_is_right(lambda X: model.posterior(X).mean.sum(), Z[1:4])
    gradient_is_right(lambda X: model.posterior(X).variance.log().sum(), Z[1:4])


@each_model
def test_functions_have_the_moments_of_predictions(name):
    model, problem = made(name)
    X = inputs(name, problem, Z)
    values = model.sample_functions(800, seed=0, num_features=128)(X)
    values = model.on_gaussian_scale(values)
    means, variances = model.components(X)
    mean, variance = means.mean(0), variances.mean(0) + means.var(0, correction=0)
    assert ((values.mean(0) - mean).abs() <= 0.15 * variance.sqrt() + 1e-9).all()
    torch.testing.assert_close(values.std(0), variance.sqrt(), rtol=0.15, atol=1e-3)


@pytest.mark.filterwarnings("ignore:.*Pass it again")
@each_model
def test_a_file_has_the_model(name, tmp_path):
    model, problem = made(name)
    X = inputs(name, problem, Z)
    objects = {"physics": problem.physics, "covar_module": Stationary(MATERN52)}
    noise = None if model.data.Yvar is None else model.data.Yvar[:5]
    later = model.condition_on_observations(X, problem.f(Z), noise)
    for each in (model, later):
        missing = save(each, tmp_path / "model.pt").missing
        again = load(tmp_path / "model.pt", trusted=True, **{n: objects[n] for n in missing})
        same(answers(again, X), answers(each, X), rtol=1e-9, atol=1e-12)
        assert again.summary() == each.summary()


QUICK = {"CKA", "log"}
CASES = [(name, {"method": "map"}) for name in MODELS] + [("CKA", {"num_draws": 8})]


@pytest.mark.parametrize(
    ("name", "options"),
    [pytest.param(*c, marks=[] if c[0] in QUICK else pytest.mark.slow) for c in CASES],
)
@pytest.mark.filterwarnings("ignore:Predictions depend on the seed")
def test_a_second_fit_is_the_first(name, options):
    problem = Problem()
    model = MODELS[name](problem)
    X = inputs(name, problem, Z)
    before = answers(model, X)
    fit(model, **options)
    first = answers(model, X)
    fit(model, **options)
    same(answers(model, X), first, rtol=0, atol=0)
    assert not torch.allclose(first[0], before[0], rtol=1e-4)
