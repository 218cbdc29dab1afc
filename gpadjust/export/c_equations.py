"""A physics that is written in formulas, as functions of C."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from string import Template
from typing import Any

from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.export.equations import Equations, OfPhysics, equations_of
from gpadjust.export.transition import following_state
from gpadjust.physics.formula import NAMES, Functions
from gpadjust.physics.ode import METHODS
from gpadjust.physics.unknown import Unknown

_OTHER_NAMES = {"abs": "fabs", "ln": "log", "min": "fmin", "max": "fmax"}  # in C
# z(x) = sum_i w_i k(x, x_i) with Matern's kernel (5/2), and the value at this coordinate.
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
# C has no function of this name; 0 has the sign 0.
_SIGN = "static double {}_sign(double x) {{ return (x > 0.0) - (x < 0.0); }}\n"
# Stage k ends at s + h sum_{j <= k} a_kj g_j, the last one is the step.
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


class Text(str):
    """An expression in C."""

    def __add__(self, other: str) -> Text:
        return Text(f"({self} + {other})")

    def __radd__(self, number: Any) -> Text:
        return Text(f"{number!r} + {self}")

    def __sub__(self, other: str) -> Text:
        return Text(f"({self} - {other})")

    def __rmul__(self, number: Any) -> Text:
        return Text(f"{number!r} * {self}")


def entries(name: str, size: int) -> list[Text]:
    """Return the entries of an array."""
    return [Text(f"{name}[{i}]") for i in range(size)]


def braced(values: Iterable[str]) -> str:
    """Return the entries of a table."""
    return f"{{{', '.join(values)}}}"


def comment(lines: Iterable[str]) -> list[str]:
    """Return the lines of a comment."""
    return ["/*", *(f" * {line.replace('*/', '* /')}" for line in lines), " */", ""]


def parameters_text(names: Iterable[str], values: Iterable[float]) -> str:
    """Return a sentence on the values of the parameters of a physics."""
    pairs = zip(names, values, strict=True)
    return f"Its parameters are {', '.join(f'{name} = {value!r}' for name, value in pairs)}."


def equations_source(fitted: OfPhysics, name: str, free: bool) -> Iterator[str]:
    """Yield the lines of a file with a physics, or with a step of dynamics that are one."""
    equations = equations_of(fitted, free)
    is_step = isinstance(fitted, Dynamics)
    yield from (*comment(_about(equations, fitted, free)), "#include <math.h>", "")
    yield from physics_lines(equations, f"{name}_predict", free, is_static=is_step)
    if not isinstance(fitted, Dynamics):
        return
    spec = fitted.spec
    state, action = entries("state", spec.state_dim), entries("action", spec.action_dim)
    x = [(*state, *action)[i] for i in spec.physics_columns]
    f_p = entries("f_p", len(equations.formula.outputs))
    inputs = ["const double *state", "const double *action"]
    values = ["x", "f_p"]
    if free:
        inputs.append("const double *parameters")
        values.insert(1, "parameters")
    yield f"void {name}_step({', '.join(inputs)}, double *mean)"
    yield "{"
    yield f"    const double x[] = {braced(x)};"
    yield f"    double f_p[{len(f_p)}];"
    yield f"    {name}_predict({', '.join(values)});"
    # All of them are there before `mean` is written, which may be `state`.
    yield f"    const double next[] = {braced(following_state(spec, state, action, f_p))};"
    yield f"    for (int i = 0; i < {spec.state_dim}; i++) mean[i] = next[i];"
    yield "}"


def _about(equations: Equations, fitted: OfPhysics, free: bool) -> Iterator[str]:
    """Yield lines on the content of the file."""
    formula, unknowns = equations.formula, equations.formula.unknowns
    yield f"The physics {formula.name}. Made by gpadjust; numbers are in its units."
    if isinstance(fitted, Dynamics):
        spec = fitted.spec
        yield f"state, mean: {', '.join(spec.states)}; action: {', '.join(spec.actions)}."
    else:
        yield f"x: {', '.join(formula.columns)}."
    if free:
        yield f"parameters: {', '.join(unknowns)}."
    elif unknowns:
        yield parameters_text(unknowns, equations.parameters.tolist())
    if equations.ode is not None:
        yield f"A step lasts {equations.ode.step!r}."


def physics_lines(
    equations: Equations, name: str, free: bool = False, is_static: bool = True
) -> Iterator[str]:
    """Yield functions of C, the last of which is ``NAME(x, mean)``, the outputs of a physics.

    If its parameters are free, it is ``NAME(x, parameters, mean)``.
    """
    formula, ode = equations.formula, equations.ode
    curves = list[str]()  # functions of C, of unknown functions

    def curve(function: str, unknown: Unknown, weights: Tensor) -> Callable[[str], str]:
        curves.append(_curve(f"{name}_of_{function}", unknown, weights))
        return lambda x: f"{name}_of_{function}({x})"

    columns = entries("x", len(formula.columns))
    values: Sequence[str] = entries("parameters", len(equations.parameters))
    if not free:
        values = [*map(_number, equations.parameters.tolist())]
    outputs = equations.values(columns, values, _functions(name), _number, curve)
    yield from curves  # before the function that calls them
    if any(f"{name}_sign(" in output for output in outputs):
        yield _SIGN.format(name)
    declared = "const double *x"
    passed = ""  # to the rates of a stage
    if free:
        declared += ", const double *parameters"
        passed = ", parameters"
    head = f"void {name}({declared}, double *mean)\n{{"
    if is_static:
        head = f"static {head}"
    if ode is None:
        yield from (head, *_assigned("mean", outputs, free), "}\n")
        return
    yield f"static void {name}_rates({declared}, double *rates)\n{{"
    yield from (*_assigned("rates", outputs, free), "}\n", head)
    x = [f"x[{i}]" for i in equations.inputs]
    stages = METHODS[ode.method]
    # A table of C is a rectangle.
    weights = [[*row, *[0.0] * (len(stages) - len(row))] for row in stages]
    yield _STEPS.substitute(
        stages=len(stages),
        weights=braced([braced(map(repr, row)) for row in weights]),
        x=braced(x),
        states=ode.state_dim,
        substeps=ode.substeps,
        rates=f"{name}_rates",
        parameters=passed,
        h=repr(ode.step / ode.substeps),
    ).rstrip()
    yield from (f"    mean[{i}] = at[{i}];" for i in range(ode.state_dim))
    yield "}\n"


def _assigned(name: str, outputs: Sequence[str], free: bool) -> Iterator[str]:
    """Yield the lines that write the outputs of a formula."""
    yield "    (void)x;"  # a formula may be a number
    if free:
        yield "    (void)parameters;"
    yield from (f"    {name}[{i}] = {value};" for i, value in enumerate(outputs))


def _functions(name: str) -> Functions:
    """Return functions of texts."""
    infix = {"Add": "+", "Sub": "-", "Mult": "*", "Div": "/"}
    compared = {"Lt": "<", "LtE": "<=", "Gt": ">", "GtE": ">="}

    def called(function: str) -> Callable[..., str]:
        return lambda *parts: f"{function}({', '.join(parts)})"

    def filled(template: str) -> Callable[..., str]:
        return lambda *parts: template.format(*parts)

    return {
        **{function: called(_OTHER_NAMES.get(function, function)) for function in NAMES},
        **{part: filled(f"({{}} {sign} {{}})") for part, sign in infix.items()},
        **{part: filled(f"({{}} {sign} {{}} ? 1.0 : 0.0)") for part, sign in compared.items()},
        "Pow": called("pow"),
        "USub": filled("(-{})"),
        "UAdd": filled("{}"),
        "sign": called(f"{name}_sign"),
        "where": filled("({} != 0.0 ? {} : {})"),
    }


def _curve(name: str, unknown: Unknown, weights: Tensor) -> str:
    """Return an unknown function in C."""
    low, high = unknown.between or (0.0, 0.0)
    return _CURVE.substitute(
        name=name,
        k=len(weights),
        knots=braced(map(repr, unknown.knots.tolist())),
        weights=braced(map(repr, weights.tolist())),
        low=repr(low),
        high=repr(high),
        lengthscale=repr(unknown.lengthscale),
        value=unknown.quantile(
            Text("z"),
            lambda z: Text(f"exp({z})"),
            lambda z: Text(f"0.5 * erfc(-{z} / sqrt(2.0))"),
        ),
    )


def _number(value: float) -> str:
    """Return a number, in brackets if it is negative."""
    text = repr(value)
    return f"({text})" if value < 0 else text
