"""The units that a model works in: scale of the targets, offset of the physics."""

from __future__ import annotations

import torch
from botorch.models.transforms.outcome import Standardize
from torch import Tensor

from gpadjust.gp import FixedStandardize


def residual_scale(train_Y: Tensor, mean: Tensor) -> FixedStandardize:
    """The default outcome transform: divide by the root mean square of ``train_Y - mean``.

    Args:
        train_Y: Targets, ``batch_shape x n x m``.
        mean: The prior mean at the training inputs, of the same shape. Where it meets the targets
            exactly, the scale is a millionth of theirs (or 1 if they are zero).
    """

    def rms(values: Tensor) -> Tensor:
        return values.square().mean(-2, keepdim=True).sqrt()

    scale, size = rms(train_Y - mean), rms(train_Y)
    tiny = 1e-6 * size.where(size > 0, torch.full_like(size, 1e6))
    return FixedStandardize.of(torch.zeros_like(scale), scale.where(scale > 0, tiny))


def affine(transform: Standardize | None, train_Y: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """Shift and scale (``batch_shape x 1 x m``) that an outcome transform puts on the targets."""
    if transform is None:
        return torch.zeros_like(train_Y[..., :1, :]), torch.ones_like(train_Y[..., :1, :])
    if type(transform) not in (Standardize, FixedStandardize):
        raise ValueError(
            f"The outcome transform {type(transform).__name__} is not supported: f_p lives in the "
            "units of the targets, so the transform must be one shift and scale per output. Use "
            "Standardize, None, or the default, which divides by the residual's scale; to model "
            "log(y), say, take the logarithm of both train_Y and the physics."
        )
    transform.train()
    transform(train_Y, X=X)
    return transform.means, transform.stdvs


def kernel_center(center: float | Tensor | str, f_p: Tensor) -> Tensor:
    """The constant c of the kernel on ``f_p - c``, as ``batch_shape x 1 x m``."""
    mean = f_p.mean(-2, keepdim=True)
    if isinstance(center, str):
        if center != "mean":
            raise ValueError(
                f"Unknown center {center!r}; expected 'mean' (the mean of f_p at the training "
                "inputs), a number, or a tensor with one number per output."
            )
        return mean
    offset = torch.as_tensor(center, dtype=f_p.dtype, device=f_p.device)
    if offset.dim() > 1 or offset.numel() not in (1, f_p.shape[-1]) or not offset.isfinite().all():
        raise ValueError(
            f"Expected center to be 'mean', a finite number, or a tensor of {f_p.shape[-1]}, one "
            f"for each output, got {center}."
        )
    return offset.expand(mean.shape).clone()
