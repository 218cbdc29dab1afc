"""Weakly informative priors of the hyper-parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.priors import LogNormalPrior, NormalPrior
from torch import Tensor

from gpadjust.gp import PhysicsScaledKernel
from gpadjust.models.ar1 import AR1Kernel
from gpadjust.models.parameter_scales import kind, parameter_scales

_LENGTHSCALE = math.sqrt(3)  # standard deviations of the logarithms
_OUTPUTSCALE = {"rho": 1.5, "delta": 5.0}
_NOISE = 4.0
_RHO = 0.25  # the typical variance of rho
_NUGGET = 1e-4  # the typical noise, of the mean square of the residual


def register_priors(model: BatchedMultiOutputGPyTorchModel) -> None:
    r"""Register a prior on each learnable hyper-parameter that has none.

    With the inputs in units of their range at the training points, their number d, and
    :math:`v` the mean square of the targets' residual from the prior mean:

    .. math::
        \log \ell &\sim N(\sqrt 2 + \tfrac12 \log d - 1, \; \sqrt 3^2) \\
        \log s_\delta &\sim N(\log v, \; 5^2), \quad
        \log s_\rho \sim N(\log \tfrac14, \; 1.5^2) \\
        \log \sigma^2 &\sim N(\log(10^{-4} v), \; 4^2)

    The lengthscales grow with the dimension after Hvarfner et al. (2024); the prior of
    :math:`s_\delta` is all but flat, so that near-polynomial functions, of long lengthscales and
    large variance, are not ruled out. The constant rho of an
    :class:`~gpadjust.AR1` has N(1, 1). Give a kernel or likelihood priors of your own
    (``lengthscale_prior=...``, or ``register_prior``) to replace them.

    Args:
        model: A model of this library. They are made for sampling: :func:`gpadjust.fit` with
            ``"hmc"`` or ``"nuts"``, and GPyTorch's ``pyro_sample_from_prior``. The mode of a wide
            log-normal density lies far below its median, so a maximum a posteriori fit with them
            finds too little noise.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.inference import register_priors
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, X.sin(), physics=lambda X: X)
        >>> register_priors(model)
        >>> {name.rsplit(".", 1)[-1] for name, *_ in model.named_priors()} == {
        ...     "lengthscale_prior", "outputscale_prior", "noise_prior"
        ... }
        True
    """
    of_rho = {
        f"covar_module.{name}."
        for name, module in model.covar_module.named_modules()
        if isinstance(module, PhysicsScaledKernel)
    }
    if isinstance(model.covar_module, PhysicsScaledKernel):
        of_rho = {"covar_module."}
    for name, size in parameter_scales(model).items():
        module = model.get_submodule(name.rpartition(".")[0])
        which = kind(name)
        if which == "lengthscale":
            d = size.shape[-1]
            shift = math.sqrt(2) + 0.5 * math.log(d) - 1
            _register(module, which, size.log() + shift, _LENGTHSCALE)
        elif which == "outputscale":
            if any(name.startswith(prefix) for prefix in of_rho):
                _register(module, which, torch.full_like(size, _RHO).log(), _OUTPUTSCALE["rho"])
            else:
                _register(module, which, size.log(), _OUTPUTSCALE["delta"])
        elif which == "noise":
            _register(module, which, size.log() + math.log(_NUGGET), _NOISE)
    kernel = model.covar_module
    if isinstance(kernel, AR1Kernel) and "rho_prior" not in kernel._priors:
        one = torch.ones_like(kernel.rho)
        kernel.register_prior("rho_prior", NormalPrior(one, one), "rho")


def _register(module: Any, name: str, location: Tensor, scale: float) -> None:
    """Register a log-normal prior on a learnable parameter of a kernel or likelihood."""
    has_prior = f"{name}_prior" in module._priors
    if has_prior or not getattr(module, f"raw_{name}").requires_grad:
        return
    prior = LogNormalPrior(location.detach().clone(), torch.full_like(location, scale))
    read: Callable[[Any], Tensor] = getattr(module, f"_{name}_param")
    module.register_prior(f"{name}_prior", prior, read, getattr(module, f"_{name}_closure"))
