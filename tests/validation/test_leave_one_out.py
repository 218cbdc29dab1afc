"""Leave-one-out in closed form against models without a point."""

import math

import pytest
import torch

from gpadjust.core import CKA, PhysicsMeanGP, StackedGP, ZeroMeanGP, fit
from gpadjust.kinds.links import LinkedCKA
from gpadjust.validation import leave_one_out
from tests.systems import crude, line, normal, wave


def drawn(model, number=6):
    """The model with draws near the middle of its prior."""
    model.set_draws(0.3 * normal(number, model.table.problems, model.table.size, seed=2))
    return model


@pytest.mark.parametrize("known", [False, True])
def test_a_point_fit_is_rebuilding_without_the_point(data, close, num_outputs, known):
    X, Y = data(n=7, num_outputs=num_outputs)
    Y[2, 0] = torch.nan if num_outputs == 2 else Y[2, 0]
    model = drawn(CKA(X, Y, 0.02 if known else None, physics=crude_of(num_outputs)), 1)
    loo = leave_one_out(model)
    for i in range(7):
        part = model.subset_rows(torch.arange(7) != i)
        noise = torch.full((1, num_outputs), 0.02).double() if known else True
        mean, variance = part.predict(X[[i]], noise)
        seen = ~Y[i].isnan()
        density = torch.distributions.Normal(mean[0], variance[0].sqrt(), False).log_prob(Y[i])
        close(loo.mean[i, seen], mean[0, seen])
        close(loo.variance[i, seen], variance[0, seen])
        close(loo.log_density[i, seen], density[seen])
    assert loo.log_density[2, 0].isnan() == (num_outputs == 2)
    assert not loo.mean.requires_grad
    # Scores are of these predictions.
    z, scores = (Y - loo.mean) / loo.variance.sqrt(), loo.score(0.5)
    torch.testing.assert_close(loo.residuals, z, equal_nan=True)
    torch.testing.assert_close(scores.rmse, (Y - loo.mean).square().nanmean(0).sqrt())
    torch.testing.assert_close(scores.nlpd, -loo.log_density.nanmean(0))
    inside = (z.abs() < 0.6744897501960817).double().where(~z.isnan(), torch.nan)
    torch.testing.assert_close(scores.coverage, inside.nanmean(0))


def crude_of(num_outputs):
    return lambda X: crude(X)[..., :num_outputs]


def test_draws_have_the_weights_of_those_without_the_point(data):
    X, Y = data(n=7)
    model = drawn(CKA(X, Y, 0.5, physics=crude_of(1)), 200)
    loo = leave_one_out(model)
    means, variances = model.left_out()
    normal = torch.distributions.Normal(means, variances.sqrt())
    weight = (-normal.log_prob(Y)).softmax(0).clamp_max(200**-0.5)
    weight = weight / weight.sum(0)
    mean = (weight * means).sum(0).detach()
    density = (weight * normal.log_prob(Y).exp()).sum(0).log().detach()
    plain = model.left_out()
    torch.testing.assert_close(loo.mean, mean, rtol=0, atol=0.03)
    torch.testing.assert_close(loo.log_density, density, rtol=0, atol=0.1)
    assert (plain.prediction.mean - mean).abs().max() > 0.06
    assert (plain.log_density(Y) - density).abs().max() > 0.2


def test_a_mixture_is_that_of_its_models(data):
    X, Y = data(num_outputs=2)
    models = {"a": drawn(CKA(X, Y, 0.5, physics=crude)), "b": drawn(ZeroMeanGP(X, Y, 0.5))}
    loo = leave_one_out(StackedGP(models, [[0.25, 1.0], [0.75, 0.0]]))
    a, b = (leave_one_out(model) for model in models.values())
    density = (0.25 * a.log_density.exp() + 0.75 * b.log_density.exp())[:, 0].log()
    torch.testing.assert_close(loo.log_density[:, 0], density, rtol=0, atol=0.05)
    mean = 0.25 * a.mean[:, 0] + 0.75 * b.mean[:, 0]
    torch.testing.assert_close(loo.mean[:, 0], mean, rtol=0, atol=0.03)
    torch.testing.assert_close(loo.log_density[:, 1], a.log_density[:, 1])


def test_with_a_link_it_is_of_the_users_numbers(data):
    X, Y = data()
    Y, f_p = Y.exp(), lambda X: crude(X)[..., :1].exp()
    loo = leave_one_out(drawn(LinkedCKA(X, Y, physics=f_p), 1))
    plain = leave_one_out(drawn(CKA(X, Y.log(), physics=lambda X: f_p(X).log()), 1))
    torch.testing.assert_close(loo.mean.log(), plain.mean)
    torch.testing.assert_close(loo.pit, plain.pit)
    torch.testing.assert_close(loo.log_density, plain.log_density - Y.log())


@pytest.mark.slow
def test_it_is_about_fits_without_each_point():
    X, elpd = line(15), 0.0
    model = PhysicsMeanGP(X, 3 * wave(X) + X + 0.1 * normal(15, 1), physics=wave)
    fit(model)
    for i in range(15):
        part = model.subset_rows(torch.arange(15) != i)
        fit(part)
        elpd += part.marginals(X[[i]], True).log_density(model.data.Y[[i]]).item()
    assert leave_one_out(model).log_density.sum().item() == pytest.approx(elpd, abs=1)
    assert math.isfinite(elpd)
