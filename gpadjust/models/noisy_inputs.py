"""Inputs that were measured with noise, which the slope of the function carries to the targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.checks import check_finite
from gpadjust.gp.noise import RowNoise, RowSource
from gpadjust.models.training_data import ArrayLike, TrainingData, to_tensor
from gpadjust.physics import PhysicsError

_SPREAD = (3.0**0.5, 1.0, 0.5, 0.1)  # differences, in standard deviations of a true input
_SETTLED = (0.05, 0.1)  # change of variances, relative, and of means, in standard deviations


class NoisyInputs(RowSource, Module):
    r"""Inputs that were measured with independent Gaussian errors of known variances S.

    The true inputs of a column have the mean and variance of the measured ones, less S. Given a
    measured input x, the true one then has the mean :math:`\hat x = \bar x + \lambda (x - \bar x)`
    and the variance :math:`P = \lambda S`, with :math:`\lambda` the share of the variance that is
    not error (regression calibration: Fuller 1987; Carroll et al. 2006). Models are of
    :math:`\hat x`, and a target has, beside its noise,

    .. math::

        \mathrm{E} = f(\hat x) + \tfrac12 \sum_j P_j \partial_j^2 f, \quad
        \mathrm{Var} = \sum_j P_j (\partial_j f)^2 + \tfrac12 (P_j \partial_j^2 f)^2,

    of which the first part of the variance is that of McHutchon and Rasmussen (2011). The slopes
    are of f_p at first, and then of the posterior mean, by differences over
    :math:`\pm \sqrt{3 P_j}`, which are exact up to the fifth order for both sums of each input.

    Args:
        variances: S, of the shape of the inputs.
        measured: The inputs, ``n x d``.
        outputs: The shape of the targets in the model, ``(m) x n``.

    Attributes:
        points: The means of the true inputs, ``n x d``; ``spread`` their standard deviations.
        shift: What is taken from the targets, in the model's units, ``(m) x n``.
    """

    variances: Tensor
    measured: Tensor
    points: Tensor
    spread: Tensor
    shift: Tensor

    def __init__(self, variances: Tensor, measured: Tensor, outputs: Sequence[int]) -> None:
        super().__init__()
        mean, error = measured.mean(-2), variances.mean(-2)
        true = (measured.var(-2) - error).clamp_min(0.0)
        total = true + variances
        share = (true / total.where(total > 0, torch.ones_like(total))).where(total > 0, 1.0)
        points = mean + share * (measured - mean)
        named = {
            "variances": variances,
            "measured": measured,
            "points": points.where(variances > 0, measured),
            "spread": (share * variances).sqrt(),
            "shift": measured.new_zeros(*outputs),
        }
        for name, tensor in named.items():
            self.register_buffer(name, tensor)

    @classmethod
    def of(cls, train_Xvar: ArrayLike, data: TrainingData) -> NoisyInputs:
        """The inputs of data by the argument ``train_Xvar``, checked."""
        X, m = data.X, data.Y.shape[-1]
        given: Any = train_Xvar
        if isinstance(given, int | float | list | tuple):
            given = torch.tensor(given, dtype=torch.float64, device=X.device)
        given = to_tensor(given, "train_Xvar")
        if X.dim() > 2:
            raise ValueError(
                "Expected inputs of one data set with train_Xvar, got a batch of shape "
                f"{tuple(X.shape)}; build a model for each."
            )
        if given.shape not in (X.shape, (), (1,), X.shape[-1:]):
            raise ValueError(
                f"Expected train_Xvar (variances of inputs) as one number, {X.shape[-1]} numbers "
                f"(one for each input), or of the inputs' shape {tuple(X.shape)}, got "
                f"{tuple(given.shape)}."
            )
        variances = given.expand(X.shape).clone()
        check_finite("train_Xvar", variances)
        if (given < 0).any():
            raise ValueError(
                f"Expected train_Xvar (variances) not to be negative, got {given.min():.3g}."
            )
        if (bad := variances.mean(0) >= X.var(0)).logical_and(X.var(0) > 0).any():
            names = ", ".join(n for n, b in zip(data.input_names, bad.tolist(), strict=True) if b)
            raise ValueError(
                f"The variances train_Xvar of {names} are as large as that of the measured inputs "
                "themselves, so that nothing is known of the true ones. They are variances, in the "
                "square of the inputs' units, not standard deviations."
            )
        return cls(variances, X, (m, len(X)) if m > 1 else (len(X),))

    def of_outputs(self, numbers: list[int]) -> NoisyInputs:
        """The same for some of several outputs."""
        shift = self.shift[numbers if len(numbers) > 1 else numbers[0]]
        found = NoisyInputs(self.variances, self.measured, shift.shape)
        found.shift = shift
        return found

    @torch.no_grad()
    def refine(self, model: Any, rows: RowNoise) -> bool:
        """Set the shift and added variances by the slopes of a fitted model."""
        is_first = not rows.added.any()
        mean, variance = self._moments(model, is_first)
        if is_first and not variance.any():  # a prior mean without slope
            mean, variance = self._moments(model, False)
        noise = rows.errors + model.noise.at(model.train_inputs[0])
        off = (variance - rows.added).abs() / (rows.added + noise)
        away = (mean - self.shift).abs() / (variance + noise).sqrt()
        self.move(model, mean)
        rows.added = variance
        moved = bool(off.nanmean() > _SETTLED[0]) or bool(away.nan_to_num().max() > _SETTLED[1])
        return bool(variance.any()) and (is_first or moved)

    def move(self, model: Any, shift: Tensor) -> None:
        """Take another shift from the targets of a model."""
        targets = model.train_targets + self.shift - shift
        self.shift = shift
        model.train()  # what was known by the old ones goes
        model.train_targets = targets

    def _moments(self, model: Any, of_prior: bool) -> tuple[Tensor, Tensor]:
        """Mean, beside that at the points, and variance of the function at the true inputs."""

        def function(X: Tensor) -> Tensor:
            inputs = model.model_inputs(X)
            if of_prior:
                value: Tensor = model.at(inputs).mean()
                return value
            return model.conditioning().marginals(model.at(inputs))[0]

        here = function(self.points)
        mean, variance = torch.zeros_like(here), torch.zeros_like(here)
        for j in self.spread.any(0).nonzero().flatten().tolist():
            for width in _SPREAD:
                step = torch.zeros_like(self.points)
                step[:, j] = width * self.spread[:, j]
                try:
                    up, down = (
                        function(self.points + step) - here,
                        function(self.points - step) - here,
                    )
                    break
                except PhysicsError:  # near the end of where f_p can be asked
                    if width == _SPREAD[-1]:
                        raise
            mean = mean + (up + down) / (2 * width**2)
            variance = variance + (up - down).square() / (4 * width**2)
            variance = variance + (up + down).square() / (2 * width**4)
        return mean, variance
