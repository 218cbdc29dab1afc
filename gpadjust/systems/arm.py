"""The muscle arm as a system: reaching for targets, with a physics of torques."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import gymnasium as gym

from gpadjust.physics import Physics, Unknown
from gpadjust.systems.reaching import ARM_MEMORY_SPEC, ARM_SPEC, arm_reward, arm_start
from gpadjust.systems.system import System
from gpadjust.systems.torque_arm import SUBSTEPS, torque_arm, torque_arm_physics
from gpadjust.systems.wrappers import NoisySensors, RememberAction


def arm(
    *,
    strength: float = 0.5,
    gains: tuple[float, float] = (8.0, 4.0),
    memory: bool = False,
    noise: Mapping[str, float] | None = None,
    unknowns: bool = False,
    opensim: bool = False,
    substeps: int = SUBSTEPS,
    gradient: Literal["autograd", "finite-difference"] = "autograd",
    episode_length: int = 15,
) -> System:
    """Reaching with an arm of six muscles; its physics has torques in their place.

    Its environment is :class:`MuscleArmEnv`. In the physics the links are a tenth too heavy, the
    joints damped twice as much as the real ones; torques follow the actions at once, whatever the
    angles, and nothing limits the joints.

    Args:
        strength: The factor on the forces of the muscles, in (0, 2].
        gains: The torques of full actions at shoulder and elbow that the physics has, in N m. The
            default suits strength 0.5; (5, 2.5) suits 0.3.
        memory: Whether the state has the previous action (:class:`RememberAction`), by which the
            muscles' delay can be learnt.
        noise: Standard deviations of the sensors' noise, by the name of the state.
        unknowns: Whether the physics has four unknown parameters: ``forearm`` (a factor on its mass
            and inertia), ``damping``, ``shoulder_gain``, ``elbow_gain``.
        opensim: Whether OpenSim computes the physics, as a black box, a row at a time. The two
            agree to 1e-5 rad.
        substeps: Integration steps, of 5 ms by default. With 8 (which err by 2e-4 rad) and
            ``gradient="finite-difference"`` a gradient along an episode takes a tenth of the time.
        gradient: As of :class:`~gpadjust.physics.ODEPhysics`.
        episode_length: In steps of 0.2 s.

    Raises:
        ImportError: If ``opensim`` is asked for and missing.
        ValueError: If an option is out of range, or ``opensim`` is asked for with ``unknowns``.

    Example:
        >>> import torch
        >>> from gpadjust import systems
        >>> physics = systems.arm().physics
        >>> physics(torch.tensor([[0.6, 1.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0]], dtype=torch.float64))
        tensor([[ 0.6902,  1.0405,  0.7442, -0.2988]], dtype=torch.float64)
    """
    spec = ARM_MEMORY_SPEC if memory else ARM_SPEC
    physics: Physics
    if opensim:
        from gpadjust.systems.opensim import opensim_arm_physics

        if unknowns:
            raise ValueError("The physics by OpenSim has no unknown parameters; use opensim=False.")
        physics = opensim_arm_physics(gains)
    else:
        believed = torque_arm(gains)
        named = {
            "forearm": Unknown(1.0, factor=1.5),
            "damping": Unknown(believed.damping, factor=2.0, unit="N m s/rad"),
            "shoulder_gain": Unknown(max(believed.gains[0], 0.1), factor=2.0, unit="N m"),
            "elbow_gain": Unknown(max(believed.gains[1], 0.1), factor=2.0, unit="N m"),
        }
        physics = torque_arm_physics(
            believed, substeps=substeps, gradient=gradient, unknowns=named if unknowns else None
        )
    return System(
        partial(_make, strength, memory, noise, episode_length),
        spec,
        physics,
        arm_reward,
        start=partial(arm_start, spec=spec),
        episode_length=episode_length,
    )


def _make(
    strength: float,
    memory: bool,
    noise: Mapping[str, float] | None,
    episode_length: int,
    **options: Any,
) -> gym.Env[Any, Any]:
    """The environment."""
    name = "gpadjust/MuscleArm-v0"
    env = gym.make(name, max_episode_steps=episode_length, strength=strength, **options)
    env = RememberAction(env) if memory else env
    return NoisySensors(env, ARM_MEMORY_SPEC if memory else ARM_SPEC, noise) if noise else env
