"""Noise that is given: in BoTorch's units to `posterior`, in the user's to all else."""

from functools import partial

import pytest
import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Standardize
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import CKA, PhysicsMeanGP, StackedGP
from tests.systems import holding, refused

# The targets are 60 times those of the physics, so that their units matter.
pytestmark = pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")

STEPS = (-0.2, 0.0, 0.2)


def added(model, Z, noise, **options):
    """What the noise adds to the variance of the posterior."""
    noisy = model.posterior(Z, observation_noise=noise, **options).variance
    return (noisy - model.posterior(Z, **options).variance).detach()


@pytest.fixture
def large(data):
    """Targets of a standard deviation of about 40."""

    def large(num_outputs, **options):
        X, Y = data(n=12, num_outputs=num_outputs, **options)
        return X / 2, 60 * Y  # in the unit cube, as BoTorch wants it

    return large


class TestPosterior:
    @pytest.mark.parametrize("shape", [(5,), (3, 5)])
    def test_as_a_single_task_gp(self, large, build, num_outputs, kind, uniform, shape):
        X, Y = large(num_outputs)
        theirs = SingleTaskGP(X, Y, outcome_transform=Standardize(num_outputs))
        ours = build(kind, X, Y, outcome_transform=Standardize(num_outputs))
        Z, noise = uniform(*shape, 2), uniform(*shape, num_outputs, low=0.1, seed=2)
        scale = ours.outcome_transform.stdvs.reshape(-1)
        torch.testing.assert_close(added(ours, Z, noise), noise * scale.square())
        if kind != "AR1":  # whose transform is that of two levels
            torch.testing.assert_close(added(ours, Z, noise), added(theirs, Z, noise))
        for outputs in ([1], [0], [1, 0]) if num_outputs == 2 else ():
            found = added(ours, Z, noise, output_indices=outputs)
            torch.testing.assert_close(found, added(ours, Z, noise)[..., outputs])

    def test_units_samples_and_one_number_for_all_points(self, large, build, num_outputs, uniform):
        X, Y = large(num_outputs)
        Z, noise = uniform(5, 2), uniform(5, num_outputs, low=0.1, seed=2)
        plain = build("CKA", X, Y, outcome_transform=None)
        torch.testing.assert_close(added(plain, Z, noise), noise)
        model = build("CKA", X, Y, outcome_transform=Standardize(num_outputs))
        found = added(model, Z, torch.full((1, 1), 0.5, dtype=torch.float64))
        torch.testing.assert_close(found, (0.5 * Y.var(0)).expand(5, num_outputs))
        expected = (noise * Y.var(0)).expand(3, 5, num_outputs)
        torch.testing.assert_close(added(holding(model, *STEPS), Z, noise), expected)

    def test_of_a_mixture_of_structures(self, large, num_outputs, uniform):
        X, Y = large(num_outputs)

        def f(X):
            return 60 * torch.stack([X.sum(-1), X.prod(-1)], -1)[..., :num_outputs]

        models = {
            "CKA": holding(CKA(X, Y, physics=f), *STEPS),
            "standardised": PhysicsMeanGP(
                X, Y, physics=f, outcome_transform=Standardize(num_outputs)
            ),
        }
        model = StackedGP(models, [[0.5] * num_outputs] * 2, num_components=4)
        for shape in ((5,), (3, 5)):
            Z, noise = uniform(*shape, 2), uniform(*shape, num_outputs, low=0.1, seed=2)
            expected = noise.unsqueeze(-3).expand(*shape[:-1], 4, 5, num_outputs)
            torch.testing.assert_close(added(model, Z, noise), expected)
            low, high = model.interval(Z), model.interval(Z, observation_noise=noise)
            assert (high[1] > low[1]).all()
            difference = model.predict(Z, noise).variance - model.predict(Z).variance
            torch.testing.assert_close(difference.detach(), noise)
        if num_outputs == 2:
            found = added(model, Z, noise, output_indices=[1])
            torch.testing.assert_close(found, expected[..., 1:])

    def test_fantasies_of_known_noise(self, large, build, uniform):
        """BoTorch passes their noise, in the units after the transform, to `posterior`."""
        X, Y = large(1)
        model = build("CKA", X, Y, torch.full_like(Y, 4.0), outcome_transform=Standardize(1))
        asked, posterior = [], model.posterior
        model.posterior = lambda *args, **kwargs: asked.append(kwargs) or posterior(*args, **kwargs)
        sampler = SobolQMCNormalSampler(torch.Size([4]), seed=0)
        fantasies = model.fantasize(uniform(3, 2), sampler)
        (noise,) = [kwargs["observation_noise"] for kwargs in asked]
        torch.testing.assert_close(noise * Y.var(), torch.full_like(noise, 4.0))
        known = fantasies.likelihood.noise[..., -3:] * Y.var()
        torch.testing.assert_close(known, torch.full_like(known, 4.0))


class TestInTheUsersUnits:
    @pytest.mark.parametrize("transform", ["default", "standardize", None])
    @pytest.mark.parametrize("samples", [False, True])
    def test_predict_and_interval(self, large, build, num_outputs, uniform, transform, samples):
        X, Y = large(num_outputs)
        options = {} if transform == "default" else {"outcome_transform": None}
        if transform == "standardize":
            options["outcome_transform"] = Standardize(num_outputs)
        model = build("CKA", X, Y, **options)
        model = holding(model, *STEPS) if samples else model
        Z, noise = uniform(5, 2), uniform(5, num_outputs, low=0.1, seed=2)
        with torch.no_grad():
            silent, noisy = model.predict(Z), model.predict(Z, noise)
            torch.testing.assert_close(noisy.variance - silent.variance, noise)
            low, high = model.interval(Z, 0.95, observation_noise=noise)
        if not samples:
            width = 2 * 1.959963984540054 * noisy.variance.sqrt()
            torch.testing.assert_close(high - low, width)


class TestRefused:
    @pytest.fixture(params=["CKA", "mixture"])
    def model(self, request, large, build):
        model = build("CKA", *large(2))
        if request.param == "CKA":
            return model
        return StackedGP({"CKA": model}, [[1.0, 1.0]], num_components=2)

    def test_what_is_no_variance(self, model, uniform):
        Z, noise = uniform(5, 2), torch.ones(5, 2, dtype=torch.float64)
        methods = model.posterior, model.predict, model.interval
        for wrong in (-1e-300, float("nan"), float("inf")):
            noise[2, 1] = wrong
            for method in (*methods, partial(model.posterior, output_indices=[1])):
                refused(ValueError, "finite and not negative", method, Z, observation_noise=noise)
        for shape in ((), (2,), (4, 2), (5, 3), (2, 5)):
            wrong = torch.ones(shape, dtype=torch.float64)
            for method in methods:
                says = "Expected observation_noise"
                refused(ValueError, says, method, Z, observation_noise=wrong)
