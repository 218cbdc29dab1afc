"""Models made by whatever the user gives to make one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from typing import Any

from botorch.models.model import Model

ModelFactory = Callable[..., Model]
"""A callable ``(X, Y, **physics) -> model``: a class of models, ``functools.partial`` of one with
further arguments, or a function."""


def with_options(factory: ModelFactory, options: Mapping[str, Any]) -> ModelFactory:
    """A model factory with further arguments, but for those that it has already.

    Args:
        factory: Makes a model.
        options: Those of :class:`~gpadjust.models.term_builder.ModelOptions`, as a rule.
    """
    own = factory.keywords if isinstance(factory, partial) else {}
    given = {name: value for name, value in options.items() if name not in own}
    return partial(factory, **given) if given else factory


def make_model(
    factory: ModelFactory, X: Any, Y: Any, *, kind: type[Model] = Model, **given: Any
) -> Any:
    """A new model of data.

    Args:
        factory: Makes it. What a ``functools.partial`` holds beside a physics (kernels, a
            likelihood) is copied, so that each model has its own.
        X: Inputs, ``n x d``.
        Y: Targets, ``n x m``.
        kind: The class that the model has to be of.
        given: What else it is made of, such as ``physics``; None is left out.

    Raises:
        TypeError: If ``factory`` is not callable, does not take the arguments, or makes something
            else.
    """
    if not callable(factory):
        raise TypeError(
            "Expected a callable (X, Y, **physics) that makes a model, such as CKA or "
            f"functools.partial(CKA, rho_mean=2.0), got {factory!r}."
        )
    if isinstance(factory, partial):
        own = {n: v if n == "physics" else deepcopy(v) for n, v in factory.keywords.items()}
        factory = partial(factory.func, *factory.args, **own)
    model = factory(X, Y, **{name: value for name, value in given.items() if value is not None})
    if not isinstance(model, kind):
        raise TypeError(
            f"Expected the model factory to make a {kind.__module__.partition('.')[0]} "
            f"{kind.__name__}, got {type(model).__name__}."
        )
    return model
