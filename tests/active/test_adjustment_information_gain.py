"""The information about rho and delta, against other ways to compute it."""

import copy
import pickle

import mpmath
import pytest
import torch
from botorch.models import ModelListGP
from botorch.models.transforms import Normalize

from gpadjust import BlackBoxPhysics, VariationalCKA, fit
from gpadjust.active import qAdjustmentInformationGain
from gpadjust.models import BiasGP
from tests.systems import crude

ABOUT = ["rho", "delta", "both"]
BOUNDS = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)


def log_det(K):
    """In fifty digits, since vague priors leave few of sixteen."""
    with mpmath.workdps(50):
        return float(mpmath.log(mpmath.det(K)))


class Gaussian:
    """The joint prior of what is observed at D and X and of rho and delta there, one output.

    In the units of the targets, from the model's kernels on the inputs.
    """

    def __init__(self, model, D, X, output=None, center=0.0, noise=None):
        pick = (lambda k: k[output]) if output is not None else (lambda k: k)
        scale = model.outcome_transform.stdvs.reshape(-1)[output or 0]
        Z = torch.cat([D, X])
        self.n, self.size = len(D), len(Z)
        self.f = (model.physics(Z)[:, output or 0] - center) / scale
        self.k, self.constant = {}, {}
        for term in model.terms:
            zero = torch.zeros(len(Z), len(Z), dtype=torch.float64)
            kernel = term.kernel
            self.k[term.name] = zero if kernel is None else pick(kernel)(Z).to_dense().detach()
            self.constant[term.name] = term.mean_variance.reshape(-1)[output or 0].item()
        if noise is None:
            noise = model.likelihood.noise.detach().reshape(-1)[output or 0].expand(len(Z))
        self.noise = noise

    def covariance(self, *terms):
        """Of the observations, were they of these terms and noise alone."""
        K = mpmath.diag(self.noise.tolist())
        for name in terms:
            weight = self.f if name == "rho" else torch.ones_like(self.f)
            for i in range(self.size):
                for j in range(self.size):
                    prior = mpmath.mpf(self.k[name][i, j].item()) + self.constant[name]
                    K[i, j] += prior * weight[i].item() * weight[j].item()
        return K

    def log_det_of_new(self, *terms):
        """log|Cov(new | old)| = log|Cov(all)| - log|Cov(old)|."""
        with mpmath.workdps(50):
            K = self.covariance(*terms)
            return log_det(K) - log_det(K[: self.n, : self.n])

    def information(self, about):
        others = {"rho": ["delta"], "delta": ["rho"], "both": []}[about]
        return (self.log_det_of_new("rho", "delta") - self.log_det_of_new(*others)) / 2


def ask(model, X, about, **options):
    with torch.no_grad():
        return qAdjustmentInformationGain(model, about, **options)(X)


@pytest.fixture
def model(data, build, shuffle):
    return shuffle(build("CKA", *data()))


@pytest.fixture
def X(uniform):
    return uniform(3, 2, high=2.0, seed=5)


def assert_close(actual, expected, tolerance=1e-8):
    expected = torch.as_tensor(expected, dtype=torch.float64).expand_as(actual)
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


