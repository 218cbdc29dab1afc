"""Systems to control, as Gymnasium environments and as physics.

To import this package registers the environments with Gymnasium; ``gym.make`` imports it by itself
where the id names it, as in ``gym.make("gpadjust.envs:gpadjust/CartPoleSwingUp-v0")``.
"""

try:
    import gymnasium as _gymnasium
except ImportError as error:
    raise ImportError('gpadjust.envs needs Gymnasium; run `pip install "gpadjust[rl]"`.') from error

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

_gymnasium.register(
    id="gpadjust/CartPoleSwingUp-v0",
    entry_point="gpadjust.envs.cart_pole_swing_up:CartPoleSwingUpEnv",
    max_episode_steps=25,
)

__all__ = [
    "CART_POLE_RAW_SPEC",
    "CART_POLE_SPEC",
    "REAL_CART_POLE",
    "CartPoleEquation",
    "CartPoleSwingUpEnv",
    "cart_pole_cost",
    "cart_pole_physics",
    "cart_pole_reward",
    "cart_pole_start",
    "random_cart_pole_physics",
]
