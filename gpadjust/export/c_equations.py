"""A physics that is written in formulas, as functions of C."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from string import Template

from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.export.equations import Equations, OfPhysics, equations_of
from gpadjust.export.transition import following
from gpadjust.physics.formula import NAMES, Functions
from gpadjust.physics.ode import FIXED_STEP, ODEPhysics
from gpadjust.physics.unknown import Unknown

_OTHER_NAMES = {"abs": "fabs", "ln": "log", "min": "fmin", "max": "fmax"}  # in C
_CURVE = Template("""\
static double $name(double x)
{
    static const double knots[$k] = $knots;
    static const double weights[$k] = $weights;
    double z = 0.0;
    x = fmin(fmax(x, $low), $high);
    for (int i = 0; i < $k; i++) {
        const double r = sqrt(5.0) * fabs(x - knots[i]) / $lengthscale;
        z += weights[i] * (1.0 + r + r * r / 3.0) * exp(-r);
    }
    return $value;
}
""")
_SIGN = "static double {}_sign(double x) {{ return (x > 0.0) - (x < 0.0); }}\n"
_STEPS = Template("""\
    static const double weights[$stages][$stages] = $weights;
    double at[] = $x, start[$states], slopes[$stages][$states];
    for (int n = 0; n < $substeps; n++) {
        for (int i = 0; i < $states; i++) start[i] = at[i];
        for (int k = 0; k < $stages; k++) {
            $rates(at$parameters, slopes[k]);
            for (int i = 0; i < $states; i++) {
                at[i] = start[i];
                for (int j = 0; j <= k; j++) at[i] += $h * weights[k][j] * slopes[j][i];
            }
        }
    }
