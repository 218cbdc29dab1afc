"""The Dyna agents."""

from __future__ import annotations

from stable_baselines3 import SAC, TD3

from gpadjust.rl.dyna import Dyna


class DynaSAC(Dyna, SAC):
    """Soft actor-critic that also trains inside a dynamics model, see :class:`Dyna`.

    One whose model never serves (``DynaOptions(last_model_episode=0)``) is Stable-Baselines3's
    ``SAC``, bit for bit.

    Example:
        >>> import gymnasium
        >>> from gpadjust.control import Task
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> from gpadjust.systems import cart_pole
        >>> from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward
        >>> from gpadjust.rl import DynaOptions, DynaSAC
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> dynamics = LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics)
        >>> task = Task(dynamics, cart_pole_reward)
        >>> agent = DynaSAC("MlpPolicy", env, task, DynaOptions(model_episodes=2), seed=0)
        >>> agent.learn(total_timesteps=25).num_episodes
        1
    """


class DynaTD3(Dyna, TD3):
    """TD3 that also trains inside a dynamics model, see :class:`Dyna`.

    Its policy is deterministic: pass ``action_noise``, without which it explores neither the real
    system nor the model. Particles have noise of their own.

    Example:
        >>> import gymnasium
        >>> import numpy as np
        >>> from stable_baselines3.common.noise import NormalActionNoise
        >>> from gpadjust.control import Task
        >>> from gpadjust.dynamics import PhysicsDynamics
        >>> from gpadjust.systems import cart_pole
        >>> from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward
        >>> from gpadjust.rl import DynaOptions, DynaTD3
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> dynamics = PhysicsDynamics(CART_POLE_SPEC, cart_pole(0).physics)
        >>> task = Task(dynamics, cart_pole_reward)
        >>> noise = NormalActionNoise(np.zeros(1), 0.2 * np.ones(1))
        >>> options = DynaOptions(model_episodes=2)
        >>> agent = DynaTD3("MlpPolicy", env, task, options, action_noise=noise, seed=0)
        >>> agent.learn(total_timesteps=25).num_episodes
        1
    """
