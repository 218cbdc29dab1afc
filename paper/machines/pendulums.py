"""The pendulums: an equation of motion each, and parameters that were published."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.states import StateSpec

STEP = 0.05  # s, of control
SUBSTEPS = 10  # at 4 its RK4 comes near its limit: friction that sets in is stiff
_GRAVITY = 9.81
_GEAR = 6.0
_LENGTH = 0.3  # m, of the first link
_SLIDES = 0.05  # rad/s, at which Coulomb friction is three quarters of its value
FRICTION = {
    "viscous": Unknown(0.01, factor=5.0, unit="N m s"),
    "coulomb": Unknown(0.1, factor=3.0, unit="N m"),
}
"""Prior knowledge of friction in drives of this size."""

Parameters = Mapping[str, float]
Rates = Callable[[Tensor, Tensor, Mapping[str, Any]], Tensor]


@dataclass(frozen=True)
class Machine:
    """A machine, and what was published of it."""

    spec: StateSpec  # what states and actions are; the scores are of the last angle first of all
    # The equation of motion: the time derivatives `N x state_dim` of states `N x state_dim`
    # under actions `N x action_dim`, with parameters by name, each `N` or a number.
    rates: Rates
    # Parameters by what is known: `"crude"`, as someone has them who knows the machine a little,
    # and `"identified"`, by experiments.
    known: Mapping[str, Parameters]

    @property
    def unknowns(self) -> dict[str, Unknown]:
        """Its parameters with what someone knows beforehand who has the crude ones.

        Masses and inertias are known within a factor of 1.5 or so, of friction the order of
        magnitude only.
        """
        return {
            name: FRICTION.get(name.rpartition("_")[0] or name, Unknown(value or 1.0, factor=1.5))
            for name, value in self.known["crude"].items()
        }

    def physics(self, parameters: str | Parameters = "unknown") -> ODEPhysics:
        """Return the physics of a step, its parameters unknown, by the name of a set, or given."""
        options: dict[str, Any] = {
            "step": STEP,
            "state_dim": self.spec.state_dim,
            "substeps": SUBSTEPS,
            "name": self.rates.__name__,
        }
        if parameters == "unknown":
            return ODEPhysics(self.rates, unknowns=self.unknowns, **options)
        given = self.known[parameters] if isinstance(parameters, str) else parameters
        values = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in given.items()}
        return ODEPhysics(lambda state, action: self.rates(state, action, values), **options)


def _friction(rate: Tensor, viscous: Any, coulomb: Any) -> Tensor:
    return viscous * rate + coulomb * (rate / _SLIDES).tanh()


def double_pendulum(state: Tensor, action: Tensor, p: Mapping[str, Any]) -> Tensor:
    """Return the rates of two links with geared drives, by nine sums of masses.

    ``inertia_1`` is :math:`I_1 + m_2 l_1^2`, ``inertia_2`` :math:`I_2`, ``moment_1``
    :math:`m_1 r_1 + m_2 l_1` and ``moment_2`` :math:`m_2 r_2`, with inertias about the joints, and
    ``rotor`` the inertia of a rotor. Source: the makers' ``docs/text/dynamics.rst``, but for the
    form of the friction.
    """
    q1, q2, dq1, dq2 = state.unbind(-1)
    coupling = _LENGTH * p["moment_2"]
    across = p["inertia_2"] + coupling * q2.cos()
    whole = p["inertia_1"] + coupling * q2.cos() + across + (_GEAR**2 + 1) * p["rotor"]
    across = across - _GEAR * p["rotor"]
    fore = p["inertia_2"] + _GEAR**2 * p["rotor"]
    swing = coupling * q2.sin()
    both = _GRAVITY * p["moment_2"] * (q1 + q2).sin()
    torque_1 = action[:, 0] + swing * (2 * dq1 + dq2) * dq2 - both
    torque_1 = torque_1 - _GRAVITY * p["moment_1"] * q1.sin()
    torque_1 = torque_1 - _friction(dq1, p["viscous_1"], p["coulomb_1"])
    torque_2 = action[:, 1] - swing * dq1.square() - both
    torque_2 = torque_2 - _friction(dq2, p["viscous_2"], p["coulomb_2"])
    size = whole * fore - across.square()
    ddq1 = (fore * torque_1 - across * torque_2) / size
    ddq2 = (whole * torque_2 - across * torque_1) / size
    return torch.stack([dq1, dq2, ddq1, ddq2], dim=-1)


def pendulum(state: Tensor, action: Tensor, p: Mapping[str, Any]) -> Tensor:
    """Return the rates of a rigid body on a drive, of ``moment`` :math:`m l`, with friction."""
    q, dq = state.unbind(-1)
    torque = action[:, 0] - _GRAVITY * p["moment"] * q.sin()
    torque = torque - _friction(dq, p["viscous"], p["coulomb"])
    return torch.stack([dq, torque / p["inertia"]], dim=-1)


def sums_of_masses(
    first: tuple[float, float, float], second: tuple[float, float, float], *friction: float
) -> Parameters:
    """Return the parameters of a double pendulum by masses, inertias and centers of its links.

    Friction is viscous and Coulomb of the first joint, then of the second.
    """
    (mass_1, inertia_1, center_1), (mass_2, inertia_2, center_2) = first, second
    names = ("viscous_1", "coulomb_1", "viscous_2", "coulomb_2")
    return {
        "inertia_1": inertia_1 + mass_2 * _LENGTH**2,
        "inertia_2": inertia_2,
        "moment_1": mass_1 * center_1 + mass_2 * _LENGTH,
        "moment_2": mass_2 * center_2,
        "rotor": 7.66e-5,
        **dict(zip(names, friction, strict=True)),
    }


# The makers' model 2.0 of design A.0; their Coulomb friction, c arctan(100 q'), is c pi / 2 where
# it slides. The crude one has masses and inertias of the first link 15 % too small, of the second
# 15 % too large, and no friction.
DOUBLE_PENDULUM = Machine(
    StateSpec(["q1", "q2", "dq1", "dq2"], ["u1", "u2"], angles=["q1", "q2"]),
    double_pendulum,
    {
        "crude": sums_of_masses(
            (0.85 * 0.5594, 0.85 * 0.05347, 0.3), (1.15 * 0.6043, 1.15 * 0.02392, 0.1838),
            *(0.0, 0.0, 0.0, 0.0),
        ),
        "identified": sums_of_masses(
            (0.5594, 0.05347, 0.3), (0.6043, 0.02392, 0.1838),
            *(0.001, 0.093 * math.pi / 2, 0.001, 0.078 * math.pi / 2),
        ),
    },
)  # fmt: skip

PENDULUM = Machine(
    StateSpec(["q", "dq"], ["u"], angles=["q"]),
    pendulum,
    {
        # The makers' file: 0.6755 kg at 0.5 m.
        "crude": {
            "inertia": 0.6755 * 0.5**2,
            "moment": 0.6755 * 0.5,
            "viscous": 0.1,
            "coulomb": 0.0,
        },
        # By free runs of these records, as the makers' identified values are off by a factor of 3.
        "identified": {"inertia": 0.19, "moment": 0.372, "viscous": 0.01, "coulomb": 0.15},
    },
)