""")


def equations_source(fitted: OfPhysics, name: str, free: bool) -> Iterator[str]:
    """Yield the lines of a file with a physics, or with a step of dynamics that are one."""
    found = equations_of(fitted, free)
    formula, is_step = found.formula, isinstance(fitted, Dynamics)
    yield "/*"
    for line in _about(found, fitted, free):
        yield f" * {line.replace('*/', '* /')}"
    yield from (" */", "", "#include <math.h>", "")
    yield from physics_lines(found, f"{name}_predict", free, is_static=is_step)
    if not isinstance(fitted, Dynamics):
        return
    spec = fitted.spec
    state = [f"state[{i}]" for i in range(spec.state_dim)]
    action = [f"action[{i}]" for i in range(spec.action_dim)]
    x = [(*state, *action)[i] for i in spec.physics_columns]
    f_p = [f"f_p[{i}]" for i in range(len(formula.outputs))]
    given = ", const double *parameters" if free else ""
    yield f"void {name}_step(const double *state, const double *action{given}, double *mean)"
    yield "{"
    yield f"    const double x[] = {_braced(x)};"
    yield f"    double f_p[{len(f_p)}];"
    yield f"    {name}_predict(x{', parameters' if free else ''}, f_p);"
    # All of them are there before `mean` is written, which may be `state`.
    yield f"    const double next[] = {_braced(following(spec, state, action, f_p))};"
    yield f"    for (int i = 0; i < {spec.state_dim}; i++) mean[i] = next[i];"
    yield "}"


def _about(found: Equations, fitted: OfPhysics, free: bool) -> Iterator[str]:
    """Yield lines on what the file contains."""
    formula, unknowns = found.formula, found.formula.unknowns
    yield f"The physics {formula.name}. Made by gpadjust; numbers are in its units."
    if isinstance(fitted, Dynamics):
        spec = fitted.spec
        yield f"state, mean: {', '.join(spec.states)}; action: {', '.join(spec.actions)}."
    else:
        yield f"x: {', '.join(formula.columns)}."
    if free:
        yield f"parameters: {', '.join(unknowns)}."
    elif unknowns:
        pairs = zip(unknowns, found.parameters.tolist(), strict=True)
        yield f"Its parameters are {', '.join(f'{name} = {value!r}' for name, value in pairs)}."
    if found.ode is not None:
        yield f"A step lasts {found.ode.step!r}."


def physics_lines(
    found: Equations, name: str, free: bool = False, is_static: bool = True
) -> Iterator[str]:
    """Yield functions of C, the last of which is ``NAME(x, mean)``, the outputs of a physics.

    If its parameters are free, it is ``NAME(x, parameters, mean)``.
    """
    formula, curves = found.formula, list[str]()

    def curve(function: str, unknown: Unknown, weights: Tensor) -> Callable[[str], str]:
        curves.append(_curve(f"{name}_of_{function}", unknown, weights))
        return lambda x: f"{name}_of_{function}({x})"

    columns = [f"x[{i}]" for i in range(len(formula.columns))]
    values = [
        f"parameters[{i}]" if free else _number(value)
        for i, value in enumerate(found.parameters.tolist())
    ]
    outputs = found.values(columns, values, _functions(name), _number, curve)
    yield from curves
    if any(f"{name}_sign(" in output for output in outputs):
        yield _SIGN.format(name)
    given = ", const double *parameters" if free else ""
    head = f"{'static ' * is_static}void {name}(const double *x{given}, double *mean)\n{{"
    if found.ode is None:
        yield head
        yield from _assigned("mean", outputs, free)
        yield "}\n"
        return
    yield f"static void {name}_rates(const double *x{given}, double *rates)\n{{"
    yield from _assigned("rates", outputs, free)
    yield "}\n"
    yield head
    x = columns if found.inputs is None else [f"x[{i}]" for i in found.inputs]
    yield from _steps(found.ode, x, f"{name}_rates", free)
    yield "}\n"


def _assigned(name: str, outputs: Sequence[str], free: bool) -> Iterator[str]:
    """Yield the lines that write the outputs of a formula."""
    yield "    (void)x;"  # a formula may be a number
    if free:
        yield "    (void)parameters;"
    yield from (f"    {name}[{i}] = {value};" for i, value in enumerate(outputs))


def _steps(ode: ODEPhysics, x: Sequence[str], rates: str, free: bool) -> Iterator[str]:
    """Yield the lines of the steps of an equation of motion."""
    stages = FIXED_STEP[ode.method]
    weights = [[*row, *[0.0] * (len(stages) - len(row))] for row in stages]
    yield _STEPS.substitute(
        stages=len(stages),
        weights=_braced([_braced(map(repr, row)) for row in weights]),
        x=_braced(x),
        states=ode.state_dim,
        substeps=ode.substeps,
        rates=rates,
        parameters=", parameters" if free else "",
        h=repr(ode.step / ode.substeps),
    ).rstrip()
    for i in range(ode.state_dim):
        yield f"    mean[{i}] = at[{i}]{f' - {x[i]}' if ode.difference else ''};"


def _functions(name: str) -> Functions:
    """Return functions of texts."""

    def infix(sign: str) -> Callable[[str, str], str]:
        return lambda a, b: f"({a} {sign} {b})"

    def compared(sign: str) -> Callable[[str, str], str]:
        return lambda a, b: f"({a} {sign} {b} ? 1.0 : 0.0)"

    def called(function: str) -> Callable[..., str]:
        return lambda *parts: f"{function}({', '.join(parts)})"

    return {
        **{each: called(_OTHER_NAMES.get(each, each)) for each in NAMES},
        **{part: infix(s) for part, s in (("Add", "+"), ("Sub", "-"), ("Mult", "*"), ("Div", "/"))},
        **{
            part: compared(s)
            for part, s in (("Lt", "<"), ("LtE", "<="), ("Gt", ">"), ("GtE", ">="))
        },
        "Pow": called("pow"),
        "USub": lambda a: f"(-{a})",
        "UAdd": lambda a: a,
        "sign": called(f"{name}_sign"),
        "where": lambda c, a, b: f"({c} != 0.0 ? {a} : {b})",
    }


def _curve(name: str, unknown: Unknown, weights: Tensor) -> str:
    """Return an unknown function in C."""
    low, high = unknown.between or (0.0, 0.0)
    if unknown.sd is not None:
        value = f"{unknown.guess!r} + {unknown.sd!r} * z"
    elif unknown.factor is not None:
        value = f"{unknown.guess!r} * exp({math.log(unknown.factor)!r} * z)"
    else:
        least, most = unknown.bounds
        value = f"{least!r} + {most - least!r} * 0.5 * erfc(-z / sqrt(2.0))"
    return _CURVE.substitute(
        name=name,
        k=len(weights),
        knots=_braced(map(repr, unknown.knots.tolist())),
        weights=_braced(map(repr, weights.tolist())),
        low=repr(low),
        high=repr(high),
        lengthscale=repr(unknown.lengthscale),
        value=value,
    )


def _number(value: float) -> str:
    """Return a number, in brackets if it is negative."""
    return f"({value!r})" if value < 0 else repr(value)


def _braced(values: Iterable[str]) -> str:
    """Return the entries of a table."""
    return f"{{{', '.join(values)}}}"
