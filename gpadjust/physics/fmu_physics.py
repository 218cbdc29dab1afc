"""A functional mock-up unit (FMU) as physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_choice, checked_number, real_array
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.fmu import FMU, KINDS, opened
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

_SAME = 1e-9  # share of the duration within which two points in time are one


class FMUPhysics(BlackBoxPhysics):
    r"""Physics given as an FMU of FMI 2 or 3, the file in which simulation programs export a model.

    Each row is a simulation by `FMPy <https://github.com/CATIA-Systems/FMPy>`_ from ``start_time``
    to the last of the ``times``, with the row's inputs as start values and the outputs at the end:

    - A simulator: inputs are parameters and constant inputs of the FMU.
    - Dynamics: inputs are states and actions, outputs the states, ``times`` the control step. A
      state can be set if its start value can, or by model exchange.
    - Values over time: one of the inputs is ``"time"``, the FMU's independent variable. Rows that
      differ in it alone share a simulation; they agree with single ones within the tolerance.

    Names are those of the FMU, such as ``"wall[1].T"``. An instance that has finished is reset for
    the next row. Rows run in parallel and are remembered as of a
    :class:`~gpadjust.BlackBoxPhysics`; a process has one instance of an FMU that permits no more.

    Args:
        fmu: The file.
        inputs: The variable of each column of X, or ``"time"``.
        outputs: The variables that are the outputs.
        times: When outputs are read, in the FMU's time; of several times all outputs at the first,
            then at the second. Not with ``"time"``.
        start_values: Values of further variables, at the beginning.
        signals: Inputs of the FMU over time: a frame or mapping with ``"time"``, ascending, and a
            column for each of them. A value holds until the next, and the first before.
        unknowns: Unknown parameters by their names in the FMU, whose units they take.
        start_time: The time at which simulations begin.
        communication_step: The steps of co-simulation, which end at ``times`` and ``signals``, too.
            Default: the step that the FMU names, or none between these times.
        tolerance: The relative tolerance of model exchange; a wish to the FMU in co-simulation.
        kind: ``"CoSimulation"`` or ``"ModelExchange"``. Default: the first that the FMU has.
        columns: The columns of X to read, one for each of the inputs. Default: all.
        gradient, fd_step: As of :class:`~gpadjust.BlackBoxPhysics`. A step should exceed the
            tolerance by far.
        name: As of :class:`Physics`. Default: that of the file.

    Raises:
        ImportError: Without FMPy (``pip install "gpadjust[fmu]"``).
        OSError: If there is no such file.
        ValueError: If the FMU has no such variable, kind, or binary for this platform, a variable
            cannot be set, or a state of the FMU is not in a step of dynamics.

    Example:
        >>> tank = FMUPhysics(  # doctest: +SKIP
        ...     "tank.fmu", ["tank.T", "heater"], ["tank.T"], times=60.0,
        ...     unknowns={"wall[1].G": Unknown(5.0, factor=2.0)},
        ... )
    """

    advice = "An FMU's own message, if it wrote one, is in the error."

    def __init__(
        self,
        fmu: str | Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        *,
        times: float | Sequence[float] | None = None,
        start_values: Mapping[str, float] | None = None,
        signals: Any = None,
        unknowns: Mapping[str, Unknown] | None = None,
        start_time: float = 0.0,
        communication_step: float | None = None,
        tolerance: float = 1e-8,
        kind: Literal["CoSimulation", "ModelExchange"] | None = None,
        columns: Sequence[int] | None = None,
        gradient: Literal["finite-difference"] | None = "finite-difference",
        fd_step: float | None = None,
        name: str | None = None,
    ) -> None:
        path = Path(fmu).resolve()
        super().__init__(
            self.simulate,  # type: ignore[arg-type]  # which evaluate calls, of several rows
            unknowns=unknowns,
            batched=False,
            gradient=gradient,
            fd_step=fd_step,
            inputs=columns,
            name=name or path.stem,
        )
        check_choice("kind", kind, (*KINDS, None))
        self.path, self.kind = path, kind
        self.input_names, self.output_names = _names("inputs", inputs), _names("outputs", outputs)
        self.start_values = {k: checked_number(k, v) for k, v in (start_values or {}).items()}
        self.signals = _signals(signals)
        self.start_time = checked_number("start_time", start_time)
        self.tolerance = checked_number("tolerance", tolerance, above=0, below=1)
        self.times = self._checked_times(times)
        unpacked = opened(path, kind)
        step = unpacked.step if communication_step is None else communication_step
        self.communication_step = (
            None if step is None else checked_number("communication_step", step, above=0)
        )
        self._check(unpacked)
        for each, unknown in self.unknowns.items():
            if not unknown.unit:
                self.unknowns[each] = replace(unknown, unit=unpacked.unit(each))
        self.num_outputs = len(self.output_names) * max(1, len(self.times))

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if data have columns of these names in another order."""
        places = {name: i for i, name in enumerate(self.input_names)}
        if self.inputs is None and any(places.get(n, i) != i for i, n in enumerate(names)):
            raise ValueError(
                f"{self.path.name} has the inputs {', '.join(self.input_names)}, and the data have "
                f"{', '.join(names)}: name the inputs in the order of the data."
            )

    def read(self, X: Tensor) -> Tensor:
        """Return the columns of ``X`` (``... x n x d``) that are inputs of the FMU, checked."""
        columns = super().read(X)
        if columns.shape[-1] != len(self.input_names):
            raise ValueError(
                f"Physics {self.name!r} has the inputs {', '.join(self.input_names)}; expected a "
                f"column for each of them, or columns=, found {columns.shape[-1]} column(s)."
            )
        return columns

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs of simulations; an error of single rows contains those of others."""
        from joblib import Parallel, delayed  # slow to import

        rows = self._table(X, *parameters)
        place = np.arange(len(rows))
        if "time" in self.input_names:
            others = np.delete(rows, self.input_names.index("time"), axis=1)
            place = np.unique(others, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(place, kind="stable")
        groups = np.split(order, np.cumsum(np.bincount(place))[:-1])
        found = Parallel()(delayed(self.simulate)(rows[group]) for group in groups)
        results = dict(zip(order.tolist(), chain(*found), strict=True))
        return self._gathered([results[i] for i in range(len(rows))])

    def simulate(self, rows: NDArray[np.float64]) -> list[NDArray[np.float64] | PhysicsError]:
        """Return outputs ``(m,)`` or the error of each of ``N x (d + p)`` rows of one simulation.

        The rows differ in time alone.
        """
        values = dict(zip((*self.input_names, *self.unknowns), rows[0].tolist(), strict=True))
        times = np.array([self.times] * len(rows))
        if values.pop("time", None) is not None:
            times = rows[:, [self.input_names.index("time")]]
        found = dict[int, Any]()
        failure = PhysicsError("")
        try:
            points = self._points(times)
            read = _last(points, times, points)
            found = dict.fromkeys(read.ravel().tolist())
            opened(self.path, self.kind).simulate(
                self.start_values | values,
                points,
                self._held(points),
                self.tolerance,
                self.output_names,
                found,
            )
        except Exception as error:
            failure = PhysicsError(described(error))
            failure.__cause__ = error
            if not any(found.values()):
                return [failure] * len(rows)
        parts = [[found[i] for i in own] for own in read.tolist()]
        return [failure if None in own else np.concatenate(own) for own in parts]

    def _points(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return all times at which a simulation stops, from its start to the last output."""
        fmu, start, end = opened(self.path, self.kind), self.start_time, float(times.max())
        if times.min() < start:
            raise ValueError(f"expected times from start_time={start:g} on, found {times.min():g}")
        is_stepped = fmu.kind == "CoSimulation"
        grid = np.empty(0)
        if is_stepped and self.communication_step is not None:
            grid = np.arange(start, end, self.communication_step)
        points = np.sort(np.concatenate([[start], times.ravel(), self.signals["time"], grid]))
        points = points[(points >= start) & (points <= end)]
        points = points[np.diff(points, prepend=-np.inf) > _SAME * (end - start)]
        steps = np.diff(points)
        is_even = len(steps) == 0 or np.ptp(steps) <= _SAME * (end - start)
        if is_stepped and not is_even and not fmu.interface.canHandleVariableCommunicationStepSize:
            raise ValueError(
                f"{fmu.name} takes communication steps of one length, found steps from "
                f"{steps.min():g} to {steps.max():g}: take a communication_step of which the "
                "times, also of signals, are multiples"
            )
        return points

    def _held(self, points: NDArray[np.float64]) -> list[dict[str, float]]:
        """Return the values of signals from each point on; nothing if there are none."""
        names = [name for name in self.signals if name != "time"]
        place = _last(self.signals["time"], points, points).clip(0)
        return [{n: float(self.signals[n][i]) for n in names} for i in place if names]

    def _checked_times(self, times: float | Sequence[float] | None) -> tuple[float, ...]:
        """Return the times of outputs, none if they are a column of X."""
        if ("time" in self.input_names) is not (times is None):
            raise ValueError(
                "Expected the times at which outputs are read, such as times=10.0, or 'time' as "
                f"one of the inputs, and not both; found inputs {', '.join(self.input_names)} and "
                f"times={times!r}."
            )
        numbers = [] if times is None else np.atleast_1d(real_array(times)).tolist()
        return tuple(checked_number("times", t, least=self.start_time) for t in numbers)

    def _check(self, fmu: FMU) -> None:
        """Raise a ValueError if variables are not in the FMU or cannot be set."""
        moving = [name for name in self.signals if name != "time"]
        values = [name for name in self.input_names if name != "time"]
        given = [*values, *self.unknowns, *self.start_values, *moving]
        twice = sorted({name for name in given if given.count(name) > 1})
        if twice:
            raise ValueError(
                f"{twice[0]!r} is given twice: in inputs, unknowns, start_values or signals."
            )
        for name in (*values, *self.unknowns, *self.start_values):
            fmu.check_settable(name)
        for name in moving:
            if fmu.variable(name).causality != "input":
                raise ValueError(f"Expected signals of inputs of {fmu.name}; {name!r} is not one.")
        for name in self.output_names:
            fmu.variable(name)
        left = [name for name in fmu.states if name not in given]
        if left and self.times and {*values} & {*self.output_names} & {*fmu.states}:
            raise ValueError(
                f"The inputs and outputs are states of a step, and {', '.join(left)} of "
                f"{fmu.name} would begin each step at its start value: add it to inputs and "
                "outputs, or, if it does not matter, to start_values."
            )


def _names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return names of variables, checked."""
    if isinstance(names, str) or not names or not all(isinstance(n, str) for n in names):
        raise TypeError(f"{argument} must be a list of names of variables; found {names!r}.")
    return tuple(names)


def _last(
    of: NDArray[np.float64], until: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the places of the last times that are not after others, but for rounding errors."""
    return np.searchsorted(of, until + _SAME * np.ptp(points), side="right") - 1


def _signals(signals: Any) -> dict[str, NDArray[np.float64]]:
    """Return signals by name, with their times."""
    if signals is None:
        return {"time": np.empty(0)}
    found = {str(name): np.atleast_1d(real_array(signals[name])) for name in signals}
    times = found.get("time", np.empty(0))
    is_table = times.ndim == 1 and all(each.shape == times.shape for each in found.values())
    if len(found) < 2 or not is_table or not len(times) or (np.diff(times) <= 0).any():
        shapes = {name: each.shape for name, each in found.items()}
        raise ValueError(
            "Expected signals as columns of one length, 'time', ascending, and one or more inputs; "
            f"found {shapes}."
        )
    return found
