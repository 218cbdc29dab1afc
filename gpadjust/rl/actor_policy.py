"""Actors of Stable-Baselines3 as policies that a search improves."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import SAC, TD3
from torch import Tensor, nn

from gpadjust.control import BoundedPolicy
from gpadjust.states import StateSpec


def actor_policy(agent: SAC | TD3, spec: StateSpec) -> BoundedPolicy:
    """The actor of an agent as a policy that shares its parameters: who improves it improves both.

    Args:
        agent: SAC, TD3, DDPG, or a descendant such as :class:`DynaSAC`; its observations are those
            of the spec.
        spec: What the entries of states and actions are.

    Raises:
        TypeError: If the agent has no such actor.
        ValueError: If its observations or actions are as many as the spec's are not, or it
            normalises observations.

    Example:
        >>> import torch
        >>> from gpadjust.control import PolicySearch, Task
        >>> from gpadjust.dynamics import PhysicsDynamics
        >>> from gpadjust.systems.swing_up import CART_POLE_SPEC, cart_pole_reward, cart_pole_start
        >>> from gpadjust.systems import cart_pole
        >>> from gpadjust.rl import actor_policy
        >>> from stable_baselines3 import SAC
        >>> agent = SAC("MlpPolicy", "gpadjust/CartPoleSwingUp-v0", seed=0)
        >>> physics = PhysicsDynamics(CART_POLE_SPEC, cart_pole(0).physics)
        >>> task = Task(
        ...     physics, cart_pole_reward, initial_states=cart_pole_start, episode_length=5
        ... )
        >>> search = PolicySearch(updates=2, num_starts=4)
        >>> len(search.improve(actor_policy(agent, CART_POLE_SPEC), task).values)
        2
    """
    if not isinstance(agent, SAC | TD3):
        raise TypeError(f"Expected an agent such as SAC or TD3, found {type(agent).__name__}.")
    found = (agent.observation_space.shape, agent.action_space.shape)
    expected = ((spec.observation_dim,), (spec.action_dim,))
    if found != expected:
        raise ValueError(
            f"Expected an agent with observations and actions of shapes {expected}, those of the "
            f"spec; found {found}."
        )
    if agent.get_vec_normalize_env() is not None:
        raise ValueError(
            "The agent's environment normalises observations (VecNormalize), which a model does "
            "not; train it without."
        )
    space: Any = agent.action_space
    bounds = torch.stack([torch.from_numpy(bound) for bound in (space.low, space.high)])
    policy = BoundedPolicy(_Body(agent.actor), spec, bounds)
    return policy.to(agent.device)


class _Body(nn.Module):
    """An actor without its last tanh, from observations in double precision to the same."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observations: Tensor) -> Tensor:
        """Return the arguments of the actor's tanh, ``N x action_dim``."""
        actor = self.actor
        features = actor.extract_features(observations.float(), actor.features_extractor)
        if hasattr(actor, "latent_pi"):  # SAC
            mean: Tensor = actor.mu(actor.latent_pi(features))
            return mean.double()
        raw: Tensor = actor.mu[:-1](features)
        return raw.double()
