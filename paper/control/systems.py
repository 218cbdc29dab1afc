"""Systems that people know: the real one with friction, drag or losses, and an f_p without."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.physics import Unknown
from gpadjust.states import StateSpec
from paper.control import equations
from paper.control.machine import Machine
from paper.machines.pendulums import DOUBLE_PENDULUM


def _wrapped(angle: Tensor) -> Tensor:
    return torch.atan2(angle.sin(), angle.cos())


def _near(*errors: Tensor) -> Tensor:
    """Return the reward of errors in units in which they are large: 0 if none, -1 if any is."""
    return torch.expm1(-torch.stack(errors).square().sum(0))


def pendulum_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return Pendulum-v1's reward of the next state, divided by its largest cost."""
    theta, rate = _wrapped(next_states[:, 0]), next_states[:, 1]
    cost = theta.square() + 0.1 * rate.square() + 0.001 * actions[:, 0].square()
    return -cost / (math.pi**2 + 0.1 * 8**2 + 0.001 * 2**2)


_FRICTION = {"viscous": 0.05, "dry": 0.2}
_STARTS = ([math.pi - 0.2, -0.2], [math.pi + 0.2, 0.2])


class FrictionPendulumEnv(PendulumEnv):
    """Gymnasium's Pendulum-v1 from hanging, with friction: a torque is held for ten short steps.

    It observes sine and cosine in the order of a spec.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.dt = 0.01
        self.max_torque = 10.0  # of its own steps, where friction comes on top

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start from hanging, nearly at rest."""
        super().reset(seed=seed)
        self.state = self.np_random.uniform(*_STARTS)
        return self._get_obs(), {}

    def step(self, u: NDArray[Any]) -> Any:
        """Hold a torque."""
        torque = np.asarray(u, dtype=float).clip(*(-2.0, 2.0))
        before = self.state
        for _ in range(10):
            lost = equations.friction(torch.tensor(self.state[1:]), _FRICTION)
            super().step(torque - lost.numpy())
        rows = (torch.from_numpy(each)[None] for each in (before, torque, self.state))
        return self._get_obs(), pendulum_reward(*rows).item(), False, False, {}

    def _get_obs(self) -> NDArray[np.float32]:
        cos, sin, rate = super()._get_obs()
        return np.array([sin, cos, rate])


PENDULUM = Machine(
    StateSpec(["theta", "theta_dot"], ["torque"], angles=["theta"], step=0.1),
    equations.pendulum,
    true={"mass": 1.0, "length": 1.0, **_FRICTION},
    believed={
        "mass": Unknown(1.3, factor=1.5, unit="kg"),
        "length": Unknown(1.0, factor=1.1, unit="m"),
        "viscous": Unknown(0.0, sd=0.1, unit="N m s"),
    },
    reward=pendulum_reward,
    actions=([-2.0], [2.0]),
    starts=_STARTS,
    episode_length=50,
    env=FrictionPendulumEnv,
)
"""Gymnasium's Pendulum-v1 with friction, from hanging; f_p is 30 % too heavy and has none.

Torques of at most 2 N m, held for 0.1 s, an episode of 5 s.
"""


def furuta_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return a reward of the pendulum's angle from upright and the arm's from its start."""
    return _near(_wrapped(next_states[:, 1]) / 2, next_states[:, 0] / 2)


FURUTA = Machine(
    StateSpec(
        ["arm", "theta", "arm_dot", "theta_dot"], ["voltage"], angles=["theta"], step=0.04
    ),
    equations.furuta,
    true={
        "mass": 0.024, "length": 0.129, "arm_mass": 0.095, "arm_length": 0.085,
        "torque": 0.042 / 8.4, "induced": 0.042, "viscous": 0.0001, "dry": 0.0015, "joint": 5e-5,
    },
    believed={
        "mass": Unknown(0.03, factor=1.5, unit="kg"),
        "length": Unknown(0.129, factor=1.1, unit="m"),
        "arm_mass": Unknown(0.08, factor=1.5, unit="kg"),
        "arm_length": Unknown(0.085, factor=1.1, unit="m"),
        "torque": Unknown(0.006, factor=1.5, unit="N m/V"),
        "viscous": Unknown(0.0, sd=0.0005, unit="N m s"),
    },
    reward=furuta_reward,
    actions=([-10.0], [10.0]),
    starts=([-0.1, math.pi - 0.1, -0.1, -0.1], [0.1, math.pi + 0.1, 0.1, 0.1]),
    episode_length=40,
)  # fmt: skip
"""A Furuta pendulum of a QUBE-Servo's size; f_p lacks friction and the induced voltage.

