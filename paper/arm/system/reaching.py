"""Reaching with the planar arm: its states, reward, starts and targets, and the system."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from gpadjust.physics import ODEPhysics
from gpadjust.states import StateSpec
from gpadjust.systems.system import System
from gpadjust.systems.wrappers import RememberAction
from paper.arm.system.torque_arm import ARM_TIME_STEP, BELIEVED_ARM, REAL_ARM

START_MEAN = (math.radians(35), math.radians(65))
START_STD = math.radians(5)
MAX_TARGET = math.radians(100)
SUBSTEPS = 40  # of 5 ms: the damping of the light forearm makes the equation stiff

ARM_SPEC = StateSpec(
    ["theta_s", "theta_e", "theta_s_dot", "theta_e_dot", "target_s", "target_e"],
    actions=["a1", "a2", "a3", "a4"],
    exogenous=["target_s", "target_e"],
    step=ARM_TIME_STEP,
)
"""The state of the reaching arm, in rad and s; the targets, which stay, are for the policy only.

Angles are not encoded: joint limits keep them from going round.
"""

ARM_MEMORY_SPEC = StateSpec(
    [*ARM_SPEC.states, "a1_last", "a2_last", "a3_last", "a4_last"],
    actions=ARM_SPEC.actions,
    exogenous=ARM_SPEC.exogenous,
    step=ARM_SPEC.step,
    previous={f"{name}_last": name for name in ARM_SPEC.actions},
)
"""The state of the reaching arm with the previous action, of ``RememberAction(MuscleArmEnv())``.

Muscles follow their excitations with a delay, so that the next state depends on the previous ones.
"""


def angle_error(states: Tensor) -> Tensor:
    """Return the angles' root mean square error, ``...`` in rad, of states ``... x 6`` or more."""
    return (states[..., :2] - states[..., 4:6]).square().mean(-1).sqrt()


def arm_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    r"""Return the reward of transitions, minus the error of the next states' angles in rad.

    .. math:: r = -\sqrt{\big((\theta_s - \theta_s^*)^2 + (\theta_e - \theta_e^*)^2\big) / 2}
    """
    return -angle_error(next_states)


def arm_start(n: int, spec: StateSpec = ARM_SPEC) -> Tensor:
    r"""Draw ``n x 6`` start states, at rest, and targets from PyTorch's generator.

    The angles are from :math:`\mathcal{N}((35°, 65°), (5°)^2 I)`, each angle of the targets from
    :math:`\mathcal{U}(0°, 100°)`. Previous actions of a spec that has them are zero.
    """
    angles = torch.tensor(START_MEAN, dtype=torch.float64)
    angles = angles + START_STD * torch.randn(n, 2, dtype=torch.float64)
    targets = MAX_TARGET * torch.rand(n, 2, dtype=torch.float64)
    before = angles.new_zeros(n, len(spec.previous))
    return torch.cat([angles, torch.zeros_like(angles), targets, before], dim=-1)


def arm_targets() -> Tensor:
    """Return the ``121 x 2`` targets, in rad, of the evaluation: 0, 10, ..., 100° each."""
    grid = torch.arange(0, 101, 10, dtype=torch.float64).deg2rad()
    return torch.cartesian_prod(grid, grid)


def hand_position(angles: Tensor) -> Tensor:
    """Return the position of the hand, ``... x 2`` in m, from the shoulder, by angles in rad.

    Example:
        >>> hand_position(torch.tensor([0.0, torch.pi / 2], dtype=torch.float64))
        tensor([0.3090, 0.3330], dtype=torch.float64)
    """
    upper, fore = REAL_ARM.lengths
    shoulder, both = angles[..., 0], angles[..., 0] + angles[..., 1]
    across = upper * shoulder.cos() + fore * both.cos()
    return torch.stack([across, upper * shoulder.sin() + fore * both.sin()], dim=-1)


def hand_distance_cm(states: Tensor) -> Tensor:
    """Return the distance ``...`` of the hand from its place at the target angles, in cm.

    Example:
        >>> hand_distance_cm(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, torch.pi]))
        tensor(66.6000)
    """
    gap = hand_position(states[..., :2]) - hand_position(states[..., 4:6])
    return 100 * gap.square().sum(-1).sqrt()


def arm(*, strength: float = 0.5, memory: bool = False, episode_length: int = 15) -> System:
    """Return the arm of six muscles that reaches; its physics has torques in their place.

    Its environment is :class:`MuscleArmEnv`. In the physics, which Runge-Kutta of order four
    integrates, the links are a tenth too heavy, the joints damped twice as much as the real ones;
    torques follow the actions at once, whatever the angles, and nothing limits the joints. Unlike
    the environment, it does not clip actions.

    Args:
        strength: The factor on the forces of the muscles, in (0, 2].
        memory: Whether the state has the previous action, by which the muscles' delay can be
            learnt.
        episode_length: In steps of 0.2 s.

    Example:
        >>> import torch
        >>> from paper.arm.system import arm
        >>> physics = arm().physics
        >>> physics(torch.tensor([[0.6, 1.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0]], dtype=torch.float64))
        tensor([[ 0.6902,  1.0405,  0.7442, -0.2988]], dtype=torch.float64)
    """
    spec = ARM_MEMORY_SPEC if memory else ARM_SPEC
    return System(
        partial(_make, memory, strength=strength, max_episode_steps=episode_length),
        spec,
        ODEPhysics(
            BELIEVED_ARM, step=ARM_TIME_STEP, state_dim=4, substeps=SUBSTEPS, name="torque_arm"
        ),
        arm_reward,
        start=partial(arm_start, spec=spec),
        episode_length=episode_length,
    )


def _make(memory: bool, **options: Any) -> gym.Env[Any, Any]:
    """Return the environment."""
    env = gym.make("MuscleArm-v0", **options)
    return RememberAction(env) if memory else env
