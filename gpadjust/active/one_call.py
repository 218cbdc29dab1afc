"""A collection from its first measurement to its last."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from botorch.acquisition import AcquisitionFunction
from botorch.models.model import Model
from torch import Tensor

from gpadjust.active.collection import Collection


def collect(
    model_factory: Callable[[Tensor, Tensor], Model],
    oracle: Callable[[Tensor], Any],
    bounds: Tensor | list[list[float]],
    acquisition: Callable[[Any], AcquisitionFunction],
    budget: int,
    *,
    progress: bool = False,
    max_failures: int = 5,
    **options: Any,
) -> Collection:
    """Measure where it teaches most, until the budget is spent.

    It makes a :class:`Collection`, lets it :meth:`~Collection.run`, and closes it. With a log the
    same call goes on where the last one was killed, or with a larger budget.

    Args:
        model_factory: As of :class:`Collection`.
        oracle: As of :meth:`Collection.run`.
        bounds: As of :class:`Collection`.
        acquisition: As of :class:`Collection`.
        budget: As of :meth:`Collection.run`.
        progress: As of :meth:`Collection.run`.
        max_failures: As of :meth:`Collection.run`.
        options: The others of :class:`Collection`: ``batch_size``, ``initial``, ``data``,
            ``num_outputs``, ``fit``, ``optimizer_options``, ``log`` and ``seed``.

    Returns:
        The collection, with all data in ``X`` and ``Y``, the ``model`` of them, ``failed_X``, and
        ``ask``, ``tell`` and ``run`` to go on with.

    Raises:
        TypeError: As :class:`Collection` and :meth:`Collection.run`.
        ValueError: As both.
        LogError: As both.
        CollectionError: As :meth:`Collection.run`; the points in it can be told to its
            ``collection``.

    Warns:
        MeasurementWarning: If a measurement fails.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import collect, qAdjustmentInformationGain
        >>> result = collect(
        ...     lambda X, Y: CKA(X, Y, physics=torch.sin),
        ...     oracle=lambda X: 2 * torch.sin(X) + X,
        ...     bounds=[[0.0], [3.0]],
        ...     acquisition=qAdjustmentInformationGain,
        ...     budget=6,
        ...     batch_size=2,
        ...     optimizer_options={"num_restarts": 2, "raw_samples": 16},
        ... )
        >>> result.Y.shape
        torch.Size([6, 1])
    """
    with Collection(model_factory, bounds, acquisition, **options) as collection:
        return collection.run(oracle, budget, progress=progress, max_failures=max_failures)
