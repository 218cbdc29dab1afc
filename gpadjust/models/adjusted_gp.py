"""The Gaussian process of an adjusted physics: what CKA and its special cases share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import Likelihood
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import AppendedPhysics, PhysicsInput, Term
from gpadjust.gp.gaussian import least_squares
from gpadjust.models.adjusted_model import AdjustedModel
from gpadjust.models.exact_gp_base import ExactGPBase
from gpadjust.models.training_data import ArrayLike, estimated, residual_scale, training_data
from gpadjust.physics import Physics, as_physics

PhysicsLike = (
    Physics
    | Callable[[Tensor], Tensor]
    | Sequence[Physics | Callable[[Tensor], Tensor]]
    | dict[str, Physics | Callable[[Tensor], Tensor]]
)
KernelLike: TypeAlias = Kernel | Callable[[int, Size], Kernel]
Means = float | Sequence[float] | Literal["learn"]


class Adjustment(NamedTuple):
    """What a structure says of rho or delta.

    Attributes:
        kernel: Its kernel, or a function of the number of inputs and the batch shape that makes
            it; None for a constant. Several physics have a kernel each, made by the function, or
            given as a sequence.
        mean: Its prior mean: a number (one for each physics), or ``"learn"``. None: 1 for one
            physics, ``"learn"`` for several.
    """

    kernel: KernelLike | Sequence[KernelLike] | None
    mean: Means | None


class AdjustedGP(AdjustedModel, ExactGPBase):
    r"""The base of the models of :math:`f_a(x) = \sum_i \rho_i(x) f_i(x) + \delta(x)`.

    With :math:`\rho_i \sim GP(\bar\rho_i, k_i)` and :math:`\delta \sim GP(\bar\delta, k_\delta)`
    they are sums of the terms ``rho`` (of each physics) and ``delta``; for one physics the prior is

    .. math:: f_a \sim GP\left(f_p, \; F_p k_\rho F_p^T + k_\delta\right)

    (Wannawas and Faisal 2023, eq. 2). A structure says what kernels and means they have, by a few
    lines of its own: :class:`~gpadjust.CKA`, :class:`~gpadjust.PhysicsMeanGP`,
    :class:`~gpadjust.ScaleGP` and so on. Its input transform appends all f_i to the inputs
    (:class:`~gpadjust.gp.PhysicsInput`), once; the terms read those columns.

    With a center c the basis of rho is :math:`f_p - c`. The bias that makes
    :math:`f_a = \rho f_p + \delta` is then :math:`\delta = \delta_0 - \sum_i c_i \rho_i` for the
    model's own term :math:`\delta_0`. A centre that is learnt is a hyper-parameter, in standard
    deviations of f_p from its mean; the prior mean stays.

    Args:
        physics: As in :class:`~gpadjust.CKA`, like all that are not listed here; None for a model
            without physics, whose only term is ``f``.
        rho: What the structure says of rho.
        delta: What it says of delta.
        more_terms: Further terms of a structure of your own, made by a function of the number of
            inputs (after their transform), the batch shape, and the scale of the targets.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike,
        physics: PhysicsLike | None,
        rho: Adjustment | None,
        delta: Adjustment,
        *,
        more_terms: Callable[[int, Size, Tensor], Sequence[Term]] | None = None,
        center: float | Tensor | Literal["mean", "learn"] = "learn",
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        if physics is None and rho is not None:
            raise TypeError("Expected a physics, got None; ZeroMeanGP is the model without one.")
        data = training_data(train_X, train_Y, train_Yvar)
        m, batch_shape = data.Y.shape[-1], self.get_batch_dimensions(data.X, data.Y)[1]
        transform: Any = input_transform
        if physics is not None:
            transform = PhysicsInput(as_physics(physics), data.X.shape[-1], input_transform)
        with torch.no_grad():
            X = data.X if transform is None else transform(data.X)
        f = _values(transform, X, m)
        k, d = len(f), X.shape[-1] - len(f) * m
        rho_means = _means(rho, k)
        start = _start(data.Y, f, rho_means)
        if isinstance(outcome_transform, _DefaultType):
            mean = sum((w * v for w, v in zip(start, f, strict=True)), torch.zeros_like(data.Y))
            if f and transform.physics.unknowns:
                mean = _closer(data.Y, mean)
            units: Standardize | None = residual_scale(data.Y, mean)
        else:
            units = estimated(outcome_transform, data.Y, X)
        zero = torch.zeros_like(data.X[..., :1, :1]).expand(*data.X.shape[:-2], 1, m)
        shift, scale = (zero, zero + 1) if units is None else (units.means, units.stdvs)

        def of_outputs(values: Tensor) -> Tensor:
            """From ``batch_shape x 1 x m``, or what broadcasts to it, to ``... x (m) x 1``."""
            return (values + zero).mT if m > 1 else (values + zero).squeeze(-1)

        def term(
            name: str, kernel: KernelLike | None, basis: Module | None, mean: Tensor, learn: bool
        ) -> Term:
            label = name if basis is not None else "delta"  # of ZeroMeanGP, too
            if kernel is not None:
                kernel = make_kernel(kernel, f"the kernel of {label}", d, batch_shape)
            mean = of_outputs(mean)
            return Term(name, kernel, d, basis, mean, torch.ones_like(mean) if learn else None)

        terms: list[Term] = []
        names = ["rho"] * k if k < 2 else [f"rho_{each}" for each in transform.physics.names]
        centers, rho_kernels = [_center(center, values) for values in f], _kernels(rho, k)
        columns = torch.eye(k * m, dtype=torch.float64).split(m)  # of each physics, m x (k m)
        for i, name in enumerate(names):
            select = (columns[i].unsqueeze(-2) if m > 1 else columns[i]).expand(*batch_shape, 1, -1)
            own = [of_outputs(centers[i]), of_outputs(scale)]
            if isinstance(center, str) and center == "learn":
                own += [of_outputs(_spread(f[i])), of_outputs(start[i])]
            basis = AppendedPhysics(d, select, *own)
            terms.append(term(name, rho_kernels[i], basis, start[i], rho_means[i] == "learn"))
        known = 0.0 if delta.mean == "learn" else delta.mean
        if not isinstance(known, int | float):
            raise ValueError(f"Expected delta_mean to be 'learn' or a number, got {known!r}.")
        # f = sum rho_i (f_i - c_i) + delta_0, so that delta_0 has the mean sum rho_i c_i.
        offset = sum((c * w for c, w in zip(centers, start, strict=True)), zero)
        (kernel,), name = _kernels(delta, 1), "f" if physics is None else "delta"
        mean = (known + offset - shift) / scale
        terms.append(term(name, kernel, None, mean, delta.mean == "learn"))
        if more_terms is not None:
            terms.extend(more_terms(d, batch_shape, of_outputs(scale)))
        unknown = sum(term.learns_mean for term in terms)
        if unknown and data.X.shape[-2] < 2 + unknown:
            raise ValueError(
                f"Expected at least {2 + unknown} points to learn {unknown} constant means and a "
                f"variance, got {data.X.shape[-2]}; give the means instead: rho_mean=1.0 (a number "
                "for each physics), delta_mean=0.0."
            )
        super().__init__(data, terms, likelihood, units, transform, (*rho_kernels, kernel))


