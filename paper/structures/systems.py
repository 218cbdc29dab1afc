"""Transitions to learn from and to be scored at: of simulated systems, and of records."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.dynamics import Trajectories
from gpadjust.physics import ODEPhysics, Physics
from gpadjust.records import Records
from gpadjust.states import StateSpec
from gpadjust.systems import CartPoleSwingUpEnv, cart_pole
from gpadjust.systems.swing_up import CART_POLE_SPEC
from paper.arm.system import MuscleArmEnv, arm
from paper.arm.system.reaching import ARM_SPEC
from paper.machines.pendulums import Rates, double_pendulum, pendulum, sums_of_masses
from paper.machines.records import folder_of
from paper.structures import ARM, SIMULATED

CONTROL_STEP = 0.04  # s
_TEST_SEED = 20_000  # no run has it
_EPISODE = {"arm": 15, "cart-pole": 25}  # steps, as the environments' ids have them
_TRAIN = {"pendulum": ("energy_shaping",), "double-pendulum": ("00", "02", "03")}
_TEST = {"pendulum": ("sac",), "double-pendulum": ("01", "12", "13")}
_SPECS = {
    "pendulum": StateSpec(["q", "dq"], ["u"], angles=["q"]),
    "double-pendulum": StateSpec(["q1", "q2", "dq1", "dq2"], ["u1", "u2"], angles=["q1", "q2"]),
}
_MOVES = 0.3  # rad/s; the simple pendulum is at rest for much of its record


class System(NamedTuple):
    """What dynamics learn from, and what they are scored at.

    Attributes:
        spec: What states and actions are.
        physics: f_p, from states and actions to next states.
        train: Transitions to learn from.
        test: Others.
    """

    spec: StateSpec
    physics: Physics
    train: Trajectories
    test: Trajectories


def system(name: str, n: int, num_test: int, seed: int) -> System:
    """The transitions of a run: ``n`` to learn from, of the seed, and those that all are scored at.

    A smaller ``n`` takes the first ones of a larger one. Of a simulated system they are those of
    whole episodes with uniform actions, drawn anew for each step; of a real machine they are
    spread at random over the records, without overlap.

    Raises:
        ValueError: If the records have fewer.
    """
    if name in SIMULATED:
        physics: Any = arm().physics if name == ARM else cart_pole(seed).physics
        spec = ARM_SPEC if name == ARM else CART_POLE_SPEC
        return System(spec, physics, episodes(name, n, seed), episodes(name, num_test, _TEST_SEED))
    known = recorded(name, _TRAIN[name])
    if n > len(known.states):
        raise ValueError(f"The records of the {name} have {len(known.states)} transitions, not {n}")
    order = torch.randperm(len(known.states), generator=torch.Generator().manual_seed(seed))
    test = recorded(name, _TEST[name])
    if name == "pendulum":
        moves = test.states[:, 1].abs() > _MOVES
        test = Trajectories(*(part[moves] for part in test))
    physics = pendulum_physics() if name == "pendulum" else double_pendulum_physics()
    return System(_SPECS[name], physics, Trajectories(*(part[order[:n]] for part in known)), test)


@cache
def episodes(name: str, n: int, seed: int) -> Trajectories:
    """The first ``n`` transitions of episodes with uniform actions, drawn anew for each step."""
    env: Any = MuscleArmEnv() if name == ARM else CartPoleSwingUpEnv()
    space = env.action_space
    generator = np.random.default_rng(seed)
    found: list[tuple[NDArray[np.float64], ...]] = []
    env.reset(seed=seed)
    while len(found) < n:
        env.reset()
        for _ in range(_EPISODE[name]):
            before, action = env.state, generator.uniform(space.low, space.high)
            failed = env.step(action)[3]
            if failed:
                break
            found.append((before, action, env.state))
    return Trajectories(
        *(torch.from_numpy(np.stack(part[:n])) for part in zip(*found, strict=True))
    )


@cache
def recorded(name: str, numbers: tuple[str, ...]) -> Trajectories:
    """The transitions of 40 ms of records, one after the other, without overlap.

    The actions are means over the 40 ms.
    """
    pendulum = name == "pendulum"
    file = "{}.csv" if pendulum else "A0_20220815_{}.csv"
    folder = folder_of(name.replace("-", "_"))
    files = [folder / file.format(number) for number in numbers]
    records = Records.read_csv(files, _SPECS[name], segment="segment" if pendulum else None)
    return records.trajectories(CONTROL_STEP)


def pendulum_physics() -> ODEPhysics:
    """A point mass on a rod, of the authors' mass and length, without friction."""
    mass, length = 0.6755, 0.5
    known = {"inertia": mass * length**2, "moment": mass * length, "viscous": 0.0, "coulomb": 0.0}
    return _step(pendulum, known, 2, "pendulum")


def double_pendulum_physics() -> ODEPhysics:
    """Two rigid links with the parameters of the authors' first model, without friction."""
    known = sums_of_masses((0.608, 0.0547, 0.275), (0.630, 0.0252, 0.166), 0.3, rotor=0.0)
    return _step(double_pendulum, known, 4, "double_pendulum")


def _step(rates: Rates, parameters: Mapping[str, float], dim: int, name: str) -> ODEPhysics:
    def known(state: Tensor, action: Tensor) -> Tensor:
        return rates(state, action, parameters)

    return ODEPhysics(known, step=CONTROL_STEP, state_dim=dim, substeps=4, name=name)
