"""A physics behind Ax's transforms: what these did, undone and done in PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from ax.adapter.transforms.base import Transform
from ax.adapter.transforms.bilog_y import BilogY
from ax.adapter.transforms.cast import Cast
from ax.adapter.transforms.choice_encode import (
    ChoiceToNumericChoice,
    OrderedChoiceToIntegerRange,
)
from ax.adapter.transforms.derelativize import Derelativize
from ax.adapter.transforms.fill_missing_parameters import FillMissingParameters
from ax.adapter.transforms.int_to_float import IntToFloat
from ax.adapter.transforms.log import Log
from ax.adapter.transforms.logit import Logit
from ax.adapter.transforms.map_key_to_float import MapKeyToFloat
from ax.adapter.transforms.one_hot import OneHot
from ax.adapter.transforms.remove_fixed import RemoveFixed
from ax.adapter.transforms.standardize_y import StandardizeY
from ax.adapter.transforms.unit_x import UnitX
from ax.adapter.transforms.winsorize import Winsorize
from torch import Tensor

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.physics import ParameterValues, Physics, PhysicsError

Columns = dict[str, Tensor]
Step = Callable[[Columns], None]
Change = Callable[[Tensor], Tensor]

_NEXT_TO = 1e-6  # of a whole number


class Units:
    """Units of the search space from a model's inputs in Ax, and a model's units of the metrics.

    It is differentiable but for coded choices, and holds plain values, not Ax's objects, so
    that models can be copied and pickled.

    Args:
        transforms: Ax's transforms, initialised, in the order in which they were applied.
        names: The columns that the model sees.
        ranges: Lower and upper bounds of parameters, within which a physics is asked: BoTorch also
            looks around the data, beyond them.
        whole: Those whose values are whole numbers, to which what is next to one is rounded: Ax and
            the models scale them, so that 8 comes back as 7.999999999999999.
        choices: The numbers of choices, of which a physics is asked the nearest.

    Raises:
        ValueError: If there is a transform that it does not know.
    """

    def __init__(
        self,
        transforms: Sequence[Transform],
        names: Sequence[str],
        ranges: Mapping[str, tuple[float, float]],
        whole: Collection[str] = (),
        choices: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        known = (*_BACK, *_FORTH, *_NEITHER)
        unknown = [type(t).__name__ for t in transforms if type(t) not in known]
        if unknown:
            raise ValueError(
                f"A physics cannot be asked behind the transform(s) {', '.join(unknown)} of Ax; "
                f"expected some of {', '.join(each.__name__ for each in known)}. Leave the others "
                "out: transforms=gpadjust.ax.TRANSFORMS."
            )
        self.names, self.ranges = tuple(names), dict(ranges)
        self.whole = frozenset(whole)
        self.choices = {
            name: torch.tensor(values, dtype=torch.float64)
            for name, values in (choices or {}).items()
        }
        self._back: list[Step] = []
        for t in reversed(transforms):
            self._back += _BACK[type(t)](t) if type(t) in _BACK else []
        self._forth = [_FORTH[type(t)](t) for t in transforms if type(t) in _FORTH]

    def raw(self, X: Tensor, names: Sequence[str]) -> Tensor:
        """Return parameters in the units of the search space.

        Args:
            X: Inputs of the model, ``N x d'``.
            names: Some parameters.

        Returns:
            ``N x len(names)``.

        Raises:
            ValueError: If the values of one of them are no numbers.
        """
        columns = dict(zip(self.names, X.unbind(-1), strict=True))
        for step in self._back:
            step(columns)
        lost = [name for name in names if name not in columns]
        if lost:
            raise ValueError(
                f"The physics reads the parameter(s) {', '.join(lost)}, which are text, derived, "
                "or no part of the model. Make choices numbers, or let the physics name the "
                "parameters that it reads as its arguments: def f_p(x1, x2)."
            )
        return torch.stack([self._within(name, columns[name].expand(len(X))) for name in names], -1)

    def _within(self, name: str, values: Tensor) -> Tensor:
        """Return the nearest values that a parameter can have, with their derivative."""
        near = values.detach()
        if name in self.choices:
            listed = self.choices[name].to(near)
            near = listed[(near.unsqueeze(-1) - listed).abs().argmin(-1)]
        if name in self.whole:
            near = near.where((near - near.round()).abs() > _NEXT_TO, near.round())
        if name in self.ranges:
            near = near.clamp(*self.ranges[name])
        return near + (values - values.detach())

    def metric(self, Y: Tensor, metric: str) -> Tensor:
        """Return values of a metric in its units as the model gets them."""
        for steps in self._forth:
            if metric in steps:
                Y = steps[metric](Y)
        return Y


class PhysicsInUnits(Physics):
    """A physics behind Ax's transforms: of what a model sees, in the units of what it learns.

    Args:
        origin: The user's physics.
        metric: The metric that it predicts.
        units: The effect of the transforms.
        parameters: The parameters of the search space, in its order.
    """

    def __init__(
        self, origin: ParameterPhysics, metric: str, units: Units, parameters: list[str]
    ) -> None:
        reads = origin.names_of(parameters)
        inner = origin.of(reads)
        super().__init__(unknowns=dict(inner.unknowns.items()), name=inner.name)
        self.origin, self.metric, self.units, self.reads = origin, metric, units, reads
        self.inner = inner

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the physics in the search space's units, transformed as its metric is.

        Args:
            X: ``N x d'``, as the model sees it.
            parameters: Those that are unknown, if there are any.

        Returns:
            ``N x 1``.

        Raises:
            PhysicsError: If the physics fails, or has several outputs.
        """
        raw = self.units.raw(X, self.reads)
        try:
            Y = self.inner.of_rows(self.inner.read_rows(raw, *parameters))
        except PhysicsError as error:
            error.partial = None  # it is in other units
            raise
        if Y.shape[-1] != 1:
            raise PhysicsError(
                f"The physics {self.name!r} returned {Y.shape[-1]} columns for the metric "
                f"{self.metric!r}, expected one; give each metric a physics of its own."
            )
        return self.units.metric(Y, self.metric)