def _values(transform: Any, X: Tensor, m: int) -> list[Tensor]:
    """The physics at the training inputs, ``batch_shape x n x m`` for each."""
    if not isinstance(transform, PhysicsInput):
        return []
    total = transform.physics.num_outputs or 0
    parts = len(getattr(transform.physics, "parts", [0]))
    if total != parts * m:
        raise ValueError(
            f"The physics '{transform.physics.name}' returned {total // parts} columns, expected "
            f"{m}, one for each column of train_Y."
        )
    return list(X[..., -total:].split(m, dim=-1))


def _closer(Y: Tensor, mean: Tensor) -> Tensor:
    """The prior mean or, where guesses of the physics' parameters are farther off, that of Y."""
    own = Y.nanmean(-2, keepdim=True).expand_as(mean)
    square, least = ((Y - each).square().nanmean(-2, keepdim=True) for each in (mean, own))
    return own.where((least > 0) & (least < square), mean)


def _means(rho: Adjustment | None, number: int) -> list[float | Literal["learn"]]:
    """The prior means of the rhos, one for each physics."""
    mean = None if rho is None else rho.mean
    mean = (1.0 if number == 1 else "learn") if mean is None else mean
    if mean == "learn":
        return ["learn"] * number
    means = [mean] * number if isinstance(mean, int | float) else [*mean]
    if len(means) != number or not all(isinstance(each, int | float) for each in means):
        raise ValueError(
            f"Expected rho_mean to be 'learn', a number, or {number} numbers, one for each "
            f"physics, got {mean!r}."
        )
    return [float(each) for each in means]


