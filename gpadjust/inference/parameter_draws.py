"""Draws of the unknown parameters of a physics, and of the hyper-parameters that go with them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gpadjust.inference.annealing import Particles, raised, resampled
from gpadjust.inference.calibrate import Calibrated
from gpadjust.inference.calibration import Calibration, LinearizedMean
from gpadjust.inference.least_squares import spread_normal
from gpadjust.inference.proposals import Mixture
from gpadjust.inference.vectors import Parameters

_GIVEN = {128: 256, 512: 64, math.inf: 16}  # hyper-parameters of up to so many observations
_ENOUGH = 512  # effective sample size of the parameters that is enough
_COUNTED = 64  # draws, at least, by weights that are tempered if need be
_ROUND = 256  # draws at once
_MOST_DRAWS = 2048  # about each optimum
_MOVED = 512  # draws, where these are not enough
_MOVES = 10  # of each, for each parameter, and as many again
_LEAST_MOVES = 80
_JUMPS = 0.1  # of these by a whole difference
_JITTER = 1e-4
_MOVED_UP_TO = {False: 128, True: 24}  # observations, by whether each draw has a covariance
_ROWS = 1_000_000  # draws times observations
_STEPS = 4  # from where the mean is linear to a draw
_POLISHES = 3  # steps after these
_TINY = 1e-300
_SOLVED = 1e-2  # standard deviations that a draw may be from its aim
_FOLDED = 0.05  # of the draws without a solution, above which others are taken
_WIDER = 1.5  # than the posterior of a linear mean, these
_AT_ONCE = 2**22  # numbers in the covariances of a batch


class ParameterDraws:
    """The joint posterior of coordinates z and a choice of vectors of hyper-parameters.

    Args:
        calibration: The parameters of the physics.
        places: Their optima, ``k x p``.
        parameters: The learnable hyper-parameters.
        vectors: Vectors of them, ``H x B x q``.
        log_densities: Of what these were drawn from, less that of their priors, ``H``.
        generator: Source of randomness.
    """

    def __init__(
        self,
        calibration: Calibration,
        places: Tensor,
        parameters: Parameters,
        vectors: Tensor,
        log_densities: Tensor,
        generator: torch.Generator,
    ) -> None:
        self._calibration, self._places = calibration, places
        self._parameters, self._vectors = parameters, vectors
        self._log_densities, self._generator = log_densities, generator
        self._count = len(vectors)
        self._each, precisions = [], []
        for place in places:
            _, covariance = calibration.moments(parameters, vectors, place.unsqueeze(0))
            near, chol = calibration.linearized(place), calibration.factor(covariance)
            self._each.append((near, chol))
            _, root = calibration.information(near, chol).posterior()
            precisions.append((root @ root.mT).mean(0))
        self._precisions = torch.stack(precisions)
        # Of the targets' covariance, if parameters do not move it.
        self._chol = self._each[0][1]
        self._log_det = self._chol.diagonal(dim1=-1, dim2=-2).log().sum((-1, -2))

    def draw(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw by importance sampling, and by moves where few of the draws count.

        Coordinates are drawn for each of the vectors (:meth:`_randomized`), and the pairs weighted.
        Of several optima, each draws what is nearer to it than to the others.

        Args:
            number: Number ``K`` of pairs.

        Returns:
            Equally likely pairs, numbers of the vectors, ``K``, and coordinates, ``K x p``; and the
            effective sample size.
        """
        places, straight = self._places, [False] * len(self._places)
        found, log_weights = places[:0], self._log_densities[:0]
        size, n = log_weights.new_zeros(()), self._chol.shape[-1]
        most = len(places) * max(_ROUND, min(_MOST_DRAWS, _ROWS // n))
        turns = torch.arange(_ROUND, device=places.device) % self._count
        while len(found) < most and size < _ENOUGH:
            for i, (near, chol) in enumerate(self._each):
                if not straight[i]:
                    z, log_q = self._randomized(near, chol, _ROUND)
                    straight[i] = bool((log_q == math.inf).double().mean() > _FOLDED)
                if straight[i]:
                    z, log_q = self._straight(near, chol, _ROUND)
                log_w = -self._density(z, turns) - log_q
                log_w = log_w.nan_to_num(nan=-math.inf, posinf=-math.inf)
                log_w[self._nearest(z) != i] = -math.inf
                found, log_weights = torch.cat([found, z]), torch.cat([log_weights, log_w])
            if log_weights.isfinite().any():
                size = log_weights.softmax(0).square().sum().reciprocal()
        if not log_weights.isfinite().any():
            raise FloatingPointError("The density of the parameters is zero at all draws.")
        # Weights are tempered as far as few would have them all, and draws then moved.
        least, start = min(_COUNTED, len(found) / 4), log_weights.new_zeros(1)
        _, weights, _ = raised(log_weights.unsqueeze(1), start, least)
        moves = bool(size < _ENOUGH) and n <= _MOVED_UP_TO[self._calibration.moves_covariance]
        rows = resampled(weights, _MOVED if moves else number + number % 2, self._generator)[:, 0]
        which, found = rows % self._count, found[rows]
        if moves:
            which, before = self._moved(which, found)
            which, found = self._moved(which, before)
            size = _size_of_moved(before, found)
        again = torch.arange(number, device=rows.device) % len(found)
        return which[again], found[again], size

    def _nearest(self, z: Tensor) -> Tensor:
        """Numbers of the optima that coordinates ``N x p`` are nearest to, by each one's metric."""
        away = z.unsqueeze(1) - self._places
        return torch.einsum("nkp,kpq,nkq->nk", away, self._precisions, away).argmin(-1)

    def _moved(self, which: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Move pairs by Metropolis' rule, so that they become draws of the posterior.

        Parameters go by differences of others (ter Braak 2006), each fourth time hyper-parameters
        by the draws of them. Pairs of even and odd number are independent.

        Args:
            which: Numbers of vectors of hyper-parameters, ``N``.
            z: Coordinates, ``N x p``.
        """
        n, p = z.shape
        which, z = which.clone(), z.clone()
        value, quarter, generator = self._density(z, which), n // 4, self._generator
        every = torch.arange(n).view(quarter, 4)
        options: Any = {"generator": generator, "dtype": z.dtype}
        for step in range(max(_LEAST_MOVES, _MOVES * p)):
            for own, others in ((every[:, :2], every[:, 2:]), (every[:, 2:], every[:, :2])):
                one, two = torch.randint(quarter, (2, quarter, 2), generator=generator)
                pair = [others.gather(0, row).flatten() for row in (one, two)]
                rows, size = own.flatten(), 2 * quarter
                new, vectors = z[rows], which[rows]
                if step % 4 == 3:
                    vectors = torch.randint(self._count, (size,), generator=generator).to(which)
                else:
                    length = 2.38 / math.sqrt(2 * p) * (0.2 + torch.rand(size, 1, **options))
                    length[torch.rand(size, **options) < _JUMPS] = 1.0
                    jitter = _JITTER * torch.randn(size, p, **options) * z.std(0).cpu()
                    new = new + length.to(z) * (z[pair[0]] - z[pair[1]]) + jitter.to(z)
                found = self._density(new, vectors)
                chance = (value[rows] - found).exp().nan_to_num(nan=0.0)
                taken = torch.rand(size, **options).to(z) < chance
                kept = rows.to(z.device)[taken]
                z[kept], which[kept], value[kept] = new[taken], vectors[taken], found[taken]
        return which, z

    def _randomized(self, near: LinearizedMean, chol: Tensor, number: int) -> tuple[Tensor, Tensor]:
        r"""Draw parameters by least squares of randomised targets, which follow where a mean bends.

        With whitened residuals of prior and targets, :math:`F(z) = (z, L^{-1} (m(z) - y))`, and an
        orthonormal basis Q of their slopes near a point, a draw is the solution of :math:`Q^T F(z)
        = \eta`, :math:`\eta \sim N(0, I)`. Its density is :math:`|\det Q^T F'(z)| \, N(Q^T F(z))`
        (randomize-then-optimize, Bardsley et al. 2014), the posterior itself of a linear mean. The
        equations are solved by Broyden's method, in one step or, where that does not do, in some.

        Args:
            near: The mean near a point ``p``.
            chol: Factors of the targets' covariance, ``H x B x n x n``.
            number: Number ``N`` of draws, of the ``H`` by turns.

        Returns:
            Coordinates, ``N x p``, and logarithms of their densities, ``N``; infinite where there
            is no solution.
        """
        p, slope = len(near.point), near.slope.expand(*chol.shape[:-1], -1)
        white = torch.linalg.solve_triangular(chol, slope, upper=False)
        identity = torch.eye(p).to(white).expand(len(white), p, p)
        basis, _ = torch.linalg.qr(torch.cat([identity, white.flatten(1, 2)], dim=-2))
        first, rest = basis.split([p, basis.shape[-2] - p], dim=-2)
        rest = torch.linalg.solve_triangular(
            chol.mT, rest.unflatten(1, slope.shape[1:3]), upper=True
        )
        turns = number // len(white)
        first, rest = first.repeat(turns, 1, 1), rest.repeat(turns, 1, 1, 1)
        near = LinearizedMean(*(part.expand(number, *part.shape) for part in near))

        def value_of(z: Tensor, residual: Tensor, which: Tensor) -> Tensor:
            back = (rest[which] * residual.unsqueeze(-1)).sum((1, 2))
            return (first[which] * z.unsqueeze(-1)).sum(1) - back

        def slope_of(slope: Tensor) -> Tensor:
            return first.mT + (rest.unsqueeze(-1) * slope.unsqueeze(-2)).sum((1, 2))

        aim = spread_normal((number, p), self._generator).to(white)
        every = torch.arange(number, device=white.device)
        start, by_z = value_of(near.point, near.residual, every), slope_of(near.slope)
        found, unsolved = near.point.clone(), every
        for steps in (1, _STEPS):  # where one does not do, a way that keeps to the ridge
            z, value, slopes = near.point[unsolved], start[unsolved], by_z[unsolved]
            for step in range(steps + _POLISHES):
                share = min(1.0, (step + 1) / steps)
                goal = start[unsolved] + share * (aim - start)[unsolved]
                move = torch.linalg.solve_ex(slopes, (goal - value).unsqueeze(-1))[0]
                z = z + move.squeeze(-1)
                missed = value + (slopes @ move).squeeze(-1)
                value = value_of(z, self._calibration.residuals(z), unsolved)
                length = move.square().sum(-2, keepdim=True).clamp_min(_TINY)
                slopes = slopes + (value - missed).unsqueeze(-1) * move.mT / length
                solved = (value - aim[unsolved]).abs().amax(-1) < _SOLVED
                if step + 1 >= steps and solved.all():
                    break
            found[unsolved[solved]] = z[solved]
            unsolved = unsolved[~solved]
            if not len(unsolved):
                break
        around = self._calibration.linearized(found)
        by_z = slope_of(around.slope)
        by_z[unsolved] = torch.eye(p).to(by_z)
        value = value_of(found, around.residual, every)
        log_q = torch.linalg.slogdet(by_z).logabsdet - 0.5 * value.square().sum(-1)
        log_q[unsolved] = math.inf
        return found, log_q - 0.5 * p * math.log(2 * math.pi)

    def _straight(self, near: LinearizedMean, chol: Tensor, number: int) -> tuple[Tensor, Tensor]:
        """Return draws of Student's t about the posterior of a linear mean.

        Where a mean folds, randomised equations have no solution beyond the fold.
        """
        mean, factor = self._calibration.information(near, chol).posterior()
        root = _WIDER * torch.linalg.cholesky(torch.cholesky_inverse(factor))
        student = Mixture(mean[None], torch.ones_like(mean[None, :, 0]), root[None])
        z = student.sample(number // len(mean), self._generator)
        return z.flatten(0, 1), -student.value_and_gradient(z)[0].flatten()

    def _density(self, z: Tensor, which: Tensor) -> Tensor:
        """Negative log densities ``N`` of coordinates ``N x p`` and numbers of vectors ``N``.

        Less those that the vectors were drawn from.
        """
        calibration, found = self._calibration, []
        at_once = max(1, _AT_ONCE // self._chol[0].numel())
        for part, rows in zip(z.split(at_once), which.split(at_once), strict=True):
            if calibration.moves_covariance:
                value = calibration.density(part, self._parameters, self._vectors[rows])
            else:
                value = calibration.at_covariance(part.unsqueeze(0), self._chol[rows])[0]
                value = value + self._log_det[rows]
            found.append(value + self._log_densities[rows])
        return torch.cat(found)


@torch.no_grad()
def draw_parameters(
    calibrated: Calibrated,
    parameters: Parameters,
    vectors: Tensor,
    log_densities: Tensor,
    number: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw parameters of the physics, and of vectors of hyper-parameters those that go with them.

    Args:
        calibrated: The model near its most likely parameters.
        parameters: The learnable hyper-parameters.
        vectors: Draws of them with the parameters integrated out near there, ``H x B x q``.
        log_densities: Theirs, less that of their priors, ``H``.
        number: Number ``K`` of draws.
        generator: Source of randomness.

    Returns:
        Vectors, ``K x B x q``, coordinates of parameters, ``K x p``, and the effective sample size.
    """
    n = calibrated.near.residual.shape[-1]
    count = next(count for most, count in _GIVEN.items() if n <= most) if parameters.names else 1
    count = 2 ** int(math.log2(min(count, len(vectors))))  # a round of draws has them equally often
    rows = torch.linspace(0, len(vectors) - 1, count).round().long()
    given = (parameters, vectors[rows], log_densities[rows], generator)
    draws = ParameterDraws(calibrated.calibration, calibrated.places, *given)
    which, coordinates, size = draws.draw(number)
    return vectors[rows][which], coordinates, size


def _size_of_moved(before: Tensor, after: Tensor) -> Tensor:
    """About the effective size of draws ``N x p`` that moved, by how much they remember."""
    one, two = before - before.mean(0), after - after.mean(0)
    tiny = torch.finfo(one.dtype).tiny
    memory = (one * two).mean(0) / (one.var(0) * two.var(0)).sqrt().clamp_min(tiny)
    memory = memory.amax().clamp(0, 1)
    none = after.new_zeros(len(after), 1)
    size = Particles(after.unsqueeze(1), none, none[0], none[0]).effective_size()[0]
    return size * (1 - memory) / (1 + memory)
