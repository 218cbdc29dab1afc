"""One Gaussian process kernel for the residuals of many outputs: curves, spectra, fields."""

from __future__ import annotations

from copy import copy
from typing import Any, Literal, NamedTuple, Self

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models.transforms.input import InputTransform
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from scipy.special import gammainccinv
from torch import Tensor

from gpadjust.checks import check_level
from gpadjust.gp import PhysicsInput, SumOfTerms
from gpadjust.models.along_coordinate import AlongCoordinate, coordinates_of, smoothed
from gpadjust.models.exact_conditioning import conditional_covariance
from gpadjust.models.posteriors import (
    HyperparameterMixture,
    PosteriorCovariance,
    ScaleFreeMultitaskNormal,
    ScaleFreePosterior,
    mixture_moments,
)
from gpadjust.models.predictive_model import given_noise
from gpadjust.models.structures import ZeroMeanGP
from gpadjust.models.term_builder import KernelLike, PhysicsLike
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import (
    ArrayLike,
    new_observations,
    residual_scale,
    training_data,
)
from gpadjust.physics import as_physics

DEGREES = 2.0  # of freedom of the prior of an output's variance, around that of its residuals
_VAGUE = 100.0  # prior standard deviation of an unknown constant, in residuals' standard deviations
_CAUTION = 0.5  # standard errors that left-out errors are taken as larger by
_DRAWS = 2_000  # of curves, for intervals that hold all of one
_MOST = 4_000  # points times outputs, of a joint covariance of coupled outputs


class _Weights(NamedTuple):
    """Solutions that predictions are made of, for each of ``S`` samples.

    Attributes:
        mean: Of the residuals of all outputs, ``S x n x m``.
        coefficients: Of the columns with unknown constants, ``S x m x k``.
        columns: The columns' own solutions, ``S x n x (m k)``.
        spread: The covariances of the constants for a variance of 1, ``S x m x k x k``.
        square: What the residuals cost, ``S x m``.
    """

    mean: Tensor
    coefficients: Tensor
    columns: Tensor
    spread: Tensor
    square: Tensor


