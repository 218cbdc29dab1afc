"""Reaching with an arm of six muscles, as a Gymnasium environment."""

from __future__ import annotations

import math
import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.checks import checked_options, finite_array
from gpadjust.systems.rendering import RENDER_MODES, ViewedEnv
from paper.arm.system.opensim import (
    MUSCLES,
    NUM_EXCITED,
    REST_ACTIVATION,
    ArmSimulation,
    build_muscle_arm,
)
from paper.arm.system.reaching import (
    MAX_TARGET,
    START_MEAN,
    START_STD,
    angle_error,
    hand_distance_cm,
)
from paper.arm.system.torque_arm import ARM_TIME_STEP, REAL_ARM
from paper.arm.system.view import SIZE, draw_arm

# The arm itself stays within 3 rad and 20 rad/s.
HIGH = np.array([2 * math.pi, 2 * math.pi, 100, 100, 2 * math.pi, 2 * math.pi], dtype=np.float32)


class MuscleArmEnv(ViewedEnv):
    r"""Reach for targets with a planar arm, by exciting four of its six muscles.

    OpenSim computes the arm: Hill-type muscles with rigid tendons, joint damping and limits. The
    action, excitations in [0, 1] of biceps, long head of triceps, anterior and posterior deltoid,
    is held for 0.2 s; others are clipped. Brachialis and the lateral head of triceps are passive.
    Muscles follow their excitations with a delay, and their activations are hidden.

    The observation is :math:`[\theta_s, \theta_e, \dot\theta_s, \dot\theta_e, \theta_s^*,
    \theta_e^*]`: angles of shoulder and elbow in rad, their velocities in rad/s, and the angles to
    reach; ``state`` has it in float64, ``activations`` the six activations. The reward is minus the
    root mean square error of the angles that were reached, in rad; the ``info`` of a step has
    ``"hand_distance_cm"``, from the hand to where it should be. An episode does not terminate;
    ``gym.make`` truncates it after 15 steps. It starts at rest around 35° and 65° with a standard
    deviation of 5°, targets are from U(0°, 100°) each.

    The ``info`` of each step has ``"step_failed"``. Should an integration fail it is True, and the
    step warns and truncates the episode. Its observation and reward are then those of the state
    before, and are no data.

    Environments can be pickled at any time and go on as they were, with their random state.

    Args:
        render_mode: ``"rgb_array"``, which needs ``pygame-ce``.
        strength: The factor on the forces of the muscles, in (0, 2]. Electrical stimulation
            recruits part of a muscle; 1 is a healthy arm's.
        accuracy: The relative accuracy of the integrator, in (0, 1).

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("paper.arm.system:MuscleArm-v0")
        >>> observation, info = env.reset(
        ...     options={"state": [0.6, 1.1, 0.0, 0.0], "target": [1.0, 1.1]}
        ... )
        >>> observation
        array([0.6, 1.1, 0. , 0. , 1. , 1.1], dtype=float32)
        >>> excite_deltoid = np.array([0.0, 0.0, 0.5, 0.0], dtype=np.float32)
        >>> observation, reward, terminated, truncated, info = env.step(excite_deltoid)
        >>> bool(observation[0] > 0.7)
        True
    """

    size = SIZE
    metadata = {"render_modes": RENDER_MODES, "render_fps": round(1 / ARM_TIME_STEP)}  # noqa: RUF012

    def __init__(
        self, render_mode: str | None = None, *, strength: float = 0.5, accuracy: float = 1e-5
    ) -> None:
        super().__init__(render_mode)
        self.simulation = ArmSimulation(partial(build_muscle_arm, REAL_ARM, strength), accuracy)
        self.observation_space = gym.spaces.Box(-HIGH, HIGH, dtype=np.float32)
        self.action_space = gym.spaces.Box(0.0, 1.0, (NUM_EXCITED,), dtype=np.float32)
        self.activations = np.full(len(MUSCLES), REST_ACTIVATION)
        self._failed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode, the muscles relaxed.

        Args:
            seed: For the random start and target, and those that follow.
            options: ``"state"``, the two angles and velocities to start from, and ``"target"``, the
                two angles to reach, in rad and s. Default of each: drawn.

        Raises:
            ValueError: If ``options`` has another key, or other numbers than these.
        """
        super().reset(seed=seed)
        options = checked_options("options", options, ("state", "target"))
        # Both are drawn in any case, so that an option does not change the other one.
        angles = self.np_random.normal(START_MEAN, START_STD)
        target = self.np_random.uniform(0, MAX_TARGET, 2)
        start = np.concatenate([angles, np.zeros(2)])
        if "state" in options:
            names = "theta_s, theta_e, theta_s_dot and theta_e_dot"
            start = _checked(options["state"], "state", names, HIGH[:4])
        if "target" in options:
            target = _checked(options["target"], "target", "target_s and target_e", HIGH[4:])
        self.state = np.concatenate([start, target])
        self.activations = np.full(len(MUSCLES), REST_ACTIVATION)
        self._failed = False
        return self.state.astype(np.float32), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Excite the muscles for 0.2 s.

        Raises:
            ValueError: If the action is not four finite numbers.
            gymnasium.error.ResetNeeded: If no episode was started, or the integration failed.
        """
        if self.state is None or self._failed:
            why = "after a failed integration" if self._failed else "before the first step"
            raise gym.error.ResetNeeded(f"Call reset {why}.")
        excitations = finite_array(action, (NUM_EXCITED,))
        if excitations is None:
            raise ValueError(
                f"The action must be four finite excitations, of shape (4,); found {action!r}."
            )
        start = np.concatenate([self.state[:4], self.activations])
        try:
            end = self.simulation.step(start, excitations.clip(0, 1))
        except RuntimeError as error:
            self._failed = True
            warnings.warn(
                f"OpenSim failed to integrate the arm from {start.round(3).tolist()}, so the "
                f"episode is truncated; reset starts another. {str(error).strip()}",
                UserWarning,
                stacklevel=2,
            )
        else:
            self.state = np.concatenate([end[:4], self.state[4:]])
            self.activations = end[4:]
        state = torch.from_numpy(self.state)
        reward = -angle_error(state).item()
        info = {"hand_distance_cm": hand_distance_cm(state).item(), "step_failed": self._failed}
        return self.state.astype(np.float32), reward, False, self._failed, info

    def _draw(self, canvas: Any, state: NDArray[np.float64]) -> None:
        draw_arm(canvas, state, self.activations)


def _checked(value: Any, option: str, names: str, high: NDArray[np.float32]) -> NDArray[np.float64]:
    numbers = finite_array(value, high.shape)
    if numbers is None or (np.abs(numbers) > high).any():
        bounds = ", ".join(f"{bound:.4g}" for bound in high)
        raise ValueError(
            f"options[{option!r}] must be the {len(high)} numbers {names}, of magnitude at most "
            f"{bounds} (rad and rad/s); found {value!r}."
        )
    return numbers
