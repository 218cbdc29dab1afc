"""Outputs with bounds: a link, with the physics through it."""

import math

import pytest
import torch
from botorch.acquisition import (
    LogExpectedImprovement,
    qLogExpectedImprovement,
    qLogNoisyExpectedImprovement,
)
from botorch.acquisition.objective import GenericMCObjective, ScalarizedPosteriorTransform
from botorch.generation import MaxPosteriorSampling
from botorch.models import ModelListGP, SingleTaskGP
from botorch.sampling import SobolQMCNormalSampler
from botorch.sampling.pathwise import draw_matheron_paths
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust.core import (
    CKA,
    GP,
    StackedGP,
    Stationary,
    Term,
    ZeroMeanGP,
    fit,
    load,
    save,
)  # fmt: skip
from gpadjust.kinds.links import (
    Link,
    Linked,
    LinkedCalibratedPhysics,
    LinkedCKA,
    LinkedMarginals,
    LinkedPhysicsMeanGP,
    LinkedZeroMeanGP,
    linked,
)  # fmt: skip
from gpadjust.physics import FunctionPhysics, PhysicsError, Unknown
from tests.systems import drawn, line, normal, refused

X = line(12, 0.1)
NEW = torch.tensor([[0.05], [0.5], [2.5]], dtype=torch.float64)
NOISE = normal(12, 1)
LEVELS = torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64)


def decades(X):
    return (6 * X[:, :1]).exp()


def share(X):
    return X[:, :1] / (1 + X[:, :1])


Y = 3 * decades(X) ** 1.1 * (0.05 * NOISE).exp()
SHARES = (2 * share(X).logit() + 0.05 * NOISE).sigmoid()
C = Y.log().mean()


@pytest.fixture
def model():
    return drawn(LinkedCKA(X, Y, physics=decades))


def close(one, other, size=1e-10):
    torch.testing.assert_close(one, other, rtol=size, atol=0.0)


def test_it_is_the_model_of_the_logarithms(model):
    plain = drawn(CKA(X, Y.log() - C, physics=lambda X: decades(X).log() - C))
    for noise in (False, True):
        pair = zip(model.interval(NEW, 0.9, noise), plain.interval(NEW, 0.9, noise), strict=True)
        for ours, other in pair:
            close(ours, (other + C).exp())
    one, other = model.left_out(), plain.left_out()
    close(one.log_density(Y), other.log_density(Y.log() - C) - Y.log())
    close(one.probability(Y), other.probability(Y.log() - C))
    close(model.log_jacobian(), plain.log_jacobian() - Y.log().sum())
    close(model.delta(NEW).mean, plain.delta(NEW).mean)
    functions = model.sample_functions(3, seed=0)(NEW)
    close(functions, (plain.sample_functions(3, seed=0)(NEW) + C).exp())


def test_one_draw_is_a_log_normal():
    model = LinkedZeroMeanGP(X, Y)
    mean, variance = (each[0] for each in model.components(NEW, True))
    prediction, sd = model.predict(NEW, True), variance.sqrt()
    close(prediction.mean, (mean + C).exp())
    close(prediction.variance, (prediction.mean * sd.sinh()).square(), 1e-6)
    y = torch.tensor([[2.0], [70.0], [1e5]], dtype=torch.float64)
    law = torch.distributions.LogNormal(mean + C, sd)
    marginals = model.marginals(NEW, True)
    close(marginals.log_density(y), law.log_prob(y))
    close(marginals.probability(y), law.cdf(y))
    close(marginals.quantile(0.9), law.icdf(torch.tensor(0.9).double()), 1e-7)
    outside = marginals.log_density(torch.tensor([[0.0], [-1.0], [math.nan]]).double()).flatten()
    assert outside[:2].tolist() == [-math.inf] * 2
    assert outside[2].isnan()


def test_samples_have_the_quantiles_and_densities():
    shares = drawn(LinkedCKA(X, SHARES, physics=share, link="logit"))
    posterior = shares.posterior(NEW[:2])
    samples = posterior.rsample(torch.Size([4000]))
    quantiles = posterior.quantile(LEVELS)
    assert ((samples > 0) & (samples < 1)).all()
    for level, ends in zip(LEVELS, quantiles, strict=True):
        torch.testing.assert_close((samples < ends).double().mean(0), level.expand(2, 1),
                                   rtol=0.0, atol=0.03)  # fmt: skip
    torch.testing.assert_close(torch.stack(shares.interval(NEW[:2])), quantiles[[0, 2]])
    close(posterior.mean, quantiles[1])
    y = torch.linspace(-12, 12, 40_000, dtype=torch.float64).sigmoid().reshape(-1, 1, 1)
    total = torch.trapezoid(posterior.density(y.expand(-1, 2, 1)), y, dim=0)
    torch.testing.assert_close(total, torch.ones(2, 1).double(), rtol=1e-3, atol=0.0)
    assert not hasattr(posterior, "distribution")  # it is not Gaussian


