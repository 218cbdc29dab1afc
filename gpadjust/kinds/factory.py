"""Models made by a structure, such as CKA, or by the user's function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from typing import Any

from botorch.models.model import Model

from gpadjust.core.model import GP
from gpadjust.kinds.links import linked

ModelFactory = Callable[..., Model]
"""A callable ``(X, Y, **physics) -> model``: a structure, a partial of one, or a function."""


def map_parts(change: Callable[[Any], Any], physics: Any) -> Any:
    """Return a function of each physics of a list or dictionary, in their form, or of one."""
    if isinstance(physics, Mapping):
        return {name: change(part) for name, part in physics.items()}
    if isinstance(physics, list | tuple):
        return [change(part) for part in physics]
    return change(physics)


def with_options(factory: ModelFactory, options: Mapping[str, Any]) -> ModelFactory:
    """Return a factory with options as further arguments, if they are not None.

    Arguments of a ``functools.partial`` go before. A ``link`` makes the structure
    :func:`~gpadjust.kinds.links.linked`, or is a TypeError if the factory is a function.
    """
    if not callable(factory):
        return factory  # make_model raises the error
    base = partial(factory)  # of a partial, a partial of the same function
    further = {n: v for n, v in options.items() if n not in base.keywords and v is not None}
    if not further:
        return factory
    make: Any = base.func
    if "link" in further:
        is_structure = isinstance(make, type) and issubclass(make, GP)
        if not is_structure:
            raise TypeError(
                "Expected a structure such as CKA, or functools.partial of one, for a link; found "
                f"{factory!r}. Use the link in the function: LinkedCKA(X, Y, link=...)."
            )
        make = linked(make)
    return partial(make, *base.args, **base.keywords, **further)


def make_model(
    factory: ModelFactory, X: Any, Y: Any, *, kind: type[Model] = Model, **arguments: Any
) -> Any:
    """Return a new model of inputs ``n x d`` and targets ``n x m``, made by a factory.

    Further arguments, such as ``physics``, are omitted if they are None. Arguments of a
    ``functools.partial`` other than a physics (kernels, a noise) are copied for each model. A
    factory that is not callable, or makes another ``kind``, is a TypeError.
    """
    if not callable(factory):
        raise TypeError(
            "Expected a callable (X, Y, **physics) that makes a model, such as CKA or "
            f"functools.partial(CKA, rho_mean=2.0); found {factory!r}."
        )
    if isinstance(factory, partial):
        copies = {n: deepcopy(v) for n, v in factory.keywords.items() if n != "physics"}
        factory = partial(factory, **copies)
    model = factory(X, Y, **{name: v for name, v in arguments.items() if v is not None})
    if not isinstance(model, kind):
        raise TypeError(
            f"Expected the model factory to make a {kind.__module__.partition('.')[0]} "
            f"{kind.__name__}; found {type(model).__name__}."
        )
    return model
