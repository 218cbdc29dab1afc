"""Systems to control: each an environment, and what is known of it, in one object.

To import this package registers the environment with Gymnasium; ``gym.make`` imports it by itself
where the id names it, as in ``gym.make("gpadjust.systems:gpadjust/CartPoleSwingUp-v0")``.

A step that failed, as where a simulator could not integrate, truncates the episode and says
``info["step_failed"] = True``: its observation and reward are no data, and no learner of this
library takes them as such. Environments of your own may say so, too.
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
    "CartPoleEquation",
    "CartPoleSwingUpEnv",
    "NoisySensors",
    "RememberAction",
    "System",
    "cart_pole",
]
