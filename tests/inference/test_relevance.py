"""Whether a physics is of use: the model without it, and samples of both."""

import math
from copy import deepcopy

import pytest
import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.priors import LogNormalPrior

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit, load, save
from gpadjust.inference import FitResult, register_priors
from gpadjust.inference.relevance import (
    ADJUSTED,
    ALONE,
    WITHOUT,
    alone,
    held,
    mixed,
    probabilities,
    without_physics,
)
from gpadjust.inference.targets import LogPosterior
from gpadjust.validation import trust
from tests.systems import around, line, normal, same, uniform

# Physics of no use is what this is about.
pytestmark = pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
SHORT = {"num_draws": 64, "num_starts": 1, "num_screened": 8}
quick = pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")  # few draws


def truth(X):
    return (6 * X).sin() + X


def unrelated(X):
    """Numbers that change from point to point as if they were drawn."""
    return 3 * (1e4 * X).sin() + (3.3e5 * X).cos()


def double(X):
    return 2 * truth(X)


def unrelated_and_double(X):
    return torch.cat([unrelated(X), double(X)], dim=-1)


@pytest.fixture(scope="module")
def data():
    """15 points, where the truth is seen without noise, and others."""
    X = uniform(15, 1)
    return X, truth(X), line(40)


@pytest.fixture(scope="module")
def _fitted(data):
    X, Y, _ = data
    model = CKA(X, torch.cat([Y, Y], dim=-1), physics=unrelated_and_double)
    return model, fit(model)


@pytest.fixture
def fitted(_fitted):
    """A model whose first output has a physics of no use, and the second one of use; its fit."""
    model, result = _fitted
    return deepcopy(model), result


def half_off(model, share, number=4):
    """Samples of a model, of which some have the physics switched off; with those of both."""
    other = without_physics(model)
    on, off = around(model, number), around(other, number, seed=1)
    kept = (number * torch.as_tensor(share)).round()
    which = (torch.arange(number).reshape(-1, *[1] * kept.dim()) >= kept).long()
    return mixed([(on, model), (off, other)], which), on, off


@pytest.fixture
def partly(data):
    """A model of which a fourth of the samples of one output has no physics, half of the other."""
    X, Y, _ = data
    options = {"physics": unrelated_and_double, "center": 0.0, "outcome_transform": None}
    model = CKA(X, torch.cat([Y, 1 - Y], dim=-1), **options)
    samples, *_ = half_off(model, [0.75, 0.5])
    model.hold_samples(samples)
    return model, samples, options


def rbf(A, B, scale, lengthscale):
    return scale * (-0.5 * torch.cdist(A / lengthscale, B / lengthscale).square()).exp()


