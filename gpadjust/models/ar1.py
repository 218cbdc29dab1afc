"""AR1 co-kriging."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import Posterior
from botorch.utils.datasets import SupervisedDataset
from botorch.utils.sampling import draw_sobol_samples
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.constraints import Interval
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.likelihoods.noise_models import MultitaskHomoskedasticNoise
from gpytorch.means import ZeroMean
from linear_operator import to_dense
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor

from gpadjust.gp import DataInterval, FixedStandardize, InputsKernel
from gpadjust.models.defaults import make_kernel, scaled_rbf
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import set_initial_values
from gpadjust.models.prediction import Prediction
from gpadjust.models.training_data import check_training_data
from gpadjust.physics import Physics, as_physics


class LevelInput(InputTransform):
    """Appends the level of fidelity, 1 for a user's inputs; training inputs bring their own.

    Args:
        num_inputs: Number ``d`` of raw input columns.
        base: The user's input transform, or none.
    """

    transform_on_train = True
    transform_on_eval = True
    transform_on_fantasize = True

    def __init__(self, num_inputs: int, base: InputTransform | None = None) -> None:
        super().__init__()
        if base is not None and base.is_one_to_many:
            raise ValueError(
                f"The input transform {type(base).__name__} makes several points of one, which "
                "AR1 does not support; use a one-to-one transform."
            )
        self.num_inputs = num_inputs
        self.base = base

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` (or ``d + 1``, level included) to ``... x n x (d' + 1)``."""
        X = self.with_level(X)
        inputs, level = X[..., :-1], X[..., -1:]
        inputs = inputs if self.base is None else self.base(inputs)
        return torch.cat([inputs, level.expand(*inputs.shape[:-1], 1)], dim=-1)

    def with_level(self, X: Tensor) -> Tensor:
        """Append level 1 to ``X`` unless it has a level column."""
        if X.shape[-1] == self.num_inputs + 1:
            return X
        if X.shape[-1] == self.num_inputs:
            return torch.cat([X, torch.ones_like(X[..., :1])], dim=-1)
        raise ValueError(
            f"Expected X with {self.num_inputs} columns, the inputs that the model was built on, "
            f"got shape {tuple(X.shape)}."
        )


