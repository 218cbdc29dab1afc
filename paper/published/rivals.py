"""Other people's models with a formula as one more input, and scores of theirs and ours."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.posteriors import Posterior
from botorch.posteriors.gpytorch import GPyTorchPosterior
from gpytorch.distributions import MultivariateNormal
from gpytorch.mlls import ExactMarginalLogLikelihood
from linear_operator.operators import DiagLinearOperator
from torch import Tensor, nn

from gpadjust import CalibratedPhysics, fit
from gpadjust.physics import Physics
from gpadjust.validation import score
from paper.common.learners import LEARNERS
from paper.machines.networks import Networks

Predict = Callable[[Tensor], Posterior]
_FOLDS = 5
_STEPS = 2000  # of the deep ensemble's optimiser
_LEAST_VARIANCE = 1e-300  # SMT's may round to zero, which has no density
_TREES = {"n_estimators": (100, 400), "max_depth": (2, 4, 6)}


def fitted_formula(X: Tensor, Y: Tensor, physics: Physics) -> CalibratedPhysics:
    """Return the formula with its most likely parameters, nothing else."""
    model = CalibratedPhysics(X, Y, physics=physics)
    fit(model, "map")
    return model


def single_task(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit BoTorch's Gaussian process by its defaults, without the formula."""
    torch.manual_seed(seed)
    d = X.shape[-1]
    model = SingleTaskGP(X, Y, input_transform=Normalize(d), outcome_transform=Standardize(1))
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    return lambda test: model.posterior(test, observation_noise=True)