def _change(function: Change, name: str, columns: Columns) -> None:
    if name in columns:
        columns[name] = function(columns[name])


def _constant(name: str, value: float, columns: Columns) -> None:
    first = next(iter(columns.values()))
    columns[name] = first.new_tensor(value)


def _value_of(name: str, values: Sequence[Any], one_hot: Sequence[str], columns: Columns) -> None:
    """Set a choice, of its number or of a column for each value, of which the largest counts."""
    if one_hot:
        index = torch.stack([columns.pop(each) for each in one_hot], dim=-1).argmax(-1)
    else:
        index = columns.pop(name).round().long().clamp(0, len(values) - 1)
    if _are_numbers(values):
        columns[name] = torch.tensor(values, dtype=torch.float64)[index]


def _are_numbers(values: Sequence[Any]) -> bool:
    """Return whether values of a parameter are numbers, as a physics reads them."""
    return all(isinstance(value, bool | int | float) for value in values)


def _bent(bound: float, Y: Tensor) -> Tensor:
    return bound + (Y - bound).sign() * (Y - bound).abs().log1p()


def _scaled(mean: float, sd: float, Y: Tensor) -> Tensor:
    return (Y - mean) / sd


def _unscaled(mean: float, sd: float, Y: Tensor) -> Tensor:
    return mean + sd * Y


def _fixed(t: RemoveFixed) -> list[Step]:
    values: dict[str, Any] = {
        n: getattr(p, "value", None) for n, p in t.nontunable_parameters.items()
    }
    return [partial(_constant, n, float(v)) for n, v in values.items() if _are_numbers([v])]


def _number(t: ChoiceToNumericChoice) -> list[Step]:
    return [partial(_value_of, name, [*code], ()) for name, code in t.encoded_parameters.items()]


_BACK: Mapping[type[Transform], Callable[[Any], list[Step]]] = {
    Log: lambda t: [
        partial(_change, partial(torch.pow, 10), name) for name in t.transform_parameters
    ],
    Logit: lambda t: [partial(_change, torch.sigmoid, name) for name in t.transform_parameters],
    UnitX: lambda t: [
        partial(_change, partial(_unscaled, lower, upper - lower), name)
        for name, (lower, upper) in t.bounds.items()
    ],
    ChoiceToNumericChoice: _number,
    OrderedChoiceToIntegerRange: _number,
    OneHot: lambda t: [
        partial(_value_of, name, values, t.encoded_parameters[name])
        for name, values in t.encoded_values.items()
    ],
    RemoveFixed: _fixed,
}
"""By transform, the steps that undo it."""
_FORTH: Mapping[type[Transform], Callable[[Any], dict[str, Change]]] = {
    Winsorize: lambda t: {
        metric: partial(torch.clamp, min=low, max=high) for metric, (low, high) in t.cutoffs.items()
    },
    BilogY: lambda t: {
        metric: partial(_bent, bound) for metric, bound in t.metric_to_bound.items()
    },
    StandardizeY: lambda t: {
        metric: partial(_scaled, float(mean), float(t.Ystd[metric]))
        for metric, mean in t.Ymean.items()
    },
}
"""By transform, its effect on a metric."""
# MapKeyToFloat adds a parameter, which the physics does not read, if there are learning curves.
_NEITHER = (FillMissingParameters, Cast, IntToFloat, MapKeyToFloat, Derelativize)
