"""The arm in OpenSim: a model with muscles, and its integration."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpadjust.checks import checked_number
from paper.arm.system.torque_arm import ARM_TIME_STEP, ArmEquation

JOINTS = ("shoulder", "elbow")
LIMITS = ((-20.0, 125.0), (-5.0, 145.0))  # degrees, of shoulder and elbow
SLACK_POSE = (math.radians(35), math.radians(65))  # where each fibre is at its optimum
REST_ACTIVATION = 0.01
MAX_STRENGTH = 2.0  # beyond, the arm breaks through its joint limits


@dataclass(frozen=True)
class Muscle:
    r"""A muscle of the arm; its path is as long as :math:`a + s (\theta_s - \pi/2) + e_1 \theta_e
    + e_2 \theta_e^2`.

    Its force is the isometric one at full strength, in N, its fibres' length the optimal one, in m.
    """  # noqa: D205

    name: str
    force: float
    fibre: float
    path: tuple[float, float, float, float]  # a, s, e_1 and e_2

    def length(self, shoulder: float, elbow: float) -> float:
        """Return the length of the path, in m, at angles in rad."""
        a, s, e_1, e_2 = self.path
        return a + s * (shoulder - math.pi / 2) + e_1 * elbow + e_2 * elbow**2


MUSCLES = (
    Muscle("biceps", 414, 0.137, (0.3329, -0.03, -0.016, -0.0057)),
    Muscle("triceps_long", 603, 0.127, (0.2989, 0.03, 0.030, -0.0032)),
    Muscle("deltoid_anterior", 838, 0.134, (0.1510, -0.03, 0.0, 0.0)),
    Muscle("deltoid_posterior", 1207, 0.140, (0.2322, 0.03, 0.0, 0.0)),
    Muscle("brachialis", 1422, 0.092, (0.2859, 0.0, -0.014, -0.0040)),
    Muscle("triceps_lateral", 1549, 0.093, (0.2355, 0.0, 0.025, -0.0022)),
)
"""Forces, fibres and moment arms after Nijhof and Kouwenhoven (2000).

