"""Checks of the data that a model is built on."""

from __future__ import annotations

import torch
from torch import Tensor


def check_training_data(
    train_X: Tensor, train_Y: Tensor, train_Yvar: Tensor | None = None, prefix: str = "train"
) -> None:
    """Check inputs, targets and observation variances of a model.

    Args:
        train_X: Expected ``batch_shape x n x d``, ``n >= 2``, float64, finite.
        train_Y: Expected ``batch_shape x n x m``, float64, finite.
        train_Yvar: Expected of the shape of ``train_Y``, float64, not negative, or None.
        prefix: What the names of the three begin with in errors.

    Raises:
        TypeError: If one of them is not a float64 tensor.
        ValueError: If shapes disagree, there are fewer than 2 points, or values are not finite.
    """
    named = {f"{prefix}_X": train_X, f"{prefix}_Y": train_Y}
    if train_Yvar is not None:
        named[f"{prefix}_Yvar"] = train_Yvar
    for name, tensor in named.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(
                f"Expected {name} to be a torch tensor, got {type(tensor).__name__}; convert it "
                f"with `torch.as_tensor({name}, dtype=torch.float64)`."
            )
        if tensor.dtype != torch.float64:
            raise TypeError(
                f"Expected {name} in float64, got {tensor.dtype}: Cholesky factors of these "
                f"kernels fail in lower precision. Convert it with `{name}.double()`."
            )
        if tensor.dim() < 2:
            raise ValueError(
                f"Expected {name} with at least 2 dimensions (points x columns), got shape "
                f"{tuple(tensor.shape)}; add a column with `{name}.unsqueeze(-1)`."
            )
    if train_X.shape[:-1] != train_Y.shape[:-1]:
        raise ValueError(
            f"Expected {prefix}_X (batch_shape x n x d) and {prefix}_Y (batch_shape x n x m) to "
            f"agree in all but the last dimension, got {tuple(train_X.shape)} and "
            f"{tuple(train_Y.shape)}."
        )
    if train_Yvar is not None and train_Yvar.shape != train_Y.shape:
        raise ValueError(
            f"Expected {prefix}_Yvar of {prefix}_Y's shape {tuple(train_Y.shape)}, got "
            f"{tuple(train_Yvar.shape)}."
        )
    if train_X.shape[-1] < 1 or train_Y.shape[-1] < 1:
        raise ValueError(
            f"Expected at least one input column and one output column, got {prefix}_X of shape "
            f"{tuple(train_X.shape)} and {prefix}_Y of shape {tuple(train_Y.shape)}."
        )
    if train_X.shape[-2] < 2:
        raise ValueError(
            f"Expected at least 2 points in {prefix}_X, got {train_X.shape[-2]}: with fewer there "
            "is nothing to learn a scale from. Use the physics alone until there are two."
        )
    for name, tensor in named.items():
        check_finite(tensor, name)
    if train_Yvar is not None and (train_Yvar < 0).any():
        raise ValueError(
            f"Expected {prefix}_Yvar (variances) not to be negative, got {train_Yvar.min():.3g}."
        )


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise a ValueError that names the rows of ``tensor`` (``... x n x k``) with NaN or inf."""
    bad = ~tensor.isfinite().all(-1)
    if bad.any():
        rows = sorted({int(index[-1]) for index in bad.nonzero()})
        shown = ", ".join(str(row) for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
        raise ValueError(
            f"Expected {name} to be finite, found NaN or infinity in {len(rows)} of "
            f"{tensor.shape[-2]} rows (row {shown}); remove these points."
        )
