"""Fitting a model together with the unknown parameters of its physics."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust.inference.calibration import Calibration
from gpadjust.inference.linearisation import Around, Information, Shared
from gpadjust.inference.log_parameters import LogParameters
from gpadjust.inference.map_fit import FitResult, Search, maximise
from gpadjust.models import ExactGPBase

_ROUNDS = 4  # of hyper-parameters and parameters by turns
_ARRIVED = 0.05  # standard deviations that the parameters moved
_GIVEN = 16  # vectors of hyper-parameters that parameters are drawn for
_UNTOLD = 0.15  # of the prior's precision: what else is known of a direction is next to nothing
_FAR = 3.0  # standard deviations of the prior
_TAKES_PART = 0.3  # cosine of a parameter and such a direction


class ParameterWarning(UserWarning):
    """The observations say next to nothing of parameters of the physics, or contradict a prior."""


class Calibrated(NamedTuple):
    """A model at its most likely parameters, about which they are integrated out.

    Attributes:
        calibration: Its parameters.
        near: The prior mean near them.
        information: What the targets of each output say of them.
        shared: What they add to the distribution of the targets.
        result: What the fit of the hyper-parameters reached.
    """

    calibration: Calibration
    near: Around
    information: Information
    shared: Shared
    result: FitResult


def calibrate(model: ExactGPBase, search: Search) -> Calibrated:
    """Bring a model to its most likely hyper-parameters, and then parameters of the physics.

    The first are those most likely with the parameters integrated out, near their most likely
    values; the search for these begins with least squares. The two go by turns until the parameters
    stay. The model is left in train mode.
    """
    model.train()
    calibration = Calibration(model)
    start = [(parameter, parameter.detach().clone()) for parameter in model.parameters()]
    try:
        return _calibrate(calibration, search)
    except BaseException:  # the model is then as it was
        with torch.no_grad():
            for parameter, before in start:
                parameter.copy_(before)
        raise


def _calibrate(calibration: Calibration, search: Search) -> Calibrated:
    model, generator = calibration.model, torch.Generator().manual_seed(search.seed)
    point, variances = calibration.least_squares(generator)
    near = calibration.around(point)
    if not near.slope.any():
        raise ValueError(
            f"The unknown parameters {', '.join(calibration.unknowns)} of the physics change "
            "nothing at the training inputs that the prior mean of the model takes from it; "
            "correct the physics, or give rho a mean that is not 0 (rho_mean=1.0)."
        )
    information = calibration.independent(near, variances)
    for _ in range(_ROUNDS):
        calibration.move_to(point)
        shared = calibration.shared(near, information)
        result = maximise(model, search, shared)
        search = search._replace(num_screened=0)
        model.train()
        parameters = LogParameters(model)
        current = parameters.current()
        _, covariance = calibration.covariance(parameters, current, point.unsqueeze(0))
        target = calibration.newton(near, covariance[0])
        _, chol = calibration.information(near, covariance[0]).posterior()
        moved = (chol.mT @ (target - point)).norm()
        point, near = target, calibration.around(target)
        information = calibration.information(near, covariance[0])
        if moved < _ARRIVED * len(point) ** 0.5:
            break
    calibration.move_to(point)
    model.input_transform.remember(point.unsqueeze(0))
    shared = calibration.shared(near, information)
    return Calibrated(calibration, near, information, shared, result)


def calibrate_roughly(model: ExactGPBase, search: Search) -> Calibrated:
    """As :func:`calibrate`, of a model whose hyper-parameters are sampled afterwards."""
    search = search._replace(
        num_starts=search.num_starts or 4,
        num_screened=64 if search.num_screened is None else search.num_screened,
        max_iterations=min(search.max_iterations, 60),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OptimizationWarning)
        return calibrate(model, search)


def draw_parameters(
    calibrated: Calibrated,
    parameters: LogParameters,
    vectors: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw parameters of the physics given draws of the hyper-parameters, ``K x B x q``.

    Returns:
        ``K`` or more vectors, the coordinates of parameters that go with each, ``x p``, and the
        least power of importance weights.
    """
    count = min(_GIVEN, len(vectors))
    rows = torch.linspace(0, len(vectors) - 1, count).round().long()
    each = -(-len(vectors) // count)
    draws = calibrated.calibration.draw(calibrated.near, parameters, vectors[rows], generator)
    found = draws.resampled(each, generator)  # each x count x p
    order = torch.rand(each, count, generator=generator).argsort(0)  # they come as they were drawn
    found = found.gather(0, order.unsqueeze(-1).expand_as(found))
    coordinates = found.transpose(0, 1).flatten(0, 1)
    return vectors[rows].repeat_interleave(each, 0), coordinates, draws.power.min()


def warn_of_parameters(calibrated: Calibrated) -> None:
    """Warn of parameters that the observations tell nothing of, or against what was known.

    The first are directions in which the observations have next to none of the prior's precision;
    the second are likely more standard deviations of the prior away from its middle than it allows.
    """
    names = calibrated.calibration.unknowns.names

    def of(which: Tensor) -> str:
        return ", ".join(name for name, yes in zip(names, which.tolist(), strict=True) if yes)

    values, vectors = torch.linalg.eigh(calibrated.information.precision.sum(-3))
    silent = of(vectors[:, values < _UNTOLD].norm(dim=-1) > _TAKES_PART)
    if silent:
        warnings.warn(
            f"The observations say next to nothing of {silent} of the physics, or only of a "
            "combination of them: their posterior is their prior there. Observe where they matter, "
            "give narrower priors, or take one of them as known.",
            ParameterWarning,
            stacklevel=4,
        )
    against = of(calibrated.near.point.abs() > _FAR)
    if against:
        warnings.warn(
            f"Observations and prior disagree about {against} of the physics: most likely are "
            f"values more than {_FAR:g} standard deviations of the prior away. Look at guess, sd, "
            "factor and bounds, or at the physics.",
            ParameterWarning,
            stacklevel=4,
        )
