"""The scale on which hyper-parameters are searched and sampled."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.gp import LogInterval
from gpadjust.models.parameter_scales import constraint_of, kind

Parameters = dict[str, Tensor]

_POSITIVE = ("lengthscale", "outputscale", "noise", "constant")


class LogScale:
    """Lengthscales and variances as their logarithms, whatever constraint GPyTorch puts on them.

    Parameters of other kinds stay as they are. Tensors may have leading dimensions.

    Args:
        model: The model whose parameters are meant.
    """

    def __init__(self, model: Module) -> None:
        self._raw = dict(model.named_parameters())
        self._constraints: dict[str, Any] = {
            name: constraint_of(model, name) for name in self._raw if kind(name) in _POSITIVE
        }

    def covers(self, name: str) -> bool:
        """Whether a parameter is taken as its logarithm."""
        return self._constraints.get(name) is not None

    def constraint(self, name: str) -> Any:
        """The constraint of a parameter that is taken as its logarithm."""
        return self._constraints[name]

    def current(self, name: str) -> Tensor:
        """The model's own value of a parameter."""
        raw = self._raw[name].detach()
        if not self.covers(name) or isinstance(self._constraints[name], LogInterval):
            return raw
        return self._constraints[name].transform(raw).log()

    def to_raw(self, parameters: Parameters) -> Parameters:
        """Turn values on this scale into GPyTorch's raw parameters; differentiable."""
        return {
            name: value
            if not self.covers(name) or isinstance(self._constraints[name], LogInterval)
            else self._constraints[name].inverse_transform(value.exp())
            for name, value in parameters.items()
        }

    def assign(self, parameters: Parameters) -> None:
        """Give the model values on this scale."""
        with torch.no_grad():
            for name, value in self.to_raw(parameters).items():
                self._raw[name].copy_(value)