class TestWithoutPhysics:
    @pytest.mark.parametrize("center", ["learn", "mean", 0.0])
    def test_it_is_a_gaussian_process_around_the_mean_of_the_targets(self, data, center):
        X, Y, _ = data
        targets = torch.cat([Y, 3 - 2 * Y], dim=-1)
        targets[3, 1] = torch.nan
        mean = targets.nanmean(0)
        options = {"outcome_transform": None}
        model = CKA(X, targets, physics=unrelated_and_double, center=center, **options)
        before = deepcopy(model.state_dict())
        other, plain = without_physics(model), ZeroMeanGP(X, targets - mean, **options)
        assert all(torch.equal(before[name], v) for name, v in model.state_dict().items())
        assert all(parameter.requires_grad for parameter in model.terms[0].kernel.parameters())
        # The same hyper-parameters with the same priors.
        register_priors(other)
        register_priors(plain)
        ours, theirs = LogPosterior(other), LogPosterior(plain)
        assert [name.replace("terms.1", "terms.0") for name in ours.parameters.names] == (
            theirs.parameters.names
        )
        vectors = ours.parameters.current()
        vectors = vectors + 0.5 * torch.randn(5, *vectors.shape[1:], dtype=torch.float64)
        torch.testing.assert_close(ours(vectors), theirs(vectors), rtol=1e-6, atol=1e-6)

    def test_its_predictions_in_plain_linear_algebra_and_of_a_ridge_regression(self, data):
        X, Y, Z = data
        other = without_physics(CKA(X, Y, physics=unrelated)).eval()
        kernel, noise = other.terms[1].kernel, other.likelihood.noise
        args = kernel.outputscale, kernel.base_kernel.lengthscale
        scale = other.units()[1]
        K = rbf(X, X, *args) + noise * torch.eye(15)
        k = rbf(Z, X, *args)
        mean = Y.mean() + k @ torch.linalg.solve(K, Y - Y.mean())
        variance = args[0] - (k * torch.linalg.solve(K, k.mT).mT).sum(-1, keepdim=True)
        found = other.predict(Z)
        torch.testing.assert_close(found.mean, mean, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(found.variance, variance * scale.square(), rtol=1e-5, atol=1e-9)
        other = without_physics(RRA(X, Y, physics=unrelated, num_features=32))
        on_delta = other.eval().delta(Z).mean
        torch.testing.assert_close(other.predict(Z).mean, on_delta, rtol=1e-6, atol=1e-8)

    def test_of_several_physics_all_are_off(self, data):
        X, Y, Z = data
        model = CKA(X, Y, physics=[unrelated, double], rho_mean=[1.0, 0.3])
        other, one = without_physics(model), without_physics(CKA(X, Y, physics=double))
        other, one = other.eval(), one.eval()
        assert [t.mean.item() for t in other.terms[:2]] == [0.0, 0.0]
        kernels = [(each.terms[-1].kernel, each.units()[1].square()) for each in (one, other)]
        with torch.no_grad():  # in units of the targets
            ours, theirs = ((k.outputscale * unit).squeeze() for k, unit in kernels)
            other.likelihood.noise = one.likelihood.noise * kernels[0][1] / kernels[1][1]
            kernels[1][0].outputscale = kernels[1][0].outputscale * ours / theirs
        same(other.predict(Z), one.predict(Z), rtol=1e-6, atol=1e-8)

    def test_there_is_none(self, data):
        """Of other structures, of unknown means, and with priors or values of the user."""
        X, Y, _ = data
        bounded = ScaleKernel(RBFKernel(), outputscale_constraint=Interval(0.1, 1.0))
        models = [ZeroMeanGP(X, Y), ScaleGP(X, Y, physics=lambda X: 3 + X)]
        models += [AR1(X, Y, physics=double, low_X=X), PhysicsMeanGP(X, Y, physics=double)]
        models += [PhysicsMeanGP(X, Y, physics=double, rho_mean="learn")]
        for options in (
            {"rho_mean": "learn"},
            {"delta_mean": "learn"},
            {"physics": [double, unrelated]},
            {"rho_covar_module": RBFKernel()},
            {"rho_covar_module": bounded},
        ):
            models.append(CKA(X, Y, **{"physics": double, **options}))
        users = [CKA(X, Y, physics=double) for _ in range(3)]
        assert without_physics(users[0]) is not None
        users[0].terms[1].kernel.register_prior("p", LogNormalPrior(0.0, 1.0), "outputscale")
        users[1].terms[0].kernel.base_kernel.raw_lengthscale.requires_grad_(False)
        users[2].terms[0].kernel.raw_outputscale.requires_grad_(False)
        for i, model in enumerate(models + users):
            assert without_physics(model) is None, i


class TestAlone:
    @pytest.mark.parametrize("kind", [CKA, PhysicsMeanGP, ScaleGP, RRA])
    @pytest.mark.parametrize("known", [None, 0.04])
    def test_it_is_the_physics_and_noise(self, data, kind, known):
        X, Y, Z = data
        options = {"num_features": 32} if kind is RRA else {}
        model = kind(X, Y, known, physics=double, **options)
        before = deepcopy(model.state_dict())
        other = alone(model).eval()
        assert all(torch.equal(before[name], v) for name, v in model.state_dict().items())
        found = other.predict(Z)
        torch.testing.assert_close(found.mean, double(Z), rtol=1e-6, atol=1e-8)
        assert (found.variance < 1e-12 * Y.var()).all()
        register_priors(other)
        names = LogPosterior(other).parameters.names  # what there is to learn
        kinds = {name.rsplit(".", 1)[-1] for name in names}
        assert kinds == ({"raw_noise"} if known is None else {"raw_lengthscale"})

    def test_there_is_none(self, data):
        X, Y, _ = data
        unknown, nothing = ({"rho_mean": mean} for mean in ("learn", 0.0))
        of_one_size = {"rho_covar_module": RBFKernel()}
        models = [CKA(X, Y, physics=double, **o) for o in (unknown, nothing, of_one_size)]
        for model in (*models, ZeroMeanGP(X, Y), AR1(X, Y, physics=double, low_X=X)):
            assert alone(model) is None

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", [CKA, PhysicsMeanGP])
    def test_a_right_physics_is_followed(self, kind):
        """With noise, functions that are free find some where there is none."""
        Z, squares, sufficiency = line(40), torch.zeros(2), []
        for seed in range(4):
            X = uniform(12, 1, seed=seed)
            Y = truth(X) + 0.2 * normal(12, 1, seed=10 + seed)
            model, free = (kind(X, Y, physics=truth) for _ in range(2))
            register_priors(free)  # as if they were the user's: nothing is weighed
            for i, each in enumerate((model, free)):
                sufficiency.append(fit(each).sufficiency)
                squares[i] += (each.predict(Z).mean - truth(Z)).square().mean()
        assert squares[0] < 0.5 * squares[1]
        assert torch.stack(sufficiency[::2]).mean() > 0.4
        assert {*sufficiency[1::2]} == {None}
        assert "left as it is in" in model.summary()

    def test_shares_of_samples(self):
        shares = {ADJUSTED: [0.3, 0.05, 0.0], WITHOUT: [0.1, 0.05, 0.0], ALONE: [0.6, 0.9, 1.0]}
        shares = {name: torch.tensor(each, dtype=torch.float64) for name, each in shares.items()}
        found = held(shares)
        torch.testing.assert_close(sum(found.values()), torch.ones(3, dtype=torch.float64))
        assert found[ALONE].tolist() == pytest.approx([0.6, 0.75, 0.75])
        assert found[ADJUSTED].tolist() == pytest.approx([0.3, 0.125, 0.25])
        assert held({ADJUSTED: shares[ADJUSTED]}) == {ADJUSTED: shares[ADJUSTED]}

    def test_a_wrong_physics_is_not(self, data):
        X, Y, Z = data
        model = CKA(X, Y, physics=lambda X: truth(X) + 0.3 * X.cos())
        assert fit(model).sufficiency < 0.01
        assert (model.predict(Z).mean - truth(Z)).abs().max() < 1e-3


def test_probabilities():
    evidences = {
        ADJUSTED: torch.tensor([0.3, -2.0, 5.0]),
        WITHOUT: torch.tensor([0.1, 1.0, 5.0]),
        ALONE: torch.tensor([-1.0, 0.0, 5.0]),
    }
    found = probabilities(evidences)
    torch.testing.assert_close(sum(found.values()), torch.ones(3))
    even = {name: share[2].item() for name, share in found.items()}  # the prior ones
    for name, share in found.items():
        expected = even[name] * evidences[name].exp()
        total = sum(even[other] * evidences[other].exp() for other in evidences)
        torch.testing.assert_close(share, expected / total)
    assert even[ADJUSTED] == pytest.approx(4 * even[WITHOUT])
    far = {ADJUSTED: torch.tensor([1e4, -1e4]), WITHOUT: torch.zeros(2)}
    assert probabilities(far)[ADJUSTED].tolist() == [1.0, 0.0]
    assert probabilities({ADJUSTED: far[ADJUSTED]})[ADJUSTED].tolist() == [1.0, 1.0]


class TestConstant:
    """A constant between physics and targets, which a model without physics has for free."""

    def test_its_cost(self):
        even = {ADJUSTED: torch.zeros(5), WITHOUT: torch.zeros(5)}
        prior = probabilities(even)
        odds = (prior[ADJUSTED] / prior[WITHOUT])[0]
        away = torch.tensor([0.0, 1.0, 10.0, torch.inf, torch.nan])
        expected = (torch.tensor([1.0, 1.0, 10.0, 1.0, 1.0]) * odds).log().sigmoid()
        torch.testing.assert_close(probabilities(even, away)[ADJUSTED], expected)

    @pytest.mark.slow
    @pytest.mark.parametrize("offset", [0.0, 1e5])
    def test_it_does_not_count_against_the_physics(self, data, offset):
        X, Y, _ = data
        Y = Y + 0.1 * normal(*Y.shape, seed=1) + offset
        assert fit(CKA(X, Y, physics=double)).relevance > 0.8
        assert fit(CKA(X, Y, physics=unrelated)).relevance < 0.5


class TestMixed:
    def test_shares_of_each_output(self, data):
        X, Y, _ = data
        model = CKA(X, torch.cat([Y, 1 - Y], dim=-1), physics=unrelated_and_double)
        samples, on, off = half_off(model, [0.3, 0.95], number=8)  # 2 of 8, and all
        other, own = (dict(m.named_parameters()) for m in (without_physics(model), model))
        for name in on:
            apart = off.get(name, other[name].expand(8, *other[name].shape))
            for output, count in ((0, 2), (1, 8)):
                values = samples[name][:, output]
                assert torch.equal(values[:count], on[name][:count, output])
                assert torch.equal(values[count:], apart[count:, output])
        for i in range(2):
            name = f"covar_module.terms.{i}.mean"
            assert (samples[name][:2] == own[name]).all()
            assert (samples[name][2:, 0] == other[name][0]).all()
            assert (samples[name][2:, 1] == own[name][1]).all()
        assert (samples["covar_module.terms.0.mean"][2:, 0] == 0).all()
        assert (samples["covar_module.terms.0.kernel.raw_outputscale"][2:, 0] < -40).all()

    @pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.4, 2), (1.0, 4)])
    def test_samples_predict_as_what_they_are_of(self, data, share, count):
        X, Y, Z = data
        model, plain, other = (CKA(X, Y, physics=unrelated) for _ in range(3))
        samples, on, off = half_off(model, share)
        other = without_physics(other)
        for each, values in ((model, samples), (plain, on), (other, off)):
            each.hold_samples(values)
        found, ours, theirs = (m.components(Z, False) for m in (model, plain, other))
        for a, b, c in zip(found, ours, theirs, strict=True):
            torch.testing.assert_close(a[:count], b[:count])
            torch.testing.assert_close(a[count:], c[count:])


