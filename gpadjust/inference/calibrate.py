"""Learning the unknown parameters of a physics, with all else."""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust.gp import AppendedPhysics, OrthogonalKernel
from gpadjust.gp.gaussian import cholesky, negative_log_likelihood
from gpadjust.inference.optimise import FitResult, Search, maximise
from gpadjust.inference.targets import ByModules, MarginalizedParameters
from gpadjust.models import TermsGP
from gpadjust.models.parameters import Parameters

_STEP = 1e-4  # of differences, in standard deviations of the prior
_GUESSES = 512  # of the parameters, of which the best are started from
_STARTS = 32
_ROUNDS_OF_SEARCHES = 4  # at most
_UNSEEN = 0.02  # of the posterior, near optima that searches have not come to
_ITERATIONS = 60  # of least squares
_ARRIVED = 1e-4  # decrease of a negative log density at which they stop
_BESIDE = 0.5  # standard deviations, within which starts or optima are one
_ALIKE = 1e-3  # standard deviations of the prior, likewise
_REACHED = 2.0  # standard deviations from an optimum, within which a search came to it
_WORSE = 12.0  # negative log density, beside the best, of an optimum that does not count
_KEPT = 12  # of these
_STUCK = 1e8  # damping of a search that finds nothing better
_SILENT = 1e-14  # the mean square of residuals, relative to that of the targets, that is none
_ROUNDS = 4  # of hyper-parameters and parameters by turns
_SETTLED = 0.05  # standard deviations that the parameters moved in the last of them
_UNTOLD = 0.15  # of the prior's precision: what else is known of a direction is next to nothing
_TAKES_PART = 0.3  # cosine of a parameter and such a direction
_FAR = 3.0  # standard deviations of the prior


class ParameterWarning(UserWarning):
    """The observations say next to nothing of parameters of the physics, or contradict a prior."""


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


class Optima(NamedTuple):
    """Where least squares came to.

    Attributes:
        points: Coordinates of all optima that count, the best first, ``k x p``.
        variances: Mean squares of the residuals at the best, ``B``.
        unseen: About the share of the posterior near others that no search came to: that of those
            that one alone did (after Good and Turing), and of what is too many.
    """

    points: Tensor
    variances: Tensor
    unseen: float


