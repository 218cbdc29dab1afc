"""An equation of motion as physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, Self

import torch
from torch import Tensor

from gpadjust.checks import checked_number, checked_whole
from gpadjust.physics.base import Physics
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.gradient import ExternalCall
from gpadjust.physics.unknown import ParameterValues, Unknown

FIXED_STEP = ("euler", "midpoint", "heun2", "heun3", "rk4", "explicit_adams", "implicit_adams")
ADAPTIVE_STEP = ("dopri5", "dopri8", "bosh3", "fehlberg2", "adaptive_heun")


def _integrate() -> Any:
    """Return ``torchdiffeq.odeint``, which an extra brings."""
    try:
        from torchdiffeq import odeint
    except ImportError as error:
        raise ImportError(
            'ODEPhysics needs torchdiffeq; run `pip install "gpadjust[ode]"`.'
        ) from error
    return odeint


class ODEPhysics(Physics):
    r"""One time step of an equation of motion, differentiable by autograd.

    With :math:`x = (s, a)`, a state and an action that is held during the step :math:`h`,

    .. math:: f_p(s, a) = s(h), \qquad \dot{s}(t) = g(s(t), a), \quad s(0) = s,

    or :math:`s(h) - s` with ``difference=True``.

    Args:
        rhs: The time derivative :math:`g`, from the state ``N x state_dim`` and the action
            ``N x a`` (``a`` may be 0) to ``N x state_dim``; with ``unknowns`` also from their
            values, ``N`` each.
        step: The duration of the step, in the time unit of ``rhs``.
        state_dim: The number of leading columns that hold the state; the others hold the action.
        substeps: Integration steps within the step, for the fixed-step methods.
        method: A method of ``torchdiffeq.odeint``. The adaptive ones control one step size for all
            rows of a batch, on which a row's result then depends within the tolerances.
        rtol: Relative tolerance of the adaptive methods.
        atol: Absolute tolerance of the adaptive methods, in the unit of the state.
        max_steps: The most steps that an adaptive method tries within ``step``.
        difference: Whether the output is the change of the state instead of the new state.
        unknowns: Unknown parameters of the equation by name, its third argument:
            ``lambda state, action, p: ... p.mass ...``.
        gradient: Where the gradient in X comes from: ``"autograd"``, or ``"finite-difference"``,
            central differences in a single call, which is several times faster if there are many
            substeps, with first derivatives only.
        inputs: The columns of X that hold state and action, in this order. Default: all.
        name: The name in messages. Default: that of ``rhs``.

    Raises:
        ImportError: Without torchdiffeq, ``pip install "gpadjust[ode]"``.
        TypeError: If ``rhs`` is not callable, or a setting is no number, or not whole.
        ValueError: If a setting is out of range, or ``method`` or ``gradient`` is unknown.

    Example:
        >>> decay = ODEPhysics(lambda state, action: -state + action, step=1.0, state_dim=1)
        >>> decay(torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=torch.float64))
        tensor([[0.3679],
                [1.0000]], dtype=torch.float64)
    """

    def __init__(
        self,
        rhs: Callable[..., Tensor],
        step: float,
        state_dim: int,
        *,
        substeps: int = 10,
        method: str = "rk4",
        rtol: float = 1e-7,
        atol: float = 1e-9,
        max_steps: int = 10_000,
        difference: bool = False,
        unknowns: Mapping[str, Unknown] | None = None,
        gradient: Literal["autograd", "finite-difference"] = "autograd",
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        _integrate()
        if not callable(rhs):
            raise TypeError(f"rhs must be callable; found {type(rhs).__name__}.")
        checked_number("step", step, above=0)
        for setting, tolerance in (("rtol", rtol), ("atol", atol)):
            checked_number(setting, tolerance, least=0)
        counts = {"state_dim": state_dim, "substeps": substeps, "max_steps": max_steps}
        for setting, count in counts.items():
            checked_whole(setting, count, 1)
        if method not in FIXED_STEP + ADAPTIVE_STEP:
            raise ValueError(
                f"Unknown method {method!r}; use one with a fixed step, {', '.join(FIXED_STEP)}, "
                f"or an adaptive one, {', '.join(ADAPTIVE_STEP)}."
            )
        if gradient not in ("autograd", "finite-difference"):
            raise ValueError(
                f"Unknown gradient {gradient!r}; use 'autograd' or 'finite-difference'."
            )
        name = name or getattr(rhs, "__name__", type(rhs).__name__)
        super().__init__(unknowns=unknowns, inputs=inputs, name=name)
        self.rhs, self.step, self.difference = rhs, float(step), difference
        self.state_dim, self.substeps, self.max_steps = state_dim, substeps, max_steps
        self.method, self.rtol, self.atol = method, rtol, atol
        self.gradient = gradient
        self.num_outputs = state_dim

    @classmethod
    def of_formula(
        cls,
        formula: str,
        states: Sequence[str],
        actions: Sequence[str],
        step: float,
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        **options: Any,
    ) -> Self:
        """One time step of an equation of motion that is a text, as of :class:`FormulaPhysics`.

        Args:
            formula: The time derivative of each state, with commas between them.
            states: The names of the states.
            actions: The names of the actions.
            step: The duration of the step.
            unknowns: Unknown parameters of the formula by name.
            options: Further options of the class.

        Raises:
            ValueError: If the formula is none, or has not one derivative for each state; and as the
                class.

        Example:
            >>> decay = ODEPhysics.of_formula("-x + u", ["x"], ["u"], step=1.0)
            >>> decay(torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=torch.float64))
            tensor([[0.3679],
                    [1.0000]], dtype=torch.float64)
        """
        rates = FormulaPhysics(formula, [*states, *actions], unknowns=unknowns)
        if rates.num_outputs != len(states):
            raise ValueError(
                f"Expected a time derivative of each state, {', '.join(states)}, found "
                f"{rates.num_outputs} in {formula!r}."
            )
        options = {"name": rates.name, **options}
        return cls(partial(_rates, rates), step, len(states), unknowns=unknowns, **options)

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the equations are a text, and data have its columns otherwise."""
        if isinstance(self.rhs, partial) and self.rhs.func is _rates:
            self.rhs.args[0].check_names(names)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The state after the step or its change, ``N x state_dim``.

        A PhysicsError says that X has fewer columns, ``rhs`` returns something else than one time
        derivative per state, or an adaptive method does not arrive.
        """
        if X.shape[1] < self.state_dim:
            raise PhysicsError(
                f"Physics {self.name!r} needs {self.state_dim} state column(s), then the action; "
                f"found rows with {X.shape[1]} column(s). Correct state_dim or inputs."
            )
        state, action = X[:, : self.state_dim], X[:, self.state_dim :]

        def derivative(t: Tensor, state: Tensor) -> Tensor:
            rate = self.rhs(state, action, *parameters)
            if not torch.is_tensor(rate) or rate.shape != state.shape or rate.is_complex():
                found: object = type(rate).__name__
                if torch.is_tensor(rate):
                    found = rate.dtype if rate.is_complex() else tuple(rate.shape)
                raise PhysicsError(
                    f"The rhs of physics {self.name!r} returned {found}, expected a real tensor of "
                    f"shape {tuple(state.shape)}, as the state: a time derivative of each variable."
                )
            return rate

        options: dict[str, Any] = {"max_num_steps": self.max_steps}
        if self.method in FIXED_STEP:
            # A grid of our own: torchdiffeq's step_size rounds up to one substep too many.
            options = {"grid_constructor": lambda *_: self._times(self.substeps, X)}
        try:
            path: Tensor = _integrate()(
                derivative,
                state,
                self._times(1, X),
                rtol=self.rtol,
                atol=self.atol,
                method=self.method,
                options=options,
            )
        except AssertionError as error:
            if not str(error).startswith(("max_num_steps exceeded", "underflow in dt")):
                raise
            raise PhysicsError(
                f"The method {self.method!r} of physics {self.name!r} did not reach the end of the "
                f"time step ({error}) within max_steps={self.max_steps}. The rhs may be stiff: use "
                "'rk4' with many substeps, larger rtol and atol, or more max_steps.",
                range(len(X)),
            ) from error
        return path[-1] - state if self.difference else path[-1]

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows, with the gradient in X by differences if that was chosen."""
        by_differences = self.gradient == "finite-difference" and torch.is_grad_enabled()
        by_differences = by_differences and rows.requires_grad
        if not by_differences or any(p.requires_grad for p in self.parameters()):
            return super().of_rows(rows)

        slope: Tensor | None = None
        with torch.no_grad():
            try:
                # In one call, as what it costs grows slowly with the rows.
                values, slope = self.jacobian(rows.detach(), with_values=True)
            except PhysicsError:  # which rows they are, or that only those beside them failed
                values = super().of_rows(rows.detach())

        def jacobian(rows: Tensor) -> Tensor:
            with torch.no_grad():
                return self.jacobian(rows)[1] if slope is None else slope

        return ExternalCall.apply(rows, lambda _: values, jacobian)

    def extra_repr(self) -> str:
        """The settings that ``repr`` shows."""
        return (
            f"{super().extra_repr()}, step={self.step}, state_dim={self.state_dim}, "
            f"method={self.method!r}, difference={self.difference}"
        )

    def _times(self, intervals: int, X: Tensor) -> Tensor:
        return torch.linspace(0.0, self.step, intervals + 1, dtype=X.dtype, device=X.device)


def _rates(
    formula: FormulaPhysics, state: Tensor, action: Tensor, *parameters: ParameterValues
) -> Tensor:
    """The time derivatives by a formula of state and action."""
    return formula.evaluate(torch.cat([state, action], dim=-1), *parameters)
