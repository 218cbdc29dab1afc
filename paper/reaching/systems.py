"""Arms with noisy sensors, and physics with its parameters fitted."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gpadjust.dynamics import PhysicsDynamics, Trajectories
from gpadjust.envs import ARM_MEMORY_SPEC, ARM_SPEC, MuscleArmEnv, RememberAction
from gpadjust.envs.arm.torque_arm import ARM_TIME_STEP, ArmEquation, torque_arm
from gpadjust.physics import ODEPhysics
from gpadjust.states import StateSpec
from paper.planning.systems import least_squares_fit
from paper.reaching import SENSORS, Settings

GAINS = {"strength": (16.0, 8.0)}
"""The torques that f_p believes in, of the arms for which these are not the usual ones."""

_SD = np.array([SENSORS["angles"]] * 2 + [SENSORS["velocities"]] * 2)


class Sensors(gym.ObservationWrapper[Any, Any, Any]):
    """Observations of the arm with noise; its reward is that of the true state."""

    def observation(self, observation: Any) -> Any:
        """Add the noise to angles and velocities, by the environment's generator."""
        return with_noise(observation, self.unwrapped.np_random)


def with_noise(observation: NDArray[Any], random: np.random.Generator) -> NDArray[np.float32]:
    """Observations ``... x 6`` or more as noisy sensors have them."""
    seen = observation.astype(np.float64)
    seen[..., :4] += _SD * random.normal(size=seen[..., :4].shape)
    return seen.astype(np.float32)


class NoisyPolicy:
    """A policy that sees what noisy sensors say.

    Args:
        policy: The policy, with Stable-Baselines3's ``predict``.
        seed: Of the noise.
    """

    def __init__(self, policy: Any, seed: int) -> None:
        self.policy = policy
        self.random = np.random.default_rng(seed)

    def predict(
        self, observation: NDArray[np.float32], *, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for a batch of observations."""
        seen = with_noise(observation, self.random)
        found: tuple[NDArray[np.float32], Any] = self.policy.predict(
            seen, deterministic=deterministic
        )
        return found


def environment(system: str, settings: Settings) -> gym.Env[Any, Any]:
    """The real arm."""
    env: gym.Env[Any, Any] = MuscleArmEnv(strength=settings.strength)
    if system == "memory":
        env = RememberAction(env)
    env = Sensors(env) if system == "sensors" else env
    return gym.wrappers.TimeLimit(env, settings.episode_length)


def spec_of(system: str) -> StateSpec:
    """What the entries of its states are."""
    return ARM_MEMORY_SPEC if system == "memory" else ARM_SPEC


def believed(system: str) -> ArmEquation:
    """The equation of f_p."""
    return torque_arm(GAINS[system]) if system in GAINS else torque_arm()


def as_physics(equation: Any, settings: Settings) -> ODEPhysics:
    """A time step of an equation of motion."""
    return ODEPhysics(
        equation,
        step=ARM_TIME_STEP,
        state_dim=4,
        substeps=settings.substeps,
        name="torque_arm",
        gradient="finite-difference",
    )


class LearntArm(nn.Module):
    """The arm's equation of motion with the forearm's mass, damping and strengths to be learnt.

    The upper arm's mass stays: were all as many times as large, the arm would move as before.

    Args:
        start: Where they begin.
    """

    def __init__(self, start: ArmEquation) -> None:
        super().__init__()
        self.start = start
        self.logs = nn.Parameter(torch.zeros(4, dtype=torch.float64))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """The time derivative of the state."""
        fore, damping, shoulder, elbow = self.logs.exp()
        start, factors = self.start, (1.0, fore)
        values = {
            **asdict(start),
            "masses": tuple(f * m for f, m in zip(factors, start.masses, strict=True)),
            "inertias": tuple(f * i for f, i in zip(factors, start.inertias, strict=True)),
            "damping": damping * start.damping,
            "gains": (shoulder * start.gains[0], elbow * start.gains[1]),
        }
        known = object.__new__(ArmEquation)
        for name, value in values.items():
            object.__setattr__(known, name, value)  # tensors, which its checks would refuse
        return known(state, action)


class FittedArm(PhysicsDynamics):
    """f_p alone, its parameters fitted to all transitions, by least squares of one step.

    Args:
        spec: What the entries of states are.
        start: The equation whose parameters they are at first.
        settings: How it is integrated.
    """

    def __init__(self, spec: StateSpec, start: ArmEquation, settings: Settings) -> None:
        self.equation = LearntArm(start).requires_grad_(False)
        super().__init__(spec, as_physics(self.equation, settings))
        self._data: Trajectories | None = None

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit the parameters to these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        truth = (data.next_states - data.states)[:, :4]
        scale = truth.square().mean(0).sqrt()
        rows = torch.cat([data.states[:, :4], data.actions], dim=-1)

        def residuals() -> Tensor:
            return (data.states[:, :4] + truth - self.physics(rows)) / scale

        least_squares_fit(self.equation.logs, residuals)
        self.physics.forget()
