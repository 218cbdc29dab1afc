"""The paper's models and one more, in two protocols: the paper's training, and this library's."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal

import torch
from botorch.models import SingleTaskGP
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor

from gpadjust import AR1, CKA, RRA, BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit
from gpadjust.models import PaperRRA
from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.common.experiment import Record
from paper.forrester import Forrester, Settings
from paper.forrester.problem import CRUDE, GRID, Reading, observations, truth

Protocol = Literal["paper", "gpadjust", "closed form"]

NAMES = ("Zero-mean GP", "Phy-mean GP", "GP-bias", "GP-scale", "AR1", "CKA", "RRA")
LEARNT = "CKA, learnt means"  # not in the paper
MODELS = (*NAMES, LEARNT)


@cache
def _prepare(settings: Settings) -> None:
    """Set a process up: one fit that is not timed."""
    trained("CKA", "gpadjust", "B", *observations(0, settings.observations), settings)


def run(
    experiment: Forrester, reading: Reading, protocol: Protocol, seed: int, *, unfinished: Path
) -> Record:
    """Train all models of a protocol on a data set.

    Returns:
        For each model, and for f_p, its name, its scores and the seconds that it took.
    """
    settings = experiment.settings
    _prepare(settings)
    X, Y = observations(seed, settings.observations)
    y = truth(GRID)
    error = rmse(CRUDE[reading](GRID), y).item()
    found: dict[str, list[Any]] = {"model": ["f_p"], "rmse": [error]}
    found |= {name: [None] for name in ("nlpd", "crps", "coverage", "seconds")}
    for name, model, seconds in _models(reading, protocol, X, Y, settings):
        with torch.no_grad():
            posterior = model.posterior(GRID, observation_noise=True)
            mean, variance = posterior.mean, posterior.variance
        row = {
            "model": name,
            "rmse": rmse(mean, y).item(),
            "nlpd": nlpd(mean, variance, y).item(),
            "crps": crps(mean, variance, y).item(),
            "coverage": coverage(mean, variance, y).item(),
            "seconds": seconds,
        }
        for column, value in row.items():
            found[column].append(value)
    return found


def _models(
    reading: Reading, protocol: Protocol, X: Tensor, Y: Tensor, settings: Settings
) -> Iterator[tuple[str, SingleTaskGP, float]]:
    """Each model of a protocol, its name first, and the seconds that it took."""
    if protocol == "closed form":
        for lengthscale in settings.lengthscales:
            for ridge in settings.ridges:
                model = closed_form(reading, X, Y, lengthscale, ridge)
                yield f"{lengthscale:g}, {ridge:g}", model, 0.0
        return
    for name in MODELS:
        start = time.perf_counter()
        model = trained(name, protocol, reading, X, Y, settings)
        yield name, model, time.perf_counter() - start


def closed_form(
    reading: Reading, X: Tensor, Y: Tensor, lengthscale: float, ridge: float
) -> PaperRRA:
    """RRA as printed, with nothing learnt."""
    model = PaperRRA(X, Y, torch.full_like(Y, ridge), physics=CRUDE[reading])
    for term in model.terms:
        kernel: Any = term.kernel
        kernel.base_kernel.lengthscale = lengthscale
    return model.eval()


def trained(
    name: str, protocol: Protocol, reading: Reading, X: Tensor, Y: Tensor, settings: Settings
) -> SingleTaskGP:
    """Build one of the models and train it by a protocol."""
    with warnings.catch_warnings():
        # f_p crosses zero, and GP-scale is here to show what that does to it.
        warnings.filterwarnings("ignore", message=".*nearly zero.*")
        if protocol == "gpadjust":
            model = _build(name, protocol, reading, X, Y)
            fit(model, "map")
        else:
            model = _build(name, protocol, reading, X, Y, **_plain(name, Y, settings.noise))
            if name == "RRA":
                for term in model.terms:
                    term.kernel.base_kernel.lengthscale = RBFKernel().lengthscale.detach().double()
            _adam(model, settings)
    return model


def _build(
    name: str, protocol: Protocol, reading: Reading, X: Tensor, Y: Tensor, **options: Any
) -> SingleTaskGP:
    physics = CRUDE[reading]
    if name == "Zero-mean GP":
        return ZeroMeanGP(X, Y, **options)
    if name == "AR1":
        return AR1(X, Y, physics=physics, low_X=GRID, **options)
    if name == LEARNT:
        options |= {"rho_mean": "learn", "delta_mean": "learn"}
    kinds = {
        "Phy-mean GP": PhysicsMeanGP,
        "GP-bias": BiasGP,
        "GP-scale": ScaleGP,
        "CKA": CKA,
        "RRA": PaperRRA if protocol == "paper" else RRA,
        LEARNT: CKA,
    }
    if kinds[name] in (CKA, RRA):
        options["center"] = 0.0  # the literal model
    return kinds[name](X, Y, physics=physics, **options)


def _plain(name: str, Y: Tensor, noise: float) -> dict[str, Any]:
    """Options that make a model as plain GPyTorch does: its initial values, y as it is."""
    options: dict[str, Any] = {"train_Yvar": torch.full_like(Y, noise)}
    if name == "RRA":
        return options
    options["outcome_transform"] = None
    kernels = {
        "AR1": ("low_covar_module", "delta_covar_module"),
        "CKA": ("rho_covar_module", "delta_covar_module"),
        LEARNT: ("rho_covar_module", "delta_covar_module"),
    }
    for argument in kernels.get(name, ("covar_module",)):
        options[argument] = ScaleKernel(RBFKernel())
    return options


def _adam(model: SingleTaskGP, settings: Settings) -> None:
    """Maximise the marginal likelihood by a fixed number of steps."""
    mll = ExactMarginalLogLikelihood(model.likelihood, model).train()
    learnable = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(learnable, lr=settings.rate)
    for _ in range(settings.steps):
        optimizer.zero_grad()
        loss = -mll(model(*model.train_inputs), model.train_targets, *model.train_inputs)
        loss.backward()
        optimizer.step()
    model.eval()
