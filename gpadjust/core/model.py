"""A sum of terms as a BoTorch model and a GPyTorch model: data, predictions, conditioning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, Self

import gpytorch
import torch
from botorch.acquisition.objective import PosteriorTransform, ScalarizedPosteriorTransform
from botorch.models import SingleTaskGP
from botorch.models.model import FantasizeMixin, Model
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import Posterior
from botorch.sampling.pathwise.posterior_samplers import DrawMatheronPaths
from botorch.settings import validate_input_scaling
from gpytorch.distributions import MultivariateNormal
from gpytorch.priors import NormalPrior
from linear_operator import to_linear_operator
from torch import Size, Tensor

from gpadjust.core.data import ArrayLike, Data, as_given, as_tensor, unit_of
from gpadjust.core.functions import Functions, Paths
from gpadjust.core.gaussian import Conditioning, add_noise, log_likelihood
from gpadjust.core.noise import KnownNoise, Noise
from gpadjust.core.posterior import (
    MixturePosterior,
    Prediction,
    mixture_quantile,
    moments,
)
from gpadjust.core.summary import summary
from gpadjust.core.terms import Places, Term, TermSum, WeightedSum, check_terms
from gpadjust.core.unknowns import Choice, Row, Table, Values
from gpadjust.core.views import (
    MeanView,
    OtherPriors,
    kernel_view,
    likelihood_view,
    squeezed,
)
from gpadjust.physics import Physics, Unknown, as_physics

_STEP = 1e-4  # of differences by parameters of a physics, in coordinates


class GP(gpytorch.models.GP, FantasizeMixin, Model):
    r"""A sum of terms :math:`f(x) = \sum_t b_t(x) g_t(x)`, conditioned exactly on noisy targets.

    Each :math:`g_t` is a Gaussian process and each basis :math:`b_t` a physics or 1. All unknown
    numbers, of kernels, noise and physics, are rows of one ``table``, and ``u`` holds draws of their
    standard normal coordinates: one, all 0, until the model is fitted. Predictions are averages
    over the draws. Outputs are independent given the numbers.

    The model is a BoTorch ``Model``, of which posteriors are ordinary ones without a dimension for
    draws, and a ``gpytorch.models.GP`` with a mean, a kernel, a likelihood and the parameter ``u``.

    Args:
        train_X: Inputs in the user's units, ``n x d``: a float64 tensor, an array or a frame.
        train_Y: Targets in the user's units, ``n x m``; NaN where one is missing.
        train_Yvar: Known variances of the targets: one number, ``m``, or of their shape.
        terms: The terms.
        physics: What the bases of the terms are: functions or Physics with ``m`` outputs.
        noise: A :class:`Noise`. Default: one learnt variance of each output.
        choices: Nested models, which are averaged over by their posterior probabilities.
        input_transform: A one-to-one BoTorch transform of what kernels see; the physics sees X.
        outcome_transform: None or BoTorch's ``Standardize``, which has no effect, as priors are in
            units of the targets.
        settings: The arguments by which :func:`~gpadjust.core.save` builds the model again.

    Attributes:
        u: Coordinates of the draws that predictions average over, ``S x B x P``.
        draws: All coordinates that the last fit has drawn, ``N x B x P``.
        data: The training data.
        unit: The unit of each output's targets, ``m x 1``.

    Raises:
        TypeError: If data are no float64 tensors, arrays or frames of numbers.
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
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        terms: Sequence[Term],
        physics: Sequence[Any] = (),
        noise: Noise | None = None,
        choices: Sequence[Choice] = (),
        input_transform: Any = None,
        outcome_transform: Any = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if outcome_transform is not None and not isinstance(outcome_transform, Standardize):
            raise ValueError(
                "Expected outcome_transform=None or Standardize, which has no effect; found "
                f"{outcome_transform!r}. Transform the targets and the physics before."
            )
        self.data = Data.of(train_X, train_Y, train_Yvar, input_transform)
        self.physics = [as_physics(each) for each in physics]
        self.settings = dict(settings or {})
        self._outputs: list[int] | None = None
        self._cached: tuple[Tensor, Conditioning] | None = None
        X, Y = self.data.X, self.data.Y
        self.unit = Y.new_ones(Y.shape[-1], 1)
        self._unknowns = _unknowns_of(self.physics)
        self._f_train: list[Tensor] = []
        f = self._physics_at(X, {f"physics.{name}": Y.new_zeros(1, 1) for name in self._unknowns})
        self._check_outputs(f)
        check_terms(terms, len(f))
        mean = torch.zeros_like(Y.mT)
        for t in terms:
            mean = mean + t.mean * (1.0 if t.physics is None else f[t.physics][0])
        self.unit = unit_of(Y, mean.mT)
        self._f_train = [v / self.unit for v in f]
        self.term_sum = TermSum(terms, self._f_train, self.unit)
        if self.data.Yvar is not None:
            if noise is not None:
                raise ValueError("Expected train_Yvar or noise; found both.")
            noise = KnownNoise(self.data.Yvar.mT / self.unit.square())
        self.noise = Noise() if noise is None else noise
        rows = self.term_sum.rows(self.data.kernel_inputs(X), Y.shape[-1])
        rows += self.noise.rows(len(Y), Y.shape[-1], Y)
        rows += [Row(f"physics.{n}", Y.new_zeros(1), is_shared=True) for n in self._unknowns]
        self.table = Table(rows, Y.shape[-1], choices)
        self.u = torch.nn.Parameter(Y.new_zeros(1, self.table.problems, self.table.size))
        self.draws = self.u.detach()
        self.likelihood = likelihood_view(self)
        self.mean_module, self.covar_module = MeanView(self), kernel_view(self)
        self.register_prior("u_prior", _standard_normal(Y), _coordinates, _set_coordinates)
        if any(row.log_density is not None for row in rows):
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
    def physics_parameters(self) -> dict[str, Tensor]:
        """Draws ``N`` of each unknown parameter of the physics, in the user's units."""
        values = self.table.values(self.draws)
        return {n: p.value(values[f"physics.{n}"][..., 0]) for n, p in self._unknowns.items()}

    def set_draws(self, draws: Tensor, number: int | None = None) -> None:
        """Hold coordinates ``N x B x P``, of which predictions average over some, evenly taken.

        Args:
            draws: The coordinates; minus infinity where a positive number is 0.
            number: How many predictions take. Default: all.

        Raises:
            ValueError: If they have another shape, or are NaN or infinite.
        """
        shape = torch.Size([self.table.problems, self.table.size])
        if draws.shape[1:] != shape or not len(draws) or not (draws < torch.inf).all():
            raise ValueError(
                f"Expected finite coordinates of shape N x {shape[0]} x {shape[1]}; found "
                f"{tuple(draws.shape)}."
            )
        step = max(1, len(draws) // (number or len(draws)))
        self.draws = draws.detach()
        self.u = torch.nn.Parameter(self.draws[step // 2 :: step].clone())
        self._cached = None

    def log_likelihood(self, u: Tensor, with_gradient: bool = True) -> tuple[Tensor, Tensor]:
        """Return the log likelihood of the targets at coordinates ``S x B x P``, and its gradient.

        It is in units of the targets, minus infinity where it or f_p is not finite. The gradient is
        zero if it is not asked for.
        """
        with torch.no_grad():
            values, y = self.table.values(u), self.data.Y.mT / self.unit
            f, f_slopes = self._physics_with_slopes(values, with_gradient)
            places = Places(self._kernel_inputs(self.data.X), f)
            total = self.term_sum.at(values, places)
            if with_gradient:
                K, pull_back = total.with_pull_back()
            else:
                K = total.cross(total)
            noise = self.noise.variance(values, places, True)
            shape, observed = (len(u), *y.shape), ~y.isnan()
            residual, K = (y - total.mean).expand(shape), K.expand(*shape, shape[-1])
            residual = residual.nan_to_num() * observed
            found = log_likelihood(residual, K, noise, observed, with_gradient)
            value, gradient = found.value, torch.zeros_like(u)
            if with_gradient:
                by = pull_back(found.by_covariance)
                by_noise = found.by_covariance.diagonal(dim1=-1, dim2=-2)
                by |= self.noise.pull_back(values, places, by_noise)
                by |= self._by_physics(values, places, by, found.by_mean, by_noise, f_slopes)
                gradient = self.table.gradient(by, values)
            if self.table.problems < value.shape[-1]:
                value = value.sum(-1, keepdim=True)
        ratio, by_ratio = self._other_priors(u)
        value, gradient = value + ratio, gradient + by_ratio
        bad = ~(value.isfinite() & gradient.isfinite().all(-1))
        return value.masked_fill(bad, -torch.inf), gradient.masked_fill(bad.unsqueeze(-1), 0.0)

    def _by_physics(
        self,
        values: Values,
        places: Places,
        by: Values,
        by_mean: Tensor,
        by_variance: Tensor,
        f_slopes: dict[str, list[Tensor]],
    ) -> Values:
        """Return derivatives by centers and by the coordinates of a physics' parameters.

        Args:
            values: All numbers.
            places: The training inputs, and f_p there.
            by: Derivatives by the terms' weights, among others.
            by_mean: Derivatives by the mean of the sum, ``S x m x n``.
            by_variance: Derivatives by the variances of the noise, ``S x m x n``.
            f_slopes: Derivatives of each physics by each coordinate.
        """
        slopes: Values = {}
        by_f = [torch.zeros_like(by_mean) for _ in self.physics]
        for term in self.terms:
            if term.physics is None:
                continue
            by_weight = by.get(f"{term.name}.weight", torch.zeros_like(by_mean))
            # f_p is in the mean, times g's, and in the weight f_p - c.
            by_f[term.physics] += self.term_sum.mean_of(term, values) * by_mean + by_weight
            if term.has_center is True:
                by_c = -by_weight.sum(-1, keepdim=True)
                slopes[f"{term.name}.center"] = by_c * self.term_sum.center_scale(term)
        if f_slopes and type(self.noise).shares is not Noise.shares:
            parts_of_noise = self._noise_by_f(values, places, by_variance)
            by_f = [a + b for a, b in zip(by_f, parts_of_noise, strict=True)]
        for name, parts in f_slopes.items():
            products = [(a * b).sum((-1, -2)) for a, b in zip(by_f, parts, strict=True)]
            slopes[f"physics.{name}"] = torch.stack(products).sum(0).unsqueeze(-1)
        return slopes

    def _noise_by_f(self, values: Values, places: Places, by_variance: Tensor) -> list[Tensor]:
        """Return derivatives by each f_p, of a noise whose shares depend on it."""
        with torch.enable_grad():
            leaves = [f.detach().clone().requires_grad_() for f in places.f]
            variance = self.noise.variance(values, Places(places.x, leaves), True)
            slopes = torch.autograd.grad(
                variance.expand_as(by_variance), leaves, by_variance, allow_unused=True
            )
        return [
            torch.zeros_like(f) if s is None else s for f, s in zip(leaves, slopes, strict=True)
        ]

    def _other_priors(self, u: Tensor) -> tuple[Tensor | float, Tensor | float]:
        """Return the log density of priors other than N(0, I), and its gradient."""
        with torch.enable_grad():
            leaf = u.detach().requires_grad_()
            ratio = self.table.log_prior_ratio(leaf)
            if ratio is None:
                return 0.0, 0.0
            (slope,) = torch.autograd.grad(ratio.sum(), leaf)
        return ratio.detach(), slope

    # The physics.

    def _physics_at(self, X: Tensor, values: Values) -> list[Tensor]:
        """Return each physics at ``... x n x d``: ``... x S x m x n``, in units of the targets."""
        if self._f_train and not self._unknowns and X is self.data.X:
            return self._f_train
        outputs = []
        for physics in self.physics:
            if physics.unknowns:
                Y = physics(X.unsqueeze(-3), self._parameters_of(physics, values)).mT
            else:
                Y = physics(X).mT.unsqueeze(-3)
            outputs.append(self._of_outputs(Y) / self.unit)
        return outputs

    def _physics_with_slopes(
        self, values: Values, with_slopes: bool
    ) -> tuple[list[Tensor], dict[str, list[Tensor]]]:
        """Return each physics at the training inputs, and its derivatives by each coordinate.

        Derivatives are central differences, of one call for all. NaN where a physics fails.
        """
        if not self._unknowns:
            return self._physics_at(self.data.X, {}), {}
        names = [*self._unknowns]
        S, p = len(values[f"physics.{names[0]}"]), len(names)
        z = torch.cat([values[f"physics.{name}"] for name in names], -1)  # S x p
        steps = _STEP * torch.eye(p if with_slopes else 0, p).to(z).unsqueeze(1)
        z = torch.cat([z.unsqueeze(0), z + steps, z - steps]).reshape(-1, p)
        moved = {f"physics.{name}": z[:, [i]] for i, name in enumerate(names)}
        f, slopes = [], []
        for physics in self.physics:
            given = (self._parameters_of(physics, moved),) if physics.unknowns else ()
            Y = physics.or_nan(self.data.X.unsqueeze(-3), *given).mT
            Y = self._of_outputs(Y).expand(len(z), -1, -1) / self.unit
            Y = Y.reshape(2 * len(steps) + 1, S, *Y.shape[-2:])
            f.append(Y[0])
            slopes.append((Y[1 : len(steps) + 1] - Y[len(steps) + 1 :]) / (2 * _STEP))
        if not with_slopes:
            return f, {}
        return f, {name: [each[i] for each in slopes] for i, name in enumerate(names)}

    def _parameters_of(self, physics: Physics, values: Values) -> Tensor:
        """Return a physics' parameters ``S x p`` at their coordinates."""
        z = torch.cat([values[f"physics.{name}"] for name in physics.unknowns], -1)
        return physics.unknowns.at(z)

    def _of_outputs(self, Y: Tensor) -> Tensor:
        return Y if self._outputs is None else Y[..., self._outputs, :]

    def _check_outputs(self, f: Sequence[Tensor]) -> None:
        m = self.data.Y.shape[-1]
        for physics, values in zip(self.physics, f, strict=True):
            if values.shape[-2] != m:
                raise ValueError(
                    f"Expected as many outputs of physics {physics.name!r} as train_Y has columns, "
                    f"{m}; found {values.shape[-2]}."
                )

    # Predictions.

    def _kernel_inputs(self, X: Tensor) -> Tensor:
        return self.data.kernel_inputs(X).unsqueeze(-3).unsqueeze(-3)

    def places(self, X: Tensor, values: Values, with_physics: bool = True) -> Places:
        """Return what terms and noise read at inputs ``... x n x d``."""
        f = self._physics_at(X, values) if with_physics else []
        return Places(self._kernel_inputs(X), f)

    def at(self, X: Tensor, values: Values | None = None) -> WeightedSum:
        """Return the function at inputs ``... x n x d``, at the draws ``u`` unless values are given."""
        values = self.values if values is None else values
        return self.term_sum.at(values, self.places(X, values))

    def conditioning(self) -> Conditioning:
        """Return the posterior given the data; it is kept until the draws change.

        It has no graph of the draws.
        """
        if self._cached is None or not torch.equal(self._cached[0], self.u):
            with torch.no_grad():
                self._cached = (self.u.detach().clone(), self._condition(self.values))
        return self._cached[1]

    def _condition(self, values: Values) -> Conditioning:
        places = self.places(self.data.X, values)
        noise = self.noise.variance(values, places, True)
        y = self.data.Y.mT.unsqueeze(-3) / self.unit
        return Conditioning(self.term_sum.at(values, places), noise, y)

    def left_out_at(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return each target given all others, at coordinates ``S x B x P``: ``S x n x m``."""
        with torch.no_grad():
            mean, variance = self._condition(self.table.values(u)).left_out()
        return (mean * self.unit).mT, (variance * self.unit.square()).mT

    def left_out(self) -> tuple[Tensor, Tensor]:
        """Return means and variances of each target given all others, of each draw ``S x n x m``.

        Noise is included; NaN where a target is missing.
        """
        mean, variance = self.conditioning().left_out()
        return (mean * self.unit).mT, (variance * self.unit.square()).mT

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of each draw, ``... x S x q x m``, in the user's units."""
        X, conditioning = self.data.new_X(X), self.conditioning()
        with self._graph_for(X):
            mean, variance = conditioning.marginals(self.at(X, conditioning.train.values))
            variance = variance + self._noise_at(X, observation_noise)
            mean, variance = torch.broadcast_tensors(
                mean * self.unit, variance * self.unit.square()
            )
        return mean.mT, variance.mT

    def predict(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Prediction:
        """Predict each point by itself, without the covariances between them.

        Args:
            X: Inputs, ``... x q x d``.
            observation_noise: If True, of observations instead of the function; or the variances
                of their noise, ``... x q x m``.

        Returns:
            Mean and variance, ``... x q x m``, as ``X`` came: tensors, arrays or frames.
        """
        mean, variance = moments(*self.components(X, observation_noise))
        names = self.data.output_names
        return Prediction(as_given(mean, X, names), as_given(variance, X, names))

    def interval(
        self, X: ArrayLike, level: float = 0.95, observation_noise: bool | Tensor = False
    ) -> tuple[Any, Any]:
        """Return the lower and upper ends of the central interval at each point, as ``X`` came.

        Raises:
            ValueError: If ``level`` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise ValueError(f"Expected level between 0 and 1; found {level}; 95 % is 0.95.")
        with torch.no_grad():
            parts = self.components(X, observation_noise)
            lower = mixture_quantile(*parts, (1 - level) / 2)
            upper = mixture_quantile(*parts, (1 + level) / 2)
        names = self.data.output_names
        return as_given(lower, X, names), as_given(upper, X, names)

    def posterior(
        self,
        X: ArrayLike,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """Return the joint posterior at ``X``, ``... x q x d``, as BoTorch asks for it."""
        if output_indices is not None:
            output_indices = self._checked_outputs(output_indices)
        self.eval()
        X, conditioning = self.data.new_X(X), self.conditioning()
        with self._graph_for(X):
            mean, K = conditioning.joint(self.at(X, conditioning.train.values))
            noise = self._noise_at(X, observation_noise)
            if isinstance(noise, Tensor):
                K = add_noise(K, noise)
            posterior = self._as_posterior(mean, K, self.unit, output_indices)
        if posterior_transform is None:
            return posterior
        if isinstance(posterior_transform, ScalarizedPosteriorTransform):
            return posterior.scalarized(posterior_transform.weights, posterior_transform.offset)
        return posterior_transform(posterior=posterior, X=X)

    def term(self, name: str, X: ArrayLike) -> MixturePosterior:
        """Return the joint posterior of a term's process at ``X``, without asking the physics.

        The process of a basis has no unit, that of another term the targets'.

        Raises:
            ValueError: If there is no such term.
        """
        names = [term.name for term in self.terms]
        if name not in names:
            raise ValueError(f"Unknown term {name!r}; expected one of {', '.join(names)}.")
        X, conditioning = self.data.new_X(X), self.conditioning()
        has_unit = self.terms[names.index(name)].physics is None
        unit = self.unit if has_unit else torch.ones_like(self.unit)
        with self._graph_for(X):
            values = conditioning.train.values
            places = self.places(X, values, with_physics=False)
            mean, K = conditioning.joint(self.term_sum.term(name, values, places))
            return self._as_posterior(mean, K, unit, None)

    def rho(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of the scaling of the physics; see :meth:`term`."""
        return self.term("rho", X)

    def delta(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of what is added to the physics; see :meth:`term`."""
        return self.term("delta", X)

    def sample_functions(
        self, num_functions: int, seed: int | None = None, num_features: int = 1024
    ) -> Functions:
        """Draw functions from the posterior, to be called anywhere.

        Args:
            num_functions: Number ``k`` of functions, spread over the draws.
            seed: Seed. Default: one of PyTorch's generator.
            num_features: Number of random features for each kernel, an even one.

        Returns:
            A module that maps ``... x q x d`` to ``k x ... x q x m``, in the user's units.
        """
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        return Functions(self, num_functions, num_features, seed)

    def summary(self) -> str:
        """Return the unknown numbers in words and in the user's units."""
        return summary(self)

    def _graph_for(self, X: Tensor) -> torch.set_grad_enabled:
        """Record a graph if inputs or fantasies ask for one, not for the draws."""
        asked = X.requires_grad or self.conditioning().alpha.requires_grad
        return torch.set_grad_enabled(asked and torch.is_grad_enabled())

    def _as_posterior(
        self, mean: Tensor, K: Tensor, unit: Tensor, outputs: list[int] | None
    ) -> MixturePosterior:
        mean, K = mean * unit, K * unit.square().unsqueeze(-1)
        if outputs is not None:
            mean, K = mean[..., outputs, :], K[..., outputs, :, :]
        lead = torch.broadcast_shapes(mean.shape, K.shape[:-1])
        mean, K = mean.expand(lead), K.expand(*lead, lead[-1])
        return MixturePosterior(mean, K)

    def _noise_at(self, X: Tensor, asked: bool | Tensor) -> Tensor | float:
        """Return variances ``... x S x m x q`` in units of the targets; 0 if none are asked for."""
        if asked is False:
            return 0.0
        if asked is True:
            values = self.conditioning().train.values
            return self.noise.variance(values, self.places(X, values))
        return self._checked_noise(asked, X).mT.unsqueeze(-3) / self.unit.square()

    def _checked_noise(self, noise: Any, X: Tensor) -> Tensor:
        """Return given variances of observations at ``X``, ``... x q x m``."""
        if not isinstance(noise, Tensor):
            raise TypeError(
                "Expected noise as True, False, or a tensor of variances; found "
                f"{noise!r}. Known noise belongs to the model, in train_Yvar."
            )
        shape = (X.shape[-2], self.num_outputs)
        sizes = zip(noise.shape[-2:], shape, strict=True) if noise.dim() > 1 else [(0, 1)]
        if any(have not in (1, want) for have, want in sizes):
            raise ValueError(
                f"Expected variances of shape ... x {shape[0]} x {shape[1]} as noise; found "
                f"{tuple(noise.shape)}."
            )
        if not (noise >= 0).all():
            raise ValueError("Expected noise (variances) that is not negative or NaN.")
        return noise.expand(*noise.shape[:-2], *shape)

    # Other data, other outputs.

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None, **_: Any
    ) -> Self:
        """Return the model with further observations; unknown numbers stay as they are.

        Args:
            X: Inputs, ``... x k x d``.
            Y: Observations, ``... x k x m``; NaN where one is missing. Further dimensions in front,
                as of fantasies, share the factor of X.
            noise: Variances of the shape of ``Y``, of a model with known noise. Default: their
                mean.
        """
        X, Y = self.data.new_X(X), as_tensor(Y, "Y")
        if Y.shape[-2:] != (X.shape[-2], self.num_outputs) or Y.isinf().any():
            raise ValueError(
                f"Expected finite Y of shape ... x {X.shape[-2]} x {self.num_outputs}, or NaN where "
                f"an output is missing; found {tuple(Y.shape)}."
            )
        old = self.conditioning()
        new = self._copy()
        lead = torch.broadcast_shapes(X.shape[:-2], self.data.X.shape[:-2])
        parts = [v.expand(*lead, *v.shape[-2:]) for v in (self.data.X, X)]
        lead = torch.broadcast_shapes(lead, Y.shape[:-2], self.data.Y.shape[:-2])
        targets = [v.expand(*lead, *v.shape[-2:]) for v in (self.data.Y, Y)]
        Yvar = None
        if noise is not None and self.noise.known is not None:
            unused = noise.isnan() & Y.isnan()
            noise = noise if not unused.any() else torch.ones_like(Y).where(unused, noise)
            Yvar = self._checked_noise(noise, X).mT / self.unit.square()
        elif noise is not None:
            Yvar = noise
        new.noise = self.noise.appended(Yvar, X.shape[-2])
        new.data = self.data._replace(X=torch.cat(parts, -2), Y=torch.cat(targets, -2))
        if new.noise.known is not None:
            new.data = new.data._replace(Yvar=new.noise.known.mT * self.unit.square().mT)
        values = old.train.values
        has_graph = X.requires_grad or Y.requires_grad or old.alpha.requires_grad
        with torch.set_grad_enabled(has_graph and torch.is_grad_enabled()):
            if not self._unknowns:  # f_p is asked at the new points only
                late = self._physics_at(X, values)
                new._f_train = [
                    torch.cat([a.expand(*b.shape[:-1], a.shape[-1]), b], -1)
                    for a, b in zip(self._f_train, late, strict=True)
                ]
            places = new.places(new.data.X, values)
            total = new.term_sum.at(values, places)
            variance = new.noise.variance(values, places, True)
            y = new.data.Y.mT.unsqueeze(-3) / new.unit
            appended = Conditioning.appended(old, total, variance, y)
        new._cached = (self.u.detach().clone(), appended)
        return new.eval()

    def get_fantasy_model(self, inputs: Any, targets: Tensor, **options: Any) -> Self:
        """Return :meth:`condition_on_observations` of targets ``... x (m) x k``, as GPyTorch has it."""
        X = inputs if isinstance(inputs, Tensor) else inputs[0]
        Y = targets.unsqueeze(-1) if self.num_outputs == 1 else targets.mT
        noise = options.get("noise")
        if noise is not None and self.num_outputs == 1:
            noise = noise.unsqueeze(-1)
        return self.condition_on_observations(X, Y, noise)

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs.

        Raises:
            ValueError: If there are none, or a number is out of range.
        """
        idcs = self._checked_outputs(idcs)
        new = self._copy()
        new.data = self.data._replace(
            Y=self.data.Y[..., idcs], output_names=tuple(self.data.output_names[i] for i in idcs)
        )
        if self.data.Yvar is not None:
            new.data = new.data._replace(Yvar=self.data.Yvar[..., idcs])
        new.unit, new.noise = self.unit[idcs], self.noise.of_outputs(idcs)
        new._f_train = [f[..., idcs, :] for f in self._f_train]
        new._outputs = idcs if self._outputs is None else [self._outputs[i] for i in idcs]
        new.term_sum = TermSum(self.terms, [f[idcs] for f in self.term_sum.f], new.unit)
        new.table = self.table.of_outputs(idcs)
        new.set_draws(self.table.coordinates_of_outputs(self.draws, idcs))
        new.u = torch.nn.Parameter(self.table.coordinates_of_outputs(self.u.detach(), idcs))
        return new

    def _checked_outputs(self, outputs: list[int]) -> list[int]:
        m = self.num_outputs
        if not outputs or any(not isinstance(i, int) or not -m <= i < m for i in outputs):
            raise ValueError(f"Expected numbers of outputs from 0 to {m - 1}; found {outputs}.")
        return [i % m for i in outputs]

    def subset_rows(self, rows: Tensor) -> Self | None:
        """Return the model of some of its observations, with the same units and priors.

        None if its noise cannot do with fewer.
        """
        noise = self.noise.of_rows(rows)
        if noise is None:
            return None
        new = self._copy()
        new.noise = noise
        new.data = self.data._replace(X=self.data.X[rows], Y=self.data.Y[rows])
        new._f_train, new._cached = [f[..., rows] for f in self._f_train], None
        return new

    def subset_draws(self, rows: Tensor) -> Self:
        """Return the model of some of its draws, with repetitions, by their numbers."""
        new = self._copy()
        new.set_draws(self.u.detach()[rows])
        return new

    def _copy(self) -> Self:
        """Return a copy that shares what is never changed in place."""
        shared = (self.data, self.physics, self.table, self.term_sum, self.noise, self.unit)
        shared = (*shared, self._f_train, self._cached, self.draws, self.settings)
        return deepcopy(self, {id(each): each for each in shared})

    def to(self, *args: Any, **options: Any) -> Self:
        """Move the model to a device, with its data."""
        super().to(*args, **options)
        data = [v.to(self.u) if isinstance(v, Tensor) else v for v in self.data]
        self.data, self.unit, self.draws = Data(*data), self.unit.to(self.u), self.draws.to(self.u)
        self._f_train = [f.to(self.u) for f in self._f_train]
        f = [each.to(self.u) for each in self.term_sum.f]
        self.term_sum = TermSum(self.terms, f, self.unit)
        self.table = self.table.to(self.u)
        if isinstance(self.noise, KnownNoise):
            self.noise = KnownNoise(self.noise.known.to(self.u))
        self._cached = None
        return self

    # What BoTorch and GPyTorch ask for.

    @property
    def num_outputs(self) -> int:
        """``m``."""
        return self.data.Y.shape[-1]

    @property
    def num_draws_and_outputs(self) -> tuple[int, int]:
        """``S`` and ``m``."""
        return len(self.u), self.num_outputs

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
        """The targets, ``(m) x n``, 0 where one is missing: the likelihood then gives it no weight."""
        return squeezed(self.data.Y.mT.unsqueeze(-3), -2).nan_to_num()

    def transform_inputs(self, X: Tensor, input_transform: Any = None) -> Tensor:
        """Return X itself, as the model takes inputs in the user's units everywhere."""
        return X if input_transform is None else input_transform(X)

    def forward(self, x: Tensor) -> MultivariateNormal:
        """Return the prior at inputs ``... x n x d``."""
        return MultivariateNormal(self.mean_module(x), self.covar_module(x))

    def __call__(self, x: Tensor) -> MultivariateNormal:
        """Return the prior at the training inputs in training mode, else the posterior.

        Raises:
            RuntimeError: In training mode, if the inputs are others, or the model holds draws.
        """
        if not self.training:
            mean, K = self.conditioning().joint(self.at(self.data.new_X(x)))
            K = (K * self.unit.square().unsqueeze(-1)).expand(*mean.shape, mean.shape[-1])
            lazy = to_linear_operator(squeezed(K, -3))
            return MultivariateNormal(squeezed(mean * self.unit, -2), lazy)
        if len(self.u) > 1:
            raise RuntimeError(
                f"The model holds {len(self.u)} draws of its unknown numbers, of which a loss has no "
                "use: build a new model for a point fit, or call model.set_draws(model.u[:1])."
            )
        if x.shape != self.data.X.shape or not torch.equal(x, self.data.X):
            raise RuntimeError("In training mode call the model on its training inputs.")
        return self.forward(self.data.X)

    def as_single_task_gp(self, draw: int | None = None) -> SingleTaskGP:
        """Return BoTorch's ``SingleTaskGP`` of one output at one draw, for code that asks for one.

        Its mean, kernel and noise are the model's and are not learnt.

        Args:
            draw: The number of the draw. Default: the most likely one.

        Raises:
            ValueError: If the model has several outputs or missing targets.
        """
        if self.num_outputs > 1 or self.data.Y.isnan().any():
            raise ValueError(
                "Expected one output without missing targets; take model.subset_output([0]), and "
                "leave out rows of NaN."
            )
        if draw is None:
            density = self.log_likelihood(self.u)[0].sum(-1) - 0.5 * self.u.square().sum((-1, -2))
            draw = int(density.argmax())
        own = self._copy()
        own.set_draws(self.u[[draw]])
        own.requires_grad_(False)
        noise = own.likelihood.noise.detach().reshape(self.data.Y.shape)
        with validate_input_scaling(False):  # the model has units of its own
            return SingleTaskGP(
                self.data.X, self.data.Y, noise, covar_module=own.covar_module,
                mean_module=own.mean_module, outcome_transform=None, input_transform=None,
            )  # fmt: skip

    def __repr__(self) -> str:
        n, m = self.data.Y.shape[-2:]
        d = self.data.X.shape[-1]
        return f"{type(self).__name__}({n} points, {d} inputs, {m} outputs, {len(self.u)} draws)"


@DrawMatheronPaths.register(GP)
def _draw_matheron_paths(model: GP, *, sample_shape: Size, **_: Any) -> Paths:
    """Draw functions for BoTorch's ``draw_matheron_paths``, by the model's own features."""
    functions = model.sample_functions(max(1, sample_shape.numel()))
    return Paths(functions, sample_shape)


def _unknowns_of(physics: Sequence[Physics]) -> dict[str, Unknown]:
    """Return the unknown parameters of several physics; those of one name are one."""
    unknowns: dict[str, Unknown] = {}
    for each in physics:
        for name, unknown in each.unknowns.items():
            if unknowns.setdefault(name, unknown) != unknown:
                raise ValueError(
                    f"Expected one prior of the parameter {name!r} in all physics; found "
                    f"{unknowns[name]!r} and {unknown!r}. Rename one of them."
                )
    return unknowns


def _coordinates(model: GP) -> Tensor:
    """Return the coordinates of a single draw, ``m x P``, for their prior."""
    u, m = model.u[0], model.num_outputs
    if len(u) == m:
        return u if m > 1 else u[0]
    return u.expand(m, -1) / m**0.5  # each output adds its share of -u^2 / 2


def _set_coordinates(model: GP, u: Tensor) -> None:
    with torch.no_grad():
        model.u.copy_(u.reshape(model.u.shape))


def _standard_normal(like: Tensor) -> NormalPrior:
    return NormalPrior(like.new_zeros(()), like.new_ones(()))


def _resize(model: Any, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Make room for as many draws as a state has, before it is loaded."""
    u = state.get(f"{prefix}u")
    if u is not None and u.shape[1:] == model.u.shape[1:]:
        model.set_draws(u.to(model.u))
