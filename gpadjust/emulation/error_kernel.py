"""The covariance of an emulator's error, as the kernel of a term."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.gp.features import term_features
from gpadjust.gp.kernels import CompositeKernel
from gpadjust.models.terms_gp import TermsGP
from gpadjust.physics import Physics
from gpadjust.physics.unknown import Unknowns


def unresolved(emulator: TermsGP) -> Tensor:
    """The variance of the noise of runs, ``m``, in the square of the outputs' units."""
    noise = emulator.noise.at(emulator.train_inputs[0]) * emulator.units()[1].square()
    return noise.mean(-1).reshape(-1, emulator.num_outputs).mean(0)


def error_covariance(
    emulator: TermsGP, rows: Tensor, others: Tensor | None = None, white: Tensor | None = None
) -> Tensor:
    r"""The posterior covariance of a simulator's outputs, by an emulator of its runs.

    Of an emulator that holds samples s of its hyper-parameters, with the means :math:`m_s` and
    covariances :math:`C_s` of each, it is that of the mixture, :math:`E_s C_s + \mathrm{Cov}_s(m_s,
    m_s)`.

    Args:
        emulator: A model of the runs, in eval mode.
        rows: Inputs of the simulator, ``... x n x D``.
        others: Others, ``... x n' x D``. Default: the same.
        white: The variances of what is independent in each row, ``m``; None for nothing.

    Returns:
        ``... x m x n x n'``, in the square of the outputs' units.
    """
    left = _Side(emulator, rows)
    right = left if others is None else _Side(emulator, others)
    covariance = left.sum.cross(right.sum) - left.white @ right.white.mT
    scale = emulator.units()[1].unsqueeze(-1)
    covariance = covariance * left.wider.unsqueeze(-1) * right.wider.unsqueeze(-2)
    covariance = covariance * scale.square()
    if emulator.num_outputs == 1:
        covariance = covariance.unsqueeze(-3)
    if white is not None:
        same = (rows.unsqueeze(-2) == (rows if others is None else others).unsqueeze(-3)).all(-1)
        white = white[:, None, None] * same.unsqueeze(-3)
    if emulator.num_samples is None:
        return covariance if white is None else covariance + white
    away = [(s.mean * scale.squeeze(-1)).unsqueeze(-1) for s in (left, right)]
    away = [each if emulator.num_outputs > 1 else each.unsqueeze(-3) for each in away]
    one, two = (each - each.mean(-4, keepdim=True) for each in away)
    covariance = (covariance + one @ two.mT).mean(-4)
    return covariance if white is None else covariance + white


class _Side:
    """What a covariance takes from one of its sides: rows ``... x n x D`` of the simulator."""

    def __init__(self, emulator: TermsGP, rows: Tensor) -> None:
        inputs, conditioning = emulator.model_inputs(rows), emulator.conditioning()
        factors = conditioning.factors()
        self.sum = emulator.at(inputs)
        cross = self.sum.cross(conditioning.train, is_data=True)
        self.white = factors.whiten(cross)
        self.mean = self.sum.mean() + (cross @ factors.alpha.unsqueeze(-1)).squeeze(-1)
        wider = emulator.widening(inputs)
        self.wider = torch.ones_like(self.mean) if wider is None else wider.sqrt()


