"""Ridge regression adjustment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import GPyTorchPosterior, Posterior
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import ScaleKernel
from gpytorch.likelihoods import Likelihood
from gpytorch.means import ZeroMean
from linear_operator import to_linear_operator
from linear_operator.operators import RootLinearOperator
from torch import Size, Tensor

from gpadjust.gp import DataInterval, FourierFeatures, FourierKernel
from gpadjust.models.adjusted_functions import AdjustedFunctions, AdjustmentFeatures
from gpadjust.models.adjustment_gp import AdjustmentGP, Component
from gpadjust.physics import Physics


class RRA(AdjustmentGP):
    r"""Ridge regression adjustment (Wannawas and Faisal 2023, section 2.2), a Bayesian linear model

    .. math:: f_a(x) = f_p(x) + [f_p(x)\, \varphi_\rho(x)^T, \; \varphi_\delta(x)^T]\, \beta, \quad
        \beta_\rho \sim N(0, s_\rho^2 I), \; \beta_\delta \sim N(0, s_\delta^2 I)

    on random Fourier features: :class:`~gpadjust.CKA` with RBF kernels, seen through finitely many
    weights. It is a Gaussian process with the kernel of the features, so that the marginal
    likelihood, that is the evidence of the regression, chooses lengthscales, prior scales and
    noise, and the posterior of the weights is exact. The weights make whole *functions* that can
    be evaluated anywhere (:meth:`sample_functions`), and a Pyro model (:meth:`pyro_model`).

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64.
        train_Y: Targets, ``batch_shape x n x m``, float64.
        train_Yvar: Known observation variances, or None to learn one per output.
        physics: The physics f_p, as in :class:`~gpadjust.CKA`.
        num_features: Number ``D`` of features of each of rho and delta.
        prior: ``"physics"``: rho = 1 and delta = 0 far from the data. ``"paper"``: the closed form
            as printed there, which regresses y itself, so that the model falls to zero far from
            the data: weights of prior variance 1 in the user's units, the noise variance as the
            ridge :math:`\lambda`, :math:`\hat\beta = (\Phi^T\Phi + \lambda I)^{-1}\Phi^T y` and
            covariance :math:`(\Phi^T\Phi + I)^{-1}`. It is here for comparison: its covariance is
            not that of the conjugate posterior unless :math:`\lambda = 1`.
        center: As in :class:`~gpadjust.CKA`.
        likelihood: As in :class:`~gpadjust.CKA`.
        outcome_transform: As in :class:`~gpadjust.CKA`; with ``prior="paper"`` the default is None.
        input_transform: As in :class:`~gpadjust.CKA`.
        seed: Seed of the features.

    Raises:
        TypeError: As :class:`~gpadjust.CKA`.
        ValueError: As :class:`~gpadjust.CKA`, and for an unknown ``prior``.
        PhysicsError: As :class:`~gpadjust.CKA`.

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
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        physics: Physics | Callable[[Tensor], Tensor],
        num_features: int = 128,
        prior: Literal["physics", "paper"] = "physics",
        center: float | Tensor | Literal["mean"] = 0.0,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        if prior not in ("physics", "paper"):
            raise ValueError(f"Unknown prior {prior!r}; expected 'physics' or 'paper'.")
        if not isinstance(num_features, int) or num_features < 1:
            raise ValueError(
                f"Expected num_features to be a whole number >= 1, got {num_features}."
            )
        if prior == "paper" and isinstance(outcome_transform, _DefaultType):
            outcome_transform = None

        def kernel(num_inputs: int, batch_shape: Size, seed: int) -> ScaleKernel:
            base = FourierKernel(
                FourierFeatures(num_features, num_inputs, seed),
                ard_num_dims=num_inputs,
                batch_shape=batch_shape,
                lengthscale_constraint=DataInterval(),
            )
            return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=DataInterval())

        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics=physics,
            rho_covar_module=lambda d, batch_shape: kernel(d, batch_shape, 2 * seed),
            delta_covar_module=lambda d, batch_shape: kernel(d, batch_shape, 2 * seed + 1),
            center=center,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        self.num_features = num_features
        self.prior = prior
        if prior == "paper":
            if outcome_transform is not None:
                raise ValueError("prior='paper' is in the user's units: outcome_transform=None.")
            self.mean_module = ZeroMean()
            self._rho_mean = 0.0
            for kernel_ in (self.rho_covar_module, self.delta_covar_module):
                kernel_.raw_outputscale.requires_grad_(False).zero_()  # an outputscale of 1

    def check_can_hold_samples(self) -> None:
        """As the base class; the paper's closed form has no likelihood to sample from."""
        if self.prior == "paper":
            raise ValueError(
                "RRA(prior='paper') cannot be fully Bayesian: its covariance is not that of a "
                "posterior. Take prior='physics'."
            )
        super().check_can_hold_samples()

    def rho(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of :math:`\rho` at raw ``X`` (``... x q x d``), without units."""
        return self._adjustment(X, "rho")

    def delta(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of :math:`\delta` at raw ``X`` (``... x q x d``), in y's units."""
        return self._adjustment(X, "delta")

    def weights(self) -> MultivariateNormal:
        r"""The posterior of the weights :math:`\beta = [\beta_\rho, \beta_\delta]`.

        With ``prior="physics"`` it is the conjugate one, of precision
        :math:`\Phi^T \Phi / \sigma^2 + \text{diag}(s^2)^{-1}`.

        Returns:
            A normal distribution over ``batch_shape x (m) x 2D`` weights in the user's units:
            those of rho without units, those of delta in the units of the targets.
        """
        self.eval()
        inputs = self.train_inputs[0]
        scale, prior_sd = self._column.scale, self._prior_sd()
        # In the units of the targets, and for weights of prior variance 1.
        design = AdjustmentFeatures(self)(inputs) * (prior_sd / scale).unsqueeze(-2)
        residual = (self.train_targets - self.mean_module(inputs)).unsqueeze(-1)
        noise = self.likelihood.noise.unsqueeze(-1)
        identity = torch.eye(design.shape[-1], dtype=design.dtype, device=design.device)
        chol = torch.linalg.cholesky(design.mT @ (design / noise) + identity)
        mean = torch.cholesky_solve(design.mT @ (residual / noise), chol).squeeze(-1)
        if self.prior == "paper":
            chol = torch.linalg.cholesky(design.mT @ design + identity)
        root = torch.linalg.solve_triangular(chol, identity, upper=False).mT
        covariance = RootLinearOperator(prior_sd.unsqueeze(-1) * root)
        return MultivariateNormal(prior_sd * mean, covariance)

    def functions(self, weights: Tensor) -> AdjustedFunctions:
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
        return AdjustedFunctions(self, weights)

    def _draw_functions(self, num_functions: int) -> AdjustedFunctions:
        """As the base class, but exactly; see :meth:`functions`."""
        with torch.no_grad():
            return self.functions(self.weights().sample(Size([num_functions])))

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
        features = AdjustmentFeatures(self)
        with torch.no_grad():
            noise = self.likelihood.noise
            if X is None:
                inputs = self.train_inputs[0]
                obs: Tensor | None = features.user_units(self.train_targets)
            else:
                noise = noise.mean(-1, keepdim=True)  # known noise is that of the training points
                inputs = self.transform_inputs(X)
                inputs = inputs.expand(*self._aug_batch_shape, *inputs.shape[-2:])
                obs = Y
                if Y is not None:
                    obs = Y.mT if self.num_outputs > 1 else Y.squeeze(-1)
            prior_sd = self._prior_sd()
            design, mean = features(inputs), features.prior_mean(inputs)
            noise_sd = noise.sqrt() * self._column.scale
        weights = pyro.sample(
            "weights", dist.Normal(torch.zeros_like(prior_sd), prior_sd).to_event(prior_sd.dim())
        )
        values: Tensor = mean + (design @ weights.unsqueeze(-1)).squeeze(-1)
        pyro.sample("Y", dist.Normal(values, noise_sd).to_event(values.dim()), obs=obs)
        return values

    def posterior(
        self,
        X: Tensor,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The posterior at raw ``X`` (``... x q x d``); see BoTorch."""
        everything = output_indices is None or [*output_indices] == [*range(self.num_outputs)]
        if self.prior != "paper" or not everything:
            return super().posterior(X, output_indices, observation_noise, posterior_transform)
        self.eval()
        inputs, output_dim = self._with_output_dim(self.transform_inputs(X))
        mvn = self._push_forward(AdjustmentFeatures(self)(inputs))
        mvn = self._apply_noise(inputs, mvn, observation_noise)
        posterior = self._as_posterior(mvn, output_dim)
        return posterior if posterior_transform is None else posterior_transform(posterior)

    def _adjustment(self, X: Tensor, component: Component) -> GPyTorchPosterior:
        """As the base class; the covariance of ``prior="paper"`` is not a Gaussian process's."""
        if self.prior != "paper":
            return super()._adjustment(X, component)
        self.eval()
        inputs, output_dim = self._with_output_dim(self.input_transform.without_physics(X))
        features = AdjustmentFeatures(self)
        x = inputs[..., : self._column.num_inputs]
        rho, delta = features.rho.feature_map(x), features.delta.feature_map(x)
        if component == "rho":
            blocks = [rho, torch.zeros_like(delta)]
        else:
            blocks = [-self._column.offset.unsqueeze(-1) * rho, delta]
        return self._as_posterior(self._push_forward(torch.cat(blocks, dim=-1)), output_dim)

    def _marginals(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """As the base class; the posterior of ``prior="paper"`` is that of its weights."""
        if self.prior != "paper":
            return super()._marginals(inputs)
        features, weights = AdjustmentFeatures(self)(inputs), self.weights()
        mean = (features @ weights.mean.unsqueeze(-1)).squeeze(-1)
        root = weights.lazy_covariance_matrix.root.to_dense()
        return mean, (features @ root).square().sum(-1)

    def _push_forward(self, features: Tensor) -> MultivariateNormal:
        """The distribution of ``features @ weights``, for features ``... x q x 2D``."""
        weights = self.weights()
        mean = (features @ weights.mean.unsqueeze(-1)).squeeze(-1)
        root = features @ weights.lazy_covariance_matrix.root.to_dense()
        return MultivariateNormal(mean, to_linear_operator(root @ root.mT))

    @property
    def _covariance_noise(self) -> float | None:
        """For leave-one-out: the noise variance in the covariance, if not that in the mean."""
        return 1.0 if self.prior == "paper" else None

    def _prior_sd(self) -> Tensor:
        """Prior standard deviations of the weights in the user's units, ``... x 2D``."""
        shape = (*self._aug_batch_shape, self.num_features)
        rho = self.rho_covar_module.outputscale.sqrt().unsqueeze(-1).expand(shape)
        delta = self.delta_covar_module.outputscale.sqrt().unsqueeze(-1) * self._column.scale
        return torch.cat([rho, delta.expand(shape)], dim=-1)