class TestAgainstLinearAlgebra:
    @pytest.mark.parametrize("about", ABOUT)
    @pytest.mark.parametrize("q", [1, 3])
    def test_cka(self, model, data, X, about, q):
        expected = Gaussian(model, data()[0], X[:q]).information(about)
        assert expected > 1e-3
        assert_close(ask(model, X[:q], about), expected)

    def test_it_is_the_gain_about_rho_at_finitely_many_points(self, model, data, X):
        D = data()[0]
        joint = Gaussian(model, D, X)
        prior, f = joint.k["rho"], joint.f
        cross = prior * f
        K = f[:, None] * cross + joint.k["delta"] + joint.noise.diag()

        def entropy(m):
            gain = cross[:, :m] @ torch.linalg.solve(K[:m, :m], cross[:, :m].mT)
            return torch.logdet(prior - gain) / 2

        assert_close(ask(model, X, "rho"), entropy(joint.n) - entropy(joint.size), 1e-6)

    @pytest.mark.parametrize("about", ABOUT)
    def test_several_outputs_add_up_where_they_are_known(self, data, build, shuffle, X, about):
        D, Y = data(num_outputs=2)
        Y[[1, 4], 0] = Y[2, 1] = torch.nan
        model = shuffle(build("CKA", D, Y))
        expected = sum(
            Gaussian(model, D[~Y[:, j].isnan()], X, output=j).information(about) for j in range(2)
        )
        assert_close(ask(model, X, about), expected)

    @pytest.mark.parametrize("about", ["rho", "both"])
    def test_centred(self, data, build, shuffle, X, about):
        D, Y = data()
        model = shuffle(build("CKA", D, Y, center=3.0))
        assert_close(ask(model, X, about), Gaussian(model, D, X, center=3.0).information(about))

    @pytest.mark.parametrize(
        ("kind", "about"),
        [
            ("RRA", "rho"),
            ("RRA", "delta"),
            ("ScaleGP", "rho"),
            ("ScaleGP", "both"),
            ("PhysicsMeanGP", "delta"),
            ("BiasGP", "both"),
        ],
    )
    def test_other_models(self, data, build, shuffle, X, kind, about):
        D, Y = data()
        model = shuffle(build(kind, D, Y))
        assert_close(ask(model, X, about), Gaussian(model, D, X).information(about))

    @pytest.mark.parametrize("about", ABOUT)
    def test_known_noise_is_that_of_the_data_on_average(self, data, build, shuffle, X, about):
        D, Y = data()
        Yvar = 1e-2 * (1 + D[:, :1])
        model = shuffle(build("CKA", D, Y, Yvar))
        noise = Yvar.squeeze(-1) / model.outcome_transform.stdvs.reshape(()).square()
        noise = torch.cat([noise, noise.mean().expand(3)])
        assert_close(ask(model, X, about), Gaussian(model, D, X, noise=noise).information(about))

    @pytest.mark.parametrize("about", ABOUT)
    @pytest.mark.parametrize("kind", ["CKA", "PhysicsMeanGP"])
    def test_unknown_constant_means(self, data, build, X, kind, about):
        D, Y = data()
        Y = Y + 0.02 * torch.randn(Y.shape, dtype=torch.float64)
        model = build(kind, D, Y, rho_mean="learn", delta_mean="learn")
        fit(model, "map", num_screened=16, num_starts=2)
        expected = Gaussian(model, D, X)
        assert max(expected.constant.values()) > 1
        assert_close(ask(model, X, about), expected.information(about), 1e-5)

    def test_inducing_values_by_the_posterior_covariance(self, data, X):
        model = VariationalCKA(*data(num_outputs=2), physics=crude, num_inducing=5)
        fit(model, num_screened=0)
        expected = 0.0
        for j in range(2):
            part = model.subset_output([j])
            C = part.posterior(X[:3]).distribution.covariance_matrix.detach()
            noise = part.predict(X[:1], True).variance - part.predict(X[:1]).variance
            expected += 0.5 * torch.logdet(torch.eye(3).double() + C / noise.detach()).item()
        assert_close(ask(model, X[:3], "both"), expected, 1e-6)


class TestAgainstSimulation:
    """Given simulated measurements at X, how far does the posterior of rho move?"""

    @pytest.mark.parametrize("about", ["rho", "delta"])
    def test_expected_kullback_leibler_divergence(self, data, build, X, about):
        D, Y = data()
        model = build("CKA", D, Y)
        for term in model.terms:
            term.kernel.base_kernel.lengthscale = 0.5
        model.likelihood.noise = 0.1
        model.eval()
        points = torch.cat([D, X])
        with torch.no_grad():
            samples = model.posterior(X, observation_noise=True).sample(torch.Size([4000]))
            before = getattr(model, about)(points).distribution
            later = model.condition_on_observations(X.expand(4000, 3, 2), samples)
            after = getattr(later, about)(points)
            mean = after.mean.squeeze(-1)
            after = after.distribution.covariance_matrix
            after = after[0] if after.dim() == 3 else after
        prior = before.covariance_matrix
        shift = mean - before.mean
        quadratic = (shift * torch.linalg.solve(prior, shift.mT).mT).sum(-1)
        trace = torch.linalg.solve(prior, after).trace() - len(points)
        divergence = (trace + quadratic + torch.logdet(prior) - torch.logdet(after)) / 2
        error = divergence.std() / len(divergence) ** 0.5
        value = ask(model, X, about).item()
        assert value > 5 * error
        assert abs(divergence.mean() - value) < 4 * error


