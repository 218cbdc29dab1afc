"""AR1 co-kriging."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gpytorch
import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.sampling.pathwise.update_strategies import GaussianUpdate
from botorch.utils.sampling import draw_sobol_samples
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.likelihoods import Likelihood
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.likelihoods.noise_models import MultitaskHomoskedasticNoise
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor

from gpadjust.gp import Term
from gpadjust.gp.gaussian import noise_variances
from gpadjust.gp.physics_columns import check_one_to_one
from gpadjust.models.adjusted_gp import KernelLike, PhysicsLike, make_kernel
from gpadjust.models.cholesky_strategy import pad
from gpadjust.models.exact_gp_base import ExactGPBase
from gpadjust.models.hyperparameters import default_constraint, scaled_rbf
from gpadjust.models.training_data import (
    ArrayLike,
    TrainingData,
    estimated,
    standardize,
    to_tensor,
    training_data,
)
from gpadjust.physics import as_physics


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
        check_one_to_one(base)
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
        self.check_raw(X)
        return torch.cat([X, torch.ones_like(X[..., :1])], dim=-1)

    def check_raw(self, X: Tensor) -> None:
        """Raise a ValueError unless ``X`` has the columns of raw inputs, without a level."""
        if X.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected X with {self.num_inputs} columns, the inputs that the model was built "
                f"on, got shape {tuple(X.shape)}."
            )

    def untransform(self, X: Tensor) -> Tensor:
        """Map ``... x n x (d' + 1)`` back to ``... x n x (d + 1)``, raw inputs with their level."""
        inputs = X[..., :-1] if self.base is None else self.base.untransform(X[..., :-1])
        return torch.cat([inputs, X[..., -1:]], dim=-1)


class Level(gpytorch.Module):
    r"""The basis of a term of two levels: :math:`\rho^{[l=1]}`, or :math:`[l=1]`.

    The last column of the inputs is 0 for the low level and 1 for the high one.

    Args:
        batch_shape: Batch shape of the constant :math:`\rho`, or None for the basis without.
    """

    def __init__(self, batch_shape: Size | None = None) -> None:
        super().__init__()
        rho = None if batch_shape is None else torch.ones(*batch_shape, 1, dtype=torch.float64)
        self.register_parameter("rho", None if rho is None else torch.nn.Parameter(rho))

    def forward(self, x: Tensor) -> Tensor:
        """Return the basis at ``x`` (``... x n x (d + 1)``) as ``... x n``."""
        level = x[..., -1]
        rho: Tensor | None = self.rho
        return level if rho is None else 1 + level * (rho - 1)

    def map_batches(self, change: Callable[[Tensor], Tensor]) -> Level:
        """A copy whose constant is changed along its batch dimensions."""
        new = deepcopy(self)
        if self.rho is not None:
            new.rho = torch.nn.Parameter(change(self.rho.detach()))
        return new


class LevelLikelihood(_GaussianLikelihoodBase):
    """Gaussian noise with one variance per level, told by the last column of the inputs.

    Unlike GPyTorch's ``HadamardGaussianLikelihood`` it broadcasts over the batches that fantasies
    add.

    Args:
        batch_shape: Batch shape of the variances, ``batch_shape x 2``.
    """

    def __init__(self, batch_shape: Size) -> None:
        constraint = default_constraint()
        noise = MultitaskHomoskedasticNoise(2, noise_constraint=constraint, batch_shape=batch_shape)
        super().__init__(noise)

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
        low, high = self.noise[..., :1], self.noise[..., 1:]
        noise = low + inputs[..., -1] * (high - low)
        return DiagLinearOperator(noise.expand(torch.broadcast_shapes(noise.shape, base_shape)))


class AR1(ExactGPBase):
    r"""Auto-regressive co-kriging, :math:`f_2(x) = \rho f_1(x) + \delta(x)` with a constant rho.

    The classic of multi-fidelity modelling (Kennedy and O'Hagan 2000; Wannawas and Faisal 2023,
    sec. 2.1.3): f_p is not used as a function but through ``N_1`` samples, to which a Gaussian
    process is fitted jointly with the data, with one noise level each. ``posterior(X)`` is about
    the high level. It is here for comparison; unlike :class:`~gpadjust.CKA` its cost and accuracy
    hang on the samples, and far from them it forgets the physics.

    Args:
        train_X: Inputs of the high level, as in :class:`~gpadjust.CKA`, like all that are not
            listed here.
        train_Yvar: Known observation variances of the high level, or None to learn the noise of
            both levels.
        physics: The low level f_p, sampled in ``bounds``.
        bounds: ``2 x d`` lower and upper bounds of the inputs.
        num_low: Number ``N_1`` of samples of f_p.
        low_X: Instead of the three above, the inputs of the low level, ``batch_shape x n_1 x d``;
        low_Y: and its values, ``batch_shape x n_1 x m`` (left out: computed by ``physics``).
        low_covar_module: The kernel of the low level. Default: RBF with a lengthscale per input.
        delta_covar_module: The kernel of the bias. Default: likewise.
        outcome_transform: ``Standardize`` or None. Default: shift by the mean and divide by the
            standard deviation of the low level.
        seed: Seed of the (scrambled Sobol) samples.

    Raises:
        ValueError: As :class:`~gpadjust.CKA`; and if bounds are upside down, or neither
            ``physics`` with ``bounds`` nor ``low_X`` with its values is given.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike | None = None,
        bounds: Tensor | None = None,
        num_low: int = 40,
        low_X: ArrayLike = None,
        low_Y: ArrayLike = None,
        low_covar_module: KernelLike | None = None,
        delta_covar_module: KernelLike | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        high = training_data(train_X, train_Y, train_Yvar)
        if low_X is None and low_Y is not None:
            raise ValueError("Got `low_Y` without `low_X`, the inputs that it belongs to.")
        if low_X is None:
            low_X = _samples(high.X, bounds, num_low, seed)
        low_X = to_tensor(low_X, "low_X")
        if low_Y is None:
            if physics is None:
                raise ValueError(
                    "AR1 needs a low level: pass `physics` with `bounds` (or with `low_X`), or "
                    "`low_X` with `low_Y`."
                )
            sampled = as_physics(physics)
            if sampled.unknowns:
                raise ValueError(
                    f"AR1 samples its low level once, but physics {sampled.name!r} has unknown "
                    f"parameters: {', '.join(sampled.unknowns)}. CKA learns them."
                )
            with torch.no_grad():
                low_Y = sampled(low_X)
        low = training_data(low_X, low_Y, prefix="low")
        if low.X.shape[-1] != high.X.shape[-1] or low.Y.shape[-1] != high.Y.shape[-1]:
            raise ValueError(
                f"Expected the low level with {high.X.shape[-1]} inputs and {high.Y.shape[-1]} "
                f"outputs as the high one has, got {low.X.shape[-1]} and {low.Y.shape[-1]}."
            )
        batch_shape = self.get_batch_dimensions(high.X, high.Y)[1]
        transform = LevelInput(high.X.shape[-1], input_transform)
        X = torch.cat([pad(low.X, 1), transform.with_level(high.X)], dim=-2)
        Y = torch.cat([low.Y, high.Y], dim=-2)
        if isinstance(outcome_transform, _DefaultType):
            spread = low.Y.std(-2, keepdim=True)
            spread = spread.where(spread > 0, torch.ones_like(spread))
            units: Standardize | None = standardize(low.Y.mean(-2, keepdim=True), spread)
        else:
            units = estimated(outcome_transform, Y, X)
        Yvar: Tensor | None = None
        if high.Yvar is not None:
            # f_p is known without error, but GPyTorch wants at least 1e-6 for fixed noise.
            low_Yvar = 1e-5 * low.Y.var(-2, keepdim=True)
            low_Yvar = low_Yvar.clamp_min(1e-6) if units is None else low_Yvar
            Yvar = torch.cat([low_Yvar.expand_as(low.Y), high.Yvar], dim=-2)
        d = transform(X).shape[-1] - 1
        zero = torch.zeros(*batch_shape, 1, dtype=torch.float64)
        given = {"low": low_covar_module, "delta": delta_covar_module}
        bases = (Level(batch_shape), Level())
        terms = []
        for (name, kernel), basis in zip(given.items(), bases, strict=True):
            kernel = make_kernel(kernel or scaled_rbf, f"the kernel of {name}", d, batch_shape)
            terms.append(Term(name, kernel, d, basis, zero))
        data = TrainingData(X, Y, Yvar, high.input_names, high.output_names)
        super().__init__(data, terms, None, units, transform, (*given.values(),))

    @staticmethod
    def _learnt_noise(batch_shape: Size) -> Likelihood:
        return LevelLikelihood(batch_shape)

    @property
    def rho_constant(self) -> Tensor:
        r"""The constant :math:`\rho` of each output, ``batch_shape x (m)``."""
        basis: Any = self.terms[0].basis
        return basis.rho.squeeze(-1)

    def data(self) -> dict[str, Tensor | None]:
        """As the base class, of each level."""
        both: dict[str, Any] = super().data()
        both["train_X"], rows = self.measured_rows(both["train_X"])
        high = {name: None if v is None else v[..., rows, :] for name, v in both.items()}
        low = {f"low_{name}": both[f"train_{name}"][..., : rows.start, :] for name in "XY"}
        return {**high, **low}

    def measured_rows(self, inputs: Tensor) -> tuple[Tensor, slice]:
        """Inputs without their level, and the rows of the high level."""
        return inputs[..., :-1], slice(int((inputs[..., -1] == 0).sum(-1).max()), None)

    def _typical_noise(self) -> Tensor:
        high = self.train_inputs[0][..., -1] * ~self.train_targets.isnan()
        noise = self.likelihood.noise * high
        return noise.sum(-1, keepdim=True) / high.sum(-1, keepdim=True)

    def model_inputs(self, X: ArrayLike, with_basis: bool = True) -> Tensor:
        """As the base class; the level, which training inputs may bring, is refused."""
        if isinstance(X, Tensor):
            self.input_transform.check_raw(X)
        return super().model_inputs(X, with_basis)

    def _new_inputs(self, X: Tensor) -> Tensor:
        transform = self.input_transform
        if X.shape[-1] == transform.num_inputs:
            return transform.with_level(X)
        return super()._new_inputs(X)


@GaussianUpdate.register(AR1, LevelLikelihood)  # type: ignore[untyped-decorator, unused-ignore]
def _update_of_levels(model: AR1, likelihood: LevelLikelihood, **arguments: Any) -> Any:
    """BoTorch's pathwise update, with the noise of each point's level."""
    noise = DiagLinearOperator(noise_variances(likelihood, model.train_inputs[0]))
    update = GaussianUpdate.dispatch(type(model), _GaussianLikelihoodBase)
    return update(model, likelihood, **{"noise_covariance": noise, **arguments})


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
