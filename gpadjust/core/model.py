"""A sum of terms as a BoTorch model and a GPyTorch model: data, predictions, conditioning."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from inspect import signature
from typing import Any, NoReturn, Self

import gpytorch
import torch
from botorch.acquisition.objective import PosteriorTransform, ScalarizedPosteriorTransform
from botorch.models.model import FantasizeMixin, Model
from botorch.models.transforms.outcome import Standardize
from botorch.sampling.pathwise.posterior_samplers import DrawMatheronPaths
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import AdditiveKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import NormalPrior
from linear_operator import to_linear_operator
from torch import Size, Tensor

from gpadjust.core import gaussian
from gpadjust.core.data import ArrayLike, Data, appended, as_given, as_tensor, unit_of
from gpadjust.core.functions import Functions, Paths
from gpadjust.core.gaussian import Conditioning, Marginals, Prediction, SumLikelihood
from gpadjust.core.noise import KnownNoise, Noise
from gpadjust.core.posterior import MixturePosterior
from gpadjust.core.summary import counted, summary, summary_html
from gpadjust.core.terms import Places, Term, TermSum, WeightedSum, with_kernel
from gpadjust.core.unknowns import Choice, Row, Table, Values
from gpadjust.core.views import MeanView, NoiseView, OtherPriors, TermView, squeezed
from gpadjust.display import Display
from gpadjust.physics import Physics, PhysicsError, as_physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.physics.unknown import Unknowns
from gpadjust.progress import tick

Slopes = dict[str, list[Tensor]]
"""Derivatives of each physics by the coordinate of each unknown parameter, ``S x m x n``."""
PhysicsAt = Callable[[Values, bool], tuple[list[Tensor], Slopes]]
"""Each physics at the training inputs, ``S x m x n``, and its derivatives if these are wanted."""

_ENTRIES = 150_000  # of covariances that are computed at once and fit into caches
_STEP = 1e-4  # of differences by parameters of a physics, in coordinates


class Predictive(Model, FantasizeMixin, Display):
    """A model whose predictions are mixtures of equally likely Gaussians."""

    components: Callable[..., tuple[Tensor, Tensor]]
    """Of X and observation_noise: the means and variances of each Gaussian, ``... x S x q x m``."""
    mixture: Callable[..., MixturePosterior]
    """Of X, outputs and observation_noise: the joint posterior."""

    def predict(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Prediction:
        """Predict single points, without the covariances between them.

        Args:
            X: Inputs, ``... x q x d``.
            observation_noise: If True, with that noise; or its variances, ``... x q x m``.

        Returns:
            Mean and variance, ``... x q x m``: tensors, arrays or frames, as ``X``.
        """
        prediction = self.marginals_of(*self.components(X, observation_noise)).prediction
        if isinstance(X, Tensor):
            return prediction
        return Prediction(*(as_given(part, X, self.data.output_names) for part in prediction))

    @torch.no_grad()
    def interval(
        self, X: ArrayLike, level: float = 0.95, observation_noise: bool | Tensor = False
    ) -> tuple[Any, Any]:
        """Return the lower and upper ends of the central interval at each point, as ``predict``."""
        if not 0 < level < 1:
            raise ValueError(f"Expected level between 0 and 1; found {level}; 95 % is 0.95.")
        marginals = self.marginals(X, observation_noise)
        names = self.data.output_names
        lower, upper = (marginals.quantile(end) for end in ((1 - level) / 2, (1 + level) / 2))
        return as_given(lower, X, names), as_given(upper, X, names)

    def marginals(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Marginals:
        """Return the distributions at single points; arguments as of :meth:`predict`."""
        return self.marginals_of(*self.components(X, observation_noise))

    def marginals_of(self, means: Tensor, variances: Tensor) -> Marginals:
        """Return the distributions of Gaussian components ``... x S x q x m``."""
        return Marginals(means, variances)

    def to(self, *args: Any, **options: Any) -> Self:
        """Move the model to a device, with its data; a TypeError for a type but float64."""
        kinds = {getattr(value, "dtype", value) for value in (*args, *options.values())}
        wrong = [kind for kind in kinds - {torch.float64} if isinstance(kind, torch.dtype)]
        if wrong:
            raise TypeError(f"Expected a device, as models compute in float64; found {wrong[0]}.")
        return super().to(*args, **options)

    def float(self) -> Self:
        """Raise a TypeError, as :meth:`to` does."""
        return self.to(torch.float32)

    def half(self) -> Self:
        """Raise a TypeError, as :meth:`to` does."""
        return self.to(torch.float16)

    def posterior_of(self, mixture: MixturePosterior, outputs: list[int] | slice) -> Any:
        """Return the posterior of some outputs of a mixture where the model is Gaussian."""
        return mixture

    def posterior(
        self, X: ArrayLike, output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Any:  # fmt: skip
        """Return the joint posterior in BoTorch's form.

        It is ``... x q x m`` of inputs ``... x q x d``.
        """
        self.eval()
        outputs: list[int] | slice = slice(None)
        if output_indices is not None:
            outputs = self.checked_outputs(output_indices)
        posterior = self.posterior_of(self.mixture(X, outputs, observation_noise), outputs)
        if posterior_transform is None:
            return posterior
        if isinstance(posterior_transform, ScalarizedPosteriorTransform):
            return posterior.scalarized(posterior_transform.weights, posterior_transform.offset)
        return posterior_transform(posterior=posterior, X=X)

    def checked_outputs(self, outputs: list[int] | None) -> list[int]:
        """Return the numbers of outputs; negative ones count from the end."""
        m = self.num_outputs
        if not outputs or any(not isinstance(i, int) or not -m <= i < m for i in outputs):
            raise ValueError(f"Expected numbers of outputs from 0 to {m - 1}; found {outputs}.")
        return [i % m for i in outputs]


class GP(gpytorch.models.GP, Predictive):
    r"""A sum of terms :math:`f(x) = \sum_t b_t(x) g_t(x)`, conditioned exactly on noisy targets.

    Each :math:`g_t` is a Gaussian process and each basis :math:`b_t` a physics or 1. All unknown
    numbers, of kernels, noise and physics, are rows of one ``table``. Predictions are averages over
    ``u``, draws of their standard normal coordinates: one, all 0, until the model is fitted.
    Outputs are independent given the numbers.

    The model is a BoTorch ``Model``, of which posteriors have no dimension for draws, and a
    ``gpytorch.models.GP`` with a mean, a kernel, a likelihood and the parameter ``u``.

    Args:
        train_X: Inputs in the user's units, ``n x d``: a float64 tensor, an array or a frame.
        train_Y: Targets in the user's units, ``n x m``; NaN where one is missing.
        train_Yvar: Known variances of the targets: one number, ``m``, or of their shape.
        terms: The terms.
        physics: The bases of the terms: functions or Physics with ``m`` outputs.
        noise: A :class:`Noise`. Default: one learnt variance of each output.
        choices: Nested models, averaged by their posterior probabilities.
        input_transform: A one-to-one BoTorch transform of the inputs of kernels; the physics sees
            X. It may have the methods ``coded(X)``, from a frame to numbers, and ``terms(terms)``,
            to the terms of a model of such inputs.
        outcome_transform: None or BoTorch's ``Standardize``, which has no effect: units are learnt.
        settings: The arguments by which :func:`~gpadjust.core.save` builds a subclass again.

    Attributes:
        u: Coordinates of the draws that predictions average over, ``S x B x P``.
        data: The training data.
        unit: The unit of each output's targets, ``m x 1``.

    Raises:
        TypeError: If data are not float64 tensors, arrays or frames of numbers, or an option is
            unknown or not an instance.
        ValueError: If shapes disagree, data are not finite, or there are fewer than two points.
        PhysicsError: If a physics fails at the training inputs.

    Example:
        >>> import torch
        >>> from gpadjust.core import GP, Stationary, Term
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = GP(X, X.sin(), terms=[Term("f", Stationary())])
        >>> model.predict(X).mean.shape
        torch.Size([8, 1])
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        terms: Sequence[Term], physics: Sequence[Any] = (), noise: Noise | None = None,
        choices: Sequence[Choice] = (), input_transform: Any = None,
        outcome_transform: Any = None, settings: Mapping[str, Any] | None = None, **others: Any,
    ) -> None:  # fmt: skip
        super().__init__()
        if others:
            raise _unknown_option(type(self), next(iter(others)))
        for name, option in {"noise": noise, "input_transform": input_transform}.items():
            if isinstance(option, type):
                expected = f"an instance, {option.__name__}()"
                raise TypeError(f"Expected {name} as {expected}; found the class.")
        if outcome_transform is not None and not isinstance(outcome_transform, Standardize):
            raise ValueError(
                "Expected outcome_transform=None or Standardize, which has no effect; found "
                f"{outcome_transform!r}. Transform the targets and the physics, or take a link, "
                "such as LinkedCKA(..., link='log') of gpadjust.kinds."
            )
        # Data, physics and terms.
        self.data = Data.read(train_X, train_Y, train_Yvar, input_transform)
        X, Y = self.data.X, self.data.Y
        self.read_scale(Y)
        m = Y.shape[-1]
        self.rows_of_fit = len(Y)  # later ones are conditioned on, in the unit of these
        self.physics = [as_physics(function) for function in physics]
        for f_p in self.physics:
            f_p.check_names(self.data.input_names)
        terms = [with_kernel(term) for term in terms]
        if type(self) is GP:
            settings = {"terms": terms, "noise": noise, "choices": choices}
            settings["input_transform"] = input_transform
        self.settings = dict(settings or {})
        transform: Any = self.data.transform
        if hasattr(transform, "terms"):
            terms = transform.terms(terms)
        terms = [t._replace(kernel=t.kernel and t.kernel.of_data(self.data)) for t in terms]
        self._outputs: list[int] | None = None
        self._cached: tuple[Tensor, Conditioning] | None = None
        unknowns = [f_p.unknowns for f_p in self.physics]
        self._unknowns = unknowns[0] if len(unknowns) == 1 else Unknowns.together(unknowns)
        # f_p at the training inputs, and the unit of the targets by it.
        self._f_train: list[Tensor] = []
        self.unit = Y.new_ones(1, 1)  # the user's, until the prior mean is known
        with torch.no_grad():  # a physics may have parameters, as a network does
            places = self.places(X, {f"physics.{n}": Y.new_zeros(1, 1) for n in self._unknowns})
        mean = TermSum(terms, places.f, self.unit).mean({}, places)
        self.unit = unit_of(self.on_gaussian_scale(Y), mean[0].mT)
        self._f_train = [f / self.unit for f in places.f]
        self.term_sum = TermSum(terms, self._f_train, self.unit)
        if noise is not None and not isinstance(noise, Noise):
            raise TypeError(f"Expected noise as a Noise, not {noise!r}; variances are train_Yvar.")
        if self.data.Yvar is not None:
            known_noise = KnownNoise(self.noise_in_units(Y, self.data.Yvar))
            noise = known_noise if noise is None else noise.with_known(known_noise)
        self.noise = (noise or Noise()).of_data(self.data, self.term_sum)
        # The table of all unknown numbers, and u.
        rows = self.term_sum.rows(self.data.kernel_inputs(X), m) + self.noise.rows(Y)
        rows += [Row(f"physics.{n}", Y.new_zeros(1), is_shared=True) for n in self._unknowns]
        self.table = Table(rows, m, choices)
        names = {row.name for row in rows}
        names |= {f"{t.name}.{part}" for t in terms for part in ("mean", "process")}
        unknown = {name for choice in choices for name in choice.zeros} - names
        if unknown:
            raise ValueError(
                f"Unknown numbers {sorted(unknown)}; expected some of {sorted(names)}."
            )
        self.u = torch.nn.Parameter(Y.new_zeros(1, self.table.problems, self.table.size))
        self._draws = self.u.detach()
        prior = NormalPrior(Y.new_zeros(()), Y.new_ones(()))
        self.register_prior("u_prior", prior, _coordinates, _set_coordinates)
        if self.table.has_other_priors:
            self.register_added_loss_term("other_priors")
            self.update_added_loss_term("other_priors", OtherPriors(self))
        self.register_load_state_dict_pre_hook(_resize)

    # The unknown numbers, and how likely they are.

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms."""
        return self.term_sum.terms

    @property
    def values(self) -> Values:
        """All numbers by name, at the draws ``u``: ``S x m x k``; of a physics coordinates."""
        return self.table.values(self.u)

    @property
    def draws(self) -> Tensor:
        """All coordinates drawn by the last fit, ``N x B x P``; without a fit ``u``."""
        return self._draws if len(self._draws) > len(self.u) else self.u.detach()

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """Draws ``N`` of each unknown parameter of the physics, in the user's units."""
        return self.physics_parameters_at(self.draws)

    def physics_parameters_at(self, u: Tensor) -> PhysicsParameters:
        """Return the unknown parameters of the physics at coordinates ``N x B x P``."""
        values = self.table.values(u)
        z = [values[f"physics.{name}"] for name in self._unknowns]
        draws = self._unknowns.to_values(torch.cat(z, -1)).unbind(-1) if z else []
        return PhysicsParameters(self._unknowns, draws)

    @property
    def is_fitted(self) -> bool:
        """Whether the unknown numbers differ from the middle of their priors."""
        return bool(self.draws.any())

    def set_draws(self, draws: Tensor, number: int | None = None) -> None:
        """Set coordinates ``N x B x P``; predictions average over a number of them, or all.

        Minus infinity stands for a positive number that is 0; a ValueError if others are infinite.
        """
        shape = torch.Size([self.table.problems, self.table.size])
        if draws.shape[1:] != shape or not len(draws) or not (draws < torch.inf).all():
            shapes = f"N x {shape[0]} x {shape[1]}; found {tuple(draws.shape)}"
            raise ValueError(f"Expected finite coordinates of shape {shapes}.")
        step = max(1, len(draws) // (number or len(draws)))
        self._draws = draws.detach()
        self.u = torch.nn.Parameter(self._draws[step // 2 :: step].clone())
        self._cached = None

    @torch.no_grad()
    def log_likelihood(
        self, u: Tensor, with_gradient: bool = True, *, choice: int | None = None,
        physics: PhysicsAt | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return the log likelihood of the targets at coordinates ``S x B x P``, and its gradient.

        It is in units of the targets, minus infinity where it or f_p is not finite; a choice is the
        number of a nested model. The gradient is zero if it is not asked for. ``physics`` takes the
        place of :meth:`physics_with_slopes`.
        """
        if choice is not None:
            u = self.table.with_choice(u, choice)
        f: list[Tensor] | None = None
        slopes: Slopes = {}
        if self._unknowns:  # f_p is called once, at all draws
            physics = physics or self.physics_with_slopes
            f, slopes = physics(self.table.values(u), with_gradient)
        m, n = self.targets().shape[-2:]
        values, gradients = [], []
        for rows in torch.arange(len(u)).split(max(1, _ENTRIES // (n * n * m))):
            tick("evaluations")
            f_rows = f and [Y[rows] for Y in f]
            slope_rows = {name: [Y[rows] for Y in by_f] for name, by_f in slopes.items()}
            value, gradient = self._log_likelihood(u[rows], f_rows, slope_rows, with_gradient)
            values.append(value)
            gradients.append(gradient)
        return torch.cat(values), torch.cat(gradients)

    def _log_likelihood(
        self, u: Tensor, f: list[Tensor] | None, f_slopes: Slopes, with_gradient: bool
    ) -> tuple[Tensor, Tensor]:
        """Return the same of few draws, with f_p and its derivatives if it has parameters."""
        values, y = self.table.values(u), self.targets()
        places = self.places(self.data.X, values, f)
        total = self.term_sum.evaluate(values, places)
        noise = self.noise.variance(values, places, True)
        observed = ~y.isnan()
        residual = (y - total.mean).expand(len(u), *y.shape).masked_fill(~observed, 0.0)
        result = self.sum_likelihood(total, residual, noise, observed, with_gradient)
        value, gradient = result.value, torch.zeros_like(u)
        if with_gradient:
            by = result.by | self.noise.pull_back(values, places, result.by_variance)
            by |= self._by_physics(values, places, by, result, f_slopes)
            gradient = self.table.gradient(by, values)
        if self.table.problems < value.shape[-1]:
            value = value.sum(-1, keepdim=True)
        if self.table.has_other_priors:
            ratio, by_ratio = self._other_priors(u)
            value, gradient = value + ratio, gradient + by_ratio
        fails = ~(value.isfinite() & gradient.isfinite().all(-1))
        return value.masked_fill(fails, -torch.inf), gradient.masked_fill(fails.unsqueeze(-1), 0.0)

    def prior_mean(self, u: Tensor) -> Tensor:
        """Return the mean of the targets at u, ``S x (m n)``: NaN where f_p fails, 0 if missing."""
        total, _, y = self._with_failures(u)
        return total.mean.expand(len(u), *y.shape[1:]).masked_fill(y.isnan(), 0.0).flatten(1)

    def precision_times(self, u: Tensor, v: Tensor) -> Tensor:
        """Return the inverse covariance of the targets at ``S x B x P`` times ``S x (m n)``."""
        total, noise, y = self._with_failures(u)
        v = v.reshape(len(u), *y.shape[1:])
        return self.sum_likelihood(total, v, noise, ~y[0].isnan(), True).by_mean.flatten(1)

    def _with_failures(self, u: Tensor) -> tuple[WeightedSum, Tensor, Tensor]:
        """Return what :meth:`_observed` does at coordinates, NaN where f_p fails."""
        values = self.table.values(u)
        return self._observed(values, self.physics_with_slopes(values, False)[0])

    def sum_likelihood(
        self, train: WeightedSum, residual: Tensor, noise: Tensor, observed: Tensor,
        with_gradient: bool,
    ) -> SumLikelihood:  # fmt: skip
        """Return the log likelihood of residuals ``S x m x n``; a subclass may bound it."""
        return gaussian.sum_likelihood(train, residual, noise, observed, with_gradient)

    def conditioned(
        self, train: WeightedSum, noise: Tensor, targets: Tensor, old: Any = None
    ) -> Conditioning:
        """Return the posterior given observations of a sum, the first ones those of an old one."""
        return Conditioning(train, noise, targets, old)

    def fit_itself(self, method: str, num_draws: int | None, seed: int) -> Any:
        """Return None; a subclass with a fit without draws returns its FitResult."""
        return None

    def _by_physics(
        self, values: Values, places: Places, by: Values, result: SumLikelihood, f_slopes: Slopes
    ) -> Values:
        """Return derivatives by centers and by the coordinates of a physics' parameters."""
        by_mean = result.by_mean
        slopes: Values = {}
        by_f = [torch.zeros_like(by_mean) for _ in self.physics]
        for term in self.terms:
            if term.physics is None:
                continue
            by_weight = by.get(f"{term.name}.weight", torch.zeros_like(by_mean))
            # f_p is in the mean, times g's, and in the weight f_p - c.
            by_f[term.physics] += self.term_sum.mean_of(term, values) * by_mean + by_weight
            if term.has_center is True:
                # c is in the weight, and in the place of f_p without a mean of g.
                without = 1 - values.get(f"{term.name}.mean", by_mean.new_ones(()))
                by_c = (term.mean * without * by_mean - by_weight).sum(-1, keepdim=True)
                slopes[f"{term.name}.center"] = by_c * self.term_sum.spread[term.physics]
        if f_slopes and self.noise.has_shares:
            by_shares = self._noise_by_f(values, places, result.by_variance)
            by_f = [a + b for a, b in zip(by_f, by_shares, strict=True)]
        for name, parts in f_slopes.items():
            products = [(a * b).sum((-1, -2)) for a, b in zip(by_f, parts, strict=True)]
            slopes[f"physics.{name}"] = torch.stack(products).sum(0).unsqueeze(-1)
        return slopes

    def _noise_by_f(self, values: Values, places: Places, by_variance: Tensor) -> list[Tensor]:
        """Return derivatives by each f_p, of a noise whose shares depend on it."""
        with torch.enable_grad():
            leaves = [f.detach().clone().requires_grad_() for f in places.f]
            variance = self.noise.variance(values, places._replace(f=leaves), True)
            variance = variance.expand_as(by_variance)
            return [*torch.autograd.grad(variance, leaves, by_variance, materialize_grads=True)]

    def _other_priors(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log density of priors other than N(0, I), and its gradient."""
        with torch.enable_grad():
            leaf = u.detach().requires_grad_()
            ratio = self.table.log_prior_ratio(leaf)
            (slope,) = torch.autograd.grad(ratio.sum(), leaf)
        return ratio.detach(), slope

    # The physics.

    def _physics_at(self, X: Tensor, values: Values) -> list[Tensor]:
        """Return each physics at ``... x S x n x d`` (1 for S): ``... x S x m x n``, in units."""
        f = []
        for physics in self.physics:
            Y = physics(X, *self._arguments(physics, values))
            self._check_physics(physics, X, Y)
            f.append(self._in_units(Y))
        return f

    def _check_physics(self, physics: Physics, X: Tensor, Y: Tensor) -> None:
        """Raise an error unless outputs of a physics, ``... x n x m``, are what targets may be."""
        if self._outputs is None and Y.shape[-1] != self.num_outputs:
            raise ValueError(
                f"Expected {self.num_outputs} outputs of physics {physics.name!r}, as many as of "
                f"train_Y; found {Y.shape[-1]}."
            )
        wrong = ~self.holds(Y)
        if wrong.any():
            rows = wrong.any(-1).to(X).sum_to_size(X.shape[:-1]).flatten().nonzero().flatten()
            error = PhysicsError(
                f"Physics {physics.name!r} returned {float(Y[wrong][0].detach()):.6g}, which "
                f"targets cannot be, as {self.scale_formula} is modelled; clamp its outputs.",
                rows.tolist(),
            )  # fmt: skip
            error.inputs = X.detach().reshape(-1, X.shape[-1])[rows]
            raise error

    has_density = True
    """Whether :meth:`log_likelihood` is that of the fitted model, which NUTS draws from."""
    scale_formula: str = ""
    """The scale on which the model is Gaussian, as a formula; empty for that of the targets."""

    def read_scale(self, Y: Tensor) -> None:
        """Do nothing; a subclass may store what its scale reads of the training targets."""

    def holds(self, Y: Tensor) -> Tensor:
        """Return whether targets may have these values."""
        return torch.ones_like(Y, dtype=torch.bool)

    def on_gaussian_scale(self, Y: Tensor) -> Tensor:
        """Return targets or outputs of a physics, ``... x n x m``, where the model is Gaussian."""
        return Y

    def off_gaussian_scale(self, Z: Tensor) -> Tensor:
        """Return the reverse, of functions ``... x n x m``."""
        return Z

    def noise_in_units(self, Y: Tensor, Yvar: Tensor) -> Tensor:
        """Return known variances ``... x n x m`` of targets as ``... x m x n``, in units."""
        return Yvar.mT / self.unit.square()

    def usual_noise(self, Y: Tensor) -> Tensor | None:
        """Return the mean of the known variances, for observations ``... x k x m`` without any."""
        return None if self.data.Yvar is None else self.data.Yvar.mean(-2, keepdim=True)

    def log_jacobian(self) -> Tensor:
        """Return the log density of the targets, ``m``, in the user's units less the model's."""
        # log p(y) = log p(y / unit) - n log unit
        return -(~self.data.Y.isnan()).sum(-2) * self.unit.squeeze(-1).log()

    def targets(self) -> Tensor:
        """Return the targets less the mean of the noise, ``... x m x n``, in their unit."""
        return self.on_gaussian_scale(self.data.Y).mT / self.unit - self.noise.shift

    def _in_units(self, Y: Tensor) -> Tensor:
        """Return ``... x m x n`` of a physics' outputs, in units of the targets."""
        if self._outputs is not None:
            Y = Y[..., self._outputs]
        return self.on_gaussian_scale(Y).mT / self.unit

    def _arguments(self, physics: Physics, values: Values) -> list[Tensor]:
        """Return a physics' parameters ``S x p`` at their coordinates, if it has any."""
        if not physics.unknowns:
            return []
        z = torch.cat([values[f"physics.{name}"] for name in physics.unknowns], -1)
        return [physics.unknowns.to_values(z)]

    def physics_with_slopes(self, values: Values, with_slopes: bool) -> tuple[list[Tensor], Slopes]:
        """Return each physics at the training inputs, NaN where it fails, and its derivatives."""
        X = self.data.X
        names = [*self._unknowns]
        z = torch.cat([values[f"physics.{name}"] for name in names], -1)  # S x p
        p = 0
        if with_slopes:
            p = len(names)
        steps = _STEP * torch.eye(p, len(names)).to(z).unsqueeze(1)
        # Central differences, by one call: (1 + 2 p) x S x p.
        shifted = torch.cat([z.unsqueeze(0), z + steps, z - steps])
        moved = {f"physics.{n}": shifted[..., [i]].flatten(0, 1) for i, n in enumerate(names)}
        f, slopes = [], []
        for physics in self.physics:
            Y = physics.or_nan(X.unsqueeze(-3), *self._arguments(physics, moved))
            Y = self._in_units(Y.masked_fill(~self.holds(Y), torch.nan))
            Y = Y.expand(len(shifted) * len(z), -1, -1).unflatten(0, shifted.shape[:2])
            f.append(Y[0])
            slopes.append((Y[1 : p + 1] - Y[p + 1 :]) / (2 * _STEP))  # df / dz
        return f, {name: [slope[i] for slope in slopes] for i, name in enumerate(names[:p])}

    # Predictions.

    def kernel_inputs(self, X: Tensor) -> Tensor:
        """Return the inputs of kernels at ``... x n x d``; a kind of data may add to them."""
        return self.data.kernel_inputs(X)

    def places(self, X: Tensor, values: Values, f: Sequence[Tensor] | None = None) -> Places:
        """Return the inputs of kernels and noise at ``... x n x d``, and f_p unless it is given."""
        x = self.kernel_inputs(X).unsqueeze(-3).unsqueeze(-3)
        if self._f_train and not self._unknowns and X is self.data.X:
            f = self._f_train
        elif f is None:
            f = self._physics_at(X.unsqueeze(-3), values)
        return Places(x, f, X.unsqueeze(-3).unsqueeze(-3))

    def evaluate(self, X: Tensor, values: Values | None = None) -> WeightedSum:
        """Return the function at ``... x n x d``, at the draws ``u`` unless values are given."""
        if values is None:
            values = self.values
        return self.term_sum.evaluate(values, self.places(X, values))

    def evaluate_each(self, X: Tensor, values: Values) -> WeightedSum:
        """Return the function of each draw at points ``S x n x d`` of this draw."""
        x = self.kernel_inputs(X).unsqueeze(-3)
        places = Places(x, self._physics_at(X, values), X.unsqueeze(-3))
        return self.term_sum.evaluate(values, places)

    def conditioning(self) -> Conditioning:
        """Return the posterior given the data, without a graph of the draws; cached for these."""
        if self._cached is None or not torch.equal(self._cached[0], self.u):
            with torch.no_grad():
                conditioning = self.conditioned(*self._observed(self.table.values(self.u)))
            self._cached = (self.u.detach().clone(), conditioning)
        return self._cached[1]

    def _observed(
        self, values: Values, f: Sequence[Tensor] | None = None
    ) -> tuple[WeightedSum, Tensor, Tensor]:
        """Return the function at the training inputs, the variances of the noise, and targets."""
        places = self.places(self.data.X, values, f)
        noise = self.noise.variance(values, places, True)
        return self.term_sum.evaluate(values, places), noise, self.targets().unsqueeze(-3)

    def left_out(self) -> Marginals:
        """Return the distribution of each target given all others, with noise; NaN if missing."""
        return self.marginals_of(*self.left_out_at())

    def left_out_at(self, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return means and variances of left-out targets at ``S x B x P``, or at the draws."""
        if u is None:
            conditioning = self.conditioning()
        else:
            with torch.no_grad():
                conditioning = self.conditioned(*self._observed(self.table.values(u)))
        mean, variance = conditioning.left_out()
        mean = mean + self.noise.shift  # targets are y / unit - shift
        return (mean * self.unit).mT, (variance * self.unit.square()).mT

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of each draw, ``... x S x q x m``, in the user's units."""
        X, conditioning = self.data.new_inputs(X), self.conditioning()
        with self._graph_for(X):
            values = conditioning.train.values
            f = self.term_sum.evaluate(values, self.places(X, values))
            mean, variance = conditioning.moments(f)
            if observation_noise is not False:
                variance = variance + self._noise_at(X, observation_noise)
            variance = variance * self.unit.square()
            mean, variance = torch.broadcast_tensors(mean * self.unit, variance)
        return mean.mT, variance.mT

    def mixture(
        self, X: ArrayLike, outputs: list[int] | slice, observation_noise: bool | Tensor
    ) -> MixturePosterior:
        """Return the joint posterior of some outputs: a Gaussian of each draw."""
        X, conditioning = self.data.new_inputs(X), self.conditioning()
        with self._graph_for(X):
            mean, K = conditioning.joint(self.evaluate(X, conditioning.train.values))
            if observation_noise is not False:
                K = gaussian.add_noise(K, self._noise_at(X, observation_noise))
            mean, K = mean * self.unit, K * self.unit.square().unsqueeze(-1)
            return MixturePosterior(mean[..., outputs, :], K[..., outputs, :, :])

    def term(self, name: str, X: ArrayLike) -> MixturePosterior:
        """Return the joint posterior of a term's process at ``X``, without calling the physics.

        The process of a basis has no unit, that of another term the unit of the targets.
        """
        names = [term.name for term in self.terms]
        if name not in names:
            raise ValueError(f"Unknown term {name!r}; expected one of {', '.join(names)}.")
        X, conditioning = self.data.new_inputs(X), self.conditioning()
        has_unit = self.terms[names.index(name)].physics is None
        unit = self.unit if has_unit else torch.ones_like(self.unit)
        with self._graph_for(X):
            values = conditioning.train.values
            places = self.places(X, values, f=())
            mean, K = conditioning.joint(self.term_sum.term(name, values, places))
            return MixturePosterior(mean * unit, K * unit.square().unsqueeze(-1))

    def rho(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of the scaling of the physics; see :meth:`term`."""
        return self.term("rho", X)

    def delta(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of the correction that is added; see :meth:`term`."""
        return self.term("delta", X)

    def sample_functions(
        self, num_functions: int, seed: int | None = None, num_features: int = 1024
    ) -> Functions:
        """Draw functions from the posterior.

        They map ``... x q x d`` to ``k x ... x q x m``.

        Args:
            num_functions: Number ``k`` of functions, spread over the draws.
            seed: Seed. Default: one of PyTorch's generator.
            num_features: Number of random features for each kernel, an even one.
        """
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        return Functions(self, num_functions, num_features, seed)

    def summary(self) -> str:
        """Return the unknown numbers in words and in the user's units."""
        return summary(self)

    def priors(self) -> Any:
        """Return a frame of the unknown numbers by their priors, in the user's units.

        Its columns are name, output (empty of shared numbers), median, both ends of the central
        95 % interval, and meaning. Its ``plot()`` draws the priors, and the posterior after a fit.
        """
        from gpadjust.core.priors import priors  # with pandas, which models do not need

        return priors(self)

    def _graph_for(self, X: Tensor) -> torch.set_grad_enabled:
        """Record a graph if inputs or fantasies have one, not for the draws."""
        has_graph = X.requires_grad or self.conditioning().alpha.requires_grad
        return torch.set_grad_enabled(has_graph and torch.is_grad_enabled())

    def _noise_at(self, X: Tensor, asked: bool | Tensor) -> Tensor:
        """Return variances ``... x S x m x q`` in units of the targets."""
        if asked is True:
            values = self.conditioning().train.values
            return self.noise.variance(values, self.places(X, values))
        return self.checked_noise(asked, X).mT.unsqueeze(-3) / self.unit.square()

    def checked_noise(self, noise: Any, X: Tensor) -> Tensor:
        """Return given variances of observations at ``X``, ``... x q x m``."""
        q, m = X.shape[-2], self.num_outputs
        shape = tuple(getattr(noise, "shape", ()))
        is_right = shape[-2:-1] in ((1,), (q,)) and shape[-1] in (1, m)
        if isinstance(noise, Tensor) and is_right and (noise >= 0).all():
            return noise.expand(*shape[:-2], q, m)
        raise ValueError(
            f"Expected noise as True, False or variances ... x {q} x {m}, not negative or NaN; "
            f"found {shape or noise!r}. Known noise belongs to the model, in train_Yvar."
        )

    # Other data, outputs and draws.

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None, **_: Any
    ) -> Self:
        """Return the model with further observations; unknown numbers stay as they are.

        Args:
            X: Inputs, ``... x k x d``.
            Y: Observations, ``... x k x m``; NaN where one is missing. Further dimensions in front,
                as of fantasies, share the factor of X.
            noise: Variances of the shape of ``Y``. Default: the mean of known noise.
        """
        X, Y = self.data.new_inputs(X), as_tensor(Y, "Y")
        if Y.shape[-2:] != (X.shape[-2], self.num_outputs) or Y.isinf().any():
            shape = f"... x {X.shape[-2]} x {self.num_outputs}"
            raise ValueError(f"Expected finite Y of shape {shape}, or NaN; found {tuple(Y.shape)}.")
        self.on_gaussian_scale(Y)  # an error if targets cannot have such values
        old, new = self.conditioning(), self._copy()
        new.data = self.data.appended(X, Y)
        is_usual = noise is None
        noise = self.usual_noise(Y) if is_usual else as_tensor(noise, "noise")
        if noise is not None and self.noise.known is not None:
            is_unused = noise.isnan() & Y.isnan()
            if is_unused.any():
                noise = noise.masked_fill(is_unused, 1.0)
            noise = self.checked_noise(noise, X)
            if self.data.Yvar is not None:
                new.data = new.data._replace(Yvar=appended(self.data.Yvar, noise))
            noise = None if is_usual else self.noise_in_units(Y, noise)
        new.noise = self.noise.appended(noise, X.shape[-2])
        values = old.train.values
        has_graph = X.requires_grad or Y.requires_grad or old.alpha.requires_grad
        with torch.set_grad_enabled(has_graph and torch.is_grad_enabled()):
            if not self._unknowns:  # f_p is called at the new points only
                pairs = zip(self._f_train, self._physics_at(X.unsqueeze(-3), values), strict=True)
                new._f_train = [appended(f, f_new, -1) for f, f_new in pairs]
            conditioning = new.conditioned(*new._observed(values), old)
        new._cached = (self.u.detach().clone(), conditioning)
        return new.eval()

    def set_train_data(self, *_: Any, **__: Any) -> NoReturn:
        """Raise an error: the data of a model stay."""
        way_out = "build another one, or take model.condition_on_observations(X, Y)"
        raise NotImplementedError(f"The data of a model stay: {way_out}.")

    def get_fantasy_model(self, inputs: Any, targets: Tensor, **options: Any) -> Self:
        """Condition on targets ``... x (m) x k``, as GPyTorch's lists of models do."""
        X = inputs if isinstance(inputs, Tensor) else inputs[0]
        noise = options.get("noise")
        if self.num_outputs > 1:
            return self.condition_on_observations(X, targets.mT, noise)
        noise = None if noise is None else noise.unsqueeze(-1)
        return self.condition_on_observations(X, targets.unsqueeze(-1), noise)

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; a ValueError if there are none of these numbers."""
        idcs = self.checked_outputs(idcs)
        new = self._copy()
        new.data = self.data.of_outputs(idcs)
        new.unit, new.noise = self.unit[idcs], self.noise.of_outputs(idcs)
        new._f_train = [f[..., idcs, :] for f in self._f_train]
        new._outputs = idcs if self._outputs is None else [self._outputs[i] for i in idcs]
        new.term_sum = TermSum(self.terms, [f[idcs] for f in self.term_sum.f], new.unit)
        new.table = self.table.of_outputs(idcs)
        new.set_draws(self.table.coordinates_of_outputs(self.draws, idcs))
        new.u = torch.nn.Parameter(self.table.coordinates_of_outputs(self.u.detach(), idcs))
        return new

    def subset_rows(self, rows: Tensor) -> Self | None:
        """Return the model of some observations in the same units; None if its noise cannot."""
        noise = self.noise.of_rows(rows)
        if noise is None:
            return None
        Yvar = None if self.data.Yvar is None else self.data.Yvar[rows]
        data = self.data._replace(X=self.data.X[rows], Y=self.data.Y[rows], Yvar=Yvar)
        f_train = [f[..., rows] for f in self._f_train]
        return self._copy(noise=noise, data=data, _f_train=f_train, _cached=None)

    def with_noise(self, noise: Noise) -> Self:
        """Return the model with another noise of the same unknown numbers."""
        return self._copy(noise=noise, _cached=None)

    def with_conditioning(self, conditioning: Any) -> Self:
        """Return the model with another posterior than its data's, of the same draws."""
        return self._copy(_cached=(self.u.detach().clone(), conditioning))

    def subset_draws(self, numbers: Tensor) -> Self:
        """Return the model of some of its draws, with repetitions, by their numbers."""
        new = self._copy()
        new.set_draws(self.u.detach()[numbers])
        return new

    def _copy(self, **attributes: Any) -> Self:
        """Return a copy with other attributes, that shares what is never changed in place."""
        shared = [self.data, self.physics, self.table, self.term_sum, self.noise, self.unit]
        shared += [self._f_train, self._cached, self._draws, self.settings]
        new = deepcopy(self, {id(part): part for part in shared})
        for name, value in attributes.items():
            setattr(new, name, value)
        return new

    def to(self, *args: Any, **options: Any) -> Self:
        """Move the model to a device, with its data."""
        super().to(*args, **options)
        parts = {name: getattr(self.data, name) for name in ("X", "Y", "Yvar", "transform")}
        moved = {name: part.to(self.u) for name, part in parts.items() if part is not None}
        self.data = self.data._replace(**moved)
        self.unit = self.unit.to(self.u)
        self._draws = self._draws.to(self.u)
        self._f_train = [f.to(self.u) for f in self._f_train]
        self.term_sum = TermSum(self.terms, [f.to(self.u) for f in self.term_sum.f], self.unit)
        self.table = self.table.to(self.u)
        self.noise = self.noise.to(self.u)
        self._cached = None
        return self

    # The interfaces of BoTorch and GPyTorch.

    @property
    def num_outputs(self) -> int:
        """``m``."""
        return self.data.Y.shape[-1]

    @property
    def mean_module(self) -> MeanView:
        """The prior mean, f_p for an adjustment, in the user's units."""
        return MeanView(self)

    @property
    def covar_module(self) -> AdditiveKernel:
        """The prior covariance: the sum of the kernels of rho, scaled by f_p - c, and of delta."""
        terms = [term for term in self.terms if term.varies] or self.terms[:1]  # of zeros
        return AdditiveKernel(*(TermView(self, term.name) for term in terms))

    @property
    def likelihood(self) -> GaussianLikelihood:
        """The Gaussian likelihood with the model's noise."""
        likelihood = GaussianLikelihood()
        likelihood.noise_covar = NoiseView(self)
        return likelihood

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the data: empty but for fantasies."""
        return torch.broadcast_shapes(self.data.X.shape[:-2], self.data.Y.shape[:-2])

    @property
    def train_inputs(self) -> tuple[Tensor]:
        """The training inputs."""
        return (self.data.X,)

    @property
    def train_targets(self) -> Tensor:
        """The targets, ``(m) x n``; 0 where one is missing, of a noise that gives it no weight."""
        return squeezed(self.targets().mul(self.unit).unsqueeze(-3), -2).nan_to_num()

    def forward(self, x: Tensor) -> MultivariateNormal:
        """Return the prior at inputs ``... x n x d``."""
        return MultivariateNormal(self.mean_module(x), self.covar_module(x))

    def __call__(self, x: Tensor) -> MultivariateNormal:
        """Return the prior in training mode, at the training inputs only, else the posterior."""
        if not self.training:
            mean, K = self.conditioning().joint(self.evaluate(self.data.new_inputs(x)))
            K = (K * self.unit.square().unsqueeze(-1)).expand(*mean.shape, mean.shape[-1])
            lazy = to_linear_operator(squeezed(K, -3))
            return MultivariateNormal(squeezed(mean * self.unit, -2), lazy)
        if len(self.u) > 1:
            few = "call model.set_draws(model.u[:1])"
            raise RuntimeError(f"The model holds {len(self.u)} draws, a loss needs one: {few}.")
        if x.shape != self.data.X.shape or not torch.equal(x, self.data.X):
            raise RuntimeError("In training mode call the model on its training inputs.")
        return self.forward(self.data.X)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({counted(self)})"

    def _repr_html_(self) -> str:
        return summary_html(self)


@DrawMatheronPaths.register(Predictive)  # type: ignore[untyped-decorator]
def _draw_matheron_paths(model: Any, *, sample_shape: Size, **_: Any) -> Paths:
    """Draw functions for BoTorch's ``draw_matheron_paths``, by the model's own features."""
    return Paths(model.sample_functions(max(1, sample_shape.numel())), sample_shape)


def _unknown_option(structure: type[GP], name: str) -> TypeError:
    """Return the error of an option that a structure does not have."""
    classes = [kind for kind in structure.__mro__ if issubclass(kind, GP)]
    signatures = map(signature, classes[:-1] or classes)
    parameters = [p for one in signatures for p in one.parameters.values()]
    names = {p.name for p in parameters if p.kind is p.KEYWORD_ONLY} - {"settings"}
    return TypeError(
        f"Unknown option {name!r} of {structure.__name__}; expected some of "
        f"{', '.join(sorted(names | {'noise', 'input_transform'}))}. Kinds of data are noises and "
        "input transforms of gpadjust.kinds; see CHANGELOG.md for earlier names."
    )


def _coordinates(model: GP) -> Tensor:
    """Return the coordinates of a single draw, ``m x P``, for their prior."""
    u, m = model.u[0], model.num_outputs
    if len(u) == m:
        return u.squeeze(0)
    return u.expand(m, -1) / m**0.5  # each output adds its share of -u^2 / 2


def _set_coordinates(model: GP, u: Tensor) -> None:
    with torch.no_grad():
        model.u.copy_(u.reshape(model.u.shape))


def _resize(model: Any, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Make room for as many draws as a state has, before it is loaded."""
    u = state.get(f"{prefix}u")
    if u is not None and u.shape[1:] == model.u.shape[1:]:
        model.set_draws(u.to(model.u))
