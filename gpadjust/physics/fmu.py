"""An FMU that is unpacked in this process: its variables, and simulations in its instances."""

from __future__ import annotations

import atexit
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from difflib import get_close_matches
from functools import cache
from itertools import pairwise
from pathlib import Path
from threading import Lock, local
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = ("CoSimulation", "ModelExchange")
_MOST_EVENTS = 100_000
_MOST_STEPS = 100_000  # of CVode, between two points in time
_FATAL = 4  # the status after which no function of an instance may be called
_thread = local()
_kept: list[Any] = []


class FMU:
    """An FMU, unpacked into a temporary folder, with instances that wait for their next simulation.

    Args:
        path: The file.
        kind: ``"CoSimulation"``, ``"ModelExchange"``, or None for the first that it has.

    Raises:
        ImportError: Without FMPy.
        ValueError: If it is not an FMU of FMI 2 or 3, of this kind and this platform.
    """

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
        self.version = int(description.fmiVersion[0])
        kinds = dict(zip(KINDS, (description.coSimulation, description.modelExchange), strict=True))
        has = [name for name, interface in kinds.items() if interface is not None]
        if self.version not in (2, 3) or not has or kind not in (None, *has):
            raise ValueError(
                f"Expected {path.name} of FMI 2 or 3 with {kind or ' or '.join(KINDS)}; found FMI "
                f"{description.fmiVersion} with {' and '.join(has) or 'neither'}."
            )
        if fmpy.platform not in platforms:
            raise ValueError(
                f"Expected {path.name} with a binary for {fmpy.platform}; found "
                f"{', '.join(platforms) or 'none'}. Export it for this platform, or compile its "
                "sources by `fmpy compile`."
            )
        self.name = path.name
        self.kind: str = kind or has[0]
        self.interface: Any = kinds[self.kind]
        self.variables = {each.name: each for each in description.modelVariables}
        self.states: list[str] = [u.variable.derivative.name for u in description.derivatives]
        self.folder = fmpy.extract(path)
        self._process = os.getpid()
        self._free: list[_Instance] = []
        self._loading = Lock()  # as FMPy changes the working directory for a moment
        is_single = self.interface.canBeInstantiatedOnlyOncePerProcess
        self._turn = Lock() if is_single else nullcontext()
        atexit.register(self._close)

    def variable(self, name: str) -> Any:
        """Return the description of a scalar number, or raise a ValueError."""
        if name not in self.variables:
            close = get_close_matches(str(name), self.variables, 5, 0.5) or [*self.variables][:5]
            raise ValueError(
                f"{self.name} has no variable {name!r}; expected one such as {', '.join(close)}."
            )
        variable = self.variables[name]
        if variable.shape or variable.type in ("String", "Binary", "Clock"):
            found = f"an array of shape {variable.shape}" if variable.shape else variable.type
            raise ValueError(f"Expected {name!r} of {self.name} as one number; found {found}.")
        return variable

    def check_settable(self, name: str) -> None:
        """Raise a ValueError if a simulation cannot begin at a value of this variable."""
        from fmpy.simulation import settable_in_initialization_mode, settable_in_instantiated

        variable = self.variable(name)
        is_state = self.kind == "ModelExchange" and name in self.states
        if not (
            is_state
            or settable_in_instantiated(variable)
            or settable_in_initialization_mode(variable)
        ):
            raise ValueError(
                f"{self.name} permits no start value of {name!r}: it has causality "
                f"{variable.causality!r}, variability {variable.variability!r} and initial "
                f"{variable.initial!r}. Name the parameter of its start value, or export the FMU "
                "with initial='exact' for it, or for model exchange, whose states can be set."
            )

    @property
    def step(self) -> float | None:
        """The communication step that the FMU names."""
        experiment = self.description.defaultExperiment
        step = getattr(self.interface, "fixedInternalStepSize", None)
        step = step or getattr(experiment, "stepSize", None)
        return None if step is None else float(step)

    def unit(self, name: str) -> str:
        """Return the unit of a variable, or an empty text."""
        variable = self.variable(name)
        return variable.unit or getattr(variable.declaredType, "unit", None) or ""

    def simulate(
        self,
        values: Mapping[str, float],
        points: NDArray[np.float64],
        held: Sequence[Mapping[str, float]],
        tolerance: float,
        outputs: Sequence[str],
        found: dict[int, Any],
    ) -> None:
        """Simulate from the first of the ``points`` in time to the last, and store outputs.

        Args:
            values: Start values and parameters by name.
            points: Ascending times.
            held: Values of inputs from each point to the next, for all points; empty for none.
            tolerance: The relative tolerance of the integration.
            outputs: The variables to read.
            found: Numbers of points, to which it adds the values of the outputs there; after an
                error those after it are None.
        """
        times: list[float] = points.tolist()
        with self._instance() as instance:
            instance.begin(values, times[0], times[-1], tolerance)
            if self.kind == "CoSimulation":
                run = instance.steps(times, held)
            else:
                states = {name: values[name] for name in self.states if name in values}
                run = instance.integrate(times, held, tolerance, states)
            for i, _ in enumerate(run):
                if i == 0:
                    instance.check(values)
                if i in found:
                    found[i] = [instance.get(name) for name in outputs]
            instance.fmu.terminate()

    @contextmanager
    def _instance(self) -> Iterator[_Instance]:
        """Lend an instance, as if it were new; after an error it is not used again."""
        with self._turn:
            _written().clear()
            instance = self._ready()
            try:
                yield instance
            except BaseException as error:
                instance.close(getattr(error, "status", None) == _FATAL)
                error.stderr = "; ".join(_written())  # type: ignore[attr-defined]
                raise
            self._free.append(instance)

    def _ready(self) -> _Instance:
        """Return an instance that waited, reset, or a new one."""
        with suppress(IndexError):
            while True:
                instance = self._free.pop()
                try:
                    instance.fmu.reset()
                    return instance
                except Exception:
                    instance.close()
        with self._loading:
            return _Instance(self)

    def _close(self) -> None:
        """Free all instances, and remove the folder."""
        if os.getpid() != self._process:
            return
        for instance in self._free:
            instance.close()
        shutil.rmtree(self.folder, ignore_errors=True)