@given(
    st.sampled_from([("log", 0.0, 1.0), ("log", 0.0, 1e-12), ("log", 0.0, 1e12),
                     ("logit", -36.0, 1.0), ("logit", 36.0, 1.0), ((2.0, 2.001), 0.0, 1.0),
                     ((-3.0, math.inf), -30.0, 1.0)]),
    st.lists(st.floats(-9.0, 9.0), min_size=1, max_size=4),
    st.floats(-6.0, 6.0),
    st.floats(0.01, 0.999),
)  # fmt: skip
@settings(max_examples=40)
def test_predictions_are_within_their_intervals_and_bounds(case, means, log_sd, level):
    name, middle, size = case
    link = Link.parse(name)._replace(location=torch.tensor([middle + math.log(size)]).double())
    means = torch.tensor(means, dtype=torch.float64).reshape(-1, 1, 1)
    marginals = LinkedMarginals(means, torch.full_like(means, math.exp(2 * log_sd)), link)
    mean, variance = marginals.prediction
    lower, upper = (marginals.quantile(end) for end in ((1 - level) / 2, (1 + level) / 2))
    assert lower <= mean <= upper
    assert link.covers(torch.stack([lower, mean, upper])).all()
    assert variance.isfinite()
    assert (variance >= 0).all()
    assert link.value(torch.stack([lower, mean, upper])).isfinite().all()


@pytest.mark.parametrize("bounds", [(0.0, math.inf), (2.0, 5.0), (-1.0, math.inf)])
def test_the_link_and_its_derivative(bounds):
    link = Link.parse(bounds)._replace(location=torch.tensor([0.3, -2.0]).double())
    y = torch.tensor([[2.1, 3.0], [4.9, 4.0]], dtype=torch.float64, requires_grad=True)
    close(link.inverse(link.value(y)), y)
    (slope,) = torch.autograd.grad(link.value(y).sum(), y)
    close(link.log_slope(y.detach()), slope.log())
    close(link.of_outputs([1]).value(y[:, 1:]), link.value(y)[:, 1:])


def test_gradients_of_mean_and_variance(model):
    Z = NEW[:2].unsqueeze(1).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda Z: model.posterior(Z).mean.log(), Z, atol=1e-4)
    assert torch.autograd.gradcheck(lambda Z: model.posterior(Z).variance.log(), Z, atol=1e-4)


def test_known_variances_by_the_delta_method():
    variances = (0.05 * Y).square()
    model = drawn(LinkedCKA(X, Y, variances, physics=decades))
    known = model.noise.known * model.unit.square()
    close(known, torch.full_like(known, 0.0025))
    own = 0.0025 * decades(NEW).square()
    one = model.condition_on_observations(NEW, decades(NEW), own)
    other = model.condition_on_observations(NEW, decades(NEW))  # with the mean of those known
    close(one.predict(X).mean, other.predict(X).mean)
    close(other.data.Yvar[-3:], own)
    noise = model.components(NEW, 0.01 * model.predict(NEW).mean.square())[1]
    close(noise, model.components(NEW)[1] + 0.01)
    fantasies = model.fantasize(NEW, SobolQMCNormalSampler(torch.Size([2]), seed=0))
    assert fantasies.conditioning().chol.shape[:-2] == (2, 1)  # of all fantasies
    late = fantasies.data.Y[:, -3:], fantasies.data.Yvar[0, -3:]
    given = model.condition_on_observations(NEW, *late)
    close(given.predict(X).mean[0], fantasies.predict(X).mean[0], 1e-6)
    missing = Y.clone()
    missing[3] = math.nan
    two = LinkedZeroMeanGP(X, torch.cat([missing, Y], -1), torch.cat([variances, variances], -1))
    close(two.noise.known * two.unit.square(), torch.full((2, 12), 0.0025, dtype=torch.float64))
    close(two.posterior(NEW, [1]).mean, two.predict(NEW).mean[:, [1]])


def test_unknown_parameters_and_missing_observations():
    law = FunctionPhysics(
        lambda X, p: torch.stack([(p.a * X[:, 0]).exp() - 1, (-p.a * X[:, 0]).exp()], -1),
        unknowns={"a": Unknown(3.0, sd=3.0)},  # a negative one is outside the bounds
    )
    seen = torch.cat([decades(X) - 1, 1 / decades(X)], -1)
    seen[3, 1] = math.nan
    model = LinkedCalibratedPhysics(X, seen * (0.01 * NOISE).exp(), physics=law)
    u = model.u.detach().repeat(2, 1, 1)
    u[1, :, -1] = -2.0
    value, gradient = model.log_likelihood(u)
    assert value[0].isfinite().all()
    assert (value[1] == -math.inf).all()
    assert gradient.isfinite().all()
    result = fit(model, num_draws=32)
    torch.testing.assert_close(model.physics_parameters.mean, torch.tensor([6.0]).double(),
                               rtol=0.01, atol=0.0)  # fmt: skip
    assert model.left_out().log_density(seen).isnan().sum() == 1
    assert result.log_evidence.isfinite().all()
    outside = torch.tensor([[1.0], [-1.0]]).double()
    refused(PhysicsError, r"(?s)returned -.*row 1: \[-1.0", model.predict, outside)


