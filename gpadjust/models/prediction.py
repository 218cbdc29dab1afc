"""What a model predicts at each of many points by itself."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Prediction(NamedTuple):
    """Marginal predictions, as :meth:`~gpadjust.CKA.predict` returns them.

    Args:
        mean: Posterior means, ``batch_shape x q x m``, in the units of the targets.
        variance: Posterior variances, ``batch_shape x q x m``, in their square.
    """

    mean: Tensor
    variance: Tensor
