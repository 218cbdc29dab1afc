"""What was silently wrong once, or failed, in a former core."""

import numpy as np
import pytest
import torch
from botorch.acquisition import PosteriorMean
from botorch.acquisition.multi_objective.logei import qLogNoisyExpectedHypervolumeImprovement
from botorch.models import ModelListGP, SingleTaskGP

from gpadjust.core import CKA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.kinds import LinkedCKA
from gpadjust.physics import FormulaPhysics
from tests.systems import line, normal, same, uniform, wave

X = line(12)
Y = 1.3 * wave(X) + X + 0.05 * normal(12, 1)


def test_beyond_the_data_a_link_predicts_within_its_interval():
    """Moments of a mixture of log-normal distributions were 1e12 times the truth."""
    generator = np.random.default_rng(3)
    x = np.sort(generator.uniform(0, 1, 14))[:, None]
    y = np.exp(3 * x + 0.3 * generator.normal(size=x.shape))
    model = LinkedCKA(x, y, physics=lambda X: torch.exp(2 * X))
    fit(model)
    beyond = np.array([[1.25], [1.5], [3.0]])
    mean, variance = model.predict(beyond)
    lower, upper = model.interval(beyond)
    assert ((lower < mean) & (mean < upper) & np.isfinite(variance)).all()
    assert np.abs(np.log(mean / np.exp(3 * beyond)))[:2].max() < 1
    best = PosteriorMean(model)(torch.as_tensor(beyond).unsqueeze(1))
    same([best], [torch.as_tensor(mean[:, 0])])


@pytest.mark.parametrize("order", [1, -1])
def test_a_link_and_other_models_in_a_list(order):
    """After the default fit, by which a linked posterior once had a dimension for draws."""
    Z = uniform(5, 1, seed=3)
    linked = LinkedCKA(X, Y.exp(), physics=lambda X: wave(X).exp())
    plain = CKA(X, Y, physics=wave)
    for each in (linked, plain):
        fit(each, num_draws=16)
    for models in ([linked, plain], [linked, SingleTaskGP(X, Y)]):
        several = ModelListGP(*models[::order])
        posterior = several.posterior(Z)
        assert posterior.rsample(torch.Size([4])).shape == (4, 5, 2)
        same(posterior.mean.unbind(-1), [m.posterior(Z).mean[:, 0] for m in models[::order]])
        with torch.no_grad():
            gain = qLogNoisyExpectedHypervolumeImprovement(several, [0.0, 0.0], X)
            assert gain(Z.unsqueeze(1)).isfinite().all()


def test_a_fitted_model_is_a_physics_by_its_predictions():
    old = PhysicsMeanGP(X, Y, physics=wave)
    new = CKA(X, 2 * Y, physics=lambda X: old.predict(X).mean)
    assert (new.predict(X).mean - 2 * Y).abs().max() < 0.2


def test_a_column_with_the_name_of_a_word_of_python():
    for formula in ("2 * lambda", "2 * lambda_"):
        same([FormulaPhysics(formula, ["lambda"])(X)], [2 * X])


@pytest.mark.slow
def test_seeds_agree_of_clustered_inputs_and_exact_data():
    """One called converged what another seed changed; exact smooth data always got a warning."""
    x = torch.logspace(-3, 1, 20, dtype=torch.float64)
    x = torch.cat([x, 1.001 * x[:9]]).unsqueeze(-1)
    model = ZeroMeanGP(x, x.log() + 0.3 * (3 * x.log()).sin())
    means, sds = [], []
    for seed in range(3):
        fit(model, seed=seed)
        mean, variance = model.predict(x + 0.01)
        means.append(mean)
        sds.append(variance.sqrt())
    away = torch.stack(means).std(0) / torch.stack(sds).mean(0)
    assert away.square().mean().sqrt() < 0.5
    X = uniform(256, 2)
    assert fit(ZeroMeanGP(X, (3 * X).sin().sum(-1, True))).converged