class TestLaws:
    def test_chain_rule(self, model, X, data):
        both, rho, delta = (ask(model, X, about) for about in ("both", "rho", "delta"))
        joint = Gaussian(model, data()[0], X)
        delta_given_rho = (joint.log_det_of_new("delta") - joint.log_det_of_new()) / 2
        assert_close(both, rho + delta_given_rho)
        assert (both >= torch.maximum(rho, delta)).all()
        assert (torch.minimum(rho, delta) > 0).all()

    @pytest.mark.parametrize("about", ABOUT)
    def test_more_points_teach_more_but_less_each(self, model, X, about):
        one, two, three = (ask(model, X[:k], about) for k in (1, 2, 3))
        assert one < two < three
        if about == "both":
            assert two <= one + ask(model, X[1:2], about)

    @pytest.mark.parametrize("about", ABOUT)
    def test_the_order_of_the_points_does_not_matter(self, model, X, about):
        assert_close(ask(model, X[[2, 0, 1]], about), ask(model, X, about))

    @pytest.mark.parametrize("about", ABOUT)
    def test_units_do_not_matter(self, data, build, X, about):
        D, Y = data()
        values = []
        for u in (1.0, 1e-6, 1e5):
            model = build("CKA", D / u, Y * u, physics=lambda X, u=u: u * crude(X * u)[..., :1])
            values.append(ask(model, X / u, about))
        for value in values[1:]:
            assert_close(value, values[0], 1e-6)

    @pytest.mark.parametrize("about", ["rho", "delta"])
    def test_a_repeated_measurement_without_noise_teaches_nothing(self, data, build, about):
        D, Y = data()
        model = build("CKA", D, Y).eval()
        model.likelihood.noise = 1e-9
        again, elsewhere = ask(model, D[:1], about), ask(model, D[:1] + 0.5, about)
        assert again < 1e-2 * elsewhere

    def test_noise_drowns_all(self, data, build, X):
        model = build("CKA", *data()).eval()
        model.likelihood.noise = 1e9
        assert ask(model, X, "both").item() == pytest.approx(0, abs=1e-6)

    def test_where_the_physics_is_zero(self, uniform, build):
        D = uniform(9, 2)
        model = build("CKA", D, 1 + D[:, :1], physics=lambda X: X[..., :1].clamp(max=1) - 1).eval()
        (delta,) = (term for term in model.terms if term.name == "delta")
        delta.kernel.base_kernel.lengthscale = 0.2
        distances = torch.tensor([1.05, 1.4, 4.0], dtype=torch.float64)
        X = torch.stack([distances, 0.5 * torch.ones(3, dtype=torch.float64)], dim=-1)
        near, between, far = ask(model, X.unsqueeze(-2), "rho")
        # Only what delta was at the data leads from there to rho.
        assert near > between > far
        assert near > 1e-4
        assert far == pytest.approx(0, abs=1e-10)
        # All that such a point tells is about delta.
        assert_close(ask(model, X[2:], "delta"), ask(model, X[2:], "both"))

    def test_a_physics_of_zero_hides_rho(self, data, build, X):
        model = build("CKA", *data(), physics=lambda X: 0 * X[..., :1]).eval()
        assert_close(ask(model, X, "rho"), 0.0)
        assert_close(ask(model, X, "delta"), ask(model, X, "both"))


class TestShapes:
    @pytest.mark.parametrize("num_outputs", [1, 2])
    @pytest.mark.parametrize("about", ABOUT)
    def test_batches_are_apart(self, data, build, shuffle, uniform, num_outputs, about):
        model = shuffle(build("CKA", *data(num_outputs=num_outputs)))
        for shape in ((2,), (1, 2), (3, 2), (5, 1, 2), (4, 5, 3, 2)):
            Z = uniform(*shape, 2, high=2.0, seed=4)
            values = ask(model, Z, about)
            t_batch = shape[:-1] or (1,)
            assert values.shape == t_batch
            each = [ask(model, z, about) for z in Z.reshape(-1, *Z.shape[-2:])]
            assert_close(values, torch.cat(each).reshape(t_batch))

    @pytest.mark.parametrize("about", ABOUT)
    def test_a_batch_of_models(self, data, build, uniform, num_outputs, about):
        D, Y = data((3,), num_outputs=num_outputs)
        model = build("CKA", D, Y)
        Z = uniform(5, 1, 2, 2, high=2.0, seed=4)
        values = ask(model, Z, about)
        assert values.shape == (5, 3)
        for j in range(3):
            single = build("CKA", D[j], Y[j])
            assert_close(values[:, j], ask(single, Z[:, 0], about))

    @pytest.mark.parametrize("about", ABOUT)
    @pytest.mark.parametrize("known", [False, True])
    def test_averages_over_samples(self, data, held, uniform, num_outputs, about, known):
        D, Y = data(num_outputs=num_outputs)
        Yvar = 1e-2 * (1 + D[:, :1]).expand_as(Y) if known else None
        model, singles = held("CKA", D, Y, Yvar)
        Z = uniform(5, 2, 2, high=2.0, seed=4)
        values = ask(model, Z, about)
        assert values.shape == (5,)
        assert_close(values, torch.stack([ask(single, Z, about) for single in singles]).mean(0))

    def test_pending_points_are_as_good_as_measured(self, model, X):
        pending = ask(model, X[:1], "rho", X_pending=X[1:])
        assert_close(pending, ask(model, X, "rho"))
        acquisition = qAdjustmentInformationGain(model, "rho", X_pending=X[1:])
        acquisition.set_X_pending(None)
        assert_close(acquisition(X[:1]).detach(), ask(model, X[:1], "rho"))

    def test_input_transform(self, data, build, X):
        D, Y = data()
        normal = build("CKA", D, Y, input_transform=Normalize(2, bounds=BOUNDS))
        plain = build("CKA", D, Y)
        for model, lengthscale in ((plain, 1.0), (normal, 0.5)):
            for term in model.terms:
                term.kernel.base_kernel.lengthscale = lengthscale
        assert_close(ask(plain, X, "rho"), ask(normal, X, "rho"))


