"""Learning the unknown parameters of a physics."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gpadjust.gp import AppendedPhysics, OrthogonalKernel, PhysicsInput
from gpadjust.gp.gaussian import cholesky, known_noise, negative_log_likelihood
from gpadjust.inference.importance_sampling import Draws, Mixture
from gpadjust.inference.importance_sampling import sample as importance_sample
from gpadjust.inference.linearisation import Around, Information, Shared
from gpadjust.inference.log_parameters import LogParameters
from gpadjust.inference.target_distribution import ModuleDistribution
from gpadjust.models import ExactGPBase
from gpadjust.models.hyperparameters import kernels_of

_STEP = 1e-4  # of differences, in standard deviations of the prior
_GUESSES = 255  # of the parameters, of which the best are started from
_STARTS = 16
_ITERATIONS = 60  # of least squares
_ARRIVED = 1e-4  # decrease of a negative log density at which they stop
_TRIED = 8  # of them, after which the best go on
_KEPT = 6  # of these
_SILENT = 1e-14  # the mean square of residuals, relative to that of the targets, that is none
_AT_ONCE = 2**22  # numbers in the covariances of a batch
_STUCK = 1e8  # damping of a search that finds nothing better
_NEARER = 2  # times that the mean is linearised anew for a sample of the hyper-parameters
_POOR = 0.3  # power of the weights of such draws, below which there are more
_MOST_DRAWS = 2048
_ROWS = 1_000_000  # that the physics is asked about for them
_DRAWS = 48  # of the parameters, for each sample of the hyper-parameters


class Calibration:
    r"""The unknown parameters of a model's physics, which all of its ``B`` outputs share.

    In their coordinates z, which are standard normal by the prior, the mean of the targets is
    linear near a point, :math:`m(z) \approx m(z_0) + J (z - z_0)`. So they are integrated out in
    closed form while hyper-parameters are learnt, as unknown constants with the bases J: given z
    the outputs are independent, and what the others say of it is a normal prior to each.

    Args:
        model: A model with such a physics, in train mode.
    """

    def __init__(self, model: ExactGPBase) -> None:
        if model._input_batch_shape:
            raise ValueError(
                "Expected a model of one data set to learn unknown parameters of its physics, got "
                f"one with batch_shape {tuple(model._input_batch_shape)}; fit the data sets of a "
                "batch one by one."
            )
        self.model = model
        transform = model.input_transform
        assert isinstance(transform, PhysicsInput), "or there was no physics"
        self._transform = transform
        raw, n = model.train_inputs[0], model.train_targets.shape[-1]
        self._raw = raw[0] if model.num_outputs > 1 else raw
        self._targets = model.train_targets.reshape(-1, n)
        self._observed = ~self._targets.isnan()
        self._all = bool(self._observed.all())
        self.unknowns = transform.physics.unknowns
        kernels = (kernel for _, kernel, _, _ in kernels_of(model))
        self._is_orthogonal = any(isinstance(kernel, OrthogonalKernel) for kernel in kernels)
        scaled = (t for t in model.terms if isinstance(t.basis, AppendedPhysics))
        self._moves_covariance = self._is_orthogonal or not all(t.is_known for t in scaled)

    @property
    def point(self) -> Tensor:
        """Where the parameters are, ``p``."""
        return self._transform.coordinates.detach().clone()

    def move_to(self, point: Tensor) -> None:
        """Move the parameters to coordinates ``p``."""
        with torch.no_grad():
            self._transform.coordinates.copy_(point)
        self.direct(self.model, point)

    @torch.no_grad()
    def direct(self, model: ExactGPBase, points: Tensor) -> None:
        """Make kernels orthogonal to what the parameters do near points, ``(k) x p``.

        Args:
            model: Whose kernels; they have a batch of ``k`` if there are ``k`` points.
            points: Coordinates of the parameters.
        """
        if not self._is_orthogonal:
            return
        inputs, p = self._inputs(points), points.shape[-1]
        slope = self.around(points).slope
        shape = (*points.shape[:-1], *self.model.train_targets.shape[:-1], -1, p)
        for _, kernel, num_inputs, _ in kernels_of(model):
            if isinstance(kernel, OrthogonalKernel):
                kernel.set_directions(inputs[..., :num_inputs], slope.reshape(shape))

    @torch.no_grad()
    def around(self, points: Tensor) -> Around:
        """The prior mean near points ``... x p``."""
        p = points.shape[-1]
        moves, here = _STEP * torch.eye(p).to(points), points.unsqueeze(-2)
        residual = self._residuals(torch.cat([here, here + moves, here - moves], dim=-2))
        here, up, down = residual.split([1, p, p], dim=-3)
        slope = ((down - up) / (2 * _STEP)).movedim(-3, -1)
        return Around(points, here.squeeze(-3), slope.nan_to_num(0.0, 0.0, 0.0))

    @torch.no_grad()
    def least_squares(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        r"""The parameters that fit best without any Gaussian process, by Levenberg and Marquardt.

        They minimise :math:`\sum_j \tfrac{n_j}{2} \log |r_j|^2 + \tfrac12 |z|^2`, with the variance
        of each output's residuals at its best, from several starts at once.

        Returns:
            Their coordinates, ``p``, and the mean squares of the residuals, ``B``.
        """
        current = self.point.unsqueeze(0)  # where it works, as the model was built there
        seed = int(torch.randint(2**31, (1,), generator=generator))
        engine = torch.quasirandom.SobolEngine(current.shape[-1], scramble=True, seed=seed)
        shares = engine.draw(_GUESSES, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
        guesses = torch.cat([current, torch.special.ndtri(shares).to(current)])
        values = self._misfit(guesses, self._residuals(guesses))[0]
        best = values[1:].argsort()[: _STARTS - 1] + 1
        z = torch.cat([guesses[:1], guesses[best]])
        z = z[torch.cat([values[:1], values[best]]).isfinite()]
        damping, near = z.new_full((len(z), 1, 1), 1e-3), self.around(z)
        values, variances = self._misfit(z, near.residual)
        going = torch.ones(len(z), dtype=torch.bool)
        for iteration in range(_ITERATIONS):
            if iteration == _TRIED:
                best = values.argsort()[:_KEPT]
                near = Around(*(part[best] for part in near))
                values, variances, z = values[best], variances[best], z[best]
                damping, going = damping[best], going[best]
            slope = near.slope / variances[..., None, None]
            gradient = (slope.mT @ near.residual.unsqueeze(-1)).sum(-3).squeeze(-1) - z
            hessian = (slope.mT @ near.slope).sum(-3)
            hessian = hessian + torch.eye(z.shape[-1]).to(z)
            hessian = hessian + damping * torch.diag_embed(hessian.diagonal(dim1=-1, dim2=-2))
            moved = self.around(z + torch.linalg.solve(hessian, gradient))
            found, others = self._misfit(moved.point, moved.residual)
            better = found < values
            stops = better & (values - found < _ARRIVED)
            going &= ~stops & (damping.flatten() < _STUCK)
            near = Around(*(_where(better, new, old) for new, old in zip(moved, near, strict=True)))
            values, variances = found.where(better, values), _where(better, others, variances)
            z, damping = near.point, damping * torch.where(better, 0.2, 5.0)[:, None, None]
            if not going.any():
                break
        i = values.argmin()
        return z[i], variances[i]

    def independent(self, near: Around, variances: Tensor) -> Information:
        """What targets say whose errors are independent, of variances ``B``."""
        slope = near.slope / variances[..., None, None]
        return Information(
            slope.mT @ near.slope, (slope.mT @ near.target.unsqueeze(-1)).squeeze(-1)
        )

    def information(self, near: Around, covariance: Tensor) -> Information:
        """What targets say of covariances ``... x B x n x n``."""
        chol = self._factor(covariance)
        columns = torch.cat([near.slope, near.target.unsqueeze(-1)], dim=-1)
        white = torch.linalg.solve_triangular(
            chol, columns.expand(*chol.shape[:-1], -1), upper=False
        )
        slope, target = white[..., :-1], white[..., -1:]
        return Information(slope.mT @ slope, (slope.mT @ target).squeeze(-1))

    def shared(self, near: Around, information: Information) -> Shared:
        """What the parameters, by their prior and the other outputs, add to each output."""
        count = len(self._targets)
        mean, chol = information.posterior((1 - torch.eye(count)).to(near.point))
        root = torch.linalg.solve_triangular(chol, near.slope.mT, upper=False).mT
        away = near.slope @ (mean - near.point).unsqueeze(-1)
        shape = self.model.train_targets.shape
        return Shared(away.reshape(shape), (root @ root.mT).reshape(*shape, shape[-1]))

    @torch.no_grad()
    def covariance(
        self, parameters: LogParameters, vectors: Tensor, points: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean ``k x B x n`` and covariance of the targets, for vectors ``k x B x q`` at points."""
        inputs = self._inputs(points)
        self.direct(self.model, points)
        noise = known_noise(self.model.likelihood)
        distribution = ModuleDistribution(self.model, inputs, parameters, noise, True, None)
        mean, covariance = distribution(parameters.unflatten(vectors))
        b, n = self._targets.shape
        shape = (max(len(vectors), len(points)), b, n)
        mean = mean.expand(covariance.shape[:-1]).reshape(-1, b, n)
        return mean.expand(shape), covariance.reshape(-1, b, n, n).expand(*shape, n)

    @torch.no_grad()
    def newton(self, near: Around, covariance: Tensor) -> Tensor:
        """The most likely parameters, ``p``, at a covariance ``B x n x n``: a step of Newton's."""
        target, _ = self.information(near, covariance).posterior()
        shares = torch.tensor([1.0, 0.5, 0.25, 0.1, 0.0]).to(target).unsqueeze(-1)
        points = near.point + shares * (target - near.point)
        residual = self._residuals(points).movedim(0, -1)
        white = torch.linalg.solve_triangular(self._factor(covariance), residual, upper=False)
        value = white.square().sum((0, 1)) + points.square().sum(-1)
        return points[value.nan_to_num(nan=math.inf, posinf=math.inf).argmin()]

    @torch.no_grad()
    def draw(
        self, near: Around, parameters: LogParameters, vectors: Tensor, generator: torch.Generator
    ) -> Draws:
        """Draw parameters given each of some vectors of hyper-parameters, ``H x B x q``.

        Returns:
            Draws of ``H`` problems, with positions ``N x H x p``.
        """
        _, covariance = self.covariance(parameters, vectors, near.point.unsqueeze(0))
        mean, chol = self.information(near, covariance).posterior()
        for _ in range(_NEARER):  # each to where it is linear for these hyper-parameters
            mean, chol = self.information(self.around(mean), covariance).posterior()
        root = torch.linalg.cholesky(torch.cholesky_inverse(chol))
        # Away from the mean in standard deviations, as these may be next to nothing beside it.
        zero, one = torch.zeros_like(mean).unsqueeze(0), torch.ones(1, len(vectors)).to(mean)
        proposal = Mixture(zero, one, torch.eye(mean.shape[-1]).to(root).expand_as(root))

        def coordinates(away: Tensor) -> Tensor:
            return mean + (root @ away.unsqueeze(-1)).squeeze(-1)

        def drawn(number: int) -> Draws:
            return importance_sample(
                lambda away: potential(coordinates(away)), proposal, number, generator
            )

        potential = self._potential_given(parameters, vectors, covariance)
        draws = drawn(_DRAWS)
        more = min(_MOST_DRAWS, _ROWS // (len(vectors) * len(self._raw)))
        if (draws.power < _POOR).any() and more > _DRAWS:  # far from linear: adapt, in rounds
            draws = drawn(more)
        return draws._replace(positions=coordinates(draws.positions))

    def _potential_given(
        self, parameters: LogParameters, vectors: Tensor, covariance: Tensor
    ) -> Callable[[Tensor], Tensor]:
        """Negative log densities ``k x H`` of parameters ``k x H x p`` given hyper-parameters.

        They are up to a constant for each of the ``H`` vectors, of which ``covariance`` is that of
        the targets.
        """
        if self._moves_covariance:
            return lambda z: self._potential(z, parameters, vectors)
        chol = self._factor(covariance)

        def potential(z: Tensor) -> Tensor:
            residual = self._residuals(z).movedim(0, -1)  # H x B x n x k
            white = torch.linalg.solve_triangular(chol, residual, upper=False)
            value = 0.5 * white.square().sum((1, 2)).mT + 0.5 * z.square().sum(-1)
            return value.nan_to_num(nan=math.inf, posinf=math.inf)

        return potential

    def _potential(self, z: Tensor, parameters: LogParameters, vectors: Tensor) -> Tensor:
        """Negative log densities ``k x H`` of parameters ``k x H x p`` given hyper-parameters."""
        flat, which = z.flatten(0, 1), torch.arange(len(vectors)).repeat(len(z))
        b, n = self._targets.shape
        at_once = max(1, _AT_ONCE // (b * n**2))
        found = []
        for part, rows in zip(flat.split(at_once), which.split(at_once), strict=True):
            mean, covariance = self.covariance(parameters, vectors[rows], part)
            failed = (mean.isnan() & self._observed).flatten(1).any(-1)
            # Where the physics fails there is no covariance either.
            covariance = covariance.where(~failed[:, None, None, None], torch.eye(n).to(covariance))
            residual = self._targets - mean.nan_to_num(nan=0.0)
            value = negative_log_likelihood(residual, covariance).value.sum(-1)
            found.append(value.masked_fill(failed, math.inf) + 0.5 * part.square().sum(-1))
        return torch.cat(found).nan_to_num(nan=math.inf, posinf=math.inf).view(z.shape[:2])

    def _inputs(self, points: Tensor) -> Tensor:
        """What the terms read at points ``... x p``, ``... x (1) x n x d``; NaN if f_p fails."""
        inputs = self._transform.at(self._raw, points)
        return inputs.unsqueeze(-3) if self.model.num_outputs > 1 else inputs

    def _residuals(self, points: Tensor) -> Tensor:
        """The targets less their prior mean at points ``... x p``, as in :class:`Around`."""
        mean = self.model.mean_module(self._inputs(points))
        mean = mean.reshape(*points.shape[:-1], *self._targets.shape)
        residual = self._targets - mean.nan_to_num(nan=math.inf, posinf=math.inf)
        return residual.where(self._observed, torch.zeros_like(residual))

    def _misfit(self, z: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """What least squares minimise, ``k``, and the variances of residuals, ``k x B``."""
        count = self._observed.sum(-1).to(z)
        least = _SILENT * self._targets.square().nanmean(-1) + torch.finfo(z.dtype).tiny
        variances = (residual.square().sum(-1) / count).maximum(least)
        value = (0.5 * count * variances.log()).sum(-1) + 0.5 * z.square().sum(-1)
        return value.nan_to_num(nan=math.inf, posinf=math.inf), variances

    def _factor(self, covariance: Tensor) -> Tensor:
        return cholesky(covariance.clone(), None if self._all else self._observed)[0]


def _where(which: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Rows of the one or of the other."""
    return torch.where(which.reshape(-1, *[1] * (new.dim() - 1)), new, old)
