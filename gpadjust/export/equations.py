"""A physics that is written in formulas, for programs of other languages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.dynamics import Dynamics, IdentifiedDynamics, PhysicsDynamics
from gpadjust.physics import FormulaPhysics, ODEPhysics, Physics
from gpadjust.physics.formula import Functions
from gpadjust.physics.unknown import Unknown

MakeCurve = Callable[[str, Unknown, Tensor], Callable[[Any], Any]]
"""Makes an unknown function of its name, its prior and the weights of its knots, ``k``."""

OfPhysics = Physics | IdentifiedDynamics | PhysicsDynamics
"""Objects that have equations alone."""


class Equations(NamedTuple):
    """A formula, or the steps of an equation of motion whose right-hand side is one."""

    formula: FormulaPhysics
    parameters: Tensor  # values of its p unknown parameters
    ode: ODEPhysics | None  # None of a formula alone
    inputs: Sequence[int]  # the columns of x that it reads

    def values(
        self,
        columns: Sequence[Any],
        parameters: Sequence[Any],
        functions: Functions,
        number: Callable[[float], Any],
        curve: MakeCurve,
    ) -> list[Any]:
        """Return the outputs of the formula in scalars of another language."""
        unknowns = self.formula.unknowns
        curves = {}
        for name, (unknown, places) in unknowns.functions.items():
            # k(Z, Z)^-1 z, so that the coordinate at x is k(x, Z) times the weights
            weights = unknown.precision @ unknown.coordinate(self.parameters[places])
            curves[name] = curve(name, unknown, weights)
        named = dict(zip(unknowns, parameters, strict=True))
        return self.formula.values_at(columns, named, curves, functions, number)


def _equations(physics: Physics, parameters: Tensor | None = None) -> Equations | None:
    """Return the equations of a physics with these parameters, ``p``; None if it has none."""
    formula: Any = physics
    ode = None
    if isinstance(physics, ODEPhysics):
        formula = physics.rhs
        ode = physics
    if not isinstance(formula, FormulaPhysics):
        return None
    for name, (unknown, _) in formula.unknowns.functions.items():
        if unknown.is_cut:
            raise ValueError(
                f"Cannot export the function {name!r}, whose bounds cut off its prior: leave out "
                "bounds, or sd and factor."
            )
    inputs = physics.inputs or range(len(formula.columns))
    if min(inputs) < 0:
        raise ValueError(
            f"Cannot export columns that are counted from the end, inputs={physics.inputs}: count "
            "them from the first, 0."
        )
    if parameters is None:
        parameters = formula.unknowns.guess
    return Equations(formula, parameters.detach(), ode, inputs)


def equations_of(fitted: OfPhysics, free: bool) -> Equations:
    """Return the equations of a physics, or of dynamics that are one, or raise an error."""
    if isinstance(fitted, Physics):
        physics = fitted
        equations = _equations(physics)
    else:
        physics = fitted.physics
        equations = _equations(physics, fitted.physics_parameters.center)
    if equations is None:
        raise TypeError(
            f"Cannot export the physics {physics.name!r}, a {type(physics).__name__}: expected "
            'equations that are a text, FormulaPhysics("v, u - k * x", ["x", "v", "u"]), or an '
            "ODEPhysics of these."
        )
    if free and (physics.unknowns.functions or not physics.unknowns):
        raise ValueError(
            "parameters=True is for unknown parameters that are numbers; found "
            f"{', '.join(physics.unknowns.declared) or 'none'}. Leave it out."
        )
    return equations


def equations_within(model: GP) -> list[Equations] | None:
    """Return the equations of the physics of a model; None unless all of them are written."""
    within = []
    for term_physics in model.physics:
        physics = getattr(term_physics, "physics", term_physics)  # without targets of dynamics
        parameters = None
        if physics.unknowns:
            draws = model.physics_parameters_at(model.u)
            parameters = torch.stack([draws[name] for name in physics.unknowns], -1).mean(0)
        equations = _equations(physics, parameters)
        if equations is None:
            return None
        within.append(equations)
    return within


def exportable(fitted: Any, name: Any, free: bool = False) -> Any:
    """Return a fitted object, of an identification its dynamics, or raise a ValueError."""
    if not (isinstance(name, str) and name.isidentifier() and name.isascii()):
        raise ValueError(f"Expected name as one of C, such as 'pump', got {name!r}.")
    if not isinstance(fitted, GP | Physics | Dynamics):
        fitted = getattr(fitted, "dynamics", fitted)
    if free and not isinstance(fitted, OfPhysics):
        raise ValueError(
            "parameters=True is for a physics, and for dynamics that are one. The Gaussian "
            "process was fitted with these values of the parameters: leave it out."
        )
    return fitted