class ParallelPartialGP(TermsModel):
    r"""Adjustment of a physics with many outputs: a curve, a spectrum, a field (10 to 5,000).

    .. math:: f_j(x) = \rho_j f_{p,j}(x) + \delta_j(x), \quad
        \delta_j \sim GP(0, \tau_j k), \quad j = 1 \dots m

    One kernel k and one ratio of noise serve all outputs, so that one Cholesky factor does; the
    variance :math:`\tau_j` and the constants of each output are integrated out in closed form
    (parallel partial emulation, Gu and Berger 2016). Given the kernel the outputs are independent,
    unless they have a ``coordinate``. Where left-out errors are larger than predicted, variances
    grow.

    With a ``coordinate`` t delta is one function of x and t, with the covariance :math:`\tau\,
    k(x, x')\, a(t)\, k_t(t, t')\, a(t')` and noise of one variance for all outputs, by the
    eigenvalues of both (Stegle et al. 2011): neighbours average the noise, and whole curves have a
    joint posterior. The lengthscale of the Matern kernel :math:`k_t` is learnt; a(t) follows the
    size of the residuals.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``, none of them missing.
        train_Yvar: None; the noise is learnt.
        physics: The physics f_p, ``n x d`` to ``n x m``, without unknown parameters; None for a
            Gaussian process around the mean of each output.
        covar_module: The kernel k. Default: RBF with a lengthscale per input.
        rho_mean: :math:`\rho` of all outputs, a number; or ``"learn"`` for one unknown constant for
            each, with a vague prior.
        delta_mean: The mean of delta, 0; or ``"learn"`` for one unknown constant for each output.
        coordinate: Where the outputs are on a line (time, wavelength), ``m`` numbers. Default: they
            are not coupled.
        input_transform: A one-to-one BoTorch input transform; the physics still sees raw inputs.

    Raises:
        TypeError: As :class:`~gpadjust.CKA`.
        ValueError: As :class:`~gpadjust.CKA`; if a target is missing, the physics has unknown
            parameters, there are not ``m`` coordinates, or both coordinates and an unknown rho.

    Example:
        >>> import torch
        >>> from gpadjust import ParallelPartialGP, fit
        >>> t = torch.linspace(0, 1, 50, dtype=torch.float64)
        >>> X = torch.linspace(0.5, 2, 8, dtype=torch.float64).unsqueeze(-1)
        >>> curve = lambda X: torch.exp(-X * t)
        >>> model = ParallelPartialGP(X, curve(X) + 0.1 * X * t, physics=curve, coordinate=t)
        >>> result = fit(model)
        >>> lower, upper = model.interval(X[:1] + 0.1, simultaneous=True)
        >>> lower.shape
        torch.Size([1, 50])
    """

    scales: Tensor
    _is_fully_bayesian = _is_ensemble = True

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike | None = None,
        covar_module: KernelLike | None = None,
        rho_mean: float | Literal["learn"] = 1.0,
        delta_mean: float | Literal["learn"] = 0.0,
        coordinate: ArrayLike | None = None,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__()
        data = training_data(train_X, train_Y, train_Yvar)
        _check(data.X, data.Y, train_Yvar, rho_mean, delta_mean)
        n, m = data.Y.shape
        self.input_names, self.output_names = data.input_names, data.output_names
        f_p = torch.zeros_like(data.Y)
        if physics is not None:
            made = as_physics(physics)
            if made.unknowns:
                raise ValueError(
                    f"Physics {made.name!r} has unknown parameters, which a ParallelPartialGP does "
                    "not learn: learn them with a CKA of a few outputs, and give the physics with "
                    "their values."
                )
            if made.is_emulated:
                raise ValueError(
                    f"Physics {made.name!r} is emulated, with an error that a ParallelPartialGP "
                    "has no term for: FunctionPhysics(physics) takes the emulator's mean as exact."
                )
            self.input_transform = PhysicsInput(made, data.X.shape[-1], input_transform)
            with torch.no_grad():
                f_p = self.input_transform.values(data.X)
            if f_p.shape[-1] != m:
                raise ValueError(
                    f"The physics '{made.name}' returned {f_p.shape[-1]} columns, expected {m}, "
                    "one for each column of train_Y."
                )
        else:
            self.input_transform, rho_mean, delta_mean = None, 0.0, "learn"
        self._learns = (rho_mean == "learn", delta_mean == "learn")
        self._rho = 1.0 if rho_mean == "learn" else float(rho_mean)
        self._shift = 0.0 if delta_mean == "learn" else float(delta_mean)
        self._X, self._Y = data.X, data.Y
        prior = self._rho * f_p + self._shift
        offset = (data.Y - prior).mean(-2) if self._learns[1] else 0.0
        unit = residual_scale(data.Y, prior + offset).stdvs.squeeze(-2)
        self.coordinate: Tensor | None = None
        if coordinate is not None:
            if self._learns[0]:
                raise ValueError(
                    "Expected a number as rho_mean beside a coordinate, got 'learn': coupled "
                    "outputs have no constants of their own."
                )
            self.coordinate = coordinates_of(coordinate, m).to(data.Y)
            self.options["coordinate"] = self.coordinate
            self.objects = [name for name in self.objects if name != "coordinate"]
            unit = unit.square().mean().sqrt().expand(m)  # the noise is that of all outputs
        self.register_buffer("unit", unit.clone())
        # The data of the kernel's own model tell sizes alone: residuals are in units of theirs.
        signs = (1.0 - 2.0 * (torch.arange(n) % 2)).to(data.Y).unsqueeze(-1)
        self.shared = ZeroMeanGP(
            train_X,
            signs,
            covar_module=covar_module,
            input_transform=input_transform,
            outcome_transform=None,
        )
        self.register_buffer("scales", torch.ones(1, m).to(data.Y))
        self.register_buffer("noises", torch.ones(1, m).to(data.Y))
        self.register_buffer("along", torch.ones(1, 3).to(data.Y))
        self.register_buffer("profile", torch.ones(m).to(data.Y))
        self._remembered: Any = None
        self.was_fitted = False
        self.training = False
        self._prepare(f_p)
        own = {name: p.detach().unsqueeze(0) for name, p in self.shared.named_parameters()}
        self.hold(own, torch.Generator().manual_seed(0))
        self.was_fitted = False

    def _prepare(self, f_p: Tensor) -> None:
        """Residuals in their units, ``n x m``, and the columns of unknown constants."""
        self.residuals = (self._Y - self._rho * f_p - self._shift) / self.unit
        each = [f_p / self.unit, torch.ones_like(f_p)]
        columns = [c for c, learns in zip(each, self._learns, strict=True) if learns]
        shape = (self.num_outputs, len(self._Y), 0)
        none = self.coordinate is not None or not columns
        self.columns = f_p.new_zeros(shape) if none else torch.stack(columns, -1).transpose(0, 1)
        size = self.columns.square().mean(-2)
        self.precision = size.where(size > 0, torch.ones_like(size)) / _VAGUE**2  # m x k
        self._remembered = None

    # What a TermsModel has, of the shared kernel.

    @property
    def covar_module(self) -> SumOfTerms:  # type: ignore[override]
        """The shared kernel."""
        return self.shared.covar_module

    @property
    def likelihood(self) -> Any:
        """The noise, in units of each output's variance."""
        return self.shared.likelihood

    @property
    def train_inputs(self) -> Any:
        """Transformed training inputs, ``S x n x d``."""
        return self.shared.train_inputs

    @property
    def train_targets(self) -> Tensor:  # type: ignore[override]
        """Targets in the user's units, ``m x n``."""
        return self._Y.mT

    @property
    def num_outputs(self) -> int:
        """The number ``m`` of outputs."""
        return self._Y.shape[-1]

    @property
    def batch_shape(self) -> torch.Size:
        """One dimension, of the samples."""
        return self.scales.shape[:1]

    @property
    def num_samples(self) -> int:  # type: ignore[override]
        """The number ``S`` of samples; 1 before a fit."""
        return len(self.scales)

    @property
    def is_fitted(self) -> bool:
        """True if the model was fitted."""
        return self.was_fitted

    @property
    def learns_offset(self) -> bool:
        """True if the mean of delta is unknown."""
        return self._learns[1]

    @property
    def term_names(self) -> tuple[str, ...]:
        """None: use ``predict`` less the physics for delta."""
        return ()

    @property
    def rho_names(self) -> tuple[str, ...]:
        """The scaling of the physics, if there is one."""
        return () if self.input_transform is None else ("rho",)

    def term(self, name: str, X: ArrayLike, mixed: bool = True) -> Posterior:
        """Raise a ValueError: terms are not told apart."""
        raise ValueError(
            "A ParallelPartialGP does not tell its terms apart; delta is `model.predict(X).mean` "
            "less the physics, or take a CKA of a few outputs."
        )

    def data(self) -> dict[str, Tensor | None]:
        """Return raw inputs and targets."""
        return {"train_X": self._X, "train_Y": self._Y, "train_Yvar": None}

    def fallback(self, X: ArrayLike) -> Tensor:
        """Return the prediction far from all data, ``... x q x m``: f_p times rho."""
        return self._rho * self._physics_at(X) + self._shift

    def summary(self) -> str:
        """Return lengthscales, noise and variances of all outputs, as a text."""
        sd = (self.scales.mean(0).sqrt() * self.unit).sort().values
        own = self.shared.summary().splitlines()[2:]
        lines = [
            repr(self),
            "the kernel of all outputs, in units of each one's standard deviation:",
        ]
        lines += [line for line in own if not line.strip().startswith("log likelihood")]
        if self.coordinate is None:
            ends = f"{sd[0]:.3g} to {sd[-1]:.3g}"
            lines.append(f"standard deviations of delta: {ends}, median {sd.median():.3g}")
        else:
            length, _, noise = self.along.mean(0).tolist()
            sd = noise**0.5 * self.unit[0]
            lines[2:] = [line for line in lines[2:] if not line.strip().startswith("noise")]
            lines += [f"  lengthscale along the coordinate: {length:.4g}", f"  noise: sd {sd:.4g}"]
        return "\n".join(lines)

    def train(self, mode: bool = True) -> Self:
        """Stay in eval mode; a RuntimeError for train mode, as ``fit`` alone trains the kernel."""
        if mode:
            raise RuntimeError("A ParallelPartialGP is not trained: fit it by `gpadjust.fit`.")
        return self

    def eval(self) -> Self:
        """Return the model, which is in eval mode."""
        return self

    # The posterior.

    @torch.no_grad()
    def hold(self, samples: dict[str, Tensor], generator: torch.Generator) -> None:
        """Hold samples of the kernel's raw parameters, with a variance of each output for each.

        Args:
            samples: By their names, ``S x`` the parameter's shape.
            generator: Source of randomness.
        """
        self.shared.release_samples()
        self.shared.hold_samples(samples)
        self._remembered = None
        number = self.shared.num_samples or 1
        if self.coordinate is not None:
            self.profile = smoothed(self.coordinate, self.residuals.square().mean(0)).sqrt()
            self.along = AlongCoordinate.learn(self)
            shape = 0.5 * len(self._Y) * effective_number(self.residuals)
            rate = torch.full((number, 1), shape).to(self.unit)
        else:
            rate = 0.5 * (DEGREES + self._weights().square)  # S x m
            shape = 0.5 * (DEGREES + len(self._Y))
        # Quantiles of each output's variance (coupled, of one factor for all), one for each sample.
        order = torch.rand(rate.shape, generator=generator, dtype=rate.dtype).argsort(0)
        level = (order.double() + 0.5) / number
        unit = torch.as_tensor(1 / gammainccinv(shape, level.numpy())).to(rate)
        scales = rate * (unit if number > 1 else 1 / max(shape - 1, 0.5))
        self.scales = scales.expand(number, self.num_outputs).clone()
        if self.coordinate is not None:
            self.noises = self.along[:, 2:].expand_as(self.scales).clone()
        else:
            self.noises = self.scales * self.shared.noise.at(self.train_inputs[0])[..., :1]
        self.scales *= self._calibration()
        self.was_fitted = True

    def _weights(self) -> _Weights:
        if self._remembered is None:
            factors = self.shared.conditioning().factors()
            n, (m, k) = len(self._Y), self.precision.shape
            columns = self.columns.transpose(0, 1).reshape(n, m * k)  # n x (m k)
            both = torch.cat([self.residuals, columns], -1).mT
            white = factors.whiten(both.expand(self.num_samples_held, *both.shape))
            solved = factors.unwhiten(white).mT  # S x n x (m + m k)
            rest, own = white[:, :m], white[:, m:].unflatten(1, (m, k)).mT  # S x m x n (x k)
            gram = own.mT @ own + torch.diag_embed(self.precision)
            spread = torch.linalg.inv(gram)
            found = (spread @ (own.mT @ rest.unsqueeze(-1))).squeeze(-1)  # S x m x k
            left = rest - (own @ found.unsqueeze(-1)).squeeze(-1)
            square = left.square().sum(-1) + (self.precision * found.square()).sum(-1)
            of_columns = solved[..., m:]
            explained = (of_columns.unflatten(-1, (m, k)) * found.unsqueeze(1)).sum(-1)
            weights = solved[..., :m] - explained
            self._remembered = _Weights(weights, found, of_columns, spread, square)
        return self._remembered

    @property
    def num_samples_held(self) -> int:
        """The number of samples that the kernel holds."""
        return self.shared.num_samples or 1

    def _coupled(self) -> AlongCoordinate:
        if not isinstance(self._remembered, AlongCoordinate):
            self._remembered = AlongCoordinate.of(self)
        return self._remembered

    def _physics_at(self, X: Any) -> Tensor:
        if self.input_transform is None:
            return X.new_zeros(*X.shape[:-1], self.num_outputs)
        return self.input_transform.values(X)

    def _noise_of(self, observation_noise: bool | Tensor, num_points: int) -> Tensor | float:
        """Noise variances in the user's units, ``... x S x (q or 1) x m``."""
        if isinstance(observation_noise, Tensor):
            given = given_noise(observation_noise, num_points, self.num_outputs)
            return given.unsqueeze(MCMC_DIM)
        if not observation_noise:
            return 0.0
        return (self.noises * self.unit.square()).unsqueeze(-2)

    def _calibration(self) -> Tensor:
        """Factors of delta's variances by which left-out errors are as large as predicted, ``m``.

        At least 1, with half a standard error of caution, for errors that noise may hide.
        """
        mean, variance = self.left_out()
        own = variance - (self.noises * self.unit.square()).unsqueeze(1)  # S x n x m
        excess = ((self._Y - mean).square() - variance).mean(0)  # n x m
        own = own.mean((0, 1))
        if self.coordinate is not None:
            excess = torch.stack([smoothed(self.coordinate, row) for row in excess])
            own = smoothed(self.coordinate, own)
        excess = excess.mean(0) + _CAUTION * excess.std(0) / len(excess) ** 0.5
        return 1 + excess.clamp_min(0.0) / own.clamp_min(torch.finfo(own.dtype).tiny)

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances for each sample, ``... x S x q x m``."""
        with self._graph_for(X):
            inputs, f_p = self._inputs(X)
            sought, conditioning = self.shared.at(inputs), self.shared.conditioning()
            if self.coordinate is not None:
                mean, variance = self._coupled().marginals(sought)
            else:
                weights, (_m, k) = self._weights(), self.precision.shape
                variance = conditioning.marginals(sought)[1].unsqueeze(-1)
                cross = sought.cross(conditioning.train, is_data=True)
                mean = cross @ weights.mean
                if k:
                    away = self._away(f_p, cross)  # ... S x q x m x k
                    mean = mean + (self._columns_at(f_p) * weights.coefficients[:, None]).sum(-1)
                    spread = torch.einsum(
                        "...sqmk,smkl,...sqml->...sqm", away, weights.spread, away
                    )
                    variance = variance + spread
            variance = variance * (self.scales * self.unit.square()).unsqueeze(-2)
            variance = variance + self._noise_of(observation_noise, f_p.shape[-2])
            prior = (self._rho * f_p + self._shift).unsqueeze(MCMC_DIM)
            return mean * self.unit + prior, variance.expand(mean.shape)

    def _inputs(self, X: ArrayLike) -> tuple[Tensor, Tensor]:
        """Transformed inputs ``... x S x q x d``, and f_p there, ``... x q x m``."""
        inputs = self.shared.model_inputs(X)
        X = (
            X
            if isinstance(X, Tensor)
            else torch.as_tensor(X.to_numpy() if hasattr(X, "to_numpy") else X)
        )
        return inputs, self._physics_at(X)

    def _columns_at(self, f_p: Tensor) -> Tensor:
        """The columns of unknown constants, ``... x 1 x q x m x k``."""
        each = [f_p / self.unit, torch.ones_like(f_p)]
        columns = [c for c, learns in zip(each, self._learns, strict=True) if learns]
        return torch.stack(columns, -1).unsqueeze(MCMC_DIM - 1)

    def _away(self, f_p: Tensor, cross: Tensor) -> Tensor:
        """The columns less what the data's columns say of them, ``... x S x q x m x k``."""
        told = (cross @ self._weights().columns).unflatten(-1, (*self.precision.shape,))
        return self._columns_at(f_p) - told

    def joint_moments(
        self, X: ArrayLike, observation_noise: bool | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Means ``... x S x m x q`` and covariances ``... x S x m x q x q``, output by output."""
        inputs, f_p = self._inputs(X)
        mean, _ = self.components(X, False)
        sought, conditioning = self.shared.at(inputs), self.shared.conditioning()
        if self.coordinate is not None:
            covariance = self._coupled().joint(sought, among=False)
        else:
            cross = sought.cross(conditioning.train, is_data=True)
            white = conditioning.factors().whiten(cross)
            covariance = conditional_covariance(sought.covariance(), white).unsqueeze(-3)
            if self.precision.shape[-1]:
                away = self._away(f_p, cross).transpose(-2, -3)  # ... S x m x q x k
                covariance = covariance + away @ self._weights().spread @ away.mT
        covariance = covariance * (self.scales * self.unit.square())[..., None, None]
        noise = self._noise_of(observation_noise, f_p.shape[-2])
        if isinstance(noise, Tensor):
            covariance = covariance + torch.diag_embed(noise.expand(mean.shape).mT)
        return mean.mT, covariance

    def posterior(
        self,
        X: ArrayLike,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The joint posterior at raw ``X``; of coupled outputs with the covariances among these.

        Raises:
            ValueError: If coupled outputs would have a covariance of more than 4,000 rows; use
                ``predict`` and ``interval``, or fewer ``output_indices``.
        """
        idcs = [*range(self.num_outputs)] if output_indices is None else output_indices
        idcs = self.checked_outputs(list(idcs))
        if self.coordinate is None:
            mean, covariance = self.joint_moments(X, observation_noise)
            several = len(idcs) > 1
            mean, covariance = mean[..., idcs, :], covariance[..., idcs, :, :]
            if not several:
                mean, covariance = mean.squeeze(-2), covariance.squeeze(-3)
            found = HyperparameterMixture(ScaleFreePosterior.of_outputs(mean, covariance, several))
        else:
            inputs, f_p = self._inputs(X)
            if (size := f_p.shape[-2] * len(idcs)) > _MOST:
                raise ValueError(
                    f"A joint posterior of {f_p.shape[-2]} points and {len(idcs)} coupled outputs "
                    f"has a covariance of {size} rows, expected {_MOST} at most. Use `predict` and "
                    "`interval(X, simultaneous=True)`, or some `output_indices`."
                )
            mean, _ = self.components(X, False)
            mean = mean[..., idcs]
            covariance = self._coupled().joint(self.shared.at(inputs), among=True, idcs=idcs)
            sd = (self.scales.sqrt() * self.unit)[:, idcs].repeat(1, mean.shape[-2])
            covariance = covariance * sd.unsqueeze(-1) * sd.unsqueeze(-2)
            noise = self._noise_of(observation_noise, mean.shape[-2])
            if isinstance(noise, Tensor):
                noise = noise.expand(*noise.shape[:-2], mean.shape[-2], -1)[..., idcs]
                covariance = covariance + torch.diag_embed(noise.expand(mean.shape).flatten(-2))
            operator = PosteriorCovariance(covariance)
            found = HyperparameterMixture(
                ScaleFreePosterior(ScaleFreeMultitaskNormal(mean, operator))
            )
        if posterior_transform is None:
            return found
        return ScaleFreePosterior.transformed(posterior_transform(posterior=found, X=X))

    def interval(
        self,
        X: ArrayLike,
        level: float = 0.95,
        observation_noise: bool | Tensor = False,
        simultaneous: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """The central interval of each output at each point, or of its whole curve: both ends.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            level: The probability that it holds; a ValueError if it is not between 0 and 1.
            observation_noise: As in :meth:`predict`.
            simultaneous: Whether *all* outputs at a point lie inside with this probability: the
                mean and a multiple of the standard deviation, by draws of the largest deviation.
                Outputs that are not coupled count as independent, which makes it wider.
        """
        if not simultaneous:
            return super().interval(X, level, observation_noise)
        check_level(level)
        parts = self.components(X, observation_noise)
        mean, variance = mixture_moments(*parts)
        away = self._largest_deviations(X, observation_noise, *parts)
        reach = torch.quantile(away, level, dim=0).unsqueeze(-1) * variance.sqrt()
        return mean - reach, mean + reach

    @torch.no_grad()
    def _largest_deviations(
        self, X: ArrayLike, observation_noise: Any, mean: Tensor, variance: Tensor
    ) -> Tensor:
        """Draws of the largest standardised deviation among outputs, ``k x ... x q``."""
        middle, whole = mixture_moments(mean, variance)
        number = -(-_DRAWS // self.num_samples)
        points = mean.movedim(MCMC_DIM, 0).flatten(1, -2).transpose(0, 1)  # q x S x m
        middle, whole = middle.flatten(0, -2), whole.flatten(0, -2)
        noise: Any = self._noise_of(observation_noise, mean.shape[-2])
        found = []
        if self.coordinate is not None:
            inputs, _ = self._inputs(X)
            roots, basis = self._coupled().roots(self.shared.at(inputs))  # ... S x q x r, S x m x r
            roots = roots.movedim(-3, 0).flatten(1, -2).transpose(0, 1)  # q x S x r
            size = (self.scales.sqrt() * self.unit).unsqueeze(-2)  # S x 1 x m
            noise = torch.as_tensor(noise).to(mean).expand(mean.shape)
            noise = noise.movedim(MCMC_DIM, 0).flatten(1, -2).transpose(0, 1)
        variance = variance.movedim(MCMC_DIM, 0).flatten(1, -2).transpose(0, 1)
        generator = torch.Generator().manual_seed(0)
        options: Any = {"generator": generator, "dtype": mean.dtype}
        for s in range(self.num_samples):  # with the same draws at all points
            white = torch.randn(number, self.num_outputs, **options)
            if self.coordinate is not None:
                own = torch.randn(number, basis.shape[-1], **options)
            maxima = []
            for i, part in enumerate(points[:, s]):
                if self.coordinate is None:
                    drawn = white * variance[i, s].sqrt()
                else:
                    drawn = (own * roots[i, s]) @ basis[s].mT * size[s] + white * noise[i, s].sqrt()
                maxima.append(((drawn + part - middle[i]).abs() / whole[i].sqrt()).amax(-1))
            found.append(torch.stack(maxima))
        every = torch.cat(found, -1).mT
        return every.reshape(-1, *mean.shape[:MCMC_DIM], mean.shape[-2])

    @torch.no_grad()
    def left_out(self) -> tuple[Tensor, Tensor]:
        """Each row predicted from all others, for each sample: ``S x n x m``, noise included."""
        if self.coordinate is not None:
            mean, variance = self._coupled().left_out(self.residuals)
        else:
            factors, weights = self.shared.conditioning().factors(), self._weights()
            precision = factors.squared_columns().unsqueeze(-1)  # S x n x 1
            m, k = self.precision.shape
            own = weights.columns.unflatten(-1, (m, k))  # S x n x m x k
            known = torch.einsum("snmk,smkl,snml->snm", own, weights.spread, own)
            precision = (precision - known).clamp_min(torch.finfo(known.dtype).tiny)
            mean = self.residuals - weights.mean / precision
            noise = self.shared.noise.at(self.train_inputs[0]).unsqueeze(-1)
            variance = (precision.reciprocal() - noise).clamp_min(0.0)
        prior = self._Y - self.residuals * self.unit
        variance = variance * self.scales.unsqueeze(1) + self.noises.unsqueeze(1)
        return mean * self.unit + prior, variance * self.unit.square()

    def condition_on_observations(self, X: ArrayLike, Y: ArrayLike, **kwargs: Any) -> Self:
        """Condition on new rows of all outputs; the hyper-parameters stay.

        Args:
            X: Raw inputs, ``k x d``.
            Y: Observations, ``k x m``, in the user's units.
            kwargs: None.

        Raises:
            ValueError: If an output is missing, or there are fantasies (a batch of ``Y``).
        """
        X, Y = new_observations(X, Y, self.input_names, self.num_outputs)
        if X.dim() > 2 or Y.dim() > 2 or Y.isnan().any() or kwargs:
            raise ValueError(
                f"Expected X of shape k x d and Y of shape k x {self.num_outputs}, without missing "
                f"outputs, got {tuple(X.shape)} and {tuple(Y.shape)}; a ParallelPartialGP has one "
                "factor for all outputs, and makes no fantasies."
            )
        other = copy(self)
        other._modules, other._buffers = copy(self._modules), copy(self._buffers)
        other.shared = self.shared.condition_on_observations(X, torch.zeros_like(X[:, :1]))
        other._X, other._Y = torch.cat([self._X, X]), torch.cat([self._Y, Y])
        with torch.no_grad():
            other._prepare(other._physics_at(other._X))
        return other

    def subset_output(self, idcs: list[int]) -> Self:
        """Raise an error: outputs have one kernel; ``posterior`` takes ``output_indices``."""
        raise NotImplementedError(
            "The outputs of a ParallelPartialGP have one kernel, which is theirs together. Give "
            "`posterior` its output_indices, or build a model of some columns of train_Y."
        )

    def draw_functions(self, num_functions: int, num_features: int) -> Any:
        """Raise an error: functions of all outputs are not drawn."""
        raise NotImplementedError(
            "A ParallelPartialGP draws no functions: draw joint values from `model.posterior(X)`."
        )

    def load_state_dict(self, state_dict: Any, strict: bool = True, *args: Any, **kw: Any) -> Any:
        """Load hyper-parameters and samples of them, however many there are."""
        own = {n.removeprefix("shared."): v for n, v in state_dict.items() if "shared." in n}
        self.shared.release_samples()
        keys = self.shared.load_state_dict(own, strict)
        for name in ("scales", "noises", "along", "profile", "unit"):
            setattr(self, name, state_dict[name].clone())
        self.was_fitted = True
        with torch.no_grad():
            self._prepare(self._physics_at(self._X))
        return keys


def effective_number(residuals: Tensor) -> float:
    """The effective number of outputs ``n x m``, the participation ratio of their covariance."""
    few = residuals if residuals.shape[0] < residuals.shape[1] else residuals.mT
    size = torch.linalg.eigvalsh(few @ few.mT)
    return float(size.sum().square() / size.square().sum())


def _check(X: Tensor, Y: Tensor, Yvar: Any, rho_mean: Any, delta_mean: Any) -> None:
    """Raise the errors of what the model does not take."""
    if X.dim() > 2:
        raise ValueError(f"Expected one data set, train_X of n x d, got shape {tuple(X.shape)}.")
    if Yvar is not None:
        raise ValueError(
            "Expected train_Yvar as None, as the outputs share one ratio of noise to variance, "
            "which is learnt; a CKA of a few outputs takes known variances."
        )
    if (missing := Y.isnan()).any():
        raise ValueError(
            f"Expected all outputs in each row, found {int(missing.sum())} missing values in "
            f"{int(missing.any(-1).sum())} rows: leave these rows out, or take a CKA."
        )
    for name, value in (("rho_mean", rho_mean), ("delta_mean", delta_mean)):
        if value != "learn" and not isinstance(value, int | float):
            raise ValueError(f"Expected {name} to be 'learn' or a number, got {value!r}.")