class TestGradient:
    @pytest.mark.parametrize("about", ABOUT)
    @pytest.mark.parametrize("kind", ["CKA", "RRA", "held", "black box"])
    def test_finite_differences(self, data, build, shuffle, held, uniform, kind, about):
        D, Y = data(num_outputs=2)
        if kind == "held":
            model = held("CKA", D, Y)[0]
        elif kind == "black box":
            physics = BlackBoxPhysics(lambda X: crude(torch.from_numpy(X)).numpy())
            model = shuffle(build("CKA", D, Y, physics=physics))
        else:
            model = shuffle(build(kind, D, Y))
        acquisition = qAdjustmentInformationGain(model, about)
        Z = uniform(2, 2, 2, high=2.0, seed=6)
        leaf = Z.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(acquisition(leaf).sum(), leaf)
        expected = torch.zeros_like(Z)
        with torch.no_grad():
            for i in range(Z.numel()):
                step = torch.zeros_like(Z)
                step.view(-1)[i] = 1e-5
                change = acquisition(Z + step).sum() - acquisition(Z - step).sum()
                expected.view(-1)[i] = change / 2e-5
        size = expected.abs().max().item()
        torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-5 * size)


class TestLife:
    def test_copies(self, data, build, X):
        D, Y = data()
        model = BiasGP(D, Y, physics=torch.nn.Linear(2, 1).double())
        acquisition = qAdjustmentInformationGain(model, "delta")
        value = acquisition(X)
        for again in (copy.deepcopy(acquisition), pickle.loads(pickle.dumps(acquisition))):
            assert_close(again(X), value)

    def test_it_follows_the_model(self, model, X):
        acquisition = qAdjustmentInformationGain(model, "rho")
        before = acquisition(X)
        fit(model, "map", num_screened=8, num_starts=1)
        assert_close(acquisition(X), qAdjustmentInformationGain(model, "rho")(X))
        assert not torch.allclose(acquisition(X), before)

    @pytest.mark.parametrize("about", ABOUT)
    def test_after_conditioning(self, model, X, about):
        first = ask(model, X[:1], about)
        Y = torch.ones(1, 1, dtype=torch.float64)
        rest = ask(model.condition_on_observations(X[:1], Y), X[1:], about)
        assert_close(first + rest, ask(model, X, about))


REFUSED = [
    ("BiasGP", {}, "rho", TypeError, "PhysicsMeanGP has no unknown rho; ask about 'delta'"),
    ("ScaleGP", {}, "delta", TypeError, "ScaleGP has no unknown delta"),
    ("AR1", {}, "both", TypeError, "rho or delta .* got AR1"),
    ("ZeroMeanGP", {}, "both", TypeError, "rho or delta .* got ZeroMeanGP"),
    ("CKA", {"center": "mean"}, "delta", ValueError, "ask about 'rho' or 'both', .* center=0"),
    ("CKA", {"center": "learn"}, "delta", ValueError, "ask about 'rho' or 'both', .* center=0"),
    ("CKA", {}, "epsilon", ValueError, r"about='epsilon'; expected 'rho'"),
]


def test_what_has_no_such_adjustment_is_refused(data, build):
    for kind, options, about, error, words in REFUSED:
        with pytest.raises(error, match=words):
            qAdjustmentInformationGain(build(kind, *data(), **options), about)
    with pytest.raises(TypeError, match="got ModelListGP"):
        qAdjustmentInformationGain(ModelListGP(build("CKA", *data())))
    of_a_sum = VariationalCKA(*data(num_outputs=2), physics=crude)
    for about in ("rho", "delta"):
        with pytest.raises(TypeError, match=f"if {about} were known: ask about 'both'"):
            qAdjustmentInformationGain(of_a_sum, about)