class TestFit:
    @pytest.mark.slow
    def test_of_physics_of_no_use_and_of_use(self, fitted, data):
        X, Y, Z = data
        model, result = fitted
        assert result.relevance.shape == (2,)
        assert result.relevance[0] < 0.5
        assert result.relevance[1] > 0.95
        assert result.converged.all()
        plain = ZeroMeanGP(X, Y)
        fit(plain)
        mean, expected = model.predict(Z).mean, plain.predict(Z).mean
        assert (mean[:, :1] - expected).abs().max() < 0.01
        assert (mean[:, 1:] - truth(Z)).abs().max() < 1e-4

    def test_the_rho_of_a_physics_of_no_use_is_none_and_the_most_likely_values_are_as_ever(
        self, fitted, data
    ):
        *_, Z = data
        model, _ = fitted
        rho, delta, total = model.rho(Z), model.delta(Z), model.predict(Z)
        assert rho.mean[:, 0].abs().max() < 1e-6
        assert rho.variance[:, 0].max() < 1e-6
        torch.testing.assert_close(delta.mean[:, 0], total.mean[:, 0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(rho.mean[:, 1], torch.full_like(Z[:, 0], 0.5), rtol=0, atol=0.2)
        X, Y, Z = data
        new = CKA(X, torch.cat([Y, Y], dim=-1), physics=unrelated_and_double)
        for each in (new, model):
            assert isinstance(fit(each, "map"), FitResult)
            torch.testing.assert_close(each.fallback(Z), unrelated_and_double(Z))
            assert (each.terms[0].mean == 1.0).all()
        found, expected = (each.log_evidence()[1] for each in (model, new))
        torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-2)

    @quick
    def test_nothing_is_said_of_what_cannot_do_without_nor_with_priors_of_the_user(self, data):
        X, Y, _ = data
        users = CKA(X, Y, physics=unrelated)
        register_priors(users)
        others = PhysicsMeanGP(X, Y, physics=double), AR1(X, Y, physics=double, low_X=X)
        for model in (users, ZeroMeanGP(X, Y), *others):
            assert fit(model, "bayes", **SHORT).relevance is None
        assert (users.terms[0].mean == 1.0).all()


class TestPartlyOff:
    """What samples with the physics on, and others with it off, are to a model."""

    def test_terms_functions_and_outputs(self, partly, data):
        *_, Z = data
        model, *_ = partly
        rho, delta = (f(Z, mixed=False).mean for f in (model.rho, model.delta))  # S x q x m
        mean, variance = model.components(Z, False)
        torch.testing.assert_close(rho * unrelated_and_double(Z) + delta, mean)
        assert (rho[3:, :, 0].abs() < 1e-8).all()
        assert (rho[2:, :, 1].abs() < 1e-8).all()
        assert (rho[:2].abs() > 1e-4).any(1).all()
        found = model.predict(Z)
        torch.testing.assert_close(found.mean, mean.mean(0))
        torch.testing.assert_close(
            found.variance, variance.mean(0) + mean.var(0, correction=0), rtol=1e-6, atol=1e-10
        )
        parts = model.rho(Z), model.delta(Z)
        assert all(each.variance.isfinite().all() for each in parts)
        torch.testing.assert_close(parts[0].mean, rho.mean(0))
        torch.testing.assert_close(model.mean_functions()(Z), mean)
        torch.manual_seed(0)
        values = model.sample_functions(200, num_features=256)(Z)
        assert values.isfinite().all()
        found = model.predict(Z)
        sd = found.variance.sqrt()
        assert ((values.mean(0) - found.mean).abs() < 4 * sd / math.sqrt(200)).all()
        assert (values.var(0) / found.variance - 1).abs().median() < 0.2
        both = model.predict(Z)
        for i in range(2):
            one = model.subset_output([i]).predict(Z)
            torch.testing.assert_close(one.mean, both.mean[:, i : i + 1])
            torch.testing.assert_close(one.variance, both.variance[:, i : i + 1])

    def test_conditioning(self, partly, data):
        X, Y, Z = data
        model, samples, options = partly
        new_X = torch.tensor([[1.4], [1.7]], dtype=torch.float64)
        new_Y = torch.cat([truth(new_X), 1 - truth(new_X)], dim=-1)
        found = model.condition_on_observations(new_X, new_Y)
        every = torch.cat([Y, 1 - Y], dim=-1)
        expected = CKA(torch.cat([X, new_X]), torch.cat([every, new_Y]), **options)
        expected.hold_samples(samples)
        Z = torch.cat([Z, 1.5 + Z])
        same(found.components(Z, False), expected.components(Z, False), rtol=1e-5, atol=1e-7)
        for name in ("rho", "delta"):
            a, b = (m.term(name, Z) for m in (found, expected))
            torch.testing.assert_close(a.mean, b.mean, rtol=1e-5, atol=1e-6)

    def test_saved_and_loaded_it_predicts_the_same(self, partly, data, tmp_path):
        *_, Z = data
        model, *_ = partly
        save(model, tmp_path / "model.pt")
        again = load(tmp_path / "model.pt", physics=unrelated_and_double)
        assert again.num_samples == model.num_samples
        for a, b in (
            *zip(again.predict(Z), model.predict(Z), strict=True),
            (again.rho(Z).mean, model.rho(Z).mean),
            (again.fallback(Z), model.fallback(Z)),
        ):
            assert torch.equal(a, b)


class TestTracesOfSamplesWithoutPhysics:
    @pytest.mark.slow
    def test_relevance_of_many_inputs(self):
        """Draws that do not get to the posterior are no evidence against the physics."""
        g = torch.Generator().manual_seed(0)
        X = torch.rand(100, 20, generator=g, dtype=torch.float64)
        W = torch.randn(20, generator=g, dtype=torch.float64)

        def physics(X):
            return 2 * (3 * (X * W).sum(-1, keepdim=True)).sin() + (9 * X[:, :1]).cos()

        noise = torch.randn(100, 1, generator=g, dtype=torch.float64)
        Y = 1.5 * physics(X) + 0.3 * X[:, :1] + 0.5 * noise
        assert fit(CKA(X, Y, physics=physics)).relevance > 0.95

    def test_a_center_that_moved(self, data):
        X, Y, _ = data
        model = CKA(X, Y, physics=unrelated)
        with torch.no_grad():
            model.terms[0].basis.center.fill_(1.0)
        other = without_physics(model).eval()
        mean = other.mean_module(other.train_inputs[0])
        torch.testing.assert_close(mean, other.train_targets.mean().expand_as(mean))
        model.terms[0].basis.center.requires_grad_(False)
        assert without_physics(model) is None

    def test_trust_is_about_the_physics(self, data):
        X, Y, _ = data
        model = CKA(X, Y, physics=unrelated)
        fit(model)
        found = trust(model)
        moments = model.predict(found.X)
        least = 1e-3 * (Y - Y.mean()).square().mean().sqrt()
        half = (1.96 * moments.variance.sqrt()).maximum(least)
        expected = (moments.mean - unrelated(found.X)).abs() / half
        torch.testing.assert_close(found.override, expected, rtol=0.01, atol=0.01)

    @pytest.mark.slow
    @pytest.mark.parametrize("scale", [1e-3, 1e3])
    def test_a_physics_of_any_unit_is_switched_off(self, data, scale):
        X, Y, Z = data
        found = []
        for each in (unrelated, lambda X: scale * unrelated(X)):
            model = CKA(X, Y, physics=each, outcome_transform=None)
            fit(model)
            found.append((model.predict(Z).mean - truth(Z)).square().mean().sqrt())
        assert found[1] < 2 * found[0] + 1e-3
