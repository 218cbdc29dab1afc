"""Weakly informative priors of the hyper-parameters."""

from __future__ import annotations

import math

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.priors import LogNormalPrior, NormalPrior

from gpadjust.gp import AppendedPhysics
from gpadjust.models.ar1 import Level
from gpadjust.models.hyperparameters import (
    KINDS,
    RHO_VARIANCE,
    is_rho,
    kernels_of,
    kind_of,
    typical_sizes,
)

_CENTERS = 3.0  # the standard deviation of an unknown centre, in those of f_p


def register_priors(model: BatchedMultiOutputGPyTorchModel) -> None:
    r"""Register a prior on each learnable hyper-parameter that has none.

    With the inputs in units of their range at the training points, their number d, and
    :math:`v` the mean square of the targets' residual from the prior mean:

    .. math::
        \log \ell &\sim N(\log 3 + \tfrac12 \log d, \; 2^2) \\
        \log s_\delta &\sim N(\log v, \; 6^2), \quad
        \log s_\rho \sim N(\log 10^{-2}, \; 4^2) \\
        \log \sigma^2 &\sim N(\log(10^{-3} v), \; 6^2)

    The lengthscales grow with the dimension after Hvarfner et al. (2024). All are wide: functions
    that are nearly polynomial (long lengthscales, a large variance), a rho that is nearly constant,
    and data without noise are not ruled out. They were chosen on other data sets
    than those that are reported. A centre that is learnt has N(0, 3^2), in standard deviations of
    f_p from its mean. The constant rho of an
    :class:`~gpadjust.AR1` has N(1, 1). Give a kernel or likelihood priors of your own
    (``lengthscale_prior=...``, or ``register_prior``) to replace them.

    Args:
        model: A model of this library. They are made for sampling: :func:`gpadjust.fit` with
            ``"bayes"``, and GPyTorch's ``pyro_sample_from_prior``. The mode of a wide
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
        ...     "lengthscale_prior", "outputscale_prior", "noise_prior", "center_prior"
        ... }
        True
    """
    of_rho = [path for path, _, _, basis in kernels_of(model) if is_rho(basis)]
    for name, size in typical_sizes(model).items():
        module, kind = model.get_submodule(name.rpartition(".")[0]), kind_of(name)
        median, spread = KINDS[kind].prior
        if kind == "lengthscale":
            median *= math.sqrt(size.shape[-1])
        elif kind == "outputscale" and any(name.startswith(f"{path}.") for path in of_rho):
            size, (median, spread) = torch.ones_like(size), RHO_VARIANCE.prior
        if f"{kind}_prior" in module._priors or not getattr(module, f"raw_{kind}").requires_grad:
            continue
        location = (size.log() + math.log(median)).detach()
        prior = LogNormalPrior(location, torch.full_like(location, spread))
        read, write = getattr(module, f"_{kind}_param"), getattr(module, f"_{kind}_closure")
        module.register_prior(f"{kind}_prior", prior, read, write)
    for module in model.covar_module.modules():
        free = isinstance(module, AppendedPhysics) and module.has_free_center
        if free and not module._priors:
            zero = torch.zeros_like(module.center)
            module.register_prior("center_prior", NormalPrior(zero, zero + _CENTERS), "center")
        if isinstance(module, Level) and module.rho is not None and not module._priors:
            one = torch.ones_like(module.rho)
            module.register_prior("rho_prior", NormalPrior(one, one), "rho")
