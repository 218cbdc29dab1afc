"""The paper's models and one more, in two protocols: the paper's training, and this library's."""

from __future__ import annotations

import warnings
from typing import Any, Literal

import torch
from botorch.models import SingleTaskGP
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor

from gpadjust import AR1, CKA, RRA, BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit
from gpadjust.models import PaperRRA
from paper.forrester.problem import CRUDE, GRID, Reading

Protocol = Literal["paper", "gpadjust"]

NAMES = ("Zero-mean GP", "Phy-mean GP", "GP-bias", "GP-scale", "AR1", "CKA", "RRA")
LEARNT = "CKA, learnt means"  # not in the paper
MODELS = (*NAMES, LEARNT)
NOISE = 0.01  # the fixed noise variance of the paper's protocol
STEPS = 50  # of Adam, in the paper's protocol


def trained(name: str, protocol: Protocol, reading: Reading, X: Tensor, Y: Tensor) -> SingleTaskGP:
    """Build one of the models and train it by a protocol."""
    with warnings.catch_warnings():
        # f_p crosses zero, and GP-scale is here to show what that does to it.
        warnings.filterwarnings("ignore", message=".*nearly zero.*")
        if protocol == "gpadjust":
            model = _build(name, protocol, reading, X, Y)
            fit(model)
        else:
            model = _build(name, protocol, reading, X, Y, **_plain(name, Y))
            if name == "RRA":
                for term in model.terms:
                    term.kernel.base_kernel.lengthscale = RBFKernel().lengthscale.detach().double()
            _adam(model)
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
    return kinds[name](X, Y, physics=physics, **options)


def _plain(name: str, Y: Tensor) -> dict[str, Any]:
    """Options that make a model as plain GPyTorch does: its initial values, y as it is."""
    options: dict[str, Any] = {"train_Yvar": torch.full_like(Y, NOISE)}
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


def _adam(model: SingleTaskGP) -> None:
    """Maximise the marginal likelihood by a fixed number of steps."""
    mll = ExactMarginalLogLikelihood(model.likelihood, model).train()
    learnable = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(learnable, lr=0.1)
    for _ in range(STEPS):
        optimizer.zero_grad()
        loss = -mll(model(*model.train_inputs), model.train_targets, *model.train_inputs)
        loss.backward()
        optimizer.step()
    model.eval()
