"""AR1 co-kriging."""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.sampling import draw_sobol_samples
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.likelihoods import Likelihood
from torch import Size, Tensor
from torch.nn import Parameter

from gpadjust.checks import checked_bounds, checked_whole
from gpadjust.gp.kernels import Batched
from gpadjust.gp.physics_columns import appended, check_one_to_one
from gpadjust.models.component_noise import ComponentNoise
from gpadjust.models.parameters import scaled_rbf
from gpadjust.models.term_builder import KernelLike, PhysicsLike, TermBuilder, transformed
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.training_data import (
    ArrayLike,
    estimated,
    standardize,
    to_tensor,
    training_data,
)
from gpadjust.physics import as_physics


class LevelInput(InputTransform):
    """Appends the level of fidelity, 1 for a user's inputs; training inputs bring their own."""

    transform_on_train = transform_on_eval = transform_on_fantasize = True

    def __init__(self, num_inputs: int, base: InputTransform | None = None) -> None:
        super().__init__()
        check_one_to_one(base)
        self.num_inputs, self.base = num_inputs, base

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` (or ``d + 1``, level included) to ``... x n x (d' + 1)``."""
        X = self.with_level(X)
        return appended(self.base, X[..., :-1], X[..., -1:])

    def preprocess_transform(self, X: Tensor) -> Tensor:
        """Return :meth:`transform` with the preprocessing of the base transform."""
        X = self.with_level(X)
        return appended(self.base, X[..., :-1], X[..., -1:], preprocess=True)

    def with_level(self, X: Tensor) -> Tensor:
        """Append level 1 to ``X`` unless it has a level column."""
        if X.shape[-1] == self.num_inputs + 1:
            return X
        if X.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected X with {self.num_inputs} columns, the inputs that the model was built "
                f"on, got shape {tuple(X.shape)}."
            )
        return torch.cat([X, torch.ones_like(X[..., :1])], dim=-1)

    def untransform(self, X: Tensor) -> Tensor:
        """Map ``... x n x (d' + 1)`` back to ``... x n x (d + 1)``, raw inputs with their level."""
        inputs = X[..., :-1] if self.base is None else self.base.untransform(X[..., :-1])
        return torch.cat([inputs, X[..., -1:]], dim=-1)


class Level(Batched, gpytorch.Module):
    r"""The basis of a term of two levels l, the last input: :math:`\rho^{[l=1]}`, or :math:`[l=1]`.

    Args:
        ratio: Standard deviation of the high level's targets over that of the low one's,
            ``batch_shape x 1``, for a basis with the constant :math:`\rho`; None for that without.
    """

    ratio: Tensor

    def __init__(self, ratio: Tensor | None = None) -> None:
        super().__init__()
        self.rho: Parameter | None = None
        if ratio is not None:
            self.rho = Parameter(torch.ones_like(ratio))
            self.register_buffer("ratio", ratio.clone())

    @property
    def prior_of_learnt(self) -> tuple[float, Tensor]:
        """Mean and standard deviation of the prior of the constant."""
        return 1.0, (1 + self.ratio.square()).sqrt()

    def forward(self, x: Tensor) -> Tensor:
        """Return the basis at ``x`` (``... x n x (d + 1)``) as ``... x n``."""
        return x[..., -1] if self.rho is None else 1 + x[..., -1] * (self.rho - 1)

    @property
    def learnt(self) -> Parameter | None:
        """The constant, if a fit may move it; the basis is affine in it."""
        return self.rho if self.rho is not None and self.rho.requires_grad else None

    def slope(self, x: Tensor) -> Tensor:
        """The derivative of the basis by the constant, ``... x n``."""
        return x[..., -1]


class LevelNoise(ComponentNoise):
    """One variance for each level, which is the last column of the inputs."""

    def selection(self, inputs: Tensor) -> Tensor:
        """Return the shares of both variances at ``... x n x (d + 1)``, ``... x n x 2``."""
        return torch.stack([1 - inputs[..., -1], inputs[..., -1]], dim=-1)


class AR1(TermsGP):
    r"""Auto-regressive co-kriging, :math:`f_2(x) = \rho f_1(x) + \delta(x)` with a constant rho.

    The classic of multi-fidelity modelling (Kennedy and O'Hagan 2000; Wannawas and Faisal 2023,
    sec. 2.1.3), for comparison: a Gaussian process of the data and ``N_1`` samples of f_p, with one
    noise level each, far from which it forgets the physics. ``posterior(X)`` is about the high
    level. The arguments are those of :class:`~gpadjust.CKA`, but for:

    Args:
        train_Yvar: Known observation variances of the high level, or None to learn the noise of
            both levels.
        physics: The low level f_p, sampled in ``bounds``.
        bounds: ``2 x d`` lower and upper bounds of the inputs.
        num_low: Number ``N_1`` of samples of f_p.
        low_X: Instead of the three above, the inputs of the low level, ``batch_shape x n_1 x d``;
        low_Y: and its values, ``batch_shape x n_1 x m`` (left out: computed by ``physics``).
        low_covar_module: The kernel of the low level. Default: RBF with a lengthscale per input.
        outcome_transform: ``Standardize`` or None. Default: shift by the mean and divide by the
            standard deviation of the low level.
        seed: Seed of the (scrambled Sobol) samples.

    Raises:
        ValueError: As :class:`~gpadjust.CKA`; and if bounds are upside down, or neither
            ``physics`` with ``bounds`` nor ``low_X`` with its values is given.
    """

    data_arguments = (*TermsGP.data_arguments, "low_X", "low_Y")

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
        low_X = _samples(high.X, bounds, num_low, seed) if low_X is None else low_X
        if low_Y is None:
            if physics is None:
                raise ValueError(
                    "AR1 needs a low level: pass `physics` with `bounds` (or with `low_X`), or "
                    "`low_X` with `low_Y`."
                )
            physics = as_physics(physics)
            if physics.unknowns:
                raise ValueError(
                    f"AR1 samples its low level once, but physics {physics.name!r} has unknown "
                    f"parameters: {', '.join(physics.unknowns)}. CKA learns them."
                )
            with torch.no_grad():
                low_Y = physics(to_tensor(low_X, "low_X"))
        low, d, m = training_data(low_X, low_Y, prefix="low"), high.X.shape[-1], high.Y.shape[-1]
        if low.X.shape[-1] != d or low.Y.shape[-1] != m:
            raise ValueError(
                f"Expected the low level with {d} inputs and {m} outputs as the high one has, got "
                f"{low.X.shape[-1]} and {low.Y.shape[-1]}."
            )
        transform = LevelInput(d, input_transform)
        at_low = torch.nn.functional.pad(low.X, (0, 1))
        X = torch.cat([at_low, transform.with_level(high.X)], dim=-2)
        Y = torch.cat([low.Y, high.Y], dim=-2)
        mean, variance = low.Y.nanmean(-2, keepdim=True), _variance(low.Y)
        if isinstance(outcome_transform, _DefaultType):
            spread = variance.sqrt().where(variance > 0, torch.ones_like(variance))
            units: Standardize | None = standardize(mean, spread)
        else:
            units = estimated(outcome_transform, Y, X)
        Yvar: Tensor | None = None
        if high.Yvar is not None:
            # f_p is known without error, but GPyTorch wants at least 1e-6 for fixed noise.
            low_Yvar = 1e-5 * variance
            low_Yvar = low_Yvar.clamp_min(1e-6) if units is None else low_Yvar
            Yvar = torch.cat([low_Yvar.expand_as(low.Y), high.Yvar], dim=-2)
        data = high._replace(X=X, Y=Y, Yvar=Yvar)
        make = TermBuilder(data, transform, units, transformed(X, transform).shape[-1] - 1)
        ratio = (_variance(high.Y) / variance).sqrt().nan_to_num(0.0, posinf=0.0)
        ratio = ratio.mT if m > 1 else ratio.squeeze(-1)
        low_term = make.term("low", low_covar_module or scaled_rbf, Level(ratio))
        delta = make.term("delta", delta_covar_module or scaled_rbf, Level())
        super().__init__(make, [low_term, delta])

    @staticmethod
    def _learnt_noise(batch_shape: Size) -> Likelihood:
        return LevelNoise(2, batch_shape)

    @property
    def rho_constant(self) -> Tensor:
        r"""The constant :math:`\rho` of each output, ``batch_shape x (m)``."""
        basis: Any = self.terms[0].basis
        return basis.rho.squeeze(-1)

    def data(self) -> dict[str, Tensor | None]:
        """Return the data of each level."""
        both: dict[str, Any] = super().data()
        both["train_X"], rows = self.measured_rows(both["train_X"])
        high = {name: None if v is None else v[..., rows, :] for name, v in both.items()}
        low = {f"low_{name}": both[f"train_{name}"][..., : rows.start, :] for name in "XY"}
        return {**high, **low}

    def measured_rows(self, inputs: Tensor) -> tuple[Tensor, slice]:
        """Inputs without their level, and the rows of the high level."""
        return inputs[..., :-1], slice(int((inputs[..., -1] == 0).sum(-1).max()), None)

    def trend_inputs(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs of a trend for each level, as f_p and delta have one each."""
        level = inputs[..., -1:]
        return inputs[..., :-1], torch.cat([1 - level, level], dim=-1)

    def measured(self) -> Tensor:
        """Return a mask of the targets of the high level."""
        return super().measured() & (self.train_inputs[0][..., -1] == 1)

    def _new_inputs(self, X: Tensor) -> Tensor:
        raw = X.shape[-1] == self.input_transform.num_inputs
        return self.input_transform.with_level(X) if raw else super()._new_inputs(X)


def _variance(Y: Tensor) -> Tensor:
    """The variance of ``... x n x m`` values of which some are NaN, ``... x 1 x m``."""
    count, mean = (~Y.isnan()).sum(-2, keepdim=True), Y.nanmean(-2, keepdim=True)
    return (Y - mean).square().nansum(-2, keepdim=True) / (count - 1)


def _samples(train_X: Tensor, bounds: Tensor | None, num_low: int, seed: int) -> Tensor:
    """Draw the inputs of the low level, of the batch shape of ``train_X``."""
    if bounds is None:
        raise ValueError("AR1 samples f_p in `bounds` (2 x d); pass them, or `low_X` and `low_Y`.")
    d = train_X.shape[-1]
    bounds = checked_bounds("bounds", bounds, d).to(train_X.device)
    n, seed = checked_whole("num_low", num_low, 2), checked_whole("seed", seed)
    points = draw_sobol_samples(bounds, n=n, q=1, seed=seed).squeeze(-2)
    return points.expand(*train_X.shape[:-2], num_low, d)
