"""A constraint for parameters that are searched on a logarithmic scale."""

from __future__ import annotations

import torch
from gpytorch.constraints import Interval
from torch import Tensor


class LogInterval(Interval):
    """Positive parameters in an interval, with their logarithm as the raw parameter.

    A step in the logarithm is a relative one, so that an optimiser does the same whatever the
    units. The bounds are those of the search: BoTorch's L-BFGS keeps to them, and GPyTorch refuses
    values beyond them, but the transform does not squash, so that gradients stay honest.

    Args:
        lower_bound: Lower bound, positive.
        upper_bound: Upper bound.
    """

    def __init__(self, lower_bound: float | Tensor, upper_bound: float | Tensor) -> None:
        super().__init__(lower_bound, upper_bound, transform=torch.exp, inv_transform=torch.log)

    def transform(self, tensor: Tensor) -> Tensor:
        """Map the raw parameter to the parameter."""
        return tensor.exp()

    def inverse_transform(self, transformed_tensor: Tensor) -> Tensor:
        """Map the parameter to the raw parameter."""
        return transformed_tensor.log()


class DataInterval(LogInterval):
    """A :class:`LogInterval` whose bounds are read off the data, as nobody gave any.

    They are for optimisers that know of boxes only; :func:`gpadjust.fit` searches the ratios of
    variances instead. Any positive value may be set, as Pyro's samplers do that follow a prior.
    """

    def __init__(self) -> None:
        super().__init__(1e-12, 1e12)

    def check(self, tensor: Tensor) -> bool:
        """Whether all elements are valid values of the parameter."""
        return bool((tensor >= 0).all())

    def check_raw(self, tensor: Tensor) -> bool:
        """Whether all elements are valid raw parameters."""
        return self.check(self.transform(tensor))