class AR1Kernel(Kernel):
    r"""The joint covariance of two levels, :math:`f_2 = \rho f_1 + \delta`, :math:`\rho` constant:

    .. math:: k((x, l), (x', l')) = \rho^{[l=1] + [l'=1]} k_1(x, x') + [l = l' = 1] k_\delta(x, x'),

    where the last column of the inputs is 0 for the low level and 1 for the high one
    (Kennedy and O'Hagan 2000).

    Args:
        low_kernel: The covariance :math:`k_1` of the low level.
        delta_kernel: The covariance :math:`k_\delta` of the bias.
        batch_shape: Batch shape of the constant :math:`\rho`.
    """

    def __init__(
        self,
        low_kernel: Kernel,
        delta_kernel: Kernel,
        batch_shape: Size = Size(),  # noqa: B008
    ) -> None:
        super().__init__(batch_shape=batch_shape)
        self.low_kernel = low_kernel
        self.delta_kernel = delta_kernel
        self.register_parameter("rho", torch.nn.Parameter(torch.ones(*batch_shape, 1)))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n``."""
        high1, high2 = x1[..., -1], x2[..., -1]
        scale1, scale2 = (1 + high * (self.rho - 1) for high in (high1, high2))
        low = to_dense(self.low_kernel(x1, x2, diag=diag, **params))
        bias = to_dense(self.delta_kernel(x1, x2, diag=diag, **params))
        if diag:
            return scale1 * scale2 * low + high1 * high2 * bias
        return (
            scale1.unsqueeze(-1) * scale2.unsqueeze(-2) * low
            + high1.unsqueeze(-1) * high2.unsqueeze(-2) * bias
        )


class LevelLikelihood(_GaussianLikelihoodBase):
    """Gaussian noise with one variance per level, told by the last column of the inputs.

    Unlike GPyTorch's ``HadamardGaussianLikelihood`` it broadcasts over the batches that fantasies
    add.

    Args:
        noise_constraint: The constraint of the variances.
        batch_shape: Batch shape of the variances, ``batch_shape x 2``.
    """

    def __init__(self, noise_constraint: Interval, batch_shape: Size) -> None:
        super().__init__(
            MultitaskHomoskedasticNoise(
                num_tasks=2, noise_constraint=noise_constraint, batch_shape=batch_shape
            )
        )

    @property
    def noise(self) -> Tensor:
        """The variances of the low and of the high level, ``batch_shape x 2``."""
        noise: Tensor = self.noise_covar.noise
        return noise

    def _shaped_noise_covar(
        self, base_shape: Size, *params: Any, **kwargs: Any
    ) -> DiagLinearOperator:
        if kwargs.get("noise") is not None:
            return DiagLinearOperator(kwargs["noise"])
        inputs = params[0] if isinstance(params[0], Tensor) else params[0][0]
        high = inputs[..., -1]
        low_noise, high_noise = self.noise[..., :1], self.noise[..., 1:]
        noise = low_noise + high * (high_noise - low_noise)
        shape = torch.broadcast_shapes(noise.shape, base_shape)
        return DiagLinearOperator(noise.expand(shape))


class AR1(MultiOutputGP):
    r"""Auto-regressive co-kriging, :math:`f_2(x) = \rho f_1(x) + \delta(x)` with a constant rho.

    The classic of multi-fidelity modelling (Kennedy and O'Hagan 2000; Wannawas and Faisal 2023,
    sec. 2.1.3): f_p is not used as a function but through ``N_1`` samples, to which a Gaussian
    process is fitted jointly with the data, with one noise level each. ``posterior(X)`` is about
    the high level. It is here for comparison; unlike :class:`~gpadjust.CKA` its cost and accuracy
    hang on the samples, and far from them it forgets the physics.

    Args:
        train_X: Inputs of the high level, ``batch_shape x n x d``, float64.
        train_Y: Targets of the high level, ``batch_shape x n x m``, float64.
        train_Yvar: Known observation variances of the high level, or None to learn the noise of
            both levels.
        physics: The low level f_p, as in :class:`~gpadjust.CKA`, sampled in ``bounds``.
        bounds: ``2 x d`` lower and upper bounds of the inputs.
        num_low: Number ``N_1`` of samples of f_p.
        low_X: Instead of the three above, the inputs of the low level, ``batch_shape x n_1 x d``;
        low_Y: and its values, ``batch_shape x n_1 x m`` (left out: computed by ``physics``).
        low_covar_module: The kernel of the low level. Default: RBF with a lengthscale per input.
        delta_covar_module: The kernel of the bias. Default: likewise.
        outcome_transform: ``Standardize`` or None. Default: shift by the mean and divide by the
            standard deviation of the low level.
        input_transform: A BoTorch input transform of the ``d`` inputs.
        seed: Seed of the (scrambled Sobol) samples.

    Raises:
        TypeError: If data are not float64 tensors.
        ValueError: If shapes disagree, data are not finite, bounds are upside down, or neither
            ``physics`` with ``bounds`` nor ``low_X`` with its values is given.
        PhysicsError: If the physics fails, or returns NaN or a wrong shape.
    """

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        physics: Physics | Callable[[Tensor], Tensor] | None = None,
        bounds: Tensor | None = None,
        num_low: int = 40,
        low_X: Tensor | None = None,
        low_Y: Tensor | None = None,
        low_covar_module: Kernel | None = None,
        delta_covar_module: Kernel | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        check_training_data(train_X, train_Y, train_Yvar)
        if low_X is None and low_Y is not None:
            raise ValueError("Got `low_Y` without `low_X`, the inputs that it belongs to.")
        if low_X is None:
            low_X = _samples(train_X, bounds, num_low, seed)
        if low_Y is None:
            if physics is None:
                raise ValueError(
                    "AR1 needs a low level: pass `physics` with `bounds` (or with `low_X`), or "
                    "`low_X` with `low_Y`."
                )
            with torch.no_grad():
                low_Y = as_physics(physics)(low_X)
        check_training_data(low_X, low_Y, prefix="low")
        if low_X.shape[-1] != train_X.shape[-1] or low_Y.shape[-1] != train_Y.shape[-1]:
            raise ValueError(
                f"Expected the low level with {train_X.shape[-1]} inputs and {train_Y.shape[-1]} "
                f"outputs as the high one has, got {low_X.shape[-1]} and {low_Y.shape[-1]}."
            )
        batch_shape = self.get_batch_dimensions(train_X, train_Y)[1]
        transform = LevelInput(train_X.shape[-1], input_transform)
        low_level = torch.cat([low_X, torch.zeros_like(low_X[..., :1])], dim=-1)
        X = torch.cat([low_level, transform.with_level(train_X)], dim=-2)
        Y = torch.cat([low_Y, train_Y], dim=-2)
        if isinstance(outcome_transform, _DefaultType):
            spread = low_Y.std(-2, keepdim=True)
            outcome_transform = FixedStandardize.of(
                low_Y.mean(-2, keepdim=True),
                spread.where(spread > 0, torch.ones_like(spread)),
            )
        d = transform(X).shape[-1] - 1
        low_kernel = make_kernel(low_covar_module or scaled_rbf, "low_covar_module", d, batch_shape)
        delta_kernel = make_kernel(
            delta_covar_module or scaled_rbf, "delta_covar_module", d, batch_shape
        )
        Yvar = likelihood = None
        if train_Yvar is None:
            likelihood = LevelLikelihood(DataInterval(), batch_shape)
        else:
            # f_p is known without error, but GPyTorch wants at least 1e-6 for fixed noise.
            low_Yvar = 1e-5 * low_Y.var(-2, keepdim=True)
            low_Yvar = low_Yvar.clamp_min(1e-6) if outcome_transform is None else low_Yvar
            Yvar = torch.cat([low_Yvar.expand_as(low_Y), train_Yvar], dim=-2)
        super().__init__(
            X,
            Y,
            Yvar,
            likelihood=likelihood,
            covar_module=AR1Kernel(
                InputsKernel(low_kernel, d), InputsKernel(delta_kernel, d), batch_shape
            ),
            mean_module=ZeroMean(),
            outcome_transform=outcome_transform,
            input_transform=transform,
        )
        set_initial_values(self, low_covar_module, delta_covar_module)

    @classmethod
    def construct_inputs(
        cls,
        training_data: SupervisedDataset,
        **options: Any,
    ) -> dict[str, Any]:
        """Construct keyword arguments of the model from a dataset.

        Args:
            training_data: The data of the high level.
            options: The low level: ``physics`` with ``bounds``, or ``low_X`` with ``low_Y``.
        """
        return {**super().construct_inputs(training_data), **options}

    @property
    def rho_constant(self) -> Tensor:
        r"""The constant :math:`\rho` of each output, ``batch_shape x (m)``."""
        return self.covar_module.rho.squeeze(-1)

    def _measured(self, inputs: Tensor) -> tuple[Tensor, slice]:
        """For leave-one-out: inputs without their level, and the rows of the high level."""
        num_low = int((inputs[..., -1] == 0).sum(-1).max())
        return inputs[..., :-1], slice(num_low, None)

    def _apply_noise(
        self, X: Tensor, mvn: MultivariateNormal, observation_noise: bool | Tensor = False
    ) -> MultivariateNormal:
        """BoTorch's hook for observation noise; known noise is that of the high level."""
        if observation_noise is True and isinstance(self.likelihood, FixedNoiseGaussianLikelihood):
            high = self.train_inputs[0][..., -1]
            noise = (self.likelihood.noise * high).sum(-1, keepdim=True) / high.sum(
                -1, keepdim=True
            )
            shape = torch.broadcast_shapes(mvn.batch_shape + mvn.event_shape, noise.shape)
            return self.likelihood(mvn, X, noise=noise.expand(shape))
        return super()._apply_noise(X, mvn, observation_noise)

    def posterior(self, X: Tensor, *args: Any, **kwargs: Any) -> Posterior:
        """The posterior of the high level at raw ``X`` (``... x q x d``); see BoTorch."""
        self._check_columns(X)
        return super().posterior(X, *args, **kwargs)

    def predict(self, X: Tensor, observation_noise: bool | Tensor = False) -> Prediction:
        """Predict the high level at each point of raw ``X`` (``... x q x d``) by itself."""
        self._check_columns(X)
        return super().predict(X, observation_noise)

    def _check_columns(self, X: Tensor) -> None:
        """Refuse the level, which training inputs may bring."""
        if X.shape[-1] != self.input_transform.num_inputs:
            raise ValueError(
                f"Expected X with {self.input_transform.num_inputs} columns, the inputs that the "
                f"model was built on, got shape {tuple(X.shape)}."
            )

    def condition_on_observations(self, X: Tensor, Y: Tensor, **kwargs: Any) -> Self:
        """Condition on observations of the high level; see BoTorch."""
        return super().condition_on_observations(self.input_transform.with_level(X), Y, **kwargs)


def _samples(train_X: Tensor, bounds: Tensor | None, num_low: int, seed: int) -> Tensor:
    """Draw the inputs of the low level, of the batch shape of ``train_X``."""
    d = train_X.shape[-1]
    if bounds is None:
        raise ValueError("AR1 samples f_p in `bounds` (2 x d); pass them, or `low_X` and `low_Y`.")
    bounds = torch.as_tensor(bounds, dtype=train_X.dtype, device=train_X.device)
    if bounds.shape != (2, d):
        raise ValueError(f"Expected bounds of shape (2, {d}), got {tuple(bounds.shape)}.")
    if not bounds.isfinite().all() or (bounds[0] >= bounds[1]).any():
        raise ValueError(
            "Expected finite bounds with each lower one (row 0) below the upper one (row 1), got "
            f"{bounds.tolist()}."
        )
    if num_low < 2:
        raise ValueError(f"Expected num_low >= 2 samples of f_p, got {num_low}.")
    points = draw_sobol_samples(bounds, n=num_low, q=1, seed=seed).squeeze(-2)
    return points.expand(*train_X.shape[:-2], num_low, d)
