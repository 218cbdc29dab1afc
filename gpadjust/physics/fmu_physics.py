"""A functional mock-up unit (FMU) as physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_choice, checked_number, real_array
from gpadjust.physics.black_box import BlackBoxPhysics, call_row
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.fmu import FMU, KINDS, opened
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown


class FMUPhysics(BlackBoxPhysics):
    r"""Physics given as an FMU of FMI 2 or 3, the file in which simulation programs export a model.

    Each row is a simulation by `FMPy <https://github.com/CATIA-Systems/FMPy>`_ from time 0 to the
    last of the ``times``, with the row's inputs as start values:

    - A simulator: inputs are parameters and constant inputs of the FMU.
    - Dynamics: inputs are states and actions, outputs the states, ``times`` the control step. A
      state can be set if its start value can, or by model exchange.
    - Values over time: one of the inputs is ``"time"``. Rows that differ in it alone share a
      simulation, and fail together; they agree with single ones within the tolerance.

    Names are those of the FMU, such as ``"wall[1].T"``. Rows run in parallel, in processes, and are
    remembered as of a :class:`~gpadjust.BlackBoxPhysics`.

    Args:
        fmu: The file.
        inputs: The variable of each column of X, or ``"time"``.
        outputs: The variables that are the outputs.
        times: When outputs are read, in the FMU's time; of several times all outputs at the first,
            then at the second.
        start_values: Values of further variables, at the beginning.
        signals: Inputs of the FMU over time: a frame or mapping with ``"time"``, ascending, and a
            column for each of them. A value holds until the next, and the first before.
        unknowns: Unknown parameters by their names in the FMU, whose units they take.
        communication_step: The steps of co-simulation, which end at ``times`` and ``signals``, too.
            Default: the step that the FMU proposes, or none between these times.
        tolerance: The relative tolerance of model exchange; a wish to the FMU in co-simulation.
        kind: ``"CoSimulation"`` or ``"ModelExchange"``. Default: the first that the FMU has.
        columns: The columns of X to read, one for each of the inputs. Default: all.
        gradient, fd_step: As of :class:`~gpadjust.BlackBoxPhysics`. A step should exceed the
            tolerance by far.
        name: As of :class:`Physics`. Default: the name of the file.

    Raises:
        ImportError: Without FMPy (``pip install "gpadjust[fmu]"``).
        OSError: If there is no such file.
        ValueError: If the FMU has no such variable, kind, or binary for this platform, or a state
            of the FMU is not in a step of dynamics.
        PhysicsError: When called, if a simulation fails, or a variable has not its start value.

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
            self.simulate,
            unknowns=unknowns,
            batched=False,
            gradient=gradient,
            fd_step=fd_step,
            inputs=columns,
            name=name or path.stem,
        )
        check_choice("kind", kind, (*KINDS, None))
        if isinstance(inputs, str) or isinstance(outputs, str) or not inputs or not outputs:
            raise TypeError(
                f"Expected lists of names of variables; found {inputs!r} and {outputs!r}."
            )
        if ("time" in inputs) is not (times is None):
            raise ValueError(
                "Expected the times at which outputs are read, such as times=10.0, or 'time' as "
                f"one of the inputs, and not both; found inputs {inputs} and times={times!r}."
            )
        if communication_step is not None:
            checked_number("communication_step", communication_step, above=0)
        self.path, self.kind = path, kind
        self.input_names, self.output_names = tuple(inputs), tuple(outputs)
        self.start_values = {k: checked_number(k, v) for k, v in (start_values or {}).items()}
        self.signals = _signals(signals)
        self.times: tuple[float, ...] = ()
        if times is not None:
            numbers = np.atleast_1d(real_array(times)).tolist()
            self.times = tuple(checked_number("times", t, least=0) for t in numbers)
        self.communication_step = communication_step
        self.tolerance = checked_number("tolerance", tolerance, above=0, below=1)
        if self.inputs is None:
            self.column_names = self.input_names
        self._check(opened(path, kind))
        self.num_outputs = len(self.output_names) * max(1, len(self.times))

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs of simulations; an error of single rows contains the other outputs."""
        from joblib import Parallel, delayed  # slow to import

        if X.shape[-1] != len(self.input_names):
            raise ValueError(
                f"expected a column of X for each of the inputs {', '.join(self.input_names)}, or "
                f"columns=; found {X.shape[-1]}"
            )
        rows = self._table(X, *parameters)
        number = np.arange(len(rows))  # of the simulation of a row
        if "time" in self.input_names:
            others = np.delete(rows, self.input_names.index("time"), axis=1)
            number = np.unique(others, axis=0, return_inverse=True)[1].ravel()
        # Rows of each simulation.
        groups = [np.flatnonzero(number == i) for i in range(number.max() + 1)]
        outputs = Parallel()(delayed(call_row)(self.simulate, rows[group]) for group in groups)
        results = dict[int, NDArray[np.float64] | PhysicsError]()
        for group, y in zip(groups, outputs, strict=True):
            # N m outputs, the m of each row in turn
            parts = [y] * len(group) if isinstance(y, PhysicsError) else np.split(y, len(group))
            results |= dict(zip(group.tolist(), parts, strict=True))
        return self._gathered([results[i] for i in range(len(rows))])

    def simulate(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outputs, ``N m``, of ``N x (d + p)`` rows that differ in time alone."""
        names = (*self.input_names, *self.unknowns)
        for name, column in zip(names, rows.T, strict=True):
            if not np.isfinite(column).all():
                raise ValueError(f"expected finite numbers for {name!r}, found {column.tolist()}")
        values = dict(zip(names, rows[0].tolist(), strict=True))
        times = np.tile(self.times, (len(rows), 1))  # N x times of a row
        if values.pop("time", None) is not None:
            times = rows[:, [self.input_names.index("time")]]
        if times.min() < 0:
            raise ValueError(f"expected times of 0 or later, found {times.min():g}")
        outputs = opened(self.path, self.kind).simulate(
            self.start_values | values,
            times.ravel(),
            self.output_names,
            self.signals,
            self.communication_step,
            self.tolerance,
        )
        return outputs.ravel()

    def _check(self, fmu: FMU) -> None:
        """Raise a ValueError if variables are not in the FMU; take the units of parameters."""
        self.unknowns.refuse_functions()
        inputs = [name for name in self.input_names if name != "time"]
        moving = [name for name in self.signals if name != "time"]
        names = [*inputs, *self.unknowns, *self.start_values, *moving]
        for name in (*names, *self.output_names):
            variable = fmu.variable(name)
            if names.count(name) > 1:
                raise ValueError(
                    f"{name!r} is given twice: in inputs, unknowns, start_values or signals."
                )
            if name in moving and variable.causality != "input":
                raise ValueError(f"Expected signals of inputs of {fmu.name}; {name!r} is not one.")
            if name in self.unknowns and not self.unknowns[name].unit:
                unit = variable.unit or getattr(variable.declaredType, "unit", None) or ""
                self.unknowns[name] = replace(self.unknowns[name], unit=unit)
        # A step that forgets a state is not a step of the system.
        hidden = [name for name in fmu.states if name not in names]
        if hidden and self.times and {*inputs} & {*self.output_names} & {*fmu.states}:
            raise ValueError(
                f"The inputs and outputs are states of a step, and {', '.join(hidden)} of "
                f"{fmu.name} would begin each step at its start value: add it to inputs and "
                "outputs, or, if it does not matter, to start_values."
            )


def _signals(signals: Any) -> dict[str, NDArray[np.float64]]:
    """Return signals by name, with their times."""
    if signals is None:
        return {"time": np.array([-np.inf])}  # nothing changes
    columns = {str(name): real_array(signals[name]) for name in signals}
    shapes = {name: column.shape for name, column in columns.items()}
    is_table = "time" in columns and len(columns) > 1 and len({*shapes.values()}) == 1
    if not is_table or columns["time"].ndim != 1 or not (np.diff(columns["time"]) > 0).all():
        raise ValueError(
            "Expected signals as columns of one length, 'time', ascending, and one or more inputs; "
            f"found {shapes}."
        )
    return columns
