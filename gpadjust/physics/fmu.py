"""An FMU that is unpacked in this process: its variables, and simulations by FMPy."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from ctypes import c_double
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
KINDS = ("CoSimulation", "ModelExchange")
_SAME = 1e-9  # share within which two times are one, also of FMPy
_FATAL = 4  # the status after which no function of an instance may be called
# CVode calls these, and passes over an error in Python.
_IN_SOLVER = {"SetTime", "SetContinuousStates", "GetEventIndicators"}
_IN_SOLVER |= {"GetDerivatives", "GetContinuousStateDerivatives"}
# By model exchange FMPy permits 500 steps of CVode in each interval, none of which may be longer
# than a 50th of the simulation: finite differences of the limited steps are rough.
_INTERVALS, _LONGER = 5, 50
_lock = Lock()  # one simulation at a time in a process
_messages: deque[str] = deque(maxlen=5)
_callbacks: list[Any] = []


class FMU:
    """An FMU, unpacked into a temporary folder, with one instance, which is reset between uses."""

    def __init__(self, path: Path, kind: str | None) -> None:
        try:
            import fmpy  # slow
        except ImportError as error:
            raise ImportError('An FMU needs FMPy; run `pip install "gpadjust[fmu]"`.') from error
        try:
            self.description = description = fmpy.read_model_description(path, validate=False)
            platforms = fmpy.supported_platforms(path)
        except Exception as error:
            raise ValueError(f"Expected {path} as an FMU; it cannot be read: {error}") from error
        interfaces = (description.coSimulation, description.modelExchange)
        kinds = [k for k, interface in zip(KINDS, interfaces, strict=True) if interface is not None]
        if description.fmiVersion[0] not in "23" or not kinds or kind not in (None, *kinds):
            raise ValueError(
                f"Expected {path.name} of FMI 2 or 3 with {kind or ' or '.join(KINDS)}; found FMI "
                f"{description.fmiVersion} with {' and '.join(kinds) or 'neither'}."
            )
        if fmpy.platform not in platforms:
            raise ValueError(
                f"Expected {path.name} with a binary for {fmpy.platform}; found "
                f"{', '.join(platforms) or 'none'}. Export it for this platform, or compile its "
                "sources by `fmpy compile`."
            )
        self.name = path.name
        self.kind: str = kind or kinds[0]
        self.variables = {variable.name: variable for variable in description.modelVariables}
        # The derivatives name the states that they are of.
        self.states: list[str] = [u.variable.derivative.name for u in description.derivatives]
        step = getattr(description.coSimulation, "fixedInternalStepSize", None)
        self.step = float(step or getattr(description.defaultExperiment, "stepSize", None) or 0.0)
        self._instance: Any = None
        self._errors: list[Exception] = []  # the first one of the instance
        self._folder = TemporaryDirectory(ignore_cleanup_errors=True)
        fmpy.extract(path, self._folder.name)

    def variable(self, name: str) -> Any:
        """Return the description of a scalar number, or raise a ValueError."""
        if name not in self.variables:
            close = get_close_matches(name, self.variables, 5, 0.5) or [*self.variables][:5]
            raise ValueError(
                f"{self.name} has no variable {name!r}; expected one such as {', '.join(close)}."
            )
        variable = self.variables[name]
        if variable.shape or variable.type in ("String", "Binary", "Clock"):
            raise ValueError(
                f"Expected {name!r} of {self.name} as one number; found type {variable.type} and "
                f"shape {variable.shape}."
            )
        return variable

    def simulate(
        self,
        values: Mapping[str, float],
        times: Array,
        outputs: Sequence[str],
        signals: Mapping[str, Array],
        step: float | None,
        tolerance: float,
    ) -> Array:
        """Return outputs ``N x m`` at ``N`` times, given start values, parameters and signals."""
        from fmpy import simulate_fmu

        changes = signals["time"]
        end = stop = float(times.max())  # the latter limits the steps of a solver
        points = np.unique([0.0, *times, *changes[(changes > 0) & (changes < end)]])
        step = step or self.step or end or 1.0  # of one moment any step will do
        if self.kind == "ModelExchange":
            step = end / _INTERVALS or 1.0
            stop = _LONGER * end
        names = {*values, *outputs, *signals}
        description = copy(self.description)  # FMPy goes through all variables of one
        description.modelVariables = [v for v in self.variables.values() if v.name in names]

        def is_before_end(time: float, recorder: Any) -> bool:
            if time < end - _SAME * end:
                return True
            recorder.sample(time)
            return False

        with _lock:
            _messages.clear()
            try:
                results = simulate_fmu(
                    self._folder.name,
                    model_description=description,
                    fmu_instance=self._begun(values),
                    fmi_type=self.kind,
                    validate=False,
                    start_time=0.0,
                    stop_time=stop,
                    set_stop_time=stop == end,
                    step_finished=is_before_end,
                    output_interval=step,
                    relative_tolerance=tolerance,
                    start_values=dict(values),
                    input=self._input(values, points, signals),
                    output=names,
                )
            except BaseException as error:
                failure = [*self._errors, error][0]
                self._free()
                failure.stderr = "; ".join(_messages)  # type: ignore[attr-defined]
                raise failure from None
        for name, value in values.items():
            first = float(results[name][0])
            if not abs(first - value) <= 1e-6 * max(1.0, abs(value)):  # NaN is refused, too
                raise ValueError(
                    f"{name!r} is {first:g} after its start value was set to {value:g}: the FMU "
                    "permits none, computes it or rounds it. Name the parameter of its start "
                    "value, or take model exchange, whose states can be set"
                )
        ends = results["time"]
        missing = points[~np.isclose(ends[_places(ends, points)], points, _SAME, 0)]
        if len(missing):
            raise RuntimeError(
                f"no step ends at t = {missing[0]:g}, the last one at {ends[-1]:g}. The "
                "FMU ended the simulation, or takes steps of one length alone: give a "
                "communication_step of which the times, also of signals, are multiples"
            )
        rows = _places(ends, times)
        return np.stack([results[name][rows].astype(float) for name in outputs], axis=-1)

    def _input(
        self, values: Mapping[str, float], points: Array, signals: Mapping[str, Array]
    ) -> NDArray[np.void] | None:
        """Return inputs as FMPy takes them: two rows at each point, which make it stop there."""
        if len(signals) == 1 and len(points) <= 2:
            return None  # nothing changes before the end
        # The last change before a point, and the last one until it.
        last = [np.searchsorted(signals["time"], points, side) for side in ("left", "right")]
        rows = np.stack(last, axis=-1).clip(min=1) - 1
        rows[0] = rows[0, 1]
        columns = {"time": np.repeat(points, 2)}
        columns |= {n: signal[rows].ravel() for n, signal in signals.items() if n != "time"}
        for name, value in values.items():
            if self.variables[name].causality == "input":  # or FMPy prints a warning
                columns[name] = np.full(rows.size, value)
        return np.array([*zip(*columns.values(), strict=True)], [(name, float) for name in columns])

    def _begun(self, values: Mapping[str, float]) -> Any:
        """Return the instance as if it were new; model exchange will set its states, too."""
        try:
            if self._instance is not None:
                self._instance.reset()
        except Exception:  # an FMU may not be able to
            self._free()
        if self._instance is None:
            self._instance = self._instantiated()
        if self.kind == "ModelExchange" and values.keys() & {*self.states}:
            self._set_states_at_first_update(values)
        return self._instance

    def _instantiated(self) -> Any:
        """Return an instance that keeps its first error, even one that CVode passes over."""
        from fmpy import instantiate_fmu

        fmu = instantiate_fmu(self._folder.name, self.description, self.kind, logger=_log)
        # For FMI 2 FMPy has one logger for all FMUs, that of the last instance, alive or not.
        _callbacks.append(fmu.callbacks)
        for name in dir(fmu):
            if name.startswith(("fmi2", "fmi3")):
                setattr(fmu, name, self._guarded(getattr(fmu, name), name[4:] in _IN_SOLVER))
        return fmu

    def _guarded(self, function: Any, is_in_solver: bool) -> Any:
        """Return a function of FMI that keeps its first error, and raises that from then on."""
        errors = self._errors

        def guarded(*arguments: Any) -> Any:
            try:
                if errors:
                    raise errors[0]
                return function(*arguments)
            except Exception as error:
                errors[:] = [error]
                if is_in_solver:
                    return 0
                raise

        return guarded

    def _set_states_at_first_update(self, values: Mapping[str, float]) -> None:
        """Let the first update of discrete states set continuous states by name, too."""
        fmu = self._instance
        name = "newDiscreteStates"  # of FMI 2
        if not hasattr(fmu, name):
            name = "updateDiscreteStates"
        update = getattr(fmu, name)

        def first() -> Any:
            delattr(fmu, name)
            while update()[0]:  # until discrete states stay as they are
                pass
            fmu.enterContinuousTimeMode()
            x = (c_double * len(self.states))()
            fmu.getContinuousStates(x, len(x))
            x[:] = [values.get(state, x[i]) for i, state in enumerate(self.states)]
            fmu.setContinuousStates(x, len(x))
            fmu.enterEventMode()
            return update()

        setattr(fmu, name, first)

    def _free(self) -> None:
        """Free the instance, unless it is dead."""
        is_dead = any(getattr(error, "status", None) == _FATAL for error in self._errors)
        self._errors.clear()
        if self._instance is not None and not is_dead:
            with suppress(Exception):
                self._instance.freeInstance()
        self._instance = None


@cache
def _opened(path: Path, kind: str | None, changed: float, process: int) -> FMU:
    return FMU(path, kind)


def opened(path: Path, kind: str | None = None) -> FMU:
    """Return the FMU of a file, of which a process has one, until the file changes."""
    return _opened(path, kind, path.stat().st_mtime, os.getpid())


def _log(*message: Any) -> None:
    """Keep a message, whose text is the last argument."""
    _messages.append(message[-1].decode(errors="replace").strip())


def _places(ends: Array, times: Array) -> NDArray[np.int64]:
    """Return the places of times among the ends of steps, but for rounding errors."""
    return np.searchsorted(ends, times - _SAME * np.abs(times)).clip(max=len(ends) - 1)
