"""The basis of predictions: the physics, the data, or neither."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.checks import checked_half_width
from gpadjust.core.data import ArrayLike
from gpadjust.core.model import Predictive
from gpadjust.kinds.categories import on_levels

_POINTS = 512
SIDES = ("physics", "data", "neither")
_NOTHING = 1e-3  # of the observations' standard deviation: what makes no difference


@dataclass(frozen=True)
class Trust:
    r"""The basis of a model's predictions at some points; see :func:`trust`.

    Attributes:
        X: The points, raw inputs ``n x d``.
        override: Shift of the prediction from the physics by the data, ``n x m``: the distance
            :math:`|\mu - f_p|` in half widths w of the model's interval. Above 1 the interval
            excludes the physics.
        doubt: The half width in typical discrepancies, :math:`w / D`, ``n x m``.
        input_names: The names of the inputs.
        output_names: The names of the outputs.
    """

    X: Tensor
    override: Tensor
    doubt: Tensor
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]

    @property
    def side(self) -> Tensor:
        """The basis of each prediction, ``n x m``: 0, 1 or 2 for physics, data or neither."""
        without_data = torch.where(self.doubt > 1, 2, 0)
        return torch.where(self.override > 1, 1, without_data)

    @property
    def physics(self) -> Tensor:
        """Share of the points at which the prediction rests on the physics, ``m``."""
        return (self.side == 0).double().mean(0)

    @property
    def data(self) -> Tensor:
        """Share of the points at which the data override the physics, ``m``."""
        return (self.side == 1).double().mean(0)

    @property
    def neither(self) -> Tensor:
        """Share of the points at which there are too few data to decide, ``m``."""
        return (self.side == 2).double().mean(0)


@torch.no_grad()
def trust(model: Any, X: ArrayLike = None, *, level: float = 0.95) -> Trust:
    r"""Return where a model's predictions rest on the physics, on the data, or on neither.

    With its mean :math:`\mu(x)`, the half width :math:`w(x)` of its central interval (without
    noise), and the typical discrepancy D of the training data, the root mean square of
    :math:`y - f_p`, a prediction rests on

    .. math:: \text{data if } |\mu - f_p| > w, \quad
        \text{else physics if } w \le D, \quad \text{else neither:}

    that is, where the model is sure that the physics is wrong; where data have confirmed it; and
    where the model predicts the physics for want of data. w and D are at least a thousandth of the
    standard deviation of the observations. :math:`f_p` is the prior mean of the model, of several
    physics their weighted sum.

    Args:
        model: A model with a physics, such as :class:`~gpadjust.CKA`; the ``model`` of
            ``LearnedDynamics``, too.
        X: Inputs, ``n x d``, such as visited states and actions. Default: 512 in the box of the
            training inputs, by Sobol's sequence.
        level: Nominal coverage of the interval.

    Raises:
        TypeError: If the model has no physics to trust, or is a :class:`~gpadjust.StackedGP`, or
            ``level`` is not a number.
        ValueError: If ``X`` has the wrong shape, or ``level`` is not between 0 and 1.
        PhysicsError: If the physics fails.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, fit
        >>> X = torch.linspace(0, 1, 20, dtype=torch.float64).unsqueeze(-1)
        >>> Y = torch.sin(6 * X) + torch.where(X > 0.5, (X - 0.5).square(), 0.0)
        >>> model = CKA(X, Y, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> shares = trust(model)
        >>> bool(shares.data > 0.3), bool(shares.neither < 0.1)
        (True, True)
    """
    width = checked_half_width(level)
    if not isinstance(model, Predictive) or not getattr(model, "physics", None):
        raise TypeError(
            f"Expected a model with a physics to trust, such as CKA; found {type(model).__name__}. "
            "For LearnedDynamics pass its `model`, for a StackedGP one of its models, such as "
            "comparison.models['CKA']."
        )
    data = model.data
    if X is None:
        box = torch.stack([data.X.amin(0), data.X.amax(0)])
        points = on_levels(model, draw_sobol_samples(box, n=_POINTS, q=1, seed=0).squeeze(-2))
    else:
        points = data.new_inputs(X)
    if points.dim() != 2 or not len(points):
        raise ValueError(
            f"Expected X of shape n x d, one point or more; found {tuple(points.shape)}."
        )
    mean, variance = model.predict(points)
    distance = (mean - prior_mean(model, points)).abs()
    discrepancy = _rms(data.Y - prior_mean(model, data.X))
    least = _NOTHING * _rms(data.Y - data.Y.nanmean(0))
    least = least.clamp_min(torch.finfo(least.dtype).tiny)
    # w = z sigma, z the quantile of the level
    half = torch.maximum(width * variance.sqrt(), least)
    doubt = half / torch.maximum(discrepancy, least)
    return Trust(points, distance / half, doubt, data.input_names, data.output_names)


def prior_mean(model: Any, X: Tensor) -> Tensor:
    """Return the predictions without data, ``n x m``: the physics, whether of use or not."""
    values = model.table.values(model.table.with_choice(model.u.detach(), 0))
    mean = (model.evaluate(X, values).mean * model.unit).mT  # S x n x m
    prior: Tensor = model.marginals_of(mean, torch.zeros_like(mean)).prediction.mean
    return prior


@torch.no_grad()
def physics_at(model: Any, X: Tensor) -> dict[str, Tensor]:
    """Return the outputs ``n x m`` of each physics by name, the means of their draws."""
    if not getattr(model, "physics", None):
        return {}
    names = {term.physics: term.name.removeprefix("rho_") for term in model.terms}
    outputs = model.places(X, model.values).f
    means: dict[str, Tensor] = {}
    for i, f in enumerate(outputs):
        name = "physics"
        if len(outputs) > 1:
            name += f" {names.get(i, i + 1)}"
        values = (f * model.unit).mT
        means[name] = model.marginals_of(values, torch.zeros_like(values)).prediction.mean
    return means


def _rms(values: Tensor) -> Tensor:
    """Return the root mean square of each output where it was observed, ``m``."""
    return values.square().nanmean(0).sqrt()