Masses and torque of f_p are 16 to 25 % off. At most 10 V, held for 0.04 s, an episode of 1.6 s.
"""


def quadrotor_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return a reward of the distance from the origin and the speed of turning."""
    x, z, _, _, _, turn = next_states.unbind(-1)
    return _near(x, z, turn / 10)


QUADROTOR = Machine(
    StateSpec(
        ["x", "z", "phi", "x_dot", "z_dot", "phi_dot"],
        ["left", "right"],
        angles=["phi"],
        step=0.05,
    ),
    equations.quadrotor,
    true={"mass": 0.5, "arm": 0.15, "inertia": 0.006, "drag": 0.2, "turning_drag": 0.005},
    believed={
        "mass": Unknown(0.4, factor=1.5, unit="kg"),
        "arm": Unknown(0.18, factor=1.5, unit="m"),
        "inertia": Unknown(0.006, factor=1.5, unit="kg m²"),
        "turning_drag": Unknown(0.0, sd=0.01, unit="N m s"),
    },
    reward=quadrotor_reward,
    actions=([0.0, 0.0], [6.0, 6.0]),
    starts=([-1.0, -1.0, -0.3, -0.5, -0.5, -0.5], [1.0, 1.0, 0.3, 0.5, 0.5, 0.5]),
    episode_length=40,
)
"""A planar quadrotor that flies to the origin; f_p lacks drag, and is a fifth too light.

Thrusts of at most 6 N each, held for 0.05 s, an episode of 2 s.
"""


def double_pendulum_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return a reward of the angles of both links from upright."""
    first, second = next_states[:, 0] - math.pi, next_states[:, :2].sum(-1) - math.pi
    return _near(_wrapped(first) / 2, _wrapped(second) / 2)


def _pendubot(state: Tensor, action: Tensor, p: Mapping[str, Any]) -> Tensor:
    return DOUBLE_PENDULUM.rates(state, torch.cat([action, 0 * action], dim=-1), p)


PENDUBOT = Machine(
    StateSpec(["q1", "q2", "dq1", "dq2"], ["torque"], angles=["q1", "q2"], step=0.05),
    _pendubot,
    true=DOUBLE_PENDULUM.known["identified"],
    believed={
        name: known
        for name, known in DOUBLE_PENDULUM.unknowns.items()
        if not name.startswith(("viscous", "coulomb"))
    }
    | {f"viscous_{i}": Unknown(0.0, sd=0.05, unit="N m s") for i in (1, 2)},
    reward=double_pendulum_reward,
    actions=([-10.0], [10.0]),
    starts=([-0.1] * 4, [0.1] * 4),
    episode_length=40,
    substeps=3,
)
"""RealAIGym's pendubot, hanging at first: two links, of which the first alone has a drive.

The real one has the identified parameters of the makers' design A.0 with Coulomb friction, f_p
masses and inertias that are 15 % off, and no friction. At most 10 N m, held for 0.05 s, an episode
of 2 s.
"""


def tanks_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return a reward of the distance of the lower level from its set-point."""
    return _near((next_states[:, 1] - next_states[:, 2]) / 2)


TANKS = Machine(
    StateSpec(["upper", "lower", "set_point"], ["pump"], exogenous=["set_point"], step=5.0),
    equations.tanks,
    true={
        "pump": 0.08, "upper_outflow": 0.14, "lower_outflow": 0.12,
        "back_pressure": 0.05, "overflow": 0.3,
    },
    believed={
        "pump": Unknown(0.1, factor=1.5, unit="cm/(V s)"),
        "upper_outflow": Unknown(0.18, factor=1.5, unit="cm^0.5/s"),
        "lower_outflow": Unknown(0.16, factor=1.5, unit="cm^0.5/s"),
    },
    reward=tanks_reward,
    actions=([0.0], [10.0]),
    starts=([1.0, 1.0, 2.0], [2.0, 2.0, 7.0]),
    episode_length=30,
    bounds=([-1.0] * 3, [15.0] * 3),  # the tanks' height
)  # fmt: skip
"""Two tanks below each other, whose lower level is to come to a set-point of the episode.

The pump of the real one loses against the pressure, and the tanks can flow over; f_p lacks both,
and its flows are 25 to 33 % too strong. At most 10 V, held for 5 s, an episode of 150 s.
"""


MACHINES = {
    "pendulum": PENDULUM,
    "furuta": FURUTA,
    "quadrotor": QUADROTOR,
    "double_pendulum": PENDUBOT,
    "tanks": TANKS,
}
