"""Systems to control, as Gymnasium environments and as physics.

To import this package registers the environments with Gymnasium; ``gym.make`` imports it by itself
where the id names it, as in ``gym.make("gpadjust.envs:gpadjust/CartPoleSwingUp-v0")``.

A step that failed, as where a simulator could not integrate, truncates the episode and says
``info["step_failed"] = True``: its observation and reward are no data, and no learner of this
library takes them as such. Environments of your own may say so, too.
"""

try:
    import gymnasium as _gymnasium
except ImportError as error:
    raise ImportError('gpadjust.envs needs Gymnasium; run `pip install "gpadjust[rl]"`.') from error

from gpadjust.envs.arm.muscle_arm import MuscleArmEnv
from gpadjust.envs.arm.opensim_physics import opensim_arm_physics
from gpadjust.envs.arm.task import (
    ARM_MEMORY_SPEC,
    ARM_SPEC,
    arm_reward,
    arm_start,
    arm_targets,
    hand_distance_cm,
    hand_position,
)
from gpadjust.envs.arm.torque_arm import REAL_ARM, ArmEquation, torque_arm, torque_arm_physics
from gpadjust.envs.cart_pole.swing_up import CartPoleSwingUpEnv
from gpadjust.envs.cart_pole.system import (
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
from gpadjust.envs.remember_action import RememberAction

_gymnasium.register(
    id="gpadjust/CartPoleSwingUp-v0",
    entry_point="gpadjust.envs.cart_pole.swing_up:CartPoleSwingUpEnv",
    max_episode_steps=25,
)
_gymnasium.register(
    id="gpadjust/MuscleArm-v0",
    entry_point="gpadjust.envs.arm.muscle_arm:MuscleArmEnv",
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
