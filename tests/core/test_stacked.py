"""Mixtures of several models."""

import torch
from botorch.acquisition import LogExpectedImprovement, qLogExpectedImprovement
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.sampling import SobolQMCNormalSampler

from gpadjust.core import PhysicsMeanGP, StackedGP, ZeroMeanGP
from gpadjust.core.gaussian import Marginals
from tests.systems import line, normal, same, uniform

X, Z = uniform(9, 1), line(4)


def physics(X):
    return torch.cat([X.sin(), X.cos()], -1)


def parts(m=1, draws=(4, 8), Y=None):
    """Return two models of the same data, with some draws."""
    Y = torch.cat([(3 * X).sin(), X.exp()], -1)[:, :m] if Y is None else Y
    mean, zero = PhysicsMeanGP(X, Y, physics=lambda X: physics(X)[:, :m]), ZeroMeanGP(X, Y)
    for model, number in zip((mean, zero), draws, strict=True):
        model.set_draws(0.3 * normal(number, *model.u.shape[1:], seed=number))
    return {"mean": mean, "zero": zero}


def test_it_is_the_mixture_by_hand():
    models = parts()
    stacked = StackedGP(models, {"zero": [0.75], "mean": [0.25]}, 32)  # 8 and 24 components
    assert stacked.weights == {"mean": [0.25], "zero": [0.75]}
    pairs = zip(models["mean"].components(Z), models["zero"].components(Z), strict=True)
    components = [
        torch.cat([a.repeat_interleave(2, 0), b.repeat_interleave(3, 0)]) for a, b in pairs
    ]
    same(stacked.components(Z), components)
    mean = 0.25 * models["mean"].predict(Z).mean + 0.75 * models["zero"].predict(Z).mean
    torch.testing.assert_close(stacked.predict(Z).mean, mean)
    torch.testing.assert_close(stacked.predict(Z.numpy()).mean, mean.numpy())
    marginals = Marginals(*components)
    same(stacked.interval(Z, 0.9), [marginals.quantile(level) for level in (0.05, 0.95)])
    posterior = stacked.posterior(Z.expand(3, 4, 1))
    assert posterior.mean.shape == (3, 4, 1)
    same((posterior.mean[0], posterior.variance[1]), stacked.predict(Z))
    noisy = stacked.posterior(Z, observation_noise=True).variance
    torch.testing.assert_close(noisy, stacked.predict(Z, True).variance)


def test_one_model_is_itself():
    models = parts(2)
    for weights in ([1.0, 0.0], [[1.0, 1.0], [0.0, 0.0]]):
        stacked = StackedGP(models, weights, 8)
        assert stacked.names == ["mean"]
        torch.testing.assert_close(stacked.predict(Z), models["mean"].predict(Z))
    one, other = (m.posterior(Z) for m in (StackedGP(models, [1.0, 0.0], 4), models["mean"]))
    torch.testing.assert_close(one.mvn.covariance_matrix, other.mvn.covariance_matrix)


def test_outputs_have_weights_of_their_own():
    models = parts(2)
    weights = torch.tensor([[0.25, 1.0], [0.75, 0.0]], dtype=torch.float64)
    stacked = StackedGP(models, weights, 16)
    assert stacked.weights == {"mean": [0.25, 1.0], "zero": [0.75, 0.0]}
    mean = stacked.predict(Z).mean
    for j in range(2):
        alone = StackedGP(models, weights[:, [j]], 16).predict(Z).mean
        torch.testing.assert_close(mean[:, j], alone[:, j])
        subset = stacked.subset_output([j - 2])
        torch.testing.assert_close(subset.predict(Z).mean, mean[:, [j]])
        torch.testing.assert_close(stacked.posterior(Z, [j]).mean, mean[:, [j]])


def test_outputs_are_independent_or_mixed_as_wholes():
    models = parts(2, (1, 1))
    models["zero"].set_draws(models["zero"].u.detach() + 3.0)  # another mean
    whole, apart = (StackedGP(models, w).posterior(Z[:1]) for w in ([0.5, 0.5], [[0.5] * 2] * 2))
    covariance = [each.mvn.covariance_matrix[0, 1] for each in (whole, apart)]
    step = models["mean"].predict(Z[:1]).mean - models["zero"].predict(Z[:1]).mean
    torch.testing.assert_close(covariance[0], step.prod() / 4)
    assert abs(covariance[1]) < 0.05 * abs(covariance[0])
    torch.testing.assert_close(whole.variance, apart.variance)


def test_conditioning_and_fantasies():
    models = parts()
    stacked = StackedGP(models, [0.5, 0.5], 16)
    later = {n: model.condition_on_observations(Z, Z.cos()) for n, model in models.items()}
    expected = StackedGP(later, [0.5, 0.5], 16).predict(X)
    same(stacked.condition_on_observations(Z, Z.cos()).predict(X), expected)
    fantasies = stacked.fantasize(Z[:2].expand(3, 2, 1), SobolQMCNormalSampler(torch.Size([5])))
    assert fantasies.batch_shape == (5, 3)
    assert fantasies.posterior(Z).mean.shape == (5, 3, 4, 1)
    assert fantasies.predict(Z[:2]).mean.std(0).min() > 0


def test_acquisition_functions():
    stacked = StackedGP(parts(2), [[0.5, 0.3], [0.5, 0.7]], 8)
    w = torch.tensor([1.0, -2.0], dtype=torch.float64)
    mean = stacked.posterior(Z, posterior_transform=ScalarizedPosteriorTransform(w)).mean
    torch.testing.assert_close(mean, stacked.predict(Z).mean @ w.unsqueeze(-1))
    for acquisition in (LogExpectedImprovement, qLogExpectedImprovement):
        points = Z.unsqueeze(1).clone().requires_grad_()
        value = acquisition(stacked.subset_output([0]), 0.5)(points)
        assert value.shape == (4,)
        (slope,) = torch.autograd.grad(value.sum(), points)
        assert slope.isfinite().all()


def test_weights_by_left_out():
    Y = torch.cat([3 * X.sin() + 0.1, X.cos() + 0.003 * (40 * X).sin()], -1)
    Y[3, 1] = torch.nan
    models = parts(2, Y=Y)
    stacked = StackedGP.by_left_out(models, 200)
    weights = torch.tensor([*stacked.weights.values()], dtype=torch.float64)

    def score(w):  # of each output
        total = 0.0
        for share, model in zip(w, models.values(), strict=True):
            mean, variance = model.left_out()
            density = torch.distributions.Normal(mean, variance.sqrt(), False).log_prob(Y).exp()
            total = total + share * density.mean(0)
        return total.log().nanmean(0)

    grid = torch.linspace(0, 1, 201, dtype=torch.float64)
    best = torch.stack([score(torch.stack([w, 1 - w])) for w in grid]).amax(0)
    assert (score(weights) > best - 1e-3).all()
    assert abs(weights[0, 0] - weights[0, 1]) > 0.1
    assert 0 < weights[0, 1] < 1


def test_summary():
    stacked = StackedGP(parts(2), [[0.25, 0.5], [0.75, 0.5]], 8)
    text = stacked.summary()
    assert text.startswith("StackedGP(8 components of mean, zero)\n25%, 50% of mean: ")
    assert repr(stacked) == text.splitlines()[0]
