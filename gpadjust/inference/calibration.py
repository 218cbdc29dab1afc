"""The unknown parameters of the physics of a model, and what its targets say of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.gp import AppendedPhysics, OrthogonalKernel
from gpadjust.gp.gaussian import cholesky, negative_log_likelihood
from gpadjust.inference.distributions import ByModules, MarginalizedParameters
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP

_STEP = 1e-4  # of differences, in standard deviations of the prior


class LinearizedMean(NamedTuple):
    """The prior mean at the training inputs, linear near points of the unknown parameters.

    Attributes:
        point: Their coordinates z, ``... x p``.
        residual: The targets less the mean there, ``... x B x n``; 0 where there is no target, and
            infinite where the physics fails.
        slope: Derivatives of the mean, ``... x B x n x p``; 0 likewise.
    """

    point: Tensor
    residual: Tensor
    slope: Tensor


class Information(NamedTuple):
    """Information of each output's targets on the parameters, if the mean is linear in them.

    Attributes:
        precision: :math:`J^T K^{-1} J`, ``... x B x p x p``.
        information_vector: :math:`J^T K^{-1} (r + J z)`, ``... x B x p``.
    """

    precision: Tensor
    information_vector: Tensor

    def posterior(self, outputs: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean ``... x p`` and Cholesky factor of the precision, by the prior and all outputs.

        With a matrix of ones and zeros, ``b x B``, for each of its rows by some of them.
        """
        precision, vector = self.precision, self.information_vector
        if outputs is None:
            precision, vector = precision.sum(-3), vector.sum(-2)
        else:
            precision = torch.einsum("bc,...cpq->...bpq", outputs, precision)
            vector = outputs @ vector
        chol = torch.linalg.cholesky(precision + torch.eye(vector.shape[-1]).to(vector))
        return torch.cholesky_solve(vector.unsqueeze(-1), chol).squeeze(-1), chol


class Misfit(ABC):
    """Targets, and what unknown parameters of a physics make of them.

    Attributes:
        targets: The observations, ``B x n``, NaN where there is none.
        observed: Where there is one.
    """

    targets: Tensor
    observed: Tensor

    @property
    @abstractmethod
    def point(self) -> Tensor:
        """Coordinates at which the physics works, ``p``."""

    @abstractmethod
    def residuals(self, points: Tensor) -> Tensor:
        """Return the residuals at points ``... x p``."""

    @torch.no_grad()
    def linearized(self, points: Tensor) -> LinearizedMean:
        """The mean of the targets near points ``... x p``."""
        p = points.shape[-1]
        moves, here = _STEP * torch.eye(p).to(points), points.unsqueeze(-2)
        residual = self.residuals(torch.cat([here, here + moves, here - moves], dim=-2))
        here, up, down = residual.split([1, p, p], dim=-3)
        slope = ((down - up) / (2 * _STEP)).movedim(-3, -1)
        return LinearizedMean(points, here.squeeze(-3), slope.nan_to_num(0.0, 0.0, 0.0))


