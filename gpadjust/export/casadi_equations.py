"""A physics that is written in formulas, as functions of CasADi."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.export.equations import Equations, OfPhysics, equations_of
from gpadjust.export.transition import following
from gpadjust.physics.formula import ARITHMETIC, NAMES, Functions
from gpadjust.physics.ode import FIXED_STEP
from gpadjust.physics.unknown import Unknown

_OTHER_NAMES = {"abs": "fabs", "ln": "log", "min": "fmin", "max": "fmax", "pow": "power"}


def equations_function(fitted: OfPhysics, name: str, free: bool) -> Any:
    """Return a physics, or a step of dynamics that are one, as a ``casadi.Function``."""
    import casadi as ca

    found = equations_of(fitted, free)
    if not isinstance(fitted, Dynamics):
        return physics_function(found, name, free)
    spec = fitted.spec
    sizes = {"state": spec.state_dim, "action": spec.action_dim}
    sizes |= {"parameters": len(found.parameters)} if free else {}
    given = {entry: ca.SX.sym(entry, size) for entry, size in sizes.items()}
    state, action = (ca.vertsplit(given[entry]) for entry in ("state", "action"))
    x = ca.vertcat(*[(*state, *action)[i] for i in spec.physics_columns])
    own = (given["parameters"],) if free else ()
    f_p = ca.vertsplit(physics_function(found, "f_p", free)(x, *own))
    mean = ca.vertcat(*following(spec, state, action, f_p))
    return ca.Function(name, [*given.values()], [mean], [*given], ["mean"])


def physics_function(found: Equations, name: str, free: bool = False) -> Any:
    """Return a physics as a function of x, and of its parameters if they are free."""
    import casadi as ca

    formula, ode = found.formula, found.ode
    size = len(formula.columns) if found.inputs is None else 1 + max(found.inputs)
    x, parameters = ca.SX.sym("x", size), ca.SX(found.parameters.tolist())
    given = {"x": x}
    if free:
        given["parameters"] = parameters = ca.SX.sym("parameters", len(found.parameters))

    def outputs(columns: list[Any]) -> Any:
        own = ca.vertsplit(parameters) if found.parameters.numel() else []
        return ca.vertcat(*found.values(columns, own, _functions(ca), ca.SX, _curve))

    read = found.read(ca.vertsplit(x))
    if ode is None:
        mean = outputs(read)
    else:
        start = mean = ca.vertcat(*read[: ode.state_dim])
        for _ in range(ode.substeps):
            begin, slopes = mean, list[Any]()
            for weights in FIXED_STEP[ode.method]:
                slopes.append(outputs([*ca.vertsplit(mean), *read[ode.state_dim :]]))
                mean = begin
                for weight, slope in zip(weights, slopes, strict=True):
                    mean = mean + ode.step / ode.substeps * weight * slope
        mean = mean - start if ode.difference else mean
    return ca.Function(name, [*given.values()], [mean], [*given], ["mean"])


def _functions(ca: Any) -> Functions:
    """Return functions of symbols."""
    return {
        **ARITHMETIC,
        **{n: getattr(ca, _OTHER_NAMES.get(n, n)) for n in NAMES if n != "where"},
        "Lt": ca.lt,
        "LtE": ca.le,
        "Gt": ca.gt,
        "GtE": ca.ge,
        "where": lambda c, a, b: ca.if_else(c != 0, a, b),
    }


def _curve(name: str, unknown: Unknown, weights: Tensor) -> Callable[[Any], Any]:
    """Return an unknown function of symbols."""
    import casadi as ca

    low, high = unknown.between or (0.0, 0.0)

    def value(x: Any) -> Any:
        x = ca.fmin(ca.fmax(x, low), high)
        knots = ca.DM(unknown.knots.tolist())
        r = math.sqrt(5) * ca.fabs(x - knots) / unknown.lengthscale
        z = ca.dot(ca.DM(weights.tolist()), (1 + r + r**2 / 3) * ca.exp(-r))
        if unknown.sd is not None:
            return unknown.guess + unknown.sd * z
        if unknown.factor is not None:
            return unknown.guess * ca.exp(math.log(unknown.factor) * z)
        least, most = unknown.bounds
        return least + (most - least) * (1 + ca.erf(z / math.sqrt(2))) / 2

    return value
