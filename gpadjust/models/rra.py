"""Ridge regression adjustment: Bayesian linear regression on random features."""

from __future__ import annotations

from functools import partial
from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import RFFKernel, ScaleKernel
from gpytorch.likelihoods import Likelihood
from linear_operator.operators import RootLinearOperator
from torch import Size, Tensor

from gpadjust.gp.gaussian import noise_variances
from gpadjust.models.adjusted_gp import AdjustedGP, Adjustment, Means, PhysicsLike
from gpadjust.models.cholesky_strategy import Weights
from gpadjust.models.hyperparameters import default_constraint
from gpadjust.models.sampled_functions import SampledFunctions, TermFeatures, weighted
from gpadjust.models.training_data import ArrayLike

NOT_SAMPLED = (
    "PaperRRA cannot be fully Bayesian: its covariance is not that of a posterior. Take RRA, or "
    "fit it by method 'map'."
)


class RRA(AdjustedGP):
    r"""Ridge regression adjustment (Wannawas and Faisal 2023, section 2.2), a Bayesian linear model

    .. math:: f_a(x) = f_p(x) + [f_p(x)\, \varphi_\rho(x)^T, \; \varphi_\delta(x)^T]\, \beta, \quad
        \beta_\rho \sim N(0, s_\rho^2 I), \; \beta_\delta \sim N(0, s_\delta^2 I)

    on random Fourier features, pairs of sines and cosines (Rahimi and Recht 2007):
    :class:`~gpadjust.CKA` with RBF kernels, seen through finitely many weights. Far from the data
    it falls back to rho = 1 and delta = 0. It is a Gaussian process with the kernel of the
    features, so that the marginal likelihood, that is the evidence of the regression, chooses
    lengthscales, prior scales and noise; all predictions are those of the weights' exact posterior,
    which lose no digits where there is no noise. The weights make whole *functions* that can be
    evaluated anywhere (:meth:`sample_functions`), and a Pyro model (:meth:`pyro_model`).

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
        center: float | Tensor | Literal["mean", "learn"] = "learn",
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        if not isinstance(num_features, int) or num_features < 2 or num_features % 2:
            raise ValueError(
                "Expected num_features to be an even whole number >= 2 (sines and cosines), got "
                f"{num_features!r}."
            )
        generator = torch.Generator().manual_seed(seed)
        kernel = partial(fourier_kernel, num_features=num_features, generator=generator)
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics,
            rho=Adjustment(kernel, rho_mean),
            delta=Adjustment(kernel, delta_mean),
            center=center,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        self.num_features = num_features

    def weights(self) -> MultivariateNormal:
        r"""The posterior of the weights :math:`\beta = [\beta_\rho, \beta_\delta]`.

        It is the conjugate one, of precision
        :math:`\Phi^T \Phi / \sigma^2 + \text{diag}(s^2)^{-1}`.

        Returns:
            A normal distribution over ``batch_shape x (m) x 2D`` weights in the user's units (of
            several physics, ``D`` for each of them): those of rho without units, those of delta in
            the units of the targets. An unknown mean (``rho_mean="learn"``) is a weight more,
            after those of its function.
        """
        self.eval()
        (mean, root), sd = self._weights_posterior(), self._prior_sd()
        return MultivariateNormal(sd * mean, RootLinearOperator(sd.unsqueeze(-1) * root))

    def functions(self, weights: Tensor) -> SampledFunctions:
        r"""The functions :math:`f_i` that given weights make, to be called anywhere.

        Args:
            weights: ``k x batch_shape x (m) x 2D``, as sampled from :meth:`weights`, or from
                :meth:`pyro_model` by NUTS or a guide.

        Returns:
            A module that maps ``... x q x d`` to ``k x ... x q x m``. Later fits of the model
            leave it as it is.

        Raises:
            ValueError: If the weights have another shape.
        """
        sd = self._prior_sd()
        if weights.dim() != sd.dim() + 1 or weights.shape[1:] != sd.shape:
            raise ValueError(
                f"Expected weights of shape k x {' x '.join(map(str, sd.shape))}, got "
                f"{tuple(weights.shape)}."
            )
        self.eval()
        features = [TermFeatures(term, 2) for term in self.terms]
        parts = (weights / sd).detach().split([each.num_features for each in features], dim=-1)
        return SampledFunctions(self, features, parts)

    def _draw_functions(self, num_functions: int, num_features: int) -> SampledFunctions:
        """As the base class, but exactly; see :meth:`functions`."""
        with torch.no_grad():
            return self.functions(self.weights().sample(Size([num_functions])))

    def _mean_functions(self) -> SampledFunctions:
        """As the base class, but exactly; see :meth:`functions`."""
        with torch.no_grad():
            return self.functions(self.weights().mean.unsqueeze(0))

    def pyro_model(self, X: Tensor | None = None, Y: Tensor | None = None) -> Tensor:
        r"""The regression as a Pyro model, in the user's units, for NUTS, SVI or any guide.

        Its sample sites are ``"weights"``, ``(m) x 2D`` as in :meth:`weights`, and ``"Y"``,
        ``(m) x n``. Lengthscales, prior scales and noise stand as they are in the model.

        Args:
            X: Raw inputs, ``n x d``. Default: the training inputs, with the training targets.
            Y: Observations, ``n x m``, or None to sample them.

        Returns:
            The values of the function, ``(m) x n``.

        Raises:
            ValueError: If the model has a batch shape besides its outputs, or ``Y`` comes without
                ``X``.
        """
        if X is None and Y is not None:
            raise ValueError("Got `Y` without `X`, the inputs that it belongs to.")
        if self._input_batch_shape:
            raise ValueError(
                "The Pyro model is of one data set; this model has batch_shape "
                f"{tuple(self._input_batch_shape)}."
            )
        self.eval()
        shift, scale = self._units()
        with torch.no_grad():
            if X is None:
                inputs: Tensor = self.train_inputs[0]
                obs: Tensor | None = self.train_targets * scale + shift
                noise = noise_variances(self.likelihood, inputs)
            else:
                inputs = self.model_inputs(X).expand(*self._aug_batch_shape, -1, -1)
                noise = self.observation_noise(inputs)
                obs = None if Y is None else Y.mT if self.num_outputs > 1 else Y.squeeze(-1)
            weights, prior_sd = self._bases(inputs), self._prior_sd()
            design = self._design(inputs, weights) * scale.unsqueeze(-1) / prior_sd.unsqueeze(-2)
            mean = self._prior_mean(inputs, weights) * scale + shift
            noise_sd = noise.sqrt() * scale
        beta = pyro.sample(
            "weights", dist.Normal(torch.zeros_like(prior_sd), prior_sd).to_event(prior_sd.dim())
        )
        values: Tensor = mean + (design @ beta.unsqueeze(-1)).squeeze(-1)
        pyro.sample("Y", dist.Normal(values, noise_sd).to_event(values.dim()), obs=obs)
        return values

    def _joint(self, inputs: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
        mean, root = self._push_forward(inputs, weights)
        return mean, root @ root.mT

    def _marginals(self, inputs: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
        mean, root = self._push_forward(inputs, weights)
        return mean, root.square().sum(-1)

    def _push_forward(self, inputs: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
        """Mean ``... x q`` and a root ``... x q x 2D`` of the covariance of a sum of terms."""
        beta, root = self._weights_posterior()
        design = self._design(inputs, weights)
        mean = self._prior_mean(inputs, weights) + (design @ beta.unsqueeze(-1)).squeeze(-1)
        return mean, design @ root

    def _weights_posterior(self) -> tuple[Tensor, Tensor]:
        """Mean and a root of the covariance of the weights, in their prior's units."""
        strategy = self.strategy()
        if strategy.has_graph:
            return self._regress()
        if "weights" not in strategy.kept:
            with torch.no_grad():
                strategy.kept["weights"] = self._regress()
        return strategy.kept["weights"]

    def _regress(self) -> tuple[Tensor, Tensor]:
        (inputs,) = self.train_inputs
        weights, noise = self._bases(inputs), noise_variances(self.likelihood, inputs)
        residual = self.train_targets - self._prior_mean(inputs, weights)
        return regression(self._design(inputs, weights), residual, noise)

    def _design(self, inputs: Tensor, weights: Weights) -> Tensor:
        """Weighted features, of all terms of the model, for weights N(0, I): ``... x q x 2D``."""
        given, zero = {term.name: w for term, w in weights}, torch.zeros_like(inputs[..., 0])
        return weighted(
            [TermFeatures(term, 2)(inputs) for term in self.terms],
            [given.get(term.name, zero) for term in self.terms],
        )

    def _prior_sd(self) -> Tensor:
        """Prior standard deviations of the weights in the user's units, ``... x 2D``."""
        parts = []
        with torch.no_grad():
            for term in self.covar_module.terms:
                _, scale = self._term_units(term.name)
                sd = term.kernel.outputscale.sqrt().unsqueeze(-1) * scale
                parts.append(sd.expand(*sd.shape[:-1], self.num_features))
                if term.learns_mean:
                    parts.append(term.mean_variance.sqrt() * scale)
        return torch.cat(parts, dim=-1)


