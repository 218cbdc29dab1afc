"""Joint samples have the moments of their posterior, whatever its size, and gradients."""

import math

import pytest
import torch
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from botorch.sampling import IIDNormalSampler, SobolQMCNormalSampler
from torch.distributions import MultivariateNormal

from gpadjust import CKA, PhysicsMeanGP, StackedGP, fit
from gpadjust.models.posteriors import MarginalMixture, ScaleFreePosterior
from tests.systems import crude, holding, line, refused, wave

DRAWS = 20_000
KINDS = ["CKA", "RRA", "ZeroMeanGP", "AR1"]


def agree(make, Z):
    """Standard deviations to 3 %, correlations to 0.05, and finite gradients in Z."""
    with torch.no_grad():
        posterior = make(Z)
        samples = posterior.rsample(torch.Size([DRAWS])).flatten(1)
        covariance = posterior.distribution.covariance_matrix
    sd = covariance.diagonal().sqrt()
    assert (sd > 0).all()
    torch.testing.assert_close(sd, posterior.variance.mT.flatten().sqrt())
    standard = (samples - posterior.mean.flatten()) / sd
    assert (standard.mean(0).abs() < 0.04).all()
    assert ((standard.std(0) - 1).abs() < 0.03).all()
    correlation = covariance / sd.outer(sd)
    assert ((standard.mT @ standard / DRAWS - correlation).abs() < 0.05).all()
    leaf = Z.clone().requires_grad_()
    make(leaf).rsample(torch.Size([3])).sum().backward()
    assert leaf.grad.isfinite().all()


@pytest.fixture
def model_of(data, build):
    def model_of(kind, noisy, size, num_outputs=1):
        X, Y = data(n=12, num_outputs=num_outputs)
        options = {}
        if kind != "ZeroMeanGP":
            options["physics"] = lambda X: size * crude(X)[..., :num_outputs]
        model = build(kind, X, size * Y, **options).eval()
        noise = model.likelihood.noise_covar
        with torch.no_grad():
            if not noisy:
                noise.raw_noise.fill_(1.0001 * noise.raw_noise_constraint.lower_bound.log())
            for term in model.terms:
                if term.kernel is not None:
                    term.kernel.base_kernel.raw_lengthscale.fill_(0.4)
        return model, X

    return model_of


