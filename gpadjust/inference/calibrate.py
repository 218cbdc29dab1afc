"""Learning the unknown parameters of a physics, with all else."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust.inference.calibration import Calibration, Information, LinearizedMean
from gpadjust.inference.distributions import MarginalizedParameters
from gpadjust.inference.least_squares import least_squares
from gpadjust.inference.optimise import FitResult, Search, maximise
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP

_ROUNDS = 4  # of hyper-parameters and parameters by turns
_SETTLED = 0.05  # standard deviations that the parameters moved in the last of them
_UNTOLD = 0.15  # of the prior's precision: what else is known of a direction is next to nothing
_TAKES_PART = 0.3  # cosine of a parameter and such a direction
_FAR = 3.0  # standard deviations of the prior


class ParameterWarning(UserWarning):
    """The observations say next to nothing of parameters of the physics, or contradict a prior."""


class Calibrated(NamedTuple):
    """A model at its most likely parameters, about which they are integrated out.

    Attributes:
        calibration: Its parameters.
        near: The prior mean near them.
        information: What the targets of each output say of them.
        marginalized: What they add to the distribution of the targets.
        result: What the fit of the hyper-parameters reached.
        places: All of their optima, that best fit first, ``k x p``.
        unseen: As in :class:`~gpadjust.inference.least_squares.Optima`.
    """

    calibration: Calibration
    near: LinearizedMean
    information: Information
    marginalized: MarginalizedParameters
    result: FitResult
    places: Tensor
    unseen: float


def calibrate(model: TermsGP, search: Search) -> Calibrated:
    """Bring a model to its most likely hyper-parameters, and then parameters of the physics.

    The first are those most likely with the parameters integrated out, near their most likely
    values; the search for these begins with least squares. The two go by turns until the parameters
    stay. The model is left in train mode; after an error, as it was.
    """
    model.train()
    calibration = Calibration(model)
    start = [(parameter, parameter.detach().clone()) for parameter in model.parameters()]
    try:
        return _calibrate(calibration, search)
    except BaseException:
        with torch.no_grad():
            for parameter, before in start:
                parameter.copy_(before)
        raise


def _calibrate(calibration: Calibration, search: Search) -> Calibrated:
    model, generator = calibration.model, torch.Generator().manual_seed(search.seed)
    (point, *others), variances, unseen = least_squares(calibration, generator)
    near = calibration.linearized(point)
    calibration.check_slope(near)
    independent = torch.diag_embed(variances.unsqueeze(-1).expand(near.residual.shape))
    information = calibration.information(near, calibration.factor(independent))
    for _ in range(_ROUNDS):
        calibration.move_to(point)
        result = maximise(model, search, calibration.marginalized(near, information))
        search = search._replace(num_screened=0)
        model.train()
        parameters = Parameters(model)
        _, covariance = calibration.moments(parameters, parameters.current(), point.unsqueeze(0))
        target = calibration.newton(near, covariance[0])
        factor = calibration.factor(covariance[0])
        _, chol = calibration.information(near, factor).posterior()
        moved = (chol.mT @ (target - point)).norm()
        point, near = target, calibration.linearized(target)
        information = calibration.information(near, factor)
        if moved < _SETTLED * len(point) ** 0.5:
            break
    calibration.move_to(point)
    model.input_transform.remember(point.unsqueeze(0))
    marginalized = calibration.marginalized(near, information)
    with torch.no_grad():
        others = [calibration.newton(calibration.linearized(z), covariance[0]) for z in others]
    places = torch.stack([point, *others])
    return Calibrated(calibration, near, information, marginalized, result, places, unseen)


def calibrate_roughly(model: TermsGP, search: Search) -> Calibrated:
    """Calibrate a model whose hyper-parameters are sampled afterwards."""
    search = search._replace(
        num_starts=search.num_starts or 4,
        num_screened=64 if search.num_screened is None else search.num_screened,
        max_iterations=min(search.max_iterations, 60),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OptimizationWarning)
        return calibrate(model, search)


def warn_of_parameters(
    names: Sequence[str], precision: Tensor, point: Tensor, stacklevel: int = 4
) -> None:
    """Warn of parameters that the observations tell nothing of, or against what was known.

    The first are directions in which the observations have next to none of the prior's precision;
    the second are likely more standard deviations of the prior away from its middle than it allows.

    Args:
        names: Their names.
        precision: What the observations say of their coordinates, ``p x p``, without the prior.
        point: Their most likely coordinates, ``p``.
        stacklevel: Whose call is warned of.
    """

    def of(which: Tensor) -> str:
        return ", ".join(name for name, yes in zip(names, which.tolist(), strict=True) if yes)

    values, vectors = torch.linalg.eigh(precision)
    if silent := of(vectors[:, values < _UNTOLD].norm(dim=-1) > _TAKES_PART):
        warnings.warn(
            f"The observations say next to nothing of {silent} of the physics, or only of a "
            "combination of them: their posterior is their prior there. Observe where they matter, "
            "give narrower priors, or take one of them as known.",
            ParameterWarning,
            stacklevel=stacklevel,
        )
    if against := of(point.abs() > _FAR):
        warnings.warn(
            f"Observations and prior disagree about {against} of the physics: most likely are "
            f"values more than {_FAR:g} standard deviations of the prior away. Look at guess, sd, "
            "factor and bounds, or at the physics.",
            ParameterWarning,
            stacklevel=stacklevel,
        )
