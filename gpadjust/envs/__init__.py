"""Systems to control, as Gymnasium environments and as physics.

To import this package registers the environments with Gymnasium; ``gym.make`` imports it by itself
where the id names it, as in ``gym.make("gpadjust.envs:gpadjust/CartPoleSwingUp-v0")``.
"""

try:
    import gymnasium as _gymnasium
except ImportError as error:
    raise ImportError('gpadjust.envs needs Gymnasium; run `pip install "gpadjust[rl]"`.') from error

from gpadjust.envs.arm_task import (
    ARM_MEMORY_SPEC,
    ARM_SPEC,
    arm_reward,
    arm_start,
    arm_targets,
    hand_distance_cm,
    hand_position,
)
from gpadjust.envs.cart_pole import (
    CART_POLE_RAW_SPEC,
    CART_POLE_SPEC,
    REAL_CART_POLE,
    CartPoleEquation,
    cart_pole_cost,
    cart_pole_physics,
    cart_pole_reward,
    cart_pole_start,
    random_cart_pole_physics,
)
from gpadjust.envs.cart_pole_swing_up import CartPoleSwingUpEnv
from gpadjust.envs.muscle_arm import MuscleArmEnv
from gpadjust.envs.opensim_arm import opensim_arm_physics
from gpadjust.envs.remember_action import RememberAction
from gpadjust.envs.torque_arm import REAL_ARM, ArmEquation, torque_arm, torque_arm_physics

_gymnasium.register(
    id="gpadjust/CartPoleSwingUp-v0",
    entry_point="gpadjust.envs.cart_pole_swing_up:CartPoleSwingUpEnv",
    max_episode_steps=25,
)
_gymnasium.register(
    id="gpadjust/MuscleArm-v0",
    entry_point="gpadjust.envs.muscle_arm:MuscleArmEnv",
    max_episode_steps=15,
)

__all__ = [
    "ARM_MEMORY_SPEC",
    "ARM_SPEC",
    "CART_POLE_RAW_SPEC",
    "CART_POLE_SPEC",
    "REAL_ARM",
    "REAL_CART_POLE",
    "ArmEquation",
    "CartPoleEquation",
    "CartPoleSwingUpEnv",
    "MuscleArmEnv",
    "RememberAction",
    "arm_reward",
    "arm_start",
    "arm_targets",
    "cart_pole_cost",
    "cart_pole_physics",
    "cart_pole_reward",
    "cart_pole_start",
    "hand_distance_cm",
    "hand_position",
    "opensim_arm_physics",
    "random_cart_pole_physics",
    "torque_arm",
    "torque_arm_physics",
]
