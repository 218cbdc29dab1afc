"""Calling a function with values of unknown parameters, or a module that has them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.physics.unknown import ParameterValues


def check_module(function: Callable[..., Any], names: Collection[str]) -> None:
    """Settle that a module is called with values of its parameters, if it has some of these names.

    They do not require gradients then, or they would be learnt as those of a network, too.

    Raises:
        ValueError: If it has only some of them, or one is no single number.
    """
    own = dict(function.named_parameters()) if isinstance(function, Module) else {}
    missing = [name for name in names if name not in own]
    if len(missing) == len(names):
        return
    if missing:
        raise ValueError(
            f"The module {type(function).__name__} has no parameter {missing[0]!r}; it has "
            f"{', '.join(own)}."
        )
    for name in names:
        if own[name].numel() != 1:
            raise ValueError(
                "Expected unknown parameters of a module to be a number each; "
                f"{name!r} of {type(function).__name__} has shape {tuple(own[name].shape)}."
            )
        own[name].requires_grad_(False)


def call_with(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function; if its last argument are values of parameters of a module, set them there.

    Args:
        function: Maps tensors of ``N`` rows, and maybe values of parameters, to ``N`` rows.
        arguments: These tensors; the last may be :class:`ParameterValues`, a value for each row.
            Rows that have the same values go to the module together.
    """
    parameters = arguments[-1]
    if not isinstance(parameters, ParameterValues) or not isinstance(function, Module):
        return function(*arguments)
    own = dict(function.named_parameters())
    if not own.keys() >= parameters.keys():
        return function(*arguments)
    # Detached, as there is no derivative of what is unique.
    vectors, which = parameters.rows.detach().unique(dim=0, return_inverse=True)
    results: list[Tensor] = []
    for i in range(len(vectors)):
        here = which == i
        named = zip(parameters, parameters.rows[here][0], strict=True)
        values = {name: value.reshape(own[name].shape) for name, value in named}
        rows = tuple(tensor[here] for tensor in arguments[:-1])
        results.append(functional_call(function, values, rows))
    order = which.argsort(stable=True)
    return torch.cat(results)[order.argsort()]