class PaperRRA(RRA):
    r"""The ridge regression adjustment as printed in the paper, for comparison.

    It regresses y itself, so that it falls to zero far from the data; weights have the prior
    variance 1 in the user's units, the noise variance is the ridge :math:`\lambda`:

    .. math:: \hat\beta = (\Phi^T\Phi + \lambda I)^{-1}\Phi^T y, \quad
        \mathrm{Cov}(\beta) = (\Phi^T\Phi + I)^{-1},

    which is not the covariance of the conjugate posterior unless :math:`\lambda = 1`. It cannot be
    fully Bayesian, nor tell the information of an observation. The arguments are those of
    :class:`RRA`, without prior means, and always in the user's units.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        num_features: int = 128,
        center: float | Tensor | Literal["mean", "learn"] = 0.0,
        likelihood: Likelihood | None = None,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics=physics,
            num_features=num_features,
            rho_mean=0.0,
            center=center,
            likelihood=likelihood,
            outcome_transform=None,
            input_transform=input_transform,
            seed=seed,
        )
        for term in self.covar_module.terms:
            term.kernel.raw_outputscale.requires_grad_(False).zero_()  # an outputscale of 1

    def check_can_be_sampled(self) -> None:
        """Refuse: the paper's closed form has no likelihood to sample from."""
        raise ValueError(NOT_SAMPLED)

    def left_out(self) -> tuple[Tensor, Tensor]:
        """As the base class, with the variance of the paper's covariance."""
        mean, _ = super().left_out()
        (inputs,) = self.train_inputs
        with torch.no_grad():
            design = self._design(inputs, self._bases(inputs))
            design = design * ~self.train_targets.isnan().unsqueeze(-1)
            identity = torch.eye(design.shape[-2], dtype=design.dtype, device=design.device)
            precision = torch.linalg.inv(design @ design.mT + identity)
            latent = precision.diagonal(dim1=-1, dim2=-2).reciprocal() - 1
            return mean, latent + noise_variances(self.likelihood, inputs)

    def _regress(self) -> tuple[Tensor, Tensor]:
        mean, _ = super()._regress()
        (inputs,) = self.train_inputs
        design = self._design(inputs, self._bases(inputs))
        return mean, regression(design, self.train_targets, torch.ones_like(design[..., 0]))[1]


