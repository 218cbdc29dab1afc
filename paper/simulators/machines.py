"""Two machines as MJCFs, and their logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gpadjust.physics import MujocoPhysics, Unknown
from gpadjust.records import Record, Records

STEP = 0.01  # s
_HELD = 25  # rows for which a torque is held

PENDULUM = """<mujoco><option timestep="0.002"/><worldbody>
<body name="link"><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
</body></worldbody>
<actuator><motor name="torque" joint="hinge"/></actuator>
<sensor><jointpos name="hinge" joint="hinge"/></sensor></mujoco>"""

# Each motor turns its link by a spring, at the same place.
ARM = """<mujoco><option timestep="0.002"/><worldbody>
<body name="rotor1"><joint name="motor1" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="0.2" diaginertia="0.01 0.01 0.01"/>
  <body name="link1"><joint name="flex1" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
    <body name="rotor2" pos="0 0 -0.3"><joint name="motor2" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="0.2" diaginertia="0.005 0.005 0.005"/>
      <body name="link2"><joint name="flex2" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.5"/>
</body></body></body></body></worldbody>
<actuator><motor name="torque1" joint="motor1"/><motor name="torque2" joint="motor2"/></actuator>
<sensor><jointpos name="motor1" joint="motor1"/><jointpos name="flex1" joint="flex1"/>
<jointpos name="motor2" joint="motor2"/><jointpos name="flex2" joint="flex2"/></sensor></mujoco>"""


@dataclass(frozen=True)
class Machine:
    """A machine of which angles are measured, and rates are not.

    Attributes:
        mjcf: Its model, without dry friction.
        unknowns: The parameters; true ones are drawn from their priors.
        friction: The dry friction of joints, in N m.
        torques: Standard deviations of the torques, in N m.
        start: The first angles, in rad, at rest.
        noise: Of the measured angles, in rad.
    """

    mjcf: str
    unknowns: Mapping[str, Unknown]
    friction: Mapping[str, float]
    torques: tuple[float, ...]
    start: tuple[float, ...]
    noise: float

    def physics(self, **more: Unknown) -> MujocoPhysics:
        """Return the physics of the MJCF, with further unknown parameters."""
        return MujocoPhysics(self.mjcf, step=STEP, unknowns={**self.unknowns, **more}, threads=1)


MACHINES = {
    "pendulum": Machine(
        PENDULUM,
        {
            "link.mass": Unknown(0.5, factor=1.5, unit="kg"),
            "hinge.damping": Unknown(0.05, factor=1.5, unit="N m s"),
        },
        {"hinge.frictionloss": 0.02},
        (0.8,),
        (0.5,),
        0.005,
    ),
    "arm": Machine(
        ARM,
        {
            "link2.mass": Unknown(0.5, factor=1.3, unit="kg"),
            "flex1.stiffness": Unknown(30.0, factor=1.5, unit="N m"),
            "flex2.stiffness": Unknown(10.0, factor=1.5, unit="N m"),
            "motor1.damping": Unknown(0.2, factor=1.5, unit="N m s"),
            "motor2.damping": Unknown(0.1, factor=1.5, unit="N m s"),
        },
        {"motor1.frictionloss": 0.1, "motor2.frictionloss": 0.05},
        (2.0, 0.7),
        (0.0, 0.0, 0.0, 0.0),
        0.002,
    ),
}


@dataclass(frozen=True)
class Log:
    """A log of a machine, of ``n`` rows, and what is true of it."""

    records: Records
    torques: Tensor  # n x a
    states: Tensor  # without noise, n x d
    true: Mapping[str, float]


def log_of(machine: Machine, has_friction: bool, rows: int, seed: int) -> Log:
    """Draw the parameters, and the log, of a seed."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    friction = {name: Unknown(value, factor=2.0) for name, value in machine.friction.items()}
    real = machine.physics(**friction if has_friction else {})
    true = real.unknowns.guess
    known = len(machine.unknowns)
    true[:known] = machine.physics().unknowns.to_values(normal(known))
    torques = normal(rows // _HELD + 1, len(machine.torques)).repeat_interleave(_HELD, 0)[:rows]
    torques = torques * torch.tensor(machine.torques)
    angles = len(machine.start)
    states = [torch.tensor([[*machine.start, *[0.0] * angles]], dtype=torch.float64)]
    for torque in torques[:-1]:
        states.append(real(torch.cat([states[-1], torque[None]], -1), true))
    path = torch.cat(states)
    measured = path + machine.noise * normal(*path.shape)
    measured[:, angles:] = torch.nan
    record = Record(STEP * torch.arange(rows, dtype=torch.float64), measured, torques)
    named = dict(zip(machine.unknowns, true[:known].tolist(), strict=True))
    return Log(Records(record, real.spec), torques, path, named)