@pytest.mark.parametrize(
    ("q", "size"),
    [(1, 1e-6), (20, 1.0), (20, 1e6), pytest.param(200, 1e-6, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
@pytest.mark.parametrize("kind", KINDS)
def test_one_output(model_of, uniform, kind, noisy, size, q):
    model, X = model_of(kind, noisy, size)
    Z = torch.cat([X[: q // 4], uniform(q - len(X[: q // 4]), 2, high=2.0, seed=1)])
    agree(model.posterior, Z)
    for name in model.term_names:
        agree(lambda Z, name=name: model.term(name, Z), Z)


@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
@pytest.mark.parametrize("kind", ["CKA", "RRA"])
def test_scalarized_outputs(model_of, uniform, kind, noisy):
    model, _ = model_of(kind, noisy, 1e-3, num_outputs=2)
    weigh = ScalarizedPosteriorTransform(torch.tensor([1.0, -3.0], dtype=torch.float64))
    Z = uniform(20, 2, high=2.0, seed=1)
    agree(lambda Z: model.posterior(Z, posterior_transform=weigh), Z)
    samples = model.posterior(Z).rsample(torch.Size([DRAWS]))
    sd = model.posterior(Z).variance.sqrt()
    assert ((samples.std(0) / sd - 1).abs() < 0.03).all()


@pytest.fixture
def held(model_of, uniform):
    """`held(kind, noisy, m)` is a model of three samples of its hyper-parameters, and inputs."""

    def held(kind, noisy=True, num_outputs=1):
        model, X = model_of(kind, noisy, 1e3, num_outputs)
        return holding(model, -0.3, 0.0, 0.3), torch.cat([X[:3], uniform(9, 2, high=2.0, seed=1)])

    return held


@pytest.mark.parametrize("kind", ["CKA", "RRA"])
@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
def test_a_mixture_over_hyper_parameters(held, kind, noisy):
    model, Z = held(kind, noisy)
    for ask in (
        model.posterior,
        lambda Z: model.rho(Z, mixed=False),
        lambda Z: model.delta(Z, mixed=False),
    ):
        with torch.no_grad():
            posterior = ask(Z)
            samples = posterior.rsample(torch.Size([DRAWS]))
        assert samples.shape == (DRAWS, 3, 12, 1)
        for draws, variance in (
            (samples, posterior.variance),
            (samples.flatten(0, 1), posterior.mixture_variance),
        ):
            assert ((draws.std(0) / variance.sqrt() - 1).abs() < 0.03).all()


class TestMixed:
    """rho and delta, whose samples are mixed: moments, draws and densities of the whole."""

    @pytest.mark.parametrize("num_outputs", [1, 2])
    @pytest.mark.parametrize("sampler", [None, IIDNormalSampler, SobolQMCNormalSampler])
    def test_draws_have_the_moments(self, held, num_outputs, sampler):
        model, Z = held("CKA", True, num_outputs)
        torch.manual_seed(0)
        for ask in (model.rho, model.delta):
            with torch.no_grad():
                posterior, each = ask(Z), ask(Z, mixed=False)
                draws = posterior.rsample(torch.Size([DRAWS]))
                if sampler is not None:
                    draws = sampler(torch.Size([DRAWS]), seed=0)(posterior)
                assert draws.shape == (DRAWS, 12, num_outputs)
                assert posterior.mean.shape == posterior.variance.shape == (12, num_outputs)
                torch.testing.assert_close(posterior.mean, each.mean.mean(0))
                second = (each.variance + each.mean.square()).mean(0)
                torch.testing.assert_close(posterior.variance, second - posterior.mean.square())
                covariance = posterior.mixture_covariance_matrix
            sd = posterior.variance.mT.flatten().sqrt()
            torch.testing.assert_close(covariance.diagonal().sqrt(), sd)
            assert torch.equal(posterior.covariance_matrix, covariance)
            draws = draws.mT.flatten(1)
            standard = (draws - posterior.mean.mT.flatten()) / sd
            assert (standard.mean(0).abs() < 0.04).all()
            correlation = covariance / sd.outer(sd)
            assert ((standard.mT @ standard / DRAWS - correlation).abs() < 0.06).all()

    def test_draws_are_of_one_sample_each(self, held):
        """Far apart from the others, each draw is of one of them at all points."""
        model, Z = held("CKA")
        with torch.no_grad():
            posterior = model.rho(Z)
            far = torch.tensor([-1e3, 0.0, 1e3], dtype=torch.float64).reshape(3, 1)
            normal = posterior.components.distribution
            components = ScaleFreePosterior.of_outputs(
                normal.mean + far, normal.covariance_matrix, False
            )
            draws = MarginalMixture(components).rsample(torch.Size([600])).squeeze(-1)
        near = (draws / 1e3).round()
        assert (near == near[:, :1]).all()
        assert all(150 < (near[:, 0] == k).sum() < 250 for k in (-1, 0, 1))

    @pytest.mark.parametrize("num_outputs", [1, 2])
    def test_joint_density(self, held, num_outputs):
        model, Z = held("CKA", True, num_outputs)
        with torch.no_grad():
            posterior = model.delta(Z[::6])
            values = posterior.rsample(torch.Size([4]))
            found = posterior.log_prob(values)
            normal = posterior.components.distribution
            roots = [torch.linalg.cholesky(each) for each in normal.covariance_matrix]
            parts = [
                MultivariateNormal(mean, scale_tril=root).log_prob(values.mT.flatten(1))
                for mean, root in zip(normal.loc, roots, strict=True)
            ]
        expected = torch.stack(parts).logsumexp(0) - math.log(len(parts))
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-2)
        refused(NotImplementedError, "mixed=False", posterior.entropy)

    @pytest.mark.slow
    def test_density_is_the_slope_of_the_quantiles(self, held):
        posterior = held("CKA")[0].rho(held("CKA")[1])
        levels = torch.tensor([0.3, 0.3001], dtype=torch.float64)
        low, high = posterior.quantile(levels)
        for i in range(len(low)):
            density = posterior.density((low[i] + high[i]).squeeze() / 2)[i]
            torch.testing.assert_close(density * (high - low)[i] / 1e-4, torch.ones(1).double())


@pytest.mark.parametrize("num_outputs", [1, 2])
def test_no_variance_is_rounded_up(model_of, uniform, num_outputs):
    """GPyTorch's own distribution has variances of at least 1e-10, with a warning (an error)."""
    model, _ = model_of("CKA", True, 1e-9, num_outputs)
    Z = uniform(5, 2)
    with torch.no_grad():
        for posterior in (model.posterior(Z), model.posterior(Z, [0])):
            variance = posterior.distribution.variance
            assert variance.max() < 1e-15
            torch.testing.assert_close(
                variance.reshape(posterior.variance.shape), posterior.variance
            )
            low, high = posterior.distribution.confidence_region()
            assert (high - low).max() < 1e-6


# Posteriors are right whatever the size of the targets, of which they are multiples


SIZES = [1e-12, 1e-6, 1e-3, 1e6, 1e12]
LEVELS = torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64)
WEIGHTS = torch.tensor([1.0, -3.0], dtype=torch.float64)


@pytest.fixture
def sized(data):
    """`sized(of, size, m, noisy, num_samples)` is a model of targets of that size."""

    def sized(of, size, num_outputs, noisy, num_samples):
        X, Y = data(n=12, num_outputs=num_outputs)
        model = of(X, size * Y, physics=lambda X: size * crude(X)[..., :num_outputs])
        raw = model.likelihood.noise_covar.raw_noise
        with torch.no_grad():
            raw.fill_(-4.0 if noisy else -20.0)
        if num_samples:
            holding(model, *torch.linspace(-0.3, 0.2, num_samples).tolist())
        return model.eval()

    return sized


def posteriors(model, Z):
    """By name: a posterior, and whether it has the units of the targets."""
    yield "f", model.posterior(Z), True
    yield "observations", model.posterior(Z, observation_noise=True), True
    if isinstance(model, CKA):
        yield "rho", model.rho(Z), False
    if not isinstance(model, StackedGP):
        yield "delta", model.delta(Z), True
    if model.num_outputs > 1:
        yield "output", model.posterior(Z, [1]), True
        weighted = ScalarizedPosteriorTransform(WEIGHTS)
        yield "weighted", model.posterior(Z, posterior_transform=weighted), True


def moments(model, Z, size):
    """What posteriors say, in multiples of the size."""
    found = {"predict": model.predict(Z).variance / size**2}
    low, high = model.interval(Z)
    found["interval"] = (high - low) / size
    for name, posterior, has_units in posteriors(model, Z):
        unit = size if has_units else 1.0
        found[f"{name}, variance"] = posterior.variance / unit**2
        found[f"{name}, quantiles"] = posterior.quantile(LEVELS).diff(dim=0) / unit
        found[f"{name}, density"] = posterior.density(posterior.mean.flatten()[0]) * unit
        if isinstance(posterior, GaussianMixturePosterior):
            found[f"{name}, mixture"] = posterior.mixture_variance / unit**2
    return found


def alike(found, expected):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        size = values.abs().max().item()
        torch.testing.assert_close(found[name], values, rtol=1e-3, atol=1e-9 * size, msg=name)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("of", [CKA, PhysicsMeanGP])
@pytest.mark.parametrize("num_samples", [0, 3])
@pytest.mark.parametrize("noisy", [True, False])
def test_multiples_of_the_size(sized, uniform, of, size, num_outputs, noisy, num_samples):
    Z = uniform(7, 2, high=2.0, seed=1)
    with torch.no_grad():
        one, other = (sized(of, s, num_outputs, noisy, num_samples) for s in (1.0, size))
        alike(moments(other, Z, size), moments(one, Z, 1.0))


@pytest.mark.parametrize("size", SIZES[::2])
def test_mixtures_of_structures(sized, uniform, size, num_outputs):
    Z = uniform(7, 2, high=2.0, seed=1)
    weights = torch.tensor([[0.75], [0.25]], dtype=torch.float64).expand(2, num_outputs)

    def stacked(size):
        kinds = {"CKA": (CKA, 3), "physics mean": (PhysicsMeanGP, 0)}
        models = {n: sized(of, size, num_outputs, True, s) for n, (of, s) in kinds.items()}
        return StackedGP(models, weights, num_components=8)

    with torch.no_grad():
        alike(moments(stacked(size), Z, size), moments(stacked(1.0), Z, 1.0))


@pytest.mark.parametrize("size", SIZES[::2])
def test_quantiles_are_those_of_the_interval(sized, uniform, size):
    model, Z = sized(CKA, size, 1, True, 3), uniform(7, 2, high=2.0, seed=1)
    with torch.no_grad():
        low, middle, high = model.posterior(Z).quantile(LEVELS)
        ends = model.interval(Z, 0.95)
        draws = model.posterior(Z).rsample(torch.Size([40_000])).flatten(0, 1)
    torch.testing.assert_close((low, high), ends, rtol=0, atol=1e-9 * size)
    sd = draws.std(0)
    for level, found in zip(LEVELS, (low, middle, high), strict=True):
        assert ((draws.quantile(float(level), dim=0) - found).abs() < 0.05 * sd).all()


@pytest.mark.parametrize("method", ["bayes", "map"])
@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_eight_points_without_noise(uniform, method, size):
    """Variances of 1e-11 and less, without a warning (each is an error here)."""
    X = line(8)
    model = CKA(X, size * (2 * wave(X) + X), physics=lambda X: size * wave(X))
    fit(model, method)
    Z = uniform(5, 1)
    with torch.no_grad():
        posterior, (_, variance) = model.posterior(Z), model.predict(Z)
        found = posterior.mixture_variance if method == "bayes" else posterior.variance
        draws = posterior.rsample(torch.Size([4000]))
    torch.testing.assert_close(found, variance, rtol=1e-3, atol=1e-13 * size**2)
    assert ((draws.std(0) / posterior.variance.sqrt() - 1).abs() < 0.1).all()
