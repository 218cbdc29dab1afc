"""Ridge regression adjustment: Bayesian linear regression on random features."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal, Self, Unpack, cast

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import RFFKernel, ScaleKernel
from linear_operator.operators import RootLinearOperator
from torch import Size, Tensor

from gpadjust.checks import checked_whole
from gpadjust.gp import WeightedSum
from gpadjust.gp.features import term_features
from gpadjust.models.exact_conditioning import ExactConditioning, Factors
from gpadjust.models.parameters import LogInterval
from gpadjust.models.sampled_functions import SampledFunctions, check_num_features
from gpadjust.models.term_builder import Center, Means, ModelOptions, PhysicsLike, TermBuilder
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.training_data import ArrayLike
from gpadjust.models.updates import NewRows, UpdatedWeights


class WeightConditioning(ExactConditioning):
    """Posterior of terms on features, by the exact posterior of their weights."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.features: Any = term_features(self.kernel.terms, 2)
        self._weights: tuple[Tensor, Tensor] | None = None
        updated = getattr(self.kernel, "updated", None)
        self._known = None if updated is None else updated.moments()

    def marginals(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means and variances at each point by itself, ``... x q``."""
        mean, root = self._push_forward(sought)
        return mean, root.square().sum(-1)

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means ``... x q`` and covariances ``... x q x q``."""
        mean, root = self._push_forward(sought)
        return mean, root @ root.mT

    def weights(self) -> tuple[Tensor, Tensor]:
        """Moments of the weights as of :func:`regression`, in units of their prior."""
        if self.has_graph:
            return self.regress()
        if self._weights is None:
            with torch.no_grad():
                self._weights = self.regress()
        return self._weights

    def regress(self) -> tuple[Tensor, Tensor]:
        """Regress the targets on the features, see :func:`regression`.

        After updates it is their weights that are known, and of observations those after them.
        """
        train = self.kernel.at(self.train_inputs[0])
        noise = self.target_noise()
        design, residual = train.features(self.features), self.targets - train.mean()
        if self._known is None:
            return regression(design, residual, noise)
        mean, root, n = self._known
        design, residual = design[..., n:, :], residual[..., n:]
        residual = residual - (design @ mean.unsqueeze(-1)).squeeze(-1)
        more, narrower = regression(design @ root, residual, noise[..., n:])
        return mean + (root @ more.unsqueeze(-1)).squeeze(-1), root @ narrower

    def factors(self) -> Factors:
        """Return the factors of the observations; an error after updates, which are not kept."""
        if self._known is not None:
            raise RuntimeError(
                "The RRA knows observations by `update` that it does not keep: none can be left "
                "out, and GPyTorch's own prediction has none. Take `posterior` or `predict`; for "
                "leave-one-out build a model of the observations that you have."
            )
        return super().factors()

    def get_fantasy_strategy(
        self,
        inputs: Any,
        targets: Tensor,
        full_inputs: Any,
        full_targets: Tensor,
        *args: Any,
        **kwargs: Any,
    ) -> ExactConditioning:
        """GPyTorch's hook for further observations."""
        if self._known is None:
            given = (inputs, targets, full_inputs, full_targets, *args)
            return super().get_fantasy_strategy(*given, **kwargs)
        strategy = type(self)(full_inputs[0], full_targets, self.noise.after(**kwargs), self.kernel)
        strategy._known = self._known
        return strategy

    def _push_forward(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Mean ``... x q`` and a root ``... x q x p`` of the covariance of a sum of terms."""
        beta, root = self.weights()
        design = sought.features(self.features)
        return sought.mean() + (design @ beta.unsqueeze(-1)).squeeze(-1), design @ root


class RRA(TermsGP):
    r"""Ridge regression adjustment (Wannawas and Faisal 2023, section 2.2), a Bayesian linear model

    .. math:: f_a(x) = f_p(x) + [f_p(x)\, \varphi_\rho(x)^T, \; \varphi_\delta(x)^T]\, \beta, \quad
        \beta_\rho \sim N(0, s_\rho^2 I), \; \beta_\delta \sim N(0, s_\delta^2 I)

    on random Fourier features, pairs of sines and cosines (Rahimi and Recht 2007):
    :class:`~gpadjust.CKA` with RBF kernels, seen through finitely many weights. All predictions are
    those of the weights' exact posterior, which lose no digits where there is no noise. The weights
    make whole functions (:meth:`sample_functions`), and a Pyro model (:meth:`pyro_model`).

    The arguments and errors are those of :class:`~gpadjust.CKA`, without kernels, and:

    Args:
        num_features: Number ``D`` of features of each of rho and delta, an even one.
        seed: Seed of the features.

    Example:
        >>> import torch
        >>> from gpadjust import RRA, fit
        >>> train_X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> train_Y = 2 * torch.sin(6 * train_X) + train_X
        >>> model = RRA(train_X, train_Y, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> functions = model.sample_functions(3)
        >>> functions(torch.rand(5, 1, dtype=torch.float64)).shape
        torch.Size([3, 5, 1])
    """

    conditioning_class = WeightConditioning

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        num_features: int = 128,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        center: Center = "learn",
        seed: int = 0,
        **options: Unpack[ModelOptions],
    ) -> None:
        check_num_features(num_features)
        generator = torch.Generator().manual_seed(checked_whole("seed", seed))
        kernel = partial(fourier_kernel, num_features=num_features, generator=generator)
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, physics, rho_mean=rho_mean, center=center, **options
        )
        rhos = make.rhos(kernel)
        if any(term.scaled_by for term in rhos):
            raise ValueError(
                "The error of an emulated physics is no sum of features: take CKA, or "
                "FunctionPhysics(physics), which takes the emulator's mean as exact."
            )
        super().__init__(make, [*rhos, make.delta(kernel, delta_mean)])
        self.num_features = num_features

    def _check_window(self, forget: int | None) -> None:
        """Do nothing: weights are updated with a window and without."""

    def _take(self, new: NewRows, forget: int | None) -> None:
        """Take new observations by a step of a Kalman filter for each, which keeps no row."""
        conditioning, kernel = self._regression(), self.covar_module
        before = getattr(kernel, "updated", None)
        if before is None:
            train = self.at(self.train_inputs[0])
            design, n = train.features(conditioning.features), self.train_targets.shape[-1]
            before = UpdatedWeights.of_prior(self._prior_sd().shape, n, design)
            known = self.train_targets - train.mean()
            noise = self.noise.of_rows(self.noise.at(train.x))
            before.observe(design, known, noise, math.inf)
            kernel.updated = before
        f = self.at(new.inputs)
        noise = self.noise.at(f.x) if new.noise is None else new.noise
        design, residual = f.features(conditioning.features), new.targets - f.mean()
        before.observe(design, residual, noise, math.inf if forget is None else forget)
        self.prediction_strategy = None

    def train(self, mode: bool = True) -> Self:
        """Put the model in train mode, or eval mode; after updates it is not trained."""
        if mode:
            self._check_no_updates()
        return super().train(mode)

    def release_samples(self) -> None:
        """Reverse :meth:`hold_samples`, with the first sample; not after updates."""
        self._check_no_updates()
        super().release_samples()

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        """Load parameters, and the weights of a model that was updated."""
        if "covar_module.updated.pull" in state_dict and not hasattr(self.covar_module, "updated"):
            sd = self._prior_sd()
            self.covar_module.updated = UpdatedWeights.of_prior(sd.shape, 0, sd)
        return super().load_state_dict(state_dict, strict, *args, **kwargs)

    def _check_no_updates(self) -> None:
        updated = getattr(self.covar_module, "updated", None)
        if updated is not None and updated.rows.any():  # none before they are loaded
            raise RuntimeError(
                "The RRA knows observations by `update` that it does not keep, so that its "
                "hyper-parameters cannot be fitted to them: build a model of the observations that "
                "you have, and fit that."
            )

    def weights(self) -> MultivariateNormal:
        r"""The posterior of the weights :math:`\beta = [\beta_\rho, \beta_\delta]`.

        It is normal, of ``batch_shape x (m) x 2D`` weights (of several physics, ``D`` for each),
        those of delta in the units of the targets, with the precision :math:`\Phi^T \Phi / \sigma^2
        + \text{diag}(s^2)^{-1}`. An unknown mean is a weight more, after those of its function.
        """
        self.eval()
        (mean, root), sd = self._regression().weights(), self._prior_sd()
        return MultivariateNormal(sd * mean, RootLinearOperator(sd.unsqueeze(-1) * root))

    def functions(self, weights: Tensor) -> SampledFunctions:
        r"""The functions :math:`f_i` that given weights make, to be called anywhere.

        They are as those of :meth:`sample_functions`.

        Args:
            weights: ``k x batch_shape x (m) x 2D``, as sampled from :meth:`weights`, or from
                :meth:`pyro_model`; a ValueError for another shape.
        """
        sd = self._prior_sd()
        if weights.dim() != sd.dim() + 1 or weights.shape[1:] != sd.shape:
            raise ValueError(
                f"Expected weights of shape k x {' x '.join(map(str, sd.shape))}, got "
                f"{tuple(weights.shape)}."
            )
        self.eval()
        return SampledFunctions(self, self._regression().features, (weights / sd).detach())

    def pyro_model(self, X: Tensor | None = None, Y: Tensor | None = None) -> Tensor:
        r"""The regression as a Pyro model, in the user's units, for NUTS, SVI or any guide.

        Of outputs with a link (``outcome_transform="log"``) it is the model of their links.

        Its sample sites are ``"weights"``, ``(m) x 2D`` as in :meth:`weights`, and ``"Y"``,
        ``(m) x n``. Lengthscales, prior scales and noise stand as they are in the model.

        Args:
            X: Raw inputs, ``n x d``. Default: the training inputs, with the training targets.
            Y: Observations, ``n x m``, or None to sample them.

        Returns:
            The values of the function, ``(m) x n``.

        Raises:
            ImportError: Without Pyro, ``pip install "gpadjust[pyro]"``.
            ValueError: If the model has a batch shape besides its outputs, or ``Y`` comes without
                ``X``.
        """
        try:
            import pyro  # here alone, as it takes a second
            import pyro.distributions as dist
        except ImportError as error:
            raise ImportError(
                'pyro_model() needs Pyro; run `pip install "gpadjust[pyro]"`.'
            ) from error

        if X is None and Y is not None:
            raise ValueError("Got `Y` without `X`, the inputs that it belongs to.")
        if shape := tuple(self._input_batch_shape):
            raise ValueError(
                f"The Pyro model is of one data set; this model has batch_shape {shape}."
            )
        self.eval()
        shift, scale = self.units()
        with torch.no_grad():
            Y = Y if Y is None or self.link is None else self.link.value(Y)
            obs = None if Y is None else self.outputs_first(Y)
            if X is None:
                inputs: Tensor = self.train_inputs[0]
                noise = self.noise.of_rows(self.noise.at(inputs))
                obs = self.train_targets * scale + shift
            else:
                inputs = self.model_inputs(X).expand(*self._aug_batch_shape, -1, -1)
                noise = self.observation_noise(inputs)
            f, prior_sd = self.at(inputs), self._prior_sd()
            design = f.features(self._regression().features)
            design = design * scale.unsqueeze(-1) / prior_sd.unsqueeze(-2)
            mean, noise_sd = f.mean() * scale + shift, noise.sqrt() * scale
        prior = dist.Normal(torch.zeros_like(prior_sd), prior_sd)
        beta = pyro.sample("weights", prior.to_event(prior_sd.dim()))
        values: Tensor = mean + (design @ beta.unsqueeze(-1)).squeeze(-1)
        pyro.sample("Y", dist.Normal(values, noise_sd).to_event(values.dim()), obs=obs)
        return values

    def _functions_of_batches(self, number: int | None, num_features: int = 0) -> SampledFunctions:
        """Return exact functions, by the posterior of the weights."""
        with torch.no_grad():
            beta = self.weights()
            drawn = beta.mean.unsqueeze(0) if number is None else beta.sample(Size([number]))
            return self.functions(drawn)

    def _regression(self) -> WeightConditioning:
        return cast("WeightConditioning", self.conditioning())

    def _prior_sd(self) -> Tensor:
        """Prior standard deviations of the weights in the user's units, ``... x 2D``."""
        parts: list[Tensor] = []
        with torch.no_grad():
            for term in self.terms:
                scale, kernel = self.units(term.unit)[1], cast("ScaleKernel", term.kernel)
                sd = kernel.outputscale.sqrt().unsqueeze(-1) * scale
                parts.append(sd.expand(*sd.shape[:-1], self.num_features))
                if term.learns_mean:
                    parts.append(term.mean_variance.sqrt() * scale)
        return torch.cat(parts, dim=-1)


def fourier_kernel(
    num_inputs: int, batch_shape: Size, num_features: int, generator: torch.Generator
) -> ScaleKernel:
    """A scaled ``RFFKernel`` with a lengthscale per input; the outputs share its frequencies."""
    half = num_features // 2
    base = RFFKernel(
        num_samples=half,
        ard_num_dims=num_inputs,
        batch_shape=batch_shape,
        lengthscale_constraint=LogInterval(),
    )
    frequencies = torch.randn(num_inputs, half, generator=generator, dtype=torch.float64)
    base._init_weights(randn_weights=frequencies.repeat(*batch_shape, 1, 1))
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=LogInterval())


def regression(design: Tensor, residual: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bayesian linear regression with weights N(0, I), by an orthogonal factorisation.

    With :math:`\begin{bmatrix} \Phi / \sigma \\ I \end{bmatrix} = Q R` the posterior of the weights
    is :math:`N(R^{-1} Q^T [r / \sigma; 0], \; R^{-1} R^{-T})`: no digits cancel, however small the
    noise. The residual may be NaN. Returns the mean and the root :math:`R^{-1}`.
    """
    n, p = design.shape[-2:]
    weight = noise.rsqrt().masked_fill(residual.isnan(), 0.0)
    scaled = design * weight.unsqueeze(-1)
    identity = torch.eye(p).to(design).expand(*scaled.shape[:-2], p, p)
    q, r = torch.linalg.qr(torch.cat([scaled, identity], dim=-2))
    root = torch.linalg.solve_triangular(r, identity, upper=True)
    target = (residual.nan_to_num(nan=0.0) * weight).unsqueeze(-1)
    return (root @ (q[..., :n, :].mT @ target)).squeeze(-1), root
