"""A ridge regression adjustment as a Pyro model, for NUTS, SVI or any guide."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.core.data import ArrayLike, as_tensor
from gpadjust.core.model import GP
from gpadjust.kinds.updates import design


def pyro_model(
    model: GP, X: ArrayLike = None, Y: ArrayLike = None, *, draw: int = 0
) -> tuple[Tensor, Tensor]:
    r"""Sample a model on Fourier features as a Bayesian linear regression in Pyro.

    With the features :math:`\varphi` of rho and delta, and their constants, it is

    .. math:: y = f_p(x) + \varphi(x)^T \beta + \epsilon, \quad \beta \sim N(0, I).

    Its sample sites are ``"weights"``, ``m x p``, and ``"Y"``, ``m x n``. The posterior of the
    weights is normal, ``Weights.condition(model)`` of ``gpadjust.kinds.updates``.

    Args:
        model: An :class:`~gpadjust.core.RRA`, or another model whose kernels are ``Fourier``.
        X: Inputs, ``n x d``. Default: the training inputs, with the training targets.
        Y: Observations, ``n x m``. Default: none; Pyro samples them.
        draw: The number of the draw of lengthscales, variances and unknown parameters.

    Returns:
        The weights, and the function ``n x m``, in the user's units (of a link on its scale).

    Raises:
        ImportError: Without Pyro, ``pip install "gpadjust[pyro]"``.
        ValueError: If the draw does not exist, or ``Y`` comes without ``X``.
    """
    try:
        import pyro  # not at the top, as it takes a second
        import pyro.distributions as dist
    except ImportError as error:
        raise ImportError('pyro_model needs Pyro; run `pip install "gpadjust[pyro]"`.') from error
    if X is None and Y is not None:
        raise ValueError("Expected X, the inputs of Y; found Y alone.")
    if checked_whole("draw", draw, 0) >= len(model.u):
        raise ValueError(f"Expected draw below {len(model.u)}, the number of draws; found {draw}.")
    one = model.subset_draws(torch.tensor([draw]))
    is_training = X is None
    targets = None
    with torch.no_grad():
        values = one.values
        if is_training:
            X = model.data.X
            targets = one.targets() * one.unit
        else:
            X = model.data.new_inputs(X)
        if Y is not None:
            targets = model.on_gaussian_scale(as_tensor(Y, "Y")).mT
        f = one.evaluate(X, values)
        phi = design(f)[0] * one.unit.unsqueeze(-1)  # m x n x p
        noise = one.noise.variance(values, one.places(X, values), is_training)[0]
        sd = (noise.sqrt() * one.unit).expand(phi.shape[:-1])
        mean = f.mean[0] * one.unit
    # y = f_p(x) + phi(x)^T beta + epsilon, beta ~ N(0, I)
    zero = torch.zeros_like(phi[:, 0])
    weights = pyro.sample("weights", dist.Normal(zero, torch.ones_like(zero)).to_event(2))
    function = mean + (phi @ weights.unsqueeze(-1)).squeeze(-1)
    noisy = dist.Normal(function, sd)
    if targets is not None:  # a mask takes missing targets out of the density
        noisy = noisy.mask(~targets.isnan())
        targets = targets.nan_to_num()
    pyro.sample("Y", noisy.to_event(2), obs=targets)
    return weights, function.mT
