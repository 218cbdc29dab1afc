"""The arm of six muscles that OpenSim computes: its environment, its physics, both as a system.

To import this package registers the environment with Gymnasium; in a clone ``gym.make`` imports it
by itself where the id names it, as in ``gym.make("paper.arm.system:MuscleArm-v0")``.
"""

import gymnasium as _gymnasium

from paper.arm.system.muscle_arm import MuscleArmEnv
from paper.arm.system.reaching import arm, hand_distance_cm, hand_position
from paper.arm.system.torque_arm import ArmEquation

_gymnasium.register(
    id="MuscleArm-v0",
    entry_point="paper.arm.system.muscle_arm:MuscleArmEnv",
    max_episode_steps=15,
)

__all__ = ["ArmEquation", "MuscleArmEnv", "arm", "hand_distance_cm", "hand_position"]
