"""A planar arm of two links: its equation of motion, driven by torques."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

ARM_TIME_STEP = 0.2


@dataclass(frozen=True)
class ArmEquation:
    r"""The equation of motion of a planar arm of two links, driven by torques at its joints.

    The plane is level, so there is no gravity. With the angles :math:`q = (\theta_s, \theta_e)` of
    shoulder and elbow (the elbow's relative to the upper arm; both grow with flexion), the masses
    :math:`m_i`, lengths :math:`l_i`, distances :math:`c_i` of the centers of mass from the proximal
    joints and moments of inertia :math:`I_i` about those centers,

    .. math::
        M(q)\, \ddot{q} &= \tau - d\, \dot{q} - b \sin\theta_e
            \begin{pmatrix} -2 \dot\theta_s \dot\theta_e - \dot\theta_e^2 \\ \dot\theta_s^2
            \end{pmatrix}, \qquad
        M = \begin{pmatrix} I_1 + m_1 c_1^2 + m_2 l_1^2 + j + 2 b \cos\theta_e
            & j + b \cos\theta_e \\ j + b \cos\theta_e & j \end{pmatrix}, \\
        j &= I_2 + m_2 c_2^2, \qquad b = m_2 l_1 c_2, \qquad
        \tau = \begin{pmatrix} g_s (a_3 - a_4) \\ g_e (a_1 - a_2) \end{pmatrix}

    (Spong, Hutchinson and Vidyasagar, "Robot Modeling and Control", 2006, sec. 7.3). The actions
    are those of the muscle arm: flexor and extensor of the elbow, then of the shoulder.

    Args:
        masses: The masses of upper arm and forearm with hand, in kg.
        lengths: Their lengths, in m.
        centres: The distances of their centers of mass from shoulder and elbow, in m.
        inertias: Their moments of inertia about the centers of mass, in kg m².
        damping: The damping :math:`d` of each joint, in N m s/rad.
        gains: The torques :math:`(g_s, g_e)` of a full action, in N m.

    Example:
        >>> equation = ArmEquation(gains=(8.0, 4.0))
        >>> rest = torch.zeros(1, 4, dtype=torch.float64)
        >>> equation(rest, torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64))
        tensor([[   0.0000,    0.0000,   84.8011, -193.4000]], dtype=torch.float64)
    """

    masses: tuple[float, float] = (1.82, 1.43)
    lengths: tuple[float, float] = (0.309, 0.333)
    centres: tuple[float, float] = (0.135, 0.165)
    inertias: tuple[float, float] = (0.018, 0.018)
    damping: float = 0.5
    gains: tuple[float, float] = (0.0, 0.0)

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the time derivative ``... x 4`` of the state.

        Args:
            state: ``... x 4``: angles and angular velocities of shoulder and elbow, in rad and s.
            action: ``... x 4``, of which 1 asks for the full torque.
        """
        _, elbow, v_s, v_e = state.unbind(-1)
        a1, a2, a3, a4 = action.unbind(-1)
        coupling = self.masses[1] * self.lengths[0] * self.centres[1]
        turn, swing = coupling * elbow.cos(), coupling * elbow.sin()
        m_ee = self.inertias[1] + self.masses[1] * self.centres[1] ** 2
        upper = self.inertias[0] + self.masses[0] * self.centres[0] ** 2
        m_ss = upper + self.masses[1] * self.lengths[0] ** 2 + m_ee + 2 * turn
        m_se = m_ee + turn
        load_s = self.gains[0] * (a3 - a4) - self.damping * v_s + swing * (2 * v_s + v_e) * v_e
        load_e = self.gains[1] * (a1 - a2) - self.damping * v_e - swing * v_s.square()
        determinant = m_ss * m_ee - m_se.square()
        shoulder_ddot = (m_ee * load_s - m_se * load_e) / determinant
        elbow_ddot = (m_ss * load_e - m_se * load_s) / determinant
        return torch.stack([v_s, v_e, shoulder_ddot, elbow_ddot], dim=-1)


REAL_ARM = ArmEquation()
"""The links of the muscle arm; segments after Nijhof and Kouwenhoven (2000). No torques."""


BELIEVED_ARM = replace(
    REAL_ARM,
    masses=(1.1 * REAL_ARM.masses[0], 1.1 * REAL_ARM.masses[1]),
    inertias=(1.1 * REAL_ARM.inertias[0], 1.1 * REAL_ARM.inertias[1]),
    damping=1.0,
    gains=(8.0, 4.0),
)
"""The arm as someone may believe it to be, who has no model of its muscles."""