class Calibration(Misfit):
    r"""The unknown parameters of a model's physics, which all of its ``B`` outputs share.

    In their coordinates z, which are standard normal by the prior, the mean of the targets is
    linear near a point, :math:`m(z) \approx m(z_0) + J (z - z_0)`. So they are integrated out in
    closed form while hyper-parameters are learnt, as unknown constants with the bases J: given z
    the outputs are independent, and what the others say of it is a normal prior to each.

    Args:
        model: A model with such a physics, in train mode.

    Attributes:
        targets: The observations, ``B x n``, and ``observed`` where there is one.
        unknowns: The parameters.
        moves_covariance: Whether the covariance of the targets depends on them.

    Raises:
        ValueError: If it is of a batch of data sets.
    """

    def __init__(self, model: TermsGP) -> None:
        if model._input_batch_shape:
            raise ValueError(
                "Expected a model of one data set to learn unknown parameters of its physics, got "
                f"one with batch_shape {tuple(model._input_batch_shape)}; fit the data sets of a "
                "batch one by one."
            )
        self.model, self._transform = model, model.input_transform
        raw, n = model.train_inputs[0], model.train_targets.shape[-1]
        self._raw = raw[0] if model.num_outputs > 1 else raw
        self.targets = model.train_targets.reshape(-1, n)
        self.observed = ~self.targets.isnan()
        self._all = bool(self.observed.all())
        self.unknowns = self._transform.physics.unknowns
        self._orthogonal = [
            i for i, term in enumerate(model.terms) if isinstance(term.kernel, OrthogonalKernel)
        ]
        scaled = [term for term in model.terms if isinstance(term.basis, AppendedPhysics)]
        scaled += [term for term in model.terms if term.scaled_by is not None]
        self.moves_covariance = bool(self._orthogonal) or not all(t.is_known for t in scaled)

    @property
    def point(self) -> Tensor:
        """The present point of the parameters, ``p``."""
        point: Tensor = self._transform.coordinates.detach().clone()
        return point

    def move_to(self, point: Tensor) -> None:
        """Move the parameters to coordinates ``p``."""
        with torch.no_grad():
            self._transform.coordinates.copy_(point)
        self.direct(self.model, point)

    @torch.no_grad()
    def direct(self, model: TermsGP, points: Tensor) -> None:
        """Make kernels orthogonal to what the parameters do near points, ``(k) x p``.

        Args:
            model: Whose kernels; they have a batch of ``k`` if there are ``k`` points.
            points: Coordinates of the parameters.
        """
        if not self._orthogonal:
            return
        inputs, slope = self._inputs(points), self.linearized(points).slope
        shape = (*points.shape[:-1], *self.model.train_targets.shape, points.shape[-1])
        for term in (model.terms[i] for i in self._orthogonal):
            kernel = term.kernel
            if isinstance(kernel, OrthogonalKernel):
                kernel.set_directions(inputs[..., : term.num_inputs], slope.reshape(shape))

    def check_slope(self, near: LinearizedMean) -> None:
        """Raise a ValueError if the mean has no slope by some parameters, for no good reason."""
        silent = ~near.slope.flatten(0, 1).any(0)
        if not silent.any():
            return
        moves = _STEP * torch.eye(len(silent)).to(near.point)[silent]
        beside = torch.cat([near.point + moves, near.point - moves])
        failing = beside[~self.residuals(beside).isfinite().flatten(1).all(-1)]
        if len(failing):
            best, there = (self.unknowns.at(z) for z in (near.point, failing[0]))
            raise ValueError(
                f"The physics fails at {self._text(there)}, next to the best parameters that were "
                f"found, {self._text(best)}: better ones may lie where it cannot run. Correct it "
                "there, or say by `bounds` of Unknown which values are possible."
            )
        if silent.all():
            raise ValueError(
                f"The unknown parameters {', '.join(self.unknowns)} of the physics change nothing "
                "at the training inputs that the prior mean of the model takes from it; correct "
                "the physics, or give rho a mean that is not 0 (rho_mean=1.0)."
            )

    def information(self, near: LinearizedMean, chol: Tensor) -> Information:
        """Return the information of targets, by the factors ``... x B x n x n`` of covariances."""
        # What the slopes times the parameters are to make.
        target = near.residual.unsqueeze(-1) + near.slope @ near.point[..., None, :, None]
        columns = torch.cat([near.slope, target], dim=-1)
        white = torch.linalg.solve_triangular(
            chol, columns.expand(*chol.shape[:-1], -1), upper=False
        )
        slope, target = white[..., :-1], white[..., -1:]
        return Information(slope.mT @ slope, (slope.mT @ target).squeeze(-1))

    def factor(self, covariance: Tensor) -> Tensor:
        """Factors of covariances of the targets, ``... x n x n``."""
        return cholesky(covariance.clone(), None if self._all else self.observed)[0]

    def marginalized(
        self, near: LinearizedMean, information: Information
    ) -> MarginalizedParameters:
        """Return the contribution of the parameters to each output, given the others."""
        count = len(self.targets)
        mean, chol = information.posterior((1 - torch.eye(count)).to(near.point))
        root = torch.linalg.solve_triangular(chol, near.slope.mT, upper=False).mT
        away = near.slope @ (mean - near.point).unsqueeze(-1)
        shape = self.model.train_targets.shape
        return MarginalizedParameters(
            away.reshape(shape), (root @ root.mT).reshape(*shape, shape[-1])
        )

    @torch.no_grad()
    def moments(
        self, parameters: Parameters, vectors: Tensor, points: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean ``k x B x n`` and covariance of the targets, for vectors ``k x B x q`` at points."""
        inputs = self._inputs(points)
        self.direct(self.model, points)
        distribution = ByModules(self.model, parameters, inputs, self.model.noise.known, True)
        mean, covariance, *_ = distribution(parameters.unflatten(vectors))
        b, n = self.targets.shape
        shape = (max(len(vectors), len(points)), b, n)
        mean = mean.expand(covariance.shape[:-1]).reshape(-1, b, n)
        return mean.expand(shape), covariance.reshape(-1, b, n, n).expand(*shape, n)

    @torch.no_grad()
    def newton(self, near: LinearizedMean, covariance: Tensor) -> Tensor:
        """The most likely parameters, ``p``, at a covariance ``B x n x n``: a step of Newton's."""
        chol = self.factor(covariance)
        target, _ = self.information(near, chol).posterior()
        shares = torch.tensor([1.0, 0.5, 0.25, 0.1, 0.0]).to(target).unsqueeze(-1)
        points = near.point + shares * (target - near.point)
        return points[self.at_covariance(points, chol).argmin()]

    def at_covariance(self, z: Tensor, chol: Tensor) -> Tensor:
        """Negative log densities ``k (x H)`` of ``z``, with factors ``(H) x B x n x n``."""
        residual = self.residuals(z).movedim(0, -1)  # (H) x B x n x k
        white = torch.linalg.solve_triangular(chol, residual, upper=False)
        value = white.square().sum((-3, -2)).movedim(-1, 0) + z.square().sum(-1)
        return or_infinite(0.5 * value)

    def density(self, z: Tensor, parameters: Parameters, vectors: Tensor) -> Tensor:
        """Negative log densities ``k`` of parameters ``k x p`` beside vectors ``k x B x q``."""
        mean, covariance = self.moments(parameters, vectors, z)
        failed = (mean.isnan() & self.observed).flatten(1).any(-1)
        # Where the physics fails there is no covariance either.
        one = torch.eye(mean.shape[-1]).to(covariance)
        covariance = covariance.where(~failed[:, None, None, None], one)
        residual = self.targets - mean.nan_to_num(nan=0.0)
        value = negative_log_likelihood(residual, covariance).value.sum(-1)
        return or_infinite(value.masked_fill(failed, math.inf) + 0.5 * z.square().sum(-1))

    def _inputs(self, points: Tensor) -> Tensor:
        """Return the inputs of the terms at points ``... x p``; NaN where f_p fails."""
        inputs: Tensor = self._transform.at(self._raw, points)
        return inputs.unsqueeze(-3) if self.model.num_outputs > 1 else inputs

    def residuals(self, points: Tensor) -> Tensor:
        """Return the residuals at points ``... x p``."""
        mean = self.model.mean_module(self._inputs(points))
        mean = mean.reshape(*points.shape[:-1], *self.targets.shape)
        residual = self.targets - or_infinite(mean)
        return residual.where(self.observed, torch.zeros_like(residual))

    def _text(self, values: Tensor) -> str:
        """Parameters ``p`` in words."""
        named = zip(self.unknowns.names, values.tolist(), strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in named)


def or_infinite(values: Tensor) -> Tensor:
    """Values with infinity in place of NaN."""
    return values.nan_to_num(nan=math.inf, posinf=math.inf)
