"""The basis of predictions: the physics, the data, or neither."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import torch
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.checks import check_level, checked_whole
from gpadjust.models import StackedGP, TermsModel
from gpadjust.models.levels import coded, on_levels
from gpadjust.models.training_data import ArrayLike, to_tensor
from gpadjust.validation.leave_one_out import observations

SIDES = ("physics", "data", "neither")
_NOTHING = 1e-3  # of the targets' standard deviation: what makes no difference


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
        output_names: The names of the outputs; empty if the model has none.
    """

    X: Tensor
    override: Tensor
    doubt: Tensor
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()

    @property
    def side(self) -> Tensor:
        """The basis of each prediction, ``n x m``: 0, 1 or 2 for physics, data or neither."""
        open_ = torch.where(self.doubt > 1, 2, 0)
        return torch.where(self.override > 1, 1, open_)

    @property
    def physics(self) -> Tensor:
        """Share of the points at which the physics holds, ``m``."""
        return self._share("physics")

    @property
    def data(self) -> Tensor:
        """Share of the points at which the data override the physics, ``m``."""
        return self._share("data")

    @property
    def neither(self) -> Tensor:
        """Share of the points at which the data say too little to tell, ``m``."""
        return self._share("neither")

    def _share(self, side: str) -> Tensor:
        return (self.side == SIDES.index(side)).double().mean(0)


def trust(
    model: TermsModel, X: ArrayLike = None, *, level: float = 0.95, num_points: int = 512
) -> Trust:
    r"""Tell where a model's predictions rest on the physics, on the data, or on neither.

    With its mean :math:`\mu(x)`, the half width :math:`w(x)` of its central interval (without
    noise), and the typical discrepancy D of the training data, the root mean square of
    :math:`y - f_p`, a prediction rests on

    .. math:: \text{data if } |\mu - f_p| > w, \quad
        \text{else physics if } w \le D, \quad \text{else neither:}

    - *data*: the model is sure that the physics is wrong there, and overrides it;
    - *physics*: the physics may be right, and the model is surer of it than the discrepancies that
      were seen would allow, so that data have confirmed it there;
    - *neither*: the physics may be right, or as wrong as it was elsewhere. The model says what the
      physics says, for want of data.

    The share of the points with *data* is the share of the predictions that override the physics.
    It does not depend on units: w and D are taken to be at least a thousandth of the standard
    deviation of the targets, as less makes no difference to speak of. Of several physics
    :math:`f_p` is their weighted sum, as of :meth:`~gpadjust.models.TermsModel.fallback`.

    Args:
        model: A model with a physics, such as :class:`~gpadjust.CKA`; that of
            ``LearnedDynamics``, too. One that holds samples is judged by the moments of their
            mixture.
        X: Raw inputs, ``n x d``, such as states and actions that were visited. Default:
            ``num_points`` in the box of the training inputs, by Sobol's sequence.
        level: Nominal coverage of the interval.
        num_points: Number of points if there is no ``X``.

    Raises:
        TypeError: If the model has no physics to be trusted, or is a :class:`~gpadjust.StackedGP`,
            or ``level`` is no number.
        ValueError: If ``X`` has the wrong shape, the model is of a batch of data sets, or ``level``
            or ``num_points`` is out of range.
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
    check_level(level)
    if isinstance(model, StackedGP):
        raise TypeError(
            "Expected a model of one structure, got a StackedGP, whose parts differ in what they "
            "rest on; take one of the models that it was made of, such as "
            "comparison.models['CKA']."
        )
    if not isinstance(model, TermsModel) or not model.rho_names:
        raise TypeError(
            f"Expected a model with a physics that it could trust, such as CKA, got "
            f"{type(model).__name__}; of LearnedDynamics pass its `model`."
        )
    if model.batch_shape and model.num_samples is None:
        raise ValueError(
            f"Expected a model of one data set, got one with batch_shape "
            f"{tuple(model.batch_shape)}; judge the data sets one by one."
        )
    with torch.no_grad():
        train_X, train_Y = observations(model)
        if X is None:
            X = _points(train_X, num_points)
            X = on_levels(X, model.levels) if model.levels else X
        X = coded(X, model.levels, model.batches) if model.levels else X
        X = to_tensor(X, "X")
        if X.dim() != 2 or not len(X):
            raise ValueError(f"Expected X of shape n x d, one point or more, got {tuple(X.shape)}.")
        mean, variance = model.predict(X)
        away = (mean - model.fallback(X)).abs()
        discrepancy = _rms(train_Y - model.fallback(train_X))
        least = _NOTHING * _rms(train_Y - train_Y.nanmean(0))
    least = least.clamp_min(torch.finfo(least.dtype).tiny)
    half = torch.maximum(NormalDist().inv_cdf((1 + level) / 2) * variance.sqrt(), least)
    return Trust(
        X=X,
        override=away / half,
        doubt=half / torch.maximum(discrepancy, least),
        input_names=model.input_names,
        output_names=model.output_names,
    )


def _points(train_X: Tensor, num_points: int) -> Tensor:
    """Points in the box of the training inputs."""
    num_points = checked_whole("num_points", num_points, 1)
    bounds = torch.stack([train_X.amin(0), train_X.amax(0)])
    return draw_sobol_samples(bounds, n=num_points, q=1, seed=0).squeeze(-2)


def _rms(values: Tensor) -> Tensor:
    """The root mean square of each output where it was observed, ``m``."""
    return values.square().nanmean(0).sqrt()
