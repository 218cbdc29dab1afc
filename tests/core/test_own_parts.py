"""Parts that others bring: nested models, terms, kernels, noises, and what is refused of them."""

import pickle

import pytest
import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.priors import UniformPrior

from gpadjust.core import (
    CKA,
    GP,
    MATERN32,
    Choice,
    Kernel,
    Noise,
    Row,
    Stationary,
    Term,
    ZeroMeanGP,
    fit,
)
from gpadjust.physics import FunctionPhysics, Unknown


def wave(X):
    return torch.sin(6 * X[..., :1])


@pytest.fixture
def data(uniform):
    X = uniform(12, 2)
    return X, 1.4 * wave(X) + X[:, 1:].square() + 0.05 * uniform(12, 1, low=-1.0, seed=1)


@pytest.mark.parametrize("probabilities", [(0.3, 0.7), (0.5, 0.5), (0.1, 0.8, 0.1), (0.9, 0.1)])
def test_choices_of_any_probability(data, probabilities):
    """The first choice contains u = 0, each can be asked for, and the prior draws them so."""
    zeros = [(), ("g.process",), ("g.process", "f.process")]
    pairs = zip(probabilities, zeros, strict=False)
    choices = [Choice(f"{k}", p, names) for k, (p, names) in enumerate(pairs)]
    terms = [Term("f", Stationary()), Term("g", Stationary(MATERN32))]
    model = GP(*data, terms=terms, choices=choices)
    assert model.table.chosen(model.values).item() == 0
    u = torch.randn(4000, 1, model.table.size, dtype=torch.float64)
    drawn = model.table.chosen(model.table.values(u)).flatten()
    for k, p in enumerate(probabilities):
        of_k = model.table.values(model.table.with_choice(u[:3], k))
        assert (model.table.chosen(of_k) == k).all()
        assert (drawn == k).double().mean().item() == pytest.approx(p, abs=0.03)
    result = fit(model)
    assert sum(shares[0] for shares in result.probabilities.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ([Choice("a", 1.0)], "several"),
        ([Choice("a", 0.7), Choice("b", 0.7)], "sum to 1"),
        ([Choice("a", 1.5), Choice("b", -0.5)], "positive"),
        ([Choice("a", 0.5), Choice("b", 0.5, ("f.proces",))], "Unknown numbers"),
    ],
)
def test_choices_that_are_refused(data, choices, words):
    with pytest.raises(ValueError, match=words):
        GP(*data, terms=[Term("f", Stationary())], choices=choices)


def test_further_terms(data, uniform):
    """Terms are independent of their order, and the formula as it is has none of them."""
    X, Y = data
    g = Term("g", ScaleKernel(RBFKernel(active_dims=[1])))
    model = CKA(X, Y, physics=wave, extra_terms=[g])
    assert "g.process" in model.table.choices[1].zeros
    fit(model)
    Z = uniform(5, 2, seed=3)
    one = model.subset_draws(torch.tensor([0]))
    parts = one.rho(Z).mean * wave(Z) + one.delta(Z).mean + one.term("g", Z).mean
    torch.testing.assert_close(parts, one.predict(Z).mean)
    # g varies with its input alone, also if it is listed before delta.
    rho, delta = model.terms[:2]
    first = GP(X, Y, terms=[rho, g, delta], physics=[wave])
    same = torch.tensor([[0.1, 0.5], [0.9, 0.5]], dtype=torch.float64)
    low, high = first.term("g", same).mean
    torch.testing.assert_close(low, high)


class Constant(Kernel):
    """A kernel without parameters."""

    def rows(self, x, num_outputs):
        return []

    def covariance(self, own, x, other=None):
        other = x if other is None else other
        return torch.ones(1, 1, dtype=torch.float64) + 0.0 * (x @ other.mT)


class Brownian(Kernel):
    """min(x, x') of the first input."""

    def rows(self, x, num_outputs):
        return [Row.positive("scale", x.new_ones(num_outputs, 1), 3.0)]

    def covariance(self, own, x, other=None):
        other = x if other is None else other
        least = torch.minimum(x[..., :1], other[..., :1].mT)
        return own["scale"].unsqueeze(-1) * least


@pytest.mark.parametrize("kernel", [Constant(), Brownian(), ScaleKernel(RBFKernel())])
def test_kernels_of_ones_own(data, uniform, kernel):
    X, Y = data
    model = CKA(X, Y, physics=wave, delta_covar_module=kernel)
    fit(model)
    Z = uniform(50, 2, seed=3)
    joint = model.posterior(Z)
    torch.testing.assert_close(model.predict(Z).variance, joint.variance, rtol=1e-6, atol=1e-9)
    batch = model.predict(Z.expand(3, 50, 2))
    torch.testing.assert_close(batch.variance[1], joint.variance, rtol=1e-6, atol=1e-9)


def test_a_prior_with_ends(data):
    kernel = RBFKernel(lengthscale_prior=UniformPrior(0.1, 2.0))
    model = CKA(*data, physics=wave, delta_covar_module=ScaleKernel(kernel))
    fit(model)
    lengths = model.table.values(model.draws)["delta.kernel.base_kernel.raw_lengthscale"]
    assert ((lengths > 0.1) & (lengths < 2.0)).all()