Actions excite the first four, in this order; the last two are passive.
"""
NUM_EXCITED = 4


@lru_cache(maxsize=1)
def load_opensim() -> ModuleType:
    """Load OpenSim and silence it: else it prints, and writes ``opensim.log``.

    The first call switches the logger off, which is the process's own; later ones leave it alone,
    so that ``opensim.Logger.setLevelString("info")`` after the first arm was built lets it speak.

    Raises:
        ImportError: If it is missing. One that is installed but broken raises its own error.
    """
    libraries = os.environ.get("LD_LIBRARY_PATH")
    try:
        import opensim
    except ModuleNotFoundError as error:
        if error.name != "opensim":
            raise
        raise ImportError(
            'The muscle arm needs OpenSim; run `pip install "gpadjust[arm]"`.'
        ) from error
    finally:  # child processes would load OpenSim's CasADi in the place of their own
        os.environ.pop("LD_LIBRARY_PATH", None)
        if libraries is not None:
            os.environ["LD_LIBRARY_PATH"] = libraries
    opensim.Logger.setLevelString("off")
    return opensim


def build_muscle_arm(equation: ArmEquation, strength: float) -> Any:
    """Build the links of an equation with six muscles, of which four are excited.

    The state of this ``opensim.Model`` is angles, velocities and six activations; its inputs are
    the excitations. The strength is a factor on the forces of the muscles.
    """
    checked_number("strength", strength, above=0, most=MAX_STRENGTH)
    opensim = load_opensim()
    model = skeleton(opensim, equation)
    for joint, (low, high) in zip(JOINTS, LIMITS, strict=True):
        limit = opensim.CoordinateLimitForce(joint, high, 1.0, low, 1.0, 0.05, 10.0)
        limit.setName(f"{joint}_limit")
        model.addForce(limit)
    muscles = [_muscle(opensim, muscle, strength) for muscle in MUSCLES]
    for muscle in muscles:
        model.addForce(muscle)
    add_controller(opensim, model, muscles[:NUM_EXCITED])
    return model


def skeleton(opensim: ModuleType, equation: ArmEquation) -> Any:
    model = opensim.Model()
    model.setGravity(opensim.Vec3(0))  # the plane is level
    parent, origin = model.getGround(), opensim.Vec3(0)
    for i, joint_name in enumerate(JOINTS):
        inertia = equation.inertias[i]
        body = opensim.Body(
            f"link_{i}",
            equation.masses[i],
            opensim.Vec3(equation.centres[i], 0, 0),
            opensim.Inertia(inertia, inertia, inertia),
        )
        zero = opensim.Vec3(0)
        joint = opensim.PinJoint(f"{joint_name}_joint", parent, origin, zero, body, zero, zero)
        joint.updCoordinate().setName(joint_name)
        model.addBody(body)
        model.addJoint(joint)
        damping = opensim.SpringGeneralizedForce(joint_name)
        damping.setName(f"{joint_name}_damping")
        damping.setStiffness(0.0)
        damping.setViscosity(equation.damping)
        model.addForce(damping)
        parent, origin = body, opensim.Vec3(equation.lengths[i], 0, 0)
    return model


def _muscle(opensim: ModuleType, muscle: Muscle, strength: float) -> Any:
    force = opensim.DeGrooteFregly2016Muscle()
    force.setName(muscle.name)
    force.set_max_isometric_force(strength * muscle.force)
    force.set_optimal_fiber_length(muscle.fibre)
    force.set_tendon_slack_length(muscle.length(*SLACK_POSE) - muscle.fibre)
    force.set_pennation_angle_at_optimal(0.0)
    force.set_max_contraction_velocity(10.0)
    force.set_fiber_damping(0.0)
    force.set_passive_fiber_strain_at_one_norm_force(0.6)
    force.set_ignore_tendon_compliance(True)  # compliant tendons fail with Runge-Kutta-Merson
    # OpenSim holds the time constants of the first muscle of a process for all others in it.
    force.set_activation_time_constant(0.015)
    force.set_deactivation_time_constant(0.060)
    force.set_activation_dynamics_smoothing(10.0)  # the default, 0.1, makes muscles sluggish
    force.set_default_activation(REST_ACTIVATION)
    force.set_path(_path(opensim, muscle))
    return force


def _path(opensim: ModuleType, muscle: Muscle) -> Any:
    """Return a path as a polynomial: wrapping surfaces flip sides at large angles."""
    a, s, e_1, e_2 = muscle.path
    coefficients = opensim.Vector(6, 0.0)
    # of 1, e, e^2, s, s e, s^2
    for i, value in enumerate((a - s * math.pi / 2, e_1, e_2, s, 0.0, 0.0)):
        coefficients.set(i, value)
    names = opensim.StdVectorString()
    for joint in JOINTS:
        names.append(f"/jointset/{joint}_joint/{joint}")
    path = opensim.FunctionBasedPath()
    path.setName(f"{muscle.name}_path")
    path.setCoordinatePaths(names)
    path.setLengthFunction(opensim.MultivariatePolynomialFunction(coefficients, 2, 2))
    return path


def add_controller(opensim: ModuleType, model: Any, actuators: list[Any]) -> None:
    controller = opensim.PrescribedController()
    for actuator in actuators:
        controller.addActuator(actuator)
        controller.prescribeControlForActuator(actuator.getName(), opensim.Constant(0.0))
    model.addController(controller)


class ArmSimulation:
    """The arm in OpenSim, integrated for 0.2 s at a time by Runge-Kutta-Merson.

    A step depends on its arguments alone. The simulation can be pickled and copied: the model is
    built again.

    Args:
        build: Returns the ``opensim.Model`` with its inputs, as :func:`build_muscle_arm` does: a
            ``functools.partial`` of it can be pickled.
        accuracy: The relative accuracy of the integrator, in (0, 1).
    """

    def __init__(self, build: Callable[[], Any], accuracy: float) -> None:
        checked_number("accuracy", accuracy, above=0, below=1)
        self.build = build
        self.accuracy = accuracy
        self._start_anew()

    def step(self, state: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the state after 0.2 s.

        Args:
            state: Angles and velocities, then the six activations if there are muscles.
            inputs: Excitations of the four driven muscles.

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
        # Asked for after `initSystem`: the controller has copies of what it was given.
        controller = opensim.PrescribedController.safeDownCast(
            self._model.getControllerSet().get(0)
        )
        functions = controller.get_ControlFunctions()
        inputs = range(functions.getSize())
        self._controls = [opensim.Constant.safeDownCast(functions.get(i)) for i in inputs]
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
