"""A SingleTaskGP with the ends tied that BoTorch leaves loose."""

from __future__ import annotations

from typing import Any, Self

import torch
from botorch.models import SingleTaskGP
from torch import Size, Tensor

from gpadjust.gp import FourierFeatures


class MultiOutputGP(SingleTaskGP):
    """The base of this library's models: a ``SingleTaskGP`` with independent outputs.

    Beyond BoTorch's, a subset of its outputs can be fitted again, whatever its kernels and
    transforms, and it can be conditioned on observations before any prediction was made.
    """

    @property
    def _subset_batch_dict(self) -> dict[str, int]:
        """Where in each batched parameter and buffer the outputs lie, for ``subset_output``."""
        outputs: Size = self._aug_batch_shape
        if self.num_outputs == 1:
            return {}
        shared = {
            f"{name}.{buffer}"
            for name, module in self.named_modules()
            if isinstance(module, FourierFeatures)
            for buffer, _ in module.named_buffers()
        }
        dimensions = {}
        for part in ("mean_module", "covar_module", "likelihood"):
            module = getattr(self, part)
            for name, tensor in [*module.named_parameters(), *module.named_buffers()]:
                full_name = f"{part}.{name}"
                if tensor.shape[: len(outputs)] == outputs and full_name not in shared:
                    dimensions[full_name] = len(outputs) - 1 - tensor.dim()
        return dimensions

    def subset_output(self, idcs: list[int]) -> Self:
        """Subset the model along the outputs; see BoTorch."""
        subset = super().subset_output(idcs)
        original = subset._original_train_inputs
        if original is not None and len(idcs) < self.num_outputs:
            # BoTorch subsets the transformed inputs only, and a later fit starts from these.
            subset._original_train_inputs = original[..., idcs if len(idcs) > 1 else idcs[0], :, :]
        return subset

    def condition_on_observations(self, X: Tensor, Y: Tensor, **kwargs: Any) -> Self:
        """Condition on new observations; see BoTorch. No posterior has to be called before."""
        if self.prediction_strategy is None:
            with torch.no_grad():
                SingleTaskGP.posterior(self, X)
        return super().condition_on_observations(X, Y, **kwargs)
