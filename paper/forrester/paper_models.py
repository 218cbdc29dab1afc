"""The paper's models as it trains them: plain GPyTorch, and RRA as printed."""

from __future__ import annotations

from typing import Any

import torch
from botorch.models import SingleTaskGP
from botorch.models.model import Model
from botorch.settings import validate_input_scaling
from gpytorch.kernels import Kernel, RBFKernel, RFFKernel, ScaleKernel
from gpytorch.means import ZeroMean
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor
from torch.nn import functional

from gpadjust.gpytorch import PhysicsMean, PhysicsScaledKernel
from paper.forrester import Forrester
from paper.forrester.paper_rra import PaperRRA
from paper.forrester.problem import CRUDE, POINTS

_EXACT = 1e-5  # the noise of the low level of AR1, a share of its variance


def closed_form(
    reading: str, X: Tensor, Y: Tensor, lengthscales: tuple[float, float], ridge: float
) -> PaperRRA:
    """Return RRA as printed, with nothing learnt, by the lengthscales of rho and delta."""
    model = PaperRRA(X, Y, torch.full_like(Y, ridge), physics=CRUDE[reading])
    names = ("rho.kernel.lengthscale", "delta.kernel.lengthscale")
    values = {name: X.new_tensor(each) for name, each in zip(names, lengthscales, strict=True)}
    model.set_draws(model.table.with_values(model.u.detach(), values))
    return model


def by_gpytorch(name: str, reading: str, X: Tensor, Y: Tensor, settings: Forrester) -> Model:
    """Train a model of plain GPyTorch: its initial values, y as it is."""
    one, other = (ScaleKernel(RBFKernel()) for _ in range(2))
    if name == "RRA":
        one, other = (RFFKernel(64, num_dims=1) for _ in range(2))
        printed: Any = closed_form(reading, X, Y, (1.0, 1.0), settings.noise)
        for kernel, term in zip((one, other), printed.terms, strict=True):
            kernel.randn_weights = term.kernel.frequencies
    physics, variances = CRUDE[reading], torch.full_like(Y, settings.noise)
    scaled = PhysicsScaledKernel(one, physics)
    kernels = {"GP-scale": scaled, "CKA": scaled + other, "RRA": scaled + other}
    options = {
        "covar_module": kernels.get(name, one),
        "mean_module": ZeroMean() if name in ("Zero-mean GP", "RRA") else PhysicsMean(physics),
        "outcome_transform": None,
    }
    if name == "AR1":
        options |= {"covar_module": _Levels(one, other), "mean_module": ZeroMean()}
        low, high = (functional.pad(x, (0, 1), value=v) for x, v in ((POINTS, 0.0), (X, 1.0)))
        low_Y = physics(POINTS)
        X, Y = torch.cat([low, high]), torch.cat([low_Y, Y])
        variances = torch.cat([(_EXACT * low_Y.var()).expand_as(low_Y), variances])
    with validate_input_scaling(False):
        model = (_AR1 if name == "AR1" else SingleTaskGP)(X, Y, variances, **options)
    mll = ExactMarginalLogLikelihood(model.likelihood, model.double()).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.rate)
    for _ in range(settings.steps):
        optimizer.zero_grad()
        loss = -mll(model(*model.train_inputs), model.train_targets)
        loss.backward()
        optimizer.step()
    if name == "RRA":
        lengthscales = (one.lengthscale.item(), other.lengthscale.item())
        return closed_form(reading, X, Y, lengthscales, settings.noise)
    return model.eval()


class _Levels(Kernel):
    """The kernel of AR1 of inputs with their level, 0 or 1, as last column."""

    def __init__(self, low: Kernel, delta: Kernel) -> None:
        super().__init__()
        self.low, self.delta = low, delta
        self.rho = torch.nn.Parameter(torch.ones(()))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **_: Any) -> Tensor:
        (x1, level1), (x2, level2) = ((x[..., :-1], x[..., -1:]) for x in (x1, x2))
        K: Tensor = self.rho**level1 * self.low(x1, x2).to_dense() * (self.rho**level2).mT
        K = K + level1 * self.delta(x1, x2).to_dense() * level2.mT
        return K.diagonal(dim1=-1, dim2=-2) if diag else K


class _AR1(SingleTaskGP):
    """AR1 of plain GPyTorch, which predicts the level 1."""

    def posterior(self, X: Tensor, *args: Any, **options: Any) -> Any:
        return super().posterior(functional.pad(X, (0, 1), value=1.0), *args, **options)
