"""An equation of motion as physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Literal

import torch
from torch import Tensor

from gpadjust.checks import check_choice, checked_number, checked_whole
from gpadjust.physics.base import Physics, name_of
from gpadjust.physics.black_box import FiniteDifferences
from gpadjust.physics.error import PhysicsError, outline
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

# Runge-Kutta methods of a fixed step: the weights of slopes in each further stage, and in the step.
FIXED_STEP: dict[str, tuple[tuple[float, ...], ...]] = {
    "euler": ((1.0,),),
    "midpoint": ((0.5,), (0.0, 1.0)),
    "rk4": ((1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0), (0.125, 0.375, 0.375, 0.125)),
}
ADAPTIVE_STEP = ("dopri5", "dopri8", "bosh3", "fehlberg2", "adaptive_heun")
_MOST_STEPS = 10_000  # of an adaptive method


class ODEPhysics(Physics):
    r"""One time step of an equation of motion, differentiable by autograd.

    With :math:`x = (s, a)`, a state and an action that is held during the step :math:`h`,

    .. math:: f_p(s, a) = s(h), \qquad \dot{s}(t) = g(s(t), a), \quad s(0) = s,

    or :math:`s(h) - s` with ``difference=True``.

    Args:
        rhs: The time derivative :math:`g`, a function of state ``N x state_dim``, action ``N x a``
            (``a`` may be 0) and, with ``unknowns``, their values, ``N`` each, to ``N x state_dim``.
            Or a :class:`FormulaPhysics` of state and action, with its unknown parameters.
        step: The duration of the step, in the time unit of ``rhs``.
        state_dim: The number of leading columns that contain the state; the action follows.
        substeps: Integration steps within the step, for the fixed-step methods.
        method: ``"euler"``, ``"midpoint"`` or ``"rk4"`` (Kutta's 3/8 rule), of fixed steps, or an
            adaptive one of ``torchdiffeq.odeint`` (``pip install "gpadjust[ode]"``), such as
            ``"dopri5"``. These control one step size for all rows of a batch, on which a row's
            result then depends within their tolerances. They fail if ``rhs`` is stiff, for all
            rows: use ``"rk4"`` with many substeps.
        difference: If True, the output is the change of the state instead of the new state.
        gradient: Source of the gradient in X: ``"autograd"``, or ``"finite-difference"``, without
            second derivatives, which is several times faster if there are many substeps.
        unknowns, inputs, name: As of :class:`Physics`.

    Example:
        >>> decay = ODEPhysics(lambda state, action: -state + action, step=1.0, state_dim=1)
        >>> decay(torch.tensor([[1.0, 0.0]], dtype=torch.float64))
        tensor([[0.3679]], dtype=torch.float64)
    """

    step: float

    def __init__(
        self,
        rhs: Callable[..., Tensor],
        step: float,
        state_dim: int,
        *,
        substeps: int = 10,
        method: str = "rk4",
        difference: bool = False,
        unknowns: Mapping[str, Unknown] | None = None,
        gradient: Literal["autograd", "finite-difference"] = "autograd",
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        if isinstance(rhs, FormulaPhysics):
            unknowns = rhs.unknowns
            name = name or rhs.name
        super().__init__(unknowns=unknowns, inputs=inputs, name=name_of(rhs, name, "rhs"))
        check_choice("method", method, (*FIXED_STEP, *ADAPTIVE_STEP))
        if method in ADAPTIVE_STEP and find_spec("torchdiffeq") is None:
            raise ImportError(
                f'The method {method!r} needs torchdiffeq; run `pip install "gpadjust[ode]"`, or '
                'take "rk4".'
            )
        check_choice("gradient", gradient, ("autograd", "finite-difference"))
        self.rhs, self.method, self.gradient = rhs, method, gradient
        self.step = checked_number("step", step, above=0)
        self.state_dim = self.num_outputs = checked_whole("state_dim", state_dim, 1)
        self.substeps = checked_whole("substeps", substeps, 1)
        self.difference = difference

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the equations are a text, and data have other columns."""
        if isinstance(self.rhs, FormulaPhysics):
            self.rhs.check_names(names)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the state after the step or its change, ``N x state_dim``."""
        state, action = X[:, : self.state_dim], X[:, self.state_dim :]

        def derivative(state: Tensor) -> Tensor:
            if isinstance(self.rhs, FormulaPhysics):
                rate = self.rhs.evaluate(torch.cat([state, action], dim=-1), *parameters)
            else:
                rate = self.rhs(state, action, *parameters)
            shape = (len(X), self.state_dim)
            if not torch.is_tensor(rate) or rate.shape != shape or rate.is_complex():
                raise PhysicsError(
                    f"The rhs of physics {self.name!r} returned {outline(rate)}, expected a real "
                    f"tensor of shape {shape}: a time derivative of each state. Correct it, or "
                    f"state_dim, or inputs; state and action have {X.shape[1]} column(s)."
                )
            return rate

        if self.method in FIXED_STEP:
            end = _fixed(derivative, state, self.step / self.substeps, self.substeps, self.method)
        else:
            from torchdiffeq import odeint  # slow to import

            times = torch.tensor([0.0, self.step]).to(state)
            limits = {"max_num_steps": _MOST_STEPS}
            _, end = odeint(
                lambda _, s: derivative(s), state, times, method=self.method, options=limits
            )
        return end - state if self.difference else end

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows, with the gradient in X by differences if that was chosen."""
        learns = any(p.requires_grad for p in self.parameters())
        if self.gradient == "autograd" or learns or not rows.requires_grad:
            return super().of_rows(rows)
        return FiniteDifferences.apply(rows, super().of_rows(rows.detach()), self)


def _fixed(
    derivative: Callable[[Tensor], Tensor], state: Tensor, h: float, number: int, method: str
) -> Tensor:
    """Return the state after a number of steps h of a Runge-Kutta method.

    Source: Hairer, Norsett and Wanner (1993), section II.1.
    """
    for _ in range(number):
        point = state
        slopes = list[Tensor]()
        for weights in FIXED_STEP[method]:
            # k_i = g(s + h sum_{j < i} a_ij k_j); the last weights are those of the step
            slopes.append(derivative(point))
            point = state
            for weight, slope in zip(weights, slopes, strict=True):
                if weight:
                    point = point.add(slope, alpha=h * weight)
        state = point
    return state
