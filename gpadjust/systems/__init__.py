"""Systems to control: environment, physics and task in one object.

The import of this package registers the environment with Gymnasium; ``gym.make`` imports it if the
id has its name, as in ``gym.make("gpadjust.systems:gpadjust/CartPoleSwingUp-v0")``.

A failed step, for example of a simulator that could not integrate, truncates the episode and sets
``info["step_failed"] = True``: no learner of this library uses its observation and reward.
Environments of your own may set it, too.
"""

try:
    import gymnasium as _gymnasium
except ImportError as error:
    raise ImportError(
        'gpadjust.systems needs Gymnasium; run `pip install "gpadjust[control]"`.'
    ) from error

from gpadjust.systems.swing_up import CartPoleEquation, CartPoleSwingUpEnv, cart_pole
from gpadjust.systems.system import System
from gpadjust.systems.wrappers import NoisySensors, RememberAction

_gymnasium.register(
    id="gpadjust/CartPoleSwingUp-v0",
    entry_point="gpadjust.systems.swing_up:CartPoleSwingUpEnv",
    max_episode_steps=25,
)

__all__ = [
    "RememberAction",
    "System",
    "cart_pole",
]