class Information(NamedTuple):
    """What the targets of each output say of the parameters, if the mean is linear in them.

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


class Calibration:
    r"""The unknown parameters of a model's physics, which all of its ``B`` outputs share.

    In their coordinates z, which are standard normal by the prior, the mean of the targets is
    linear near a point, :math:`m(z) \approx m(z_0) + J (z - z_0)`. So they are integrated out in
    closed form while hyper-parameters are learnt, as unknown constants with the bases J: given z
    the outputs are independent, and what the others say of it is a normal prior to each.

    Args:
        model: A model with such a physics, in train mode.

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
        self._targets = model.train_targets.reshape(-1, n)
        self._observed = ~self._targets.isnan()
        self._all = bool(self._observed.all())
        self.unknowns = self._transform.physics.unknowns
        self._orthogonal = [
            i for i, term in enumerate(model.terms) if isinstance(term.kernel, OrthogonalKernel)
        ]
        scaled = [term for term in model.terms if isinstance(term.basis, AppendedPhysics)]
        self.moves_covariance = bool(self._orthogonal) or not all(t.is_known for t in scaled)

    @property
    def point(self) -> Tensor:
        """Where the parameters are, ``p``."""
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

    @torch.no_grad()
    def linearized(self, points: Tensor) -> LinearizedMean:
        """The prior mean near points ``... x p``."""
        p = points.shape[-1]
        moves, here = _STEP * torch.eye(p).to(points), points.unsqueeze(-2)
        residual = self.residuals(torch.cat([here, here + moves, here - moves], dim=-2))
        here, up, down = residual.split([1, p, p], dim=-3)
        slope = ((down - up) / (2 * _STEP)).movedim(-3, -1)
        return LinearizedMean(points, here.squeeze(-3), slope.nan_to_num(0.0, 0.0, 0.0))

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

    @torch.no_grad()
    def least_squares(self, generator: torch.Generator) -> Optima:
        r"""The parameters that fit best without any Gaussian process.

        They minimise :math:`\sum_j \tfrac{n_j}{2} \log |r_j|^2 + \tfrac12 |z|^2`, with the variance
        of each output's residuals at its best. Where a single search came to an optimum, there are
        likely others that none did, so that more begin.
        """
        guesses, found = self.point.unsqueeze(0), []  # where it works, as the model was built there
        for _ in range(_ROUNDS_OF_SEARCHES):
            others = spread_normal((_GUESSES, guesses.shape[-1]), generator).to(guesses)
            found.append(self._descend(torch.cat([guesses, others])))
            points, values, variances, hessians = map(torch.cat, zip(*found, strict=True))
            kept, square = _apart(points, values, hessians)
            share = (values[kept].min() - values[kept]).exp()
            alone = (square < _REACHED**2).sum(-1) == 1
            alone[_KEPT:] = True
            unseen = (share * alone).sum() / share.sum()
            if unseen < _UNSEEN:
                break
            guesses = guesses[:0]
        kept = kept[:_KEPT]
        kept = kept[values[kept] < values[kept[0]] + _WORSE]
        return Optima(points[kept], variances[kept[0]], unseen.item())

    def _descend(self, guesses: Tensor) -> tuple[Tensor, ...]:
        """Searches by Levenberg and Marquardt, which begin at the best of guesses ``... x p``.

        Returns:
            Where they came to, ``k x p``, what they minimise there, ``k``, variances of residuals,
            ``k x B``, and about the second derivatives, ``k x p x p``.
        """
        values = self._misfit(guesses, self.residuals(guesses))[0]
        prior = torch.eye(guesses.shape[-1]).to(guesses).expand(len(guesses), -1, -1)
        best = _apart(guesses, values, prior)[0][:_STARTS]
        near = self.linearized(guesses[best[values[best].isfinite()]])
        values, variances = self._misfit(near.point, near.residual)
        damping = values.new_full((len(values), 1, 1), 1e-3)
        hessians = torch.empty_like(damping).expand(-1, *prior.shape[1:]).clone()
        going = torch.arange(len(values), device=values.device)
        for _ in range(_ITERATIONS):
            z, slope = near.point[going], near.slope[going]
            weighted = slope / variances[going][..., None, None]
            residual = near.residual[going].unsqueeze(-1)
            gradient = (weighted.mT @ residual).sum(-3).squeeze(-1) - z
            hessian = hessians[going] = (weighted.mT @ slope).sum(-3) + prior[0]
            damped = hessian + damping[going] * torch.diag_embed(hessian.diagonal(dim1=1, dim2=2))
            moved = self.linearized(z + torch.linalg.solve(damped, gradient))
            found, others = self._misfit(moved.point, moved.residual)
            better = found < values[going]
            arrived = better & (values[going] - found < _ARRIVED)
            damping[going] *= torch.where(better, 0.2, 5.0)[:, None, None]
            pairs = zip((*near, variances, values), (*moved, others, found), strict=True)
            for old, new in pairs:
                old[going[better]] = new[better]
            going = going[~arrived & (damping[going].flatten() < _STUCK)]
            if not len(going):
                break
        return near.point, values, variances, hessians

    def information(self, near: LinearizedMean, chol: Tensor) -> Information:
        """What targets say whose covariances have the factors ``... x B x n x n``."""
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
        return cholesky(covariance.clone(), None if self._all else self._observed)[0]

    def marginalized(
        self, near: LinearizedMean, information: Information
    ) -> MarginalizedParameters:
        """What the parameters, by their prior and the other outputs, add to each output."""
        count = len(self._targets)
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
        b, n = self._targets.shape
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
        return _or_infinite(0.5 * value)

    def density(self, z: Tensor, parameters: Parameters, vectors: Tensor) -> Tensor:
        """Negative log densities ``k`` of parameters ``k x p`` beside vectors ``k x B x q``."""
        mean, covariance = self.moments(parameters, vectors, z)
        failed = (mean.isnan() & self._observed).flatten(1).any(-1)
        # Where the physics fails there is no covariance either.
        one = torch.eye(mean.shape[-1]).to(covariance)
        covariance = covariance.where(~failed[:, None, None, None], one)
        residual = self._targets - mean.nan_to_num(nan=0.0)
        value = negative_log_likelihood(residual, covariance).value.sum(-1)
        return _or_infinite(value.masked_fill(failed, math.inf) + 0.5 * z.square().sum(-1))

    def _inputs(self, points: Tensor) -> Tensor:
        """What the terms read at points ``... x p``, ``... x (1) x n x d``; NaN if f_p fails."""
        inputs: Tensor = self._transform.at(self._raw, points)
        return inputs.unsqueeze(-3) if self.model.num_outputs > 1 else inputs

    def residuals(self, points: Tensor) -> Tensor:
        """As in :class:`LinearizedMean`, at points ``... x p``."""
        mean = self.model.mean_module(self._inputs(points))
        mean = mean.reshape(*points.shape[:-1], *self._targets.shape)
        residual = self._targets - _or_infinite(mean)
        return residual.where(self._observed, torch.zeros_like(residual))

    def _misfit(self, z: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """What least squares minimise, ``k``, and the variances of residuals, ``k x B``."""
        count = self._observed.sum(-1).to(z)
        least = _SILENT * self._targets.square().nanmean(-1) + torch.finfo(z.dtype).tiny
        variances = (residual.square().sum(-1) / count).maximum(least)
        value = (0.5 * count * variances.log()).sum(-1) + 0.5 * z.square().sum(-1)
        return _or_infinite(value), variances

    def _text(self, values: Tensor) -> str:
        """Parameters ``p`` in words."""
        named = zip(self.unknowns.names, values.tolist(), strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in named)


class Calibrated(NamedTuple):
    """A model at its most likely parameters, about which they are integrated out.

    Attributes:
        calibration: Its parameters.
        near: The prior mean near them.
        information: What the targets of each output say of them.
        marginalized: What they add to the distribution of the targets.
        result: What the fit of the hyper-parameters reached.
        places: All of their optima, that best fit first, ``k x p``.
        unseen: As in :class:`Optima`.
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
    (point, *others), variances, unseen = calibration.least_squares(generator)
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
    """As :func:`calibrate`, of a model whose hyper-parameters are sampled afterwards."""
    search = search._replace(
        num_starts=search.num_starts or 4,
        num_screened=64 if search.num_screened is None else search.num_screened,
        max_iterations=min(search.max_iterations, 60),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OptimizationWarning)
        return calibrate(model, search)


def warn_of_parameters(calibrated: Calibrated) -> None:
    """Warn of parameters that the observations tell nothing of, or against what was known.

    The first are directions in which the observations have next to none of the prior's precision;
    the second are likely more standard deviations of the prior away from its middle than it allows.
    """
    names = calibrated.calibration.unknowns.names

    def of(which: Tensor) -> str:
        return ", ".join(name for name, yes in zip(names, which.tolist(), strict=True) if yes)

    values, vectors = torch.linalg.eigh(calibrated.information.precision.sum(-3))
    if silent := of(vectors[:, values < _UNTOLD].norm(dim=-1) > _TAKES_PART):
        warnings.warn(
            f"The observations say next to nothing of {silent} of the physics, or only of a "
            "combination of them: their posterior is their prior there. Observe where they matter, "
            "give narrower priors, or take one of them as known.",
            ParameterWarning,
            stacklevel=4,
        )
    if against := of(calibrated.near.point.abs() > _FAR):
        warnings.warn(
            f"Observations and prior disagree about {against} of the physics: most likely are "
            f"values more than {_FAR:g} standard deviations of the prior away. Look at guess, sd, "
            "factor and bounds, or at the physics.",
            ParameterWarning,
            stacklevel=4,
        )


def spread_normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Standard normal draws ``... x p`` that fill space evenly, in random order (Sobol)."""
    seed = int(torch.randint(2**31, (1,), generator=generator))
    engine = SobolEngine(shape[-1], scramble=True, seed=seed)
    number = math.prod(shape[:-1])
    shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    order = torch.randperm(number, generator=generator)
    return torch.special.ndtri(shares[order]).reshape(shape)


def _apart(points: Tensor, values: Tensor, hessians: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``k x p`` that are not beside a better one.

    Args:
        points: The points.
        values: Negative log densities there, ``k``.
        hessians: Metrics of distances from each, ``k x p x p``.

    Returns:
        Their numbers, ``K``, the best first, and squares of their distances to all, ``K x k``.
    """
    order = values.argsort()
    away = points[order].unsqueeze(0) - points[order].unsqueeze(1)
    square = torch.einsum("ijp,ipq,ijq->ij", away, hessians[order], away)
    alike = (square < _BESIDE**2) | (away.square().sum(-1) < _ALIKE**2)
    first = ~alike.tril(-1).any(-1)
    return order[first], square[first]


def _or_infinite(values: Tensor) -> Tensor:
    """Values with infinity in place of NaN."""
    return values.nan_to_num(nan=math.inf, posinf=math.inf)