class ErrorKernel(CompositeKernel):
    """The covariance of the error of an emulated physics, in units of a model's targets.

    It has no parameters: the runs say all. It reads the columns that
    :class:`~gpadjust.gp.PhysicsInput` has put before f_p, raw inputs and unknown parameters.

    Args:
        physics: The emulated physics.
        emulator: The model of its runs.
        unknowns: The unknown parameters of the model's physics, of which it may be a part.
        columns: The numbers of these columns.
        unit: The scale of the model's targets, ``batch_shape x (m) x 1``.
        white: As of :func:`error_covariance`.
    """

    unit: Tensor
    outputs: Tensor

    def __init__(
        self,
        physics: Physics,
        emulator: TermsGP,
        unknowns: Unknowns,
        columns: Sequence[int],
        unit: Tensor,
        white: Tensor | None = None,
    ) -> None:
        super().__init__(batch_shape=unit.shape[:-1])
        # In a tuple, no submodule: it is the emulator's owner that is copied and moved, or not.
        self._runs = (physics, emulator, unknowns)
        self.columns, self.white = columns, white
        self.register_buffer("unit", unit.clone())
        outputs = torch.zeros_like(unit, dtype=torch.long)
        if (m := emulator.num_outputs) > 1:
            outputs += torch.arange(m, device=unit.device).unsqueeze(-1)
        self.register_buffer("outputs", outputs)

    def rows(self, x: Tensor) -> Tensor:
        """The simulator's inputs at ``... x (m) x n x (d + k)``, ``... x n x D``."""
        physics, _, unknowns = self._runs
        x = x[..., self.columns[0] : self.columns[-1] + 1]
        x = x[..., 0, :, :] if self._several and x.dim() > 2 else x
        d = x.shape[-1] - len(unknowns)
        return physics.read_rows(x[..., :d], *([unknowns.named(x[..., d:])] if unknowns else []))

    @property
    def _which(self) -> list[int]:
        """The numbers of the model's outputs."""
        every = self.outputs.flatten().tolist()
        return list(dict.fromkeys(every))

    @property
    def _several(self) -> bool:
        return len(self._which) > 1

    def _chosen(self, values: Tensor, dim: int) -> Tensor:
        """Of values of all outputs those of the model's, without the dimension if there is one."""
        which = self._which
        return values[(..., which if self._several else which[0], *[slice(None)] * (-dim - 1))]

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n``."""
        emulator, rows, unit = self._runs[1], self.rows(x1), self.unit
        if diag:
            mean, variance = emulator.components(rows, False)
            variance = variance.mean(-3) + mean.var(-3, correction=0)
            variance = variance if self.white is None else variance + self.white
            return self._chosen(variance.mT, -2) / unit.square()
        others = None if x2 is x1 or torch.equal(x1, x2) else self.rows(x2)
        found = self._chosen(error_covariance(emulator, rows, others, self.white), -3)
        return found / unit.square().unsqueeze(-1)

    def features(self, num_features: int) -> Module:
        """Random features of the kernel, for functions that are drawn."""
        return ErrorFeatures(self, num_features)


class ErrorFeatures(Module):
    r"""Features of an :class:`ErrorKernel`, by Matheron's rule.

    With features :math:`\varphi` of the emulator's prior at the runs U, whose covariance with noise
    is K, they are :math:`\varphi(u) - k(u, U) K^{-1} [\varphi(U), S^{1/2}]`, and differences of
    means of the samples of its hyper-parameters.
    """

    def __init__(self, kernel: ErrorKernel, num_features: int) -> None:
        super().__init__()
        emulator = kernel._runs[1]
        self.kernel = kernel
        each = max(2, num_features // (2 * (emulator.num_samples or 1)) * 2)
        with torch.no_grad():
            conditioning = emulator.conditioning()
            self.maps: Any = term_features(emulator.terms, each)
            self.runs = conditioning.train
            phi = self.runs.features(self.maps)
            noise = conditioning.noise.at(self.runs.x).sqrt()
            columns = torch.cat([phi, torch.diag_embed(noise.expand(phi.shape[:-1]))], dim=-1)
            columns = columns * self._observed(emulator)
            solved = [conditioning.factors().solve(c) for c in columns.unbind(-1)]
            self.weights = torch.stack(solved, dim=-1)
            self.alpha = conditioning.factors().alpha

    @staticmethod
    def _observed(emulator: TermsGP) -> Tensor:
        return (~emulator.train_targets.isnan()).unsqueeze(-1)

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        emulator = self.kernel._runs[1]
        rows = self.kernel.rows(x)
        sought = emulator.at(emulator.model_inputs(rows))
        cross = sought.cross(self.runs, is_data=True)
        phi = torch.nn.functional.pad(sought.features(self.maps), (0, self.weights.shape[-2]))
        phi = (phi - cross @ self.weights) * emulator.units()[1].unsqueeze(-1)
        if emulator.num_outputs == 1:
            phi = phi.unsqueeze(-3)
        if (number := emulator.num_samples) is not None:
            mean = sought.mean() + (cross @ self.alpha.unsqueeze(-1)).squeeze(-1)
            mean = (mean * emulator.units()[1]).unsqueeze(-1)
            mean = mean if emulator.num_outputs > 1 else mean.unsqueeze(-3)
            phi = torch.cat([phi, mean - mean.mean(-4, keepdim=True)], dim=-1)
            phi = phi.movedim(-4, -1).flatten(-2) / number**0.5
        return self.kernel._chosen(phi, -3) / self.kernel.unit.unsqueeze(-1)