@cache
def _opened(path: Path, kind: str | None, changed: float, process: int) -> FMU:
    return FMU(path, kind)


def opened(path: Path, kind: str | None = None) -> FMU:
    """Return the FMU of a file, of which a process has one, until the file changes."""
    return _opened(path, kind, path.stat().st_mtime, os.getpid())


def _written() -> list[str]:
    """Return the last messages that FMUs wrote in this thread."""
    if not hasattr(_thread, "messages"):
        _thread.messages = []
    return _thread.messages


def _log(*message: Any) -> None:
    """Keep a message, whose text is the last argument."""
    _written()[:-4] = []
    _written().append(message[-1].decode(errors="replace").strip())


class _Instance:
    """An instance of an FMU."""

    def __init__(self, owner: FMU) -> None:
        from fmpy import instantiate_fmu

        self.owner = owner
        self._solver: Any = None
        self._error: Exception | None = None
        try:
            self.fmu = instantiate_fmu(owner.folder, owner.description, owner.kind, logger=_log)
        except Exception as error:
            error.stderr = "; ".join(_written())  # type: ignore[attr-defined]
            raise
        # For FMI 2 FMPy has one logger for all FMUs, that of the last instance, alive or not.
        _kept.append(self.fmu.callbacks)

    def begin(
        self, values: Mapping[str, float], start: float, stop: float, tolerance: float
    ) -> None:
        """Initialise at a time, with the values that can be set before."""
        from fmpy.simulation import settable_in_initialization_mode, settable_in_instantiated

        fmu, is_2 = self.fmu, self.owner.version == 2
        experiment = {"tolerance": tolerance, "startTime": start}
        if stop > start:
            experiment["stopTime"] = stop
        if is_2:
            fmu.setupExperiment(**experiment)
        left = self.set(values, settable_in_instantiated)
        fmu.enterInitializationMode(**({} if is_2 else experiment))
        self.set(left, settable_in_initialization_mode)
        fmu.exitInitializationMode()

    def get(self, name: str) -> float:
        """Return the present value of a variable."""
        variable = self.owner.variables[name]
        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self.owner.version == 2 else "Int64"
        return float(getattr(self.fmu, f"get{kind}")([variable.valueReference])[0])

    def set(
        self, values: Mapping[str, float], settable: Callable[[Any], bool] | None = None
    ) -> dict[str, float]:
        """Set the values of variables that can be set now; return the others."""
        from fmpy.simulation import apply_start_values

        description = SimpleNamespace(  # as FMPy goes through all variables of one
            modelVariables=[self.owner.variables[name] for name in values],
            unitDefinitions=[],
            fmiVersion=self.owner.description.fmiVersion,
        )
        return apply_start_values(self.fmu, description, dict(values), settable)

    def check(self, values: Mapping[str, float]) -> None:
        """Raise a ValueError if a variable is not at the value to which it was set."""
        for name, value in values.items():
            found = self.get(name)
            if not abs(found - value) <= 1e-6 * max(1.0, abs(value)):
                raise ValueError(
                    f"{name!r} is {found:g} after its start value was set to {value:g}: the FMU "
                    "computes it or rounds it. Take a variable that is free, such as the parameter "
                    "of its start value"
                )

    def steps(self, times: list[float], held: Sequence[Mapping[str, float]]) -> Iterator[None]:
        """Co-simulation from time to time, by steps of the FMU's own solver."""
        if held:
            self.set(held[0])
        yield
        for i, (time, following) in enumerate(pairwise(times)):
            if held:
                self.set(held[i])
            ended = self.fmu.doStep(time, following - time)  # a status of FMI 3
            if ended and any(ended[1:3]):
                raise RuntimeError(f"the FMU ended the simulation at t = {ended[3]:g}")
            yield

    def integrate(
        self,
        times: list[float],
        held: Sequence[Mapping[str, float]],
        tolerance: float,
        states: Mapping[str, float],
    ) -> Iterator[None]:
        """Model exchange from time to time, by FMPy's CVode, with events."""
        fmu, time, num_events = self.fmu, times[0], 0
        if held:
            self.set(held[0])
        next_event = self._update()
        if any(self.get(name) != value for name, value in states.items()):
            self._set_states(states)
            fmu.enterEventMode()
            next_event = self._update()
        solver = self._solver_of(tolerance, time)
        yield
        for i, following in enumerate(times[1:]):
            if held and held[i] != held[i - 1]:
                fmu.enterEventMode()
                self.set(held[i])
                next_event = self._update()
                solver.reset(time)
            while following - time > 1e-12 * max(1.0, abs(following)):
                try:
                    is_event, _, time = solver.step(time, min(following, next_event))
                finally:
                    if self._error is not None:
                        raise self._error
                fmu.setTime(time)
                if self.owner.interface.needsCompletedIntegratorStep:
                    is_own, is_end = fmu.completedIntegratorStep()
                    if is_end:
                        raise RuntimeError(f"the FMU ended the simulation at t = {time:g}")
                    is_event = is_event or is_own
                if is_event or time >= next_event:
                    num_events += 1
                    if num_events > _MOST_EVENTS:
                        raise RuntimeError(f"more than {_MOST_EVENTS} events until t = {time:g}")
                    fmu.enterEventMode()
                    next_event = self._update()
                    solver.reset(time)
            yield

    def close(self, is_dead: bool = False) -> None:
        """Free the instance, unless it is dead."""
        if not is_dead:
            with suppress(Exception):
                self.fmu.freeInstance()

    def _update(self) -> float:
        """Iterate discrete states until they stay; return the time of the next event."""
        fmu = self.fmu
        update = fmu.newDiscreteStates if self.owner.version == 2 else fmu.updateDiscreteStates
        is_needed = True
        while is_needed:
            is_needed, is_end, _, _, is_defined, next_time = update()
            if is_end:
                raise RuntimeError("the FMU ended the simulation at an event")
        fmu.enterContinuousTimeMode()
        return float(next_time) if is_defined else float("inf")

    def _set_states(self, values: Mapping[str, float]) -> None:
        """Set continuous states by name."""
        from ctypes import c_double

        x = (c_double * len(self.owner.states))()
        self.fmu.getContinuousStates(x, len(x))
        for name, value in values.items():
            x[self.owner.states.index(name)] = value
        self.fmu.setContinuousStates(x, len(x))

    def _kept(self, function: Callable[..., Any]) -> Callable[..., None]:
        """Return a function whose first error is kept, as CVode passes over an error in Python."""

        def call(*arguments: Any) -> None:
            try:
                if self._error is None:
                    function(*arguments)
            except Exception as error:
                self._error = error

        return call

    def _solver_of(self, tolerance: float, time: float) -> Any:
        """Return CVode at the present states."""
        from fmpy.simulation import Input
        from fmpy.sundials import CVodeSolver

        fmu, description = self.fmu, self.owner.description
        rates = "getDerivatives" if self.owner.version == 2 else "getContinuousStateDerivatives"
        if self._solver is None or self._solver.reltol != tolerance:
            self._solver = CVodeSolver(
                nx=description.numberOfContinuousStates,
                nz=description.numberOfEventIndicators,
                get_x=fmu.getContinuousStates,
                set_x=self._kept(fmu.setContinuousStates),
                get_dx=self._kept(getattr(fmu, rates)),
                get_z=self._kept(fmu.getEventIndicators),
                get_nominals=fmu.getNominalsOfContinuousStates,
                set_time=self._kept(fmu.setTime),
                input=Input(fmu, description, None),
                startTime=time,
                relativeTolerance=tolerance,
                maxNumSteps=_MOST_STEPS,
            )
        self._solver.reset(time)
        return self._solver