def test_botorch_takes_it(model):
    Z, best = X[::3].unsqueeze(1), Y.max()
    sampler = SobolQMCNormalSampler(torch.Size([64]), seed=0)
    one = qLogExpectedImprovement(model, best, sampler)(Z)
    assert one.shape == (4,)
    assert one[-1] > one[0]
    assert LogExpectedImprovement(model, best)(Z).argmax() == 3
    several = ModelListGP(model, SingleTaskGP(X, SHARES))
    objective = GenericMCObjective(lambda Y, X=None: Y[..., 0])
    other = qLogExpectedImprovement(several, best, objective=objective)(Z)
    torch.testing.assert_close(other[-1], one[-1], rtol=0.0, atol=0.7)
    later = several.condition_on_observations([NEW, NEW], torch.cat([decades(NEW), share(NEW)], -1))
    close(later.models[0].data.Y[-3:], decades(NEW))
    noisy = qLogNoisyExpectedImprovement(several, X, objective=objective, prune_baseline=True)
    assert noisy(Z).isfinite().all()
    assert MaxPosteriorSampling(model, replacement=False)(X, 2).shape == (2, 1)
    values = draw_matheron_paths(model, torch.Size([5]))(X)
    assert values.shape == (5, 12)
    assert (values > 0).all()


def test_mixtures_of_linked_models():
    mean = drawn(LinkedPhysicsMeanGP(X, Y, physics=decades))
    models = {"mean": mean, "none": drawn(LinkedZeroMeanGP(X, Y), 8)}
    stacked = StackedGP(models, [0.25, 0.75], 32)
    low, middle, high = stacked.posterior(NEW).quantile(LEVELS)
    close(torch.stack([low, high]), torch.stack(stacked.interval(NEW)))
    close(stacked.predict(NEW).mean, middle)
    parts = [m.marginals(NEW).probability(middle) for m in models.values()]
    close(0.25 * parts[0] + 0.75 * parts[1], torch.full((3, 1), 0.5).double())
    density = [m.left_out().log_density(Y).sum() for m in models.values()]
    chosen = StackedGP.by_left_out(models, 16).weights
    assert max(chosen, key=chosen.get) == ("mean" if density[0] > density[1] else "none")
    several = ModelListGP(stacked, SingleTaskGP(X, SHARES))
    close(several.posterior(NEW).mean[:, :1], middle)
    unlike = {"one": mean, "other": ZeroMeanGP(X, Y)}
    refused(ValueError, r"one scale of y; found log\(y\).*, y", StackedGP, unlike, [0.5, 0.5])


class Sine(GP):
    """A structure of one's own."""

    def __init__(self, train_X, train_Y, train_Yvar=None, *, gain=1.0, **options):
        super().__init__(train_X, train_Y, train_Yvar, terms=[Term("f", Stationary(), gain)],
                         settings={"gain": gain} | options, **options)  # fmt: skip


class LinkedSine(Linked, Sine):
    """It with a link."""


def test_structures_and_their_linked_classes(tmp_path):
    assert linked(CKA) is linked(LinkedCKA) is LinkedCKA
    assert linked(Sine) is linked(Sine)
    model = drawn(LinkedSine(X, Y, gain=2.0, link=(0.0, 1e9)))
    close(drawn(linked(Sine)(X, Y, gain=2.0, link=(0.0, 1e9))).predict(NEW), model.predict(NEW))
    save(model, tmp_path / "model.pt")
    assert type(load(tmp_path / "model.pt", trusted=True)) is LinkedSine
    assert ", of log(" in model.summary().splitlines()[0]


def physics_mean(train_Y=Y, **options):
    return LinkedPhysicsMeanGP(X, train_Y, **{"physics": decades} | options)


SHARE = r"above 0 and below 1 for the link log\(y / \(1 - y\)\)"
TOTAL = ScalarizedPosteriorTransform(torch.ones(1).double())
REFUSED = [
    (lambda: physics_mean(Y - 10), ValueError, "targets above 0.*found .* the first row 0"),
    (lambda: physics_mean(link="logit"), ValueError, SHARE),
    (lambda: physics_mean(link="logarithm"), TypeError, "Expected link as 'log', 'logit'"),
    (lambda: physics_mean(link=(1.0,)), TypeError, "two bounds"),
    (lambda: physics_mean(link=("a", 1.0)), TypeError, "two bounds"),
    (lambda: physics_mean(link=(1.0, 0.0)), ValueError, "below the upper"),
    (lambda: physics_mean(link=(-math.inf, 0.0)), ValueError, "finite lower.*distance"),
    (lambda: physics_mean(physics=lambda X: X - 0.5), PhysicsError,
     r"(?s)-0.4, which.*clamp.*row 0: \[0.1\]"),
    (lambda: physics_mean().condition_on_observations(NEW, -NEW), ValueError, r"found -0\.05"),
    (lambda: physics_mean().predict(NEW, torch.ones(4, 1).double()), ValueError, "not negative"),
    (lambda: physics_mean().posterior(NEW, posterior_transform=TOTAL), TypeError, "subset_output"),
    (lambda: linked(torch.nn.Linear), TypeError, "structure"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input(call, error, words):
    refused(error, words, call)
