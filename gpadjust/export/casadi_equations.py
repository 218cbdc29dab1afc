"""A physics that is written in formulas, as functions of CasADi."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.export.equations import Equations, OfPhysics, equations_of
from gpadjust.export.transition import following_state
from gpadjust.physics.formula import ARITHMETIC, NAMES, Functions
from gpadjust.physics.ode import METHODS
from gpadjust.physics.unknown import Unknown

_OTHER_NAMES = {"abs": "fabs", "ln": "log", "min": "fmin", "max": "fmax", "pow": "power"}


def equations_function(fitted: OfPhysics, name: str, free: bool) -> Any:
    """Return a physics, or a step of dynamics that are one, as a ``casadi.Function``."""
    import casadi as ca

    equations = equations_of(fitted, free)
    if not isinstance(fitted, Dynamics):
        return physics_function(equations, name, free)
    spec = fitted.spec
    sizes = {"state": spec.state_dim, "action": spec.action_dim}
    if free:
        sizes["parameters"] = len(equations.parameters)
    arguments = {entry: ca.SX.sym(entry, size) for entry, size in sizes.items()}
    state, action, *parameters = arguments.values()
    entries = [*ca.vertsplit(state), *ca.vertsplit(action)]
    x = ca.vertcat(*[entries[i] for i in spec.physics_columns])
    f_p = physics_function(equations, "f_p", free)(x, *parameters)
    mean = following_state(
        spec, entries[: spec.state_dim], entries[spec.state_dim :], ca.vertsplit(f_p)
    )
    return ca.Function(name, [*arguments.values()], [ca.vertcat(*mean)], [*arguments], ["mean"])


def physics_function(equations: Equations, name: str, free: bool = False) -> Any:
    """Return a physics as a function of x, and of its parameters if they are free."""
    import casadi as ca

    ode = equations.ode
    x = ca.SX.sym("x", 1 + max(equations.inputs))
    parameters = ca.SX(equations.parameters.tolist())  # numbers, unless they are free
    arguments = {"x": x}
    if free:
        arguments["parameters"] = parameters = ca.SX.sym("parameters", parameters.numel())

    def outputs(columns: list[Any]) -> Any:
        values = ca.vertsplit(parameters) if parameters.numel() else []
        return ca.vertcat(*equations.values(columns, values, _functions(ca), ca.SX, _curve))

    columns = [x[i] for i in equations.inputs]
    if ode is None:
        mean = outputs(columns)
    else:
        mean = ca.vertcat(*columns[: ode.state_dim])
        action = columns[ode.state_dim :]
        for _ in range(ode.substeps):
            begin = mean
            slopes = list[Any]()
            for weights in METHODS[ode.method]:
                # k_i = g(s + h sum_{j < i} a_ij k_j), as in ODEPhysics
                slopes.append(outputs([*ca.vertsplit(mean), *action]))
                mean = begin
                for weight, slope in zip(weights, slopes, strict=True):
                    mean = mean + ode.step / ode.substeps * weight * slope
    return ca.Function(name, [*arguments.values()], [mean], [*arguments], ["mean"])


def _functions(ca: Any) -> Functions:
    """Return functions of symbols."""
    return {
        **ARITHMETIC,
        **{n: getattr(ca, _OTHER_NAMES.get(n, n)) for n in NAMES if n != "where"},
        **{"Lt": ca.lt, "LtE": ca.le, "Gt": ca.gt, "GtE": ca.ge},
        "where": lambda c, a, b: ca.if_else(c != 0, a, b),
    }


def _curve(name: str, unknown: Unknown, weights: Tensor) -> Callable[[Any], Any]:
    """Return an unknown function of symbols."""
    import casadi as ca

    low, high = unknown.between or (0.0, 0.0)

    def value(x: Any) -> Any:
        x = ca.fmin(ca.fmax(x, low), high)
        knots = ca.DM(unknown.knots.tolist())
        # z = sum_i w_i (1 + r_i + r_i^2 / 3) exp(-r_i), r_i = sqrt(5) |x - x_i| / lengthscale
        r = math.sqrt(5) * ca.fabs(x - knots) / unknown.lengthscale
        z = ca.dot(ca.DM(weights.tolist()), (1 + r + r**2 / 3) * ca.exp(-r))
        return unknown.quantile(z, ca.exp, lambda z: (1 + ca.erf(z / math.sqrt(2))) / 2)

    return value