def _start(Y: Tensor, f: list[Tensor], means: list[float | Literal["learn"]]) -> list[Tensor]:
    """The means of the rhos to begin with, ``batch_shape x 1 x m`` each.

    Unknown weights of several physics, whose scales may be anything, are at least squares.
    """
    if len(f) < 2 or "learn" not in means:
        return [Y.new_tensor(1.0 if mean == "learn" else mean) for mean in means]
    basis, y = torch.stack(f, dim=-1).transpose(-2, -3), Y.mT  # ... x m x n x k and ... x m x n
    observed = ~y.isnan()
    identity = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device).expand(*y.shape, -1)
    weights, _ = least_squares(
        identity, y.where(observed, torch.zeros_like(y)), basis * observed.unsqueeze(-1)
    )
    return [weight.unsqueeze(-2) for weight in weights.unbind(-1)]


def _kernels(adjustment: Adjustment | None, number: int) -> list[KernelLike | None]:
    """What a structure says of the kernels of its terms, one for each."""
    kernel = None if adjustment is None else adjustment.kernel
    if number > 1 and isinstance(kernel, Module):
        raise ValueError(
            f"Expected a kernel for each of the {number} physics: pass a sequence of kernels, or a "
            "function of the number of inputs and the batch shape that makes one."
        )
    each = [*kernel] if isinstance(kernel, Sequence) else [kernel] * number
    if len(each) != number:
        raise ValueError(
            f"Expected {number} kernels of rho, one for each physics, got {len(each)}."
        )
    return each


def make_kernel(kernel: KernelLike, name: str, num_inputs: int, batch_shape: Size) -> Kernel:
    """Return a user's kernel, or the one that a function makes, after checking that it fits.

    The inputs are those after their transform, the batch shape is the model's with the outputs
    last; the name is for errors.
    """
    if not isinstance(kernel, Kernel):
        if isinstance(kernel, Module | type) or not callable(kernel):
            raise TypeError(f"Expected {name} to be a GPyTorch kernel, got {kernel!r}.")
        kernel = kernel(num_inputs, batch_shape)
    if kernel.batch_shape != batch_shape:
        raise ValueError(
            f"Expected {name} with batch_shape {tuple(batch_shape)}, one for each output, got "
            f"{tuple(kernel.batch_shape)}; pass `batch_shape=torch.Size({list(batch_shape)})` to "
            "it and to the kernels inside it."
        )
    for part in kernel.modules():
        if not isinstance(part, Kernel):
            continue
        if part.active_dims is not None and int(part.active_dims.max()) >= num_inputs:
            raise ValueError(
                f"Expected {name} with active_dims below {num_inputs}, the number of inputs, got "
                f"{part.active_dims.tolist()}."
            )
        reads = num_inputs if part.active_dims is None else len(part.active_dims)
        if part.has_lengthscale and part.ard_num_dims not in (None, 1, reads) and part is kernel:
            raise ValueError(
                f"Expected {name} with ard_num_dims={reads}, one lengthscale for each input that "
                f"it reads, got {part.ard_num_dims}."
            )
    return kernel


def _spread(f_p: Tensor) -> Tensor:
    """The standard deviation of f_p, ``batch_shape x 1 x m``; 0 if it is one of rounding errors."""
    spread = f_p.std(-2, keepdim=True)
    rounding = 8 * torch.finfo(f_p.dtype).eps * f_p.abs().amax(-2, keepdim=True)
    return spread.where(spread > rounding, torch.zeros_like(spread))


def _center(center: float | Tensor | str, f_p: Tensor) -> Tensor:
    """The constant c of the basis ``f_p - c``, as ``batch_shape x 1 x m``."""
    mean = f_p.mean(-2, keepdim=True)
    if isinstance(center, str) and center in ("mean", "learn"):
        return mean
    try:
        offset = torch.as_tensor(center, dtype=f_p.dtype, device=f_p.device)
    except (TypeError, ValueError, RuntimeError):
        offset = f_p.new_full((), torch.nan)
    if offset.dim() > 1 or offset.numel() not in (1, f_p.shape[-1]) or not offset.isfinite().all():
        raise ValueError(
            "Expected center to be 'mean' (the mean of f_p at the training inputs), 'learn', a "
            f"finite number, or a tensor of {f_p.shape[-1]}, one for each output, got {center!r}."
        )
    return offset.expand(mean.shape).clone()
