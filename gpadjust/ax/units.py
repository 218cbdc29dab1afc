"""A physics behind Ax's transforms, which are undone for inputs and repeated for outputs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from numbers import Real
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

_NEAR = 1e-6  # distance from an integer that is rounding


class Units:
    """Conversions from a model's inputs in Ax to the search space, and of metrics to the model.

    They are differentiable except for coded choices, and contain plain values, so that models can
    be pickled. A physics gets values within the ranges, as BoTorch also evaluates models around
    the data; whole numbers, as 8 may be 7.999999999999999; and the nearest of the choices.
    """

    def __init__(
        self,
        transforms: Sequence[Transform],
        names: Sequence[str],
        ranges: Mapping[str, tuple[float, float]],
        integers: Collection[str] = (),
        choices: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        supported = (*_BACK, *_FORTH, *_NEITHER)
        others = [type(t).__name__ for t in transforms if type(t) not in supported]
        if others:
            raise ValueError(
                f"The transform(s) {', '.join(others)} of Ax are not supported with a physics; "
                f"expected some of {', '.join(kind.__name__ for kind in supported)}. Leave the "
                "others out: transforms=gpadjust.ax.TRANSFORMS."
            )
        self.names = tuple(names)
        self.ranges = dict(ranges)
        self.integers = frozenset(integers)
        self.choices = {
            name: torch.tensor(values, dtype=torch.float64)
            for name, values in (choices or {}).items()
        }
        # Inputs go back from the last transform to the first, metrics forth from the first.
        self._back: list[Step] = []
        for t in reversed(transforms):
            if type(t) in _BACK:
                self._back += _BACK[type(t)](t)
        self._forth = [_FORTH[type(t)](t) for t in transforms if type(t) in _FORTH]

    def raw(self, X: Tensor, names: Sequence[str]) -> Tensor:
        """Return some parameters in the units of the search space, ``N x len(names)``."""
        columns = dict(zip(self.names, X.unbind(-1), strict=True))
        for step in self._back:
            step(columns)  # in place
        missing = [name for name in names if name not in columns]
        if missing:
            raise ValueError(
                f"The physics reads the parameter(s) {', '.join(missing)}, which are text, "
                "derived, or not in the model. Make choices numbers, or let the physics name its "
                "parameters as its arguments: def f_p(x1, x2)."
            )
        return torch.stack([self._within(name, columns[name].expand(len(X))) for name in names], -1)

    def _within(self, name: str, values: Tensor) -> Tensor:
        """Return the nearest possible values of a parameter, with the derivative of the values."""
        nearest = values.detach()
        if name in self.choices:
            choices = self.choices[name].to(nearest)
            nearest = choices[(nearest.unsqueeze(-1) - choices).abs().argmin(-1)]
        if name in self.integers:
            nearest = nearest.where((nearest - nearest.round()).abs() > _NEAR, nearest.round())
        if name in self.ranges:
            nearest = nearest.clamp(*self.ranges[name])
        # Straight-through: the value of `nearest`, the derivative of `values`.
        return nearest + (values - values.detach())

    def metric(self, Y: Tensor, metric: str) -> Tensor:
        """Return values of a metric in the units of the model."""
        for steps in self._forth:  # a function for each metric that a transform changed
            Y = steps[metric](Y) if metric in steps else Y
        return Y


class PhysicsInUnits(Physics):
    """A physics behind Ax's transforms, with inputs and outputs in the units of a model."""

    def __init__(
        self, origin: ParameterPhysics, metric: str, units: Units, parameters: list[str]
    ) -> None:
        reads = origin.read_names(parameters)
        inner = origin.take_rows(reads)
        super().__init__(unknowns=dict(inner.unknowns.items()), name=inner.name)
        self.origin, self.metric, self.units = origin, metric, units
        self.reads = reads
        self.inner = inner

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the physics at inputs of the model, with the transforms of its metric, ``N x 1``.

        Raise a PhysicsError if the physics fails, or has several outputs.
        """
        # f_p at the user's parameters; its memory and batches work on these rows.
        raw = self.units.raw(X, self.reads)
        try:
            Y = self.inner.of_rows(self.inner.read_rows(raw, *parameters))
        except PhysicsError as error:
            error.partial = None  # its outputs have other units
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
    columns[name] = torch.tensor(value).to(next(iter(columns.values())))


def _value_of(name: str, values: Sequence[Any], one_hot: Sequence[str], columns: Columns) -> None:
    """Replace the number of a choice, or its columns by OneHot, by the value of the choice."""
    if one_hot:  # between the corners of the cube the largest column decides
        index = torch.stack([columns.pop(column) for column in one_hot], dim=-1).argmax(-1)
    else:
        index = columns.pop(name).round().long().clamp(0, len(values) - 1)
    # Texts are left out: a physics that reads one gets an error.
    if all(isinstance(value, Real) for value in values):
        columns[name] = torch.tensor(values, dtype=torch.float64)[index]


def _bent(bound: float, Y: Tensor) -> Tensor:
    # b + sign(y - b) log(1 + |y - b|)
    return bound + (Y - bound).sign() * (Y - bound).abs().log1p()


def _scaled(mean: float, sd: float, Y: Tensor) -> Tensor:
    return (Y - mean) / sd


_power = partial(torch.pow, 10)  # Ax's logarithms have the base 10


def _unscaled(mean: float, sd: float, Y: Tensor) -> Tensor:
    return mean + sd * Y


def _fixed(t: RemoveFixed) -> list[Step]:
    """Return the steps that add fixed parameters; derived ones have no value."""
    values = {n: getattr(p, "value", None) for n, p in t.nontunable_parameters.items()}
    return [partial(_constant, n, float(v)) for n, v in values.items() if isinstance(v, Real)]


def _number(t: ChoiceToNumericChoice) -> list[Step]:
    """Return the steps that replace the numbers of choices by their values."""
    return [partial(_value_of, name, [*code], ()) for name, code in t.encoded_parameters.items()]


_BACK: Mapping[type[Transform], Callable[[Any], list[Step]]] = {
    Log: lambda t: [partial(_change, _power, name) for name in t.transform_parameters],
    Logit: lambda t: [partial(_change, torch.sigmoid, name) for name in t.transform_parameters],
    UnitX: lambda t: [  # x = lower + (upper - lower) u
        partial(_change, partial(_unscaled, lower, upper - lower), name)
        for name, (lower, upper) in t.bounds.items()
    ],
    ChoiceToNumericChoice: _number,
    OrderedChoiceToIntegerRange: _number,
    OneHot: lambda t: [  # a column for each value
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
    StandardizeY: lambda t: {  # (y - mean) / sd
        metric: partial(_scaled, float(mean), float(t.Ystd[metric]))
        for metric, mean in t.Ymean.items()
    },
}
"""By transform, its effect on a metric."""
# No step for these. For learning curves MapKeyToFloat adds a parameter, which no physics reads.
_NEITHER = (FillMissingParameters, Cast, IntToFloat, MapKeyToFloat, Derelativize)
