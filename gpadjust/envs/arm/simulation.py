"""Integration of the arm by OpenSim."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpadjust.checks import checked_number
from gpadjust.envs.arm.opensim_model import controls, load_opensim
from gpadjust.envs.arm.torque_arm import ARM_TIME_STEP


class ArmSimulation:
    """The arm in OpenSim, integrated for 0.2 s at a time by Runge-Kutta-Merson.

    A step depends on its arguments alone. The simulation can be pickled and copied: the model is
    built anew.

    Args:
        build: Returns the ``opensim.Model`` with its inputs, as :func:`build_muscle_arm` and
            :func:`build_torque_arm` do (:mod:`gpadjust.envs.arm.opensim_model`): a
            ``functools.partial`` of one of these can be pickled.
        accuracy: The relative accuracy of the integrator.

    Raises:
        ImportError: If ``opensim`` is missing.
        TypeError: If accuracy is no number.
        ValueError: If accuracy is not in (0, 1), or ``build`` refuses its arguments.

    Example:
        >>> from functools import partial
        >>> from gpadjust.envs.arm.opensim_model import build_torque_arm
        >>> from gpadjust.envs.arm.torque_arm import REAL_ARM
        >>> simulation = ArmSimulation(partial(build_torque_arm, REAL_ARM), accuracy=1e-6)
        >>> simulation.step(np.array([0.6, 1.1, 0.0, 0.0]), np.zeros(2)).round(6)
        array([0.6, 1.1, 0. , 0. ])
    """

    def __init__(self, build: Callable[[], Any], accuracy: float) -> None:
        checked_number("accuracy", accuracy, above=0, below=1)
        self.build = build
        self.accuracy = accuracy
        self._start_anew()

    def step(self, state: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """The state after 0.2 s.

        Args:
            state: Angles and velocities, then the six activations if there are muscles.
            inputs: Excitations of the four driven muscles, or torques of shoulder and elbow in N m.

        Raises:
            RuntimeError: If the integration fails, or ends in numbers that are not finite.
        """
        with self._lock:
            for constant, value in zip(self._controls, inputs.tolist(), strict=True):
                constant.setValue(value)
            for i, value in enumerate(state.tolist()):
                self._vector.set(i, value)
            self._start.setTime(0.0)
            self._start.setY(self._vector)
            self._manager.initialize(self._start)
            # Copied at once: what OpenSim returns is a reference.
            end = np.array(self._manager.integrate(ARM_TIME_STEP).getY().to_numpy())
        if not np.isfinite(end).all():
            raise RuntimeError("The integration ended in NaN or inf.")
        return end

    def _start_anew(self) -> None:
        self._lock = Lock()
        opensim = load_opensim()
        self._model = self.build()
        self._start = self._model.initSystem()
        self._controls = controls(self._model)
        self._vector = opensim.Vector(self._start.getNY(), 0.0)
        self._manager = opensim.Manager(self._model)
        self._manager.setWriteToStorage(False)
        self._manager.setPerformAnalyses(False)
        # In this order: a new method forgets the accuracy.
        self._manager.setIntegratorMethod(opensim.Manager.IntegratorMethod_RungeKuttaMerson)
        self._manager.setIntegratorAccuracy(self.accuracy)

    def __getstate__(self) -> dict[str, Any]:
        return {"build": self.build, "accuracy": self.accuracy}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start_anew()
