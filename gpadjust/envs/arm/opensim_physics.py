"""The arm with torques as a black box, integrated by OpenSim."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from gpadjust.envs.arm.opensim_model import build_torque_arm
from gpadjust.envs.arm.simulation import ArmSimulation
from gpadjust.envs.arm.torque_arm import ArmEquation, torque_arm
from gpadjust.physics import BlackBoxPhysics

FD_STEP = 1e-3  # in rad, rad/s and 1: far above the error of the integration


def opensim_arm_physics(
    gains: tuple[float, float] = (8.0, 4.0), accuracy: float = 1e-6
) -> BlackBoxPhysics:
    """The physics of :func:`torque_arm_physics`, computed by OpenSim, a row at a time.

    The two agree to 1e-5 rad. In parallel it runs in processes (``joblib``'s ``loky``): threads
    take turns.

    Args:
        gains: The torques of full actions at shoulder and elbow, in N m. The default suits muscles
            of strength 0.5, which is the environment's; (5, 2.5) suits 0.3.
        accuracy: The relative accuracy of the integrator.

    Returns:
        A physics of columns ``[theta_s, theta_e, theta_s_dot, theta_e_dot, a1, a2, a3, a4]``, in
        rad and s, with gradients by finite differences.

    Raises:
        ImportError: If ``opensim`` is missing.
        ValueError: If the gains are not two finite numbers that are not negative, or ``accuracy``
            is not in (0, 1).

    Example:
        >>> import torch
        >>> physics = opensim_arm_physics()
        >>> physics(torch.tensor([[0.6, 1.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0]], dtype=torch.float64))
        tensor([[ 0.6902,  1.0405,  0.7442, -0.2988]], dtype=torch.float64)
    """
    step = _TorqueStep(torque_arm(gains), accuracy)
    return BlackBoxPhysics(step, batched=False, fd_step=FD_STEP, name="opensim_arm")


class _TorqueStep:
    """A step of one row; a light pickle, as each process keeps the models it has built."""

    def __init__(self, equation: ArmEquation, accuracy: float) -> None:
        self.equation = equation
        self.accuracy = accuracy
        _simulation(equation, accuracy)  # bad arguments are found now

    def __call__(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        if row.shape != (8,):
            raise ValueError(f"expected rows of 4 states and 4 actions; found shape {row.shape}")
        a1, a2, a3, a4 = row[4:]
        torques = np.array(self.equation.gains) * (a3 - a4, a1 - a2)
        return _simulation(self.equation, self.accuracy).step(row[:4], torques)


@lru_cache(maxsize=8)
def _simulation(equation: ArmEquation, accuracy: float) -> ArmSimulation:
    return ArmSimulation(partial(build_torque_arm, equation), accuracy)