def fourier_kernel(
    num_inputs: int, batch_shape: Size, num_features: int, generator: torch.Generator
) -> ScaleKernel:
    """A scaled ``RFFKernel`` with a lengthscale per input; the outputs share its frequencies."""
    base = RFFKernel(
        num_samples=num_features // 2,
        ard_num_dims=num_inputs,
        batch_shape=batch_shape,
        lengthscale_constraint=default_constraint(),
    )
    shape = (num_inputs, num_features // 2)
    frequencies = torch.randn(shape, generator=generator, dtype=torch.float64)
    base._init_weights(randn_weights=frequencies.repeat(*batch_shape, 1, 1))
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=default_constraint())


def regression(design: Tensor, residual: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bayesian linear regression with weights N(0, I), by an orthogonal factorisation.

    With :math:`\begin{bmatrix} \Phi / \sigma \\ I \end{bmatrix} = Q R` the posterior of the weights
    is :math:`N(R^{-1} Q^T [r / \sigma; 0], \; R^{-1} R^{-T})`: no digits cancel, however small the
    noise.

    Args:
        design: :math:`\Phi`, ``... x n x p``.
        residual: Targets less their prior mean, ``... x n``; NaN where one is missing.
        noise: Noise variances, ``... x n``.

    Returns:
        The mean ``... x p``, and the root :math:`R^{-1}` of the covariance, ``... x p x p``.
    """
    n, p = design.shape[-2:]
    weight = noise.rsqrt().masked_fill(residual.isnan(), 0.0)
    scaled = design * weight.unsqueeze(-1)
    identity = torch.eye(p, dtype=design.dtype, device=design.device)
    identity = identity.expand(*scaled.shape[:-2], p, p)
    q, r = torch.linalg.qr(torch.cat([scaled, identity], dim=-2))
    root = torch.linalg.solve_triangular(r, identity, upper=True)
    target = (residual.nan_to_num(nan=0.0) * weight).unsqueeze(-1)
    return (root @ (q[..., :n, :].mT @ target)).squeeze(-1), root