def single_task_feature(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit the same with the fitted formula as one more input."""
    add = _with_feature(X, Y, physics)
    predict = single_task(add(X), Y, physics, seed=seed)
    return lambda test: predict(add(test))


def boosting(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit boosted trees with the fitted formula as one more input.

    Number and depth of the trees are those of the least error in five folds of the training rows,
    whose root mean square is the standard deviation.
    """
    from sklearn.ensemble import GradientBoostingRegressor
    from sklearn.model_selection import KFold, cross_val_predict

    add = _with_feature(X, Y, physics)
    columns, target = add(X).numpy(), Y.squeeze(-1).numpy()
    folds = KFold(_FOLDS, shuffle=True, random_state=seed)
    best, least = None, np.inf
    for values in product(*_TREES.values()):
        options: dict[str, Any] = dict(zip(_TREES, values, strict=True))
        trees = GradientBoostingRegressor(
            learning_rate=0.05, subsample=0.5, random_state=seed, **options
        )
        error = np.square(cross_val_predict(trees, columns, target, cv=folds) - target).mean()
        if error < least:
            best, least = trees, error
    assert best is not None
    best.fit(columns, target)

    def predict(test: Tensor) -> Posterior:
        mean = torch.from_numpy(best.predict(add(test).numpy()))
        return gaussian(mean, torch.full_like(mean, float(least)))

    return predict


def ensemble(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit a deep ensemble to the residual of the fitted formula.

    Five networks of two layers of 50, each of a mean and a variance, trained by the likelihood from
    weights of their own (Lakshminarayanan et al. 2017), and the moments of their mixture.
    """
    formula, units = fitted_formula(X, Y, physics), (X.mean(0), X.std(0).clamp_min(1e-9))
    with torch.no_grad():
        rest = Y - formula.predict(X).mean
    shift, scale = rest.mean(0), rest.std(0)
    target = (rest - shift) / scale
    torch.manual_seed(seed)
    networks = Networks(5, X.shape[-1], 50, 2)
    optimizer = torch.optim.AdamW(networks.parameters(), lr=5e-3, weight_decay=0.1)

    def moments(points: Tensor) -> tuple[Tensor, Tensor]:
        out = networks(((points - units[0]) / units[1]).expand(5, -1, -1))
        return out[..., :1], nn.functional.softplus(out[..., 1:]) + 1e-6

    for _ in range(_STEPS):
        mean, variance = moments(X)
        optimizer.zero_grad()
        nn.functional.gaussian_nll_loss(mean, target.expand_as(mean), variance).backward()
        optimizer.step()

    def predict(test: Tensor) -> Posterior:
        with torch.no_grad():
            mean, variance = moments(test)
            spread = variance.mean(0) + mean.var(0, correction=0)
            middle = formula.predict(test).mean + shift + scale * mean.mean(0)
        return gaussian(middle.squeeze(-1), (scale.square() * spread).squeeze(-1))

    return predict


def smt(low_X: Tensor, low_Y: Tensor, X: Tensor, Y: Tensor) -> Predict:
    """Train SMT's MFK with its defaults; its predictions have no observation noise."""
    from smt.applications import MFK  # slow to import

    model = MFK(print_global=False)
    model.set_training_values(low_X.numpy(), low_Y.numpy(), name=0)
    model.set_training_values(X.numpy(), Y.numpy())
    model.train()

    def predict(test: Tensor) -> Posterior:
        mean, variance = (
            torch.as_tensor(moment(test.numpy())).squeeze(-1)
            for moment in (model.predict_values, model.predict_variances)
        )
        return gaussian(mean, variance.clamp_min(_LEAST_VARIANCE))

    return predict


def mfk(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit SMT's MFK by its defaults, with the fitted formula as the low level.

    It is evaluated at the observed inputs and as many more, whose columns are those of observed
    rows in an order of their own.
    """
    formula = fitted_formula(X, Y, physics)
    draw = np.random.default_rng(seed)
    more = np.stack([draw.permutation(column) for column in X.numpy().T], -1)
    low = torch.cat([X, torch.from_numpy(more)])
    with torch.no_grad():
        return smt(low, formula.predict(low).mean, X, Y)


RIVALS: dict[str, Callable[..., Predict]] = {
    "single": single_task,
    "feature": single_task_feature,
    "boosting": boosting,
    "ensemble": ensemble,
    "mfk": mfk,
}


def ours(learner: str, **options: Any) -> Callable[..., Predict]:
    """Return a call that fits one of our learners by the default; it predicts observations."""

    def fitted(X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
        model = LEARNERS[learner].make(X, Y, physics=physics, **options)
        fit(model, seed=seed)
        return partial(model.posterior, observation_noise=True)

    return fitted


def judged(
    fitted: Callable[..., Predict],
    data: Sequence[Tensor],
    physics: Physics,
    *,
    seed: int,
    is_centred: bool,
) -> dict[str, float]:
    """Fit a method to training rows, less their mean if asked for; return scores on test rows."""
    X, Y, test_X, test_Y = data
    shift = Y.mean() if is_centred else torch.zeros(())
    begin = time.perf_counter()
    predict = fitted(X, Y - shift, physics, seed=seed)
    seconds = time.perf_counter() - begin
    with torch.no_grad():
        posterior = predict(test_X)
        scores = score(posterior, test_Y - shift)
    error = posterior.mean.reshape(-1, 1) - (test_Y - shift)
    return {
        "mae": error.abs().mean().item(),
        "rmse": scores.rmse.item(),
        "density": -scores.nlpd.item(),
        "coverage": scores.coverage.item(),
        "seconds": seconds,
    }


def gaussian(mean: Tensor, variance: Tensor) -> GPyTorchPosterior:
    """Return independent predictions ``n`` as BoTorch's posterior."""
    return GPyTorchPosterior(MultivariateNormal(mean, DiagLinearOperator(variance)))


def _with_feature(X: Tensor, Y: Tensor, physics: Physics) -> Callable[[Tensor], Tensor]:
    formula = fitted_formula(X, Y, physics)

    def add(points: Tensor) -> Tensor:
        with torch.no_grad():
            return torch.cat([points, formula.predict(points).mean], -1)

    return add