def test_pickled(data):
    model = ZeroMeanGP(*data, covar_module=Stationary(MATERN32))
    again = pickle.loads(pickle.dumps(model))
    assert torch.equal(again.predict(data[0]).mean, model.predict(data[0]).mean)


class Growing(Noise):
    """v_1 + v_2 x_1^2."""

    def __init__(self):
        super().__init__(("constant", "growing"))

    def shares(self, places):
        x = places.X[..., 0]
        return torch.stack([torch.ones_like(x), x.square()], -1)


def test_a_noise_reads_inputs_as_the_user_gave_them(data):
    X, Y = data
    predicted = []
    for options in ({}, {"input_transform": Normalize(2)}):
        model = ZeroMeanGP(3 * X, Y, noise=Growing(), **options)
        noise = model.predict(3 * X, True).variance - model.predict(3 * X).variance
        v = [model.values[f"noise.{name}"].item() for name in ("constant", "growing")]
        expected = (v[0] + v[1] * 9 * X[:, :1].square()) * model.unit.square()
        torch.testing.assert_close(noise.detach(), expected.detach(), rtol=1e-6, atol=1e-8)
        predicted.append(noise.detach())
    torch.testing.assert_close(*predicted)


def test_numbers_after_a_search_of_ones_own(data):
    """Summary and parameters are of what predictions are made with."""
    model = ZeroMeanGP(*data)
    fit(model)
    assert len(model.draws) > len(model.u)
    model.set_draws(model.u[:1])
    with torch.no_grad():
        model.u += 1.0
    assert torch.equal(model.draws, model.u)


class NoShares(Noise):
    def __init__(self):
        super().__init__(("a", "b"))


class Negative(Growing):
    def shares(self, places):
        return -super().shares(places)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda X, Y: GP(X, Y, terms=[MATERN32]), TypeError, "Term"),
        (lambda X, Y: GP(X, Y, terms=[Term("f", MATERN32)]), TypeError, "Profile"),
        (lambda X, Y: ZeroMeanGP(X, Y, noise=0.01), TypeError, "train_Yvar"),
        (lambda X, Y: ZeroMeanGP(X, Y, noise=NoShares()).predict(X, True), ValueError, "override"),
        (lambda X, Y: ZeroMeanGP(X, Y, noise=Negative()).predict(X, True), ValueError, "negative"),
        (lambda X, Y: CKA(X, Y, physics=wave, center="yes"), TypeError, "center"),
        (lambda X, Y: CKA(X, Y, physics=lambda X: X), ValueError, "1 outputs of physics"),
        (lambda X, Y: CKA(X, Y.expand(12, 4), physics=wave), ValueError, "4 outputs of physics"),
        (lambda X, Y: fit(SingleTaskGP(X, Y, outcome_transform=None)), TypeError, "SingleTaskGP"),
    ],
)
@pytest.mark.filterwarnings("ignore:Data .outcome observations. is not standardized")
def test_what_is_refused(data, make, error, words):
    with pytest.raises(error, match=words):
        make(*data)


@pytest.mark.slow
@pytest.mark.parametrize("profile", [MATERN32, Stationary().profile])
def test_functions_of_rough_kernels_have_the_spread_of_the_model(profile):
    X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
    model = ZeroMeanGP(X, (5 * X).sin(), 1e-4, covar_module=Stationary(profile))
    model.set_draws(model.u.expand(200, -1, -1))
    Z = torch.linspace(-0.1, 1.1, 40, dtype=torch.float64).unsqueeze(-1)
    values = model.sample_functions(200, seed=0, num_features=512)(Z)
    ratio = values.std(0) / model.predict(Z).variance.sqrt()
    assert ratio.median().item() == pytest.approx(1.0, abs=0.3)


@pytest.mark.slow
def test_a_right_law_with_unknown_parameters_may_be_right_as_it_is():
    """Its parameters are then known better than those of a law up to a factor and an offset."""
    law = FunctionPhysics(
        lambda X, p: p.a * (p.w * X[:, 0]).sin(),
        unknowns={"a": Unknown(1.0, sd=0.5), "w": Unknown(5.0, factor=1.3)},
    )
    X = torch.linspace(0, 1, 15, dtype=torch.float64).unsqueeze(-1)
    Y = 1.3 * (6 * X).sin() + 0.05 * torch.randn(15, 1, dtype=torch.float64)
    spread = []
    for nested in (True, False):
        model = CKA(X, Y, physics=law, nested=nested)
        result = fit(model)
        a = model.physics_parameters["a"]
        spread.append(a.std().item())
        assert abs(a.mean().item() - 1.3) < 3 * a.std().item()
        if nested:
            assert [*result.probabilities][1] == "as it is"
    assert spread[0] < 0.7 * spread[1]


def test_a_kernel_takes_the_prior_variance_of_its_term(data):
    X, Y, *_ = data
    models = [CKA(X, Y, physics=lambda X: X[:, :1], rho_covar_module=k, delta_covar_module=k)
              for k in (None, Stationary())]  # fmt: skip
    for name in ("rho.kernel.outputscale", "delta.kernel.outputscale"):
        assert torch.equal(models[0].values[name], models[1].values[name])
    assert models[1].values["rho.kernel.outputscale"] < models[1].values["delta.kernel.outputscale"]
