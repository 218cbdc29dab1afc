"""A SingleTaskGP with the ends tied that BoTorch leaves loose."""

from __future__ import annotations

from typing import Any, Self

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models import SingleTaskGP
from botorch.posteriors import Posterior
from gpytorch.settings import detach_test_caches
from torch import Size, Tensor

from gpadjust.gp import FourierFeatures


class MultiOutputGP(SingleTaskGP):
    """The base of this library's models: a ``SingleTaskGP`` with independent outputs.

    Beyond BoTorch's, a subset of its outputs can be fitted again, whatever its kernels and
    transforms; it can be conditioned on observations before any prediction was made, with
    gradients to where they are made; and ``output_indices`` may come in any order.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluate the model at *transformed* inputs, as GPyTorch does."""
        if not self.training and self.train_inputs is not None and args:
            expected, found = self.train_inputs[0].shape[-1], args[0].shape
            if found[-1] != expected:
                raise ValueError(
                    f"In eval mode the model itself takes transformed inputs with {expected} "
                    f"columns, got shape {tuple(found)}. Call `model.posterior(X)` on raw inputs, "
                    "or `model(model.transform_inputs(X))`."
                )
        return super().__call__(*args, **kwargs)

    def posterior(
        self,
        X: Tensor,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The posterior at raw ``X`` (``... x q x d``); see BoTorch."""
        if output_indices is not None and list(output_indices) != list(range(self.num_outputs)):
            # BoTorch would undo the outcome transform of all outputs on these.
            subset = self.subset_output(list(output_indices))
            return subset.posterior(X, None, observation_noise, posterior_transform)
        return super().posterior(X, None, observation_noise, posterior_transform)

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
        # GPyTorch would cut the gradient to X, which look-ahead acquisition functions need.
        with detach_test_caches(not X.requires_grad):
            return super().condition_on_observations(X, Y, **kwargs)
