"""The methods that are compared, each with its defaults, and their scores."""

from __future__ import annotations

import math
import time
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.posteriors import GPyTorchPosterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from gpytorch.distributions import MultivariateNormal
from linear_operator.operators import DiagLinearOperator
from torch import Tensor

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.inference import SamplingWarning
from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.common.experiment import Record
from paper.multifidelity import Method, Multifidelity, Settings
from paper.multifidelity.problem import Pair, low_inputs, observations, pair

_CHUNK = 50  # points predicted jointly, for the sake of memory
_LEAST_VARIANCE = 1e-300  # SMT's may round to zero, which has no density


class SMTModel:
    """SMT's MFK with its defaults, trained, with BoTorch's way to ask for predictions.

    Args:
        low_X: Inputs of the low level, ``n_1 x d``, among them those of the high one.
        low_Y: Its values, ``n_1 x 1``.
        train_X: Inputs of the high level, ``n x d``.
        train_Y: Its values, ``n x 1``.
    """

    def __init__(self, low_X: Tensor, low_Y: Tensor, train_X: Tensor, train_Y: Tensor) -> None:
        from smt.applications import MFK  # slow to import

        self.mfk = MFK(print_global=False)
        self.mfk.set_training_values(low_X.numpy(), low_Y.numpy(), name=0)
        self.mfk.set_training_values(train_X.numpy(), train_Y.numpy())
        self.mfk.train()

    def posterior(self, X: Tensor, observation_noise: bool = False) -> GPyTorchPosterior:
        """Independent predictions at ``q x d`` inputs; the model has no observation noise."""
        mean = torch.as_tensor(self.mfk.predict_values(X.numpy())).squeeze(-1)
        variance = torch.as_tensor(self.mfk.predict_variances(X.numpy())).squeeze(-1)
        covariance = DiagLinearOperator(variance.clamp_min(_LEAST_VARIANCE))
        return GPyTorchPosterior(MultivariateNormal(mean, covariance))


@cache
def _prepare(method: Method, settings: Settings) -> None:
    """Set a process up: one fit of the method that is not timed."""
    forrester = pair("forrester")
    trained(method, forrester, *observations(forrester, 5, 0), settings.num_low, 0)


def run(
    experiment: Multifidelity,
    name: str,
    per_input: int,
    method: Method,
    seed: int,
    *,
    unfinished: Path,
) -> Record:
    """Train a method on a data set; return its scores, in units of the truth's sd."""
    settings = experiment.settings
    _prepare(method, settings)
    problem = pair(name)
    X, Y = observations(problem, per_input * problem.d, seed)
    test_X = problem.sobol(settings.num_test, seed=0)
    test_Y = problem.truth(test_X)
    start = time.perf_counter()
    model = trained(method, problem, X, Y, settings.num_low, seed)
    seconds = time.perf_counter() - start
    mean, variance, mixture_dim = _predictions(model, test_X)
    prediction = (mean, variance, test_Y)
    sd = test_Y.std().item()
    return {
        "N": len(X),
        "nrmse": rmse(mean, test_Y, mixture_dim=mixture_dim).item() / sd,
        "nlpd": nlpd(*prediction, mixture_dim=mixture_dim).item() - math.log(sd),
        "crps": crps(*prediction, mixture_dim=mixture_dim).item() / sd,
        "coverage": coverage(*prediction, mixture_dim=mixture_dim).item(),
        "seconds": seconds,
    }


def _predictions(model: Any, X: Tensor) -> tuple[Tensor, Tensor, int | None]:
    """Means and variances of new observations, and the dimension of a mixture's components."""
    with torch.no_grad():
        parts = [model.posterior(part, observation_noise=True) for part in X.split(_CHUNK)]
    mean, variance = (
        torch.cat([getattr(part, name) for part in parts], dim=-2) for name in ("mean", "variance")
    )
    is_mixture = isinstance(parts[0], GaussianMixturePosterior)
    return mean, variance, MCMC_DIM if is_mixture else None


def trained(method: Method, pair: Pair, X: Tensor, Y: Tensor, num_low: int, seed: int) -> Any:
    """Build and train a model by one of the methods.

    Args:
        method: Its name.
        pair: The truth and the physics.
        X: Inputs of the observations, ``n x d``.
        Y: The observations, ``n x 1``.
        num_low: Samples of the low level per input, for the methods that need them.
        seed: Of these samples.

    Returns:
        The model.
    """
    with warnings.catch_warnings():
        # A fit that has not converged is shown by its scores.
        warnings.filterwarnings("ignore", category=OptimizationWarning)
        warnings.filterwarnings("ignore", category=SamplingWarning)
        if method == "SMT MFK":
            low_X = low_inputs(pair, X, num_low * pair.d, seed)
            return SMTModel(low_X, pair.physics()(low_X), X, Y)
        model = _built(method, pair, X, Y, num_low, seed)
        fit(model, "bayes" if method == "CKA Bayes" else "map")
        return model


def _built(method: Method, pair: Pair, X: Tensor, Y: Tensor, num_low: int, seed: int) -> Any:
    """One of our own models."""
    if method == "GP":
        return ZeroMeanGP(X, Y)
    if method == "AR1":
        low_X = low_inputs(pair, X, num_low * pair.d, seed)
        return AR1(X, Y, physics=pair.physics(), low_X=low_X)
    if method == "Phy":
        return PhysicsMeanGP(X, Y, physics=pair.physics())
    if method == "CKA Bayes":
        return CKA(X, Y, physics=pair.physics())
    return (CKA if method == "CKA" else RRA)(X, Y, physics=pair.physics(), center=0.0)
