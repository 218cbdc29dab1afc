"""An equation of motion as physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import torch
from torch import Tensor

from gpadjust.checks import check_choice, checked_number, checked_whole
from gpadjust.physics.base import Physics, name_of
from gpadjust.physics.error import PhysicsError, outline
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

# Runge-Kutta methods: the weights a of slopes in each further stage, and b in the step (Hairer,
# Norsett and Wanner 1993, section II.1).
METHODS: dict[str, tuple[tuple[float, ...], ...]] = {
    "euler": ((1.0,),),
    "midpoint": ((0.5,), (0.0, 1.0)),
    "rk4": ((1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0), (0.125, 0.375, 0.375, 0.125)),
}
_ROWS = 30_000  # at once, whose states stay in the cache of a processor


class ODEPhysics(Physics):
    r"""One time step of an equation of motion, differentiable by autograd.

    With :math:`x = (s, a)`, a state and an action that is held during the step :math:`h`,

    .. math:: f_p(s, a) = s(h), \qquad \dot{s}(t) = g(s(t), a), \quad s(0) = s.

    Args:
        rhs: The time derivative :math:`g`, a function of state ``N x state_dim``, action ``N x a``
            (``a`` may be 0) and, with ``unknowns``, their values, ``N`` each, to ``N x state_dim``.
            Or a :class:`FormulaPhysics` of state and action, with its unknown parameters.
        step: The duration of the step, in the time unit of ``rhs``.
        state_dim: The number of leading columns that contain the state; the action follows.
        substeps: Integration steps within the step.
        method: ``"euler"``, ``"midpoint"`` or ``"rk4"`` (Kutta's 3/8 rule). An adaptive method is
            ``torchdiffeq.odeint`` in a :class:`FunctionPhysics`.
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
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        if isinstance(rhs, FormulaPhysics):
            unknowns = rhs.unknowns
            name = name or rhs.name
        super().__init__(unknowns=unknowns, inputs=inputs, name=name_of(rhs, name, "rhs"))
        check_choice("method", method, tuple(METHODS))
        self.rhs, self.method = rhs, method
        self.step = checked_number("step", step, above=0)
        self.state_dim = self.num_outputs = checked_whole("state_dim", state_dim, 1)
        self.substeps = checked_whole("substeps", substeps, 1)

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the equations are a text, and data have another order."""
        if isinstance(self.rhs, FormulaPhysics):
            self.rhs.check_names(names)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the state after the step, ``N x state_dim``."""
        if len(X) > _ROWS and not X.is_cuda:
            parts = zip(X.split(_ROWS), *(p.rows.split(_ROWS) for p in parameters), strict=True)
            with suppress(PhysicsError):  # which all rows at once raise below, with their numbers
                ends = [
                    self.evaluate(x, *(ParameterValues(self.unknowns, values) for values in rows))
                    for x, *rows in parts
                ]
                return torch.cat(ends)
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

        end = state
        h = self.step / self.substeps
        for _ in range(self.substeps):
            # k_i = g(s + h sum_{j < i} a_ij k_j), and the new s = s + h sum_i b_i k_i
            point = start = end
            slopes = list[Tensor]()
            for weights in METHODS[self.method]:
                slopes.append(derivative(point))
                point = start
                for weight, slope in zip(weights, slopes, strict=True):
                    if weight:
                        point = point.add(slope, alpha=h * weight)
            end = point
        return end
