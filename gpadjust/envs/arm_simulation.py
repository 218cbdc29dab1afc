"""Integration of the arm by OpenSim."""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpadjust.envs.torque_arm import ARM_TIME_STEP, ArmEquation
from gpadjust.envs.opensim_model import (
    build_muscle_arm,
    build_torque_arm,
    controls,
    load_opensim,
)

MAX_STRENGTH = 2.0  # beyond, the arm breaks through its joint limits


class ArmSimulation:
    """The arm in OpenSim, integrated for 0.2 s at a time by Runge-Kutta-Merson.

    A step depends on its arguments alone. The simulation can be pickled and copied: the model is
    built anew.

    Args:
        equation: The links; its gains are not used.
        strength: The factor on the forces of six muscles; None for torques in their place.
        accuracy: The relative accuracy of the integrator.

    Raises:
        ImportError: If ``opensim`` is missing.
        ValueError: If strength is not in (0, 2] or accuracy not in (0, 1).
    """

    def __init__(self, equation: ArmEquation, strength: float | None, accuracy: float) -> None:
        if strength is not None and not 0 < strength <= MAX_STRENGTH:
            raise ValueError(
                f"strength must be in (0, {MAX_STRENGTH:g}], where 1 is a healthy arm's; found "
                f"{strength}."
            )
        if not 0 < accuracy < 1:
            raise ValueError(f"accuracy must be in (0, 1), such as 1e-5; found {accuracy}.")
        self.equation = equation
        self.strength = strength
        self.accuracy = accuracy
        self._build()

    def step(self, state: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """The state after 0.2 s.

        Args:
            state: Angles and velocities, then the six activations if there are muscles.
            inputs: Excitations of the four driven muscles, or torques of shoulder and elbow.

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

    def _build(self) -> None:
        self._lock = Lock()
        opensim = load_opensim()
        if self.strength is None:
            self._model, controller = build_torque_arm(self.equation)
        else:
            self._model, controller = build_muscle_arm(self.equation, self.strength)
        self._start = self._model.initSystem()
        self._controls = controls(controller)
        self._vector = opensim.Vector(self._start.getNY(), 0.0)
        self._manager = opensim.Manager(self._model)
        self._manager.setWriteToStorage(False)
        self._manager.setPerformAnalyses(False)
        # In this order: a new method forgets the accuracy.
        self._manager.setIntegratorMethod(opensim.Manager.IntegratorMethod_RungeKuttaMerson)
        self._manager.setIntegratorAccuracy(self.accuracy)

    def __getstate__(self) -> dict[str, Any]:
        names = ("equation", "strength", "accuracy")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()
