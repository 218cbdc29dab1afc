"""A fitted model, or the dynamics that hold one, as a file of C."""

from __future__ import annotations

import re
from collections.abc import Iterator
from string import Template
from typing import Any

import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export.c_equations import equations_source, physics_lines
from gpadjust.export.equations import (
    Equations,
    OfPhysics,
    check_name,
    equations_within,
    own_dynamics,
    refuse_parameters,
)
from gpadjust.export.finite_sum import Column, FiniteSum, finite_sum, model_of
from gpadjust.export.transition import next_state, next_variance, target_columns

_KERNELS = {  # of r, the squared distance in lengthscales
    "rbf": "exp(-0.5 * r)",
    "matern1/2": "exp(-sqrt(r))",
    "matern3/2": "(1.0 + sqrt(3.0 * r)) * exp(-sqrt(3.0 * r))",
    "matern5/2": "(1.0 + sqrt(5.0 * r) + 5.0 / 3.0 * r) * exp(-sqrt(5.0 * r))",
    "constant": "0.0",
}
_BEGIN = Template("""\
    double each[DRAWS * OUTPUTS]$spread;
    for (int g = 0; g < DRAWS * OUTPUTS; g++) {
        double phi[FEATURES] = {0.0}, sum = 0.0$prior;
""")
_TERM = Template("""\
        const double f$t = $basis, b$t = f$t - center$t[g]; /* $name */
        sum += f$t * mean$t[g];
""")
_PRIOR = Template("        prior += b$t * b$t * (amplitude$t[g] + constant$t[g]);\n")
_KERNEL = Template("""\
        for (int i = 0; i < FEATURES; i++) {
            double r = 0.0;
            for (int k = 0; k < INPUTS; k++) {
                const double u = (z[k] - points[g % POINT_SETS][i][k]) * rate$t[g][k];
                r += u * u;
            }
            phi[i] += b$t * at_points$t[g][i] * (amplitude$t[g] * $kernel + constant$t[g]);
        }
""")
_WAVES = Template("""\
        for (int i = 0; i < $half; i++) {
            double angle = 0.0;
            for (int k = 0; k < INPUTS; k++) angle += z[k] * rate$t[g][k] * frequencies$t[i][k];
            phi[$first + i] = b$t * sqrt(amplitude$t[g] / $half) * cos(angle);
            phi[$first + $half + i] = b$t * sqrt(amplitude$t[g] / $half) * sin(angle);
        }
""")
_MEAN = """\
        for (int i = 0; i < FEATURES; i++) sum += phi[i] * weights[g][i];
        each[g] = scale[g] * sum;
"""
_SOLVED = """\
        if (!variance) continue;
        const double *column = lower[g];
        double squares = 0.0;
        for (int k = 0; k < FEATURES; column += FEATURES - k, k++) {
            const double u = phi[k] / column[0];
            squares += u * u;
            for (int i = 0; i < FEATURES - k; i++) phi[k + i] -= column[i] * u;
        }
"""
_MULTIPLIED = """\
        if (!variance) continue;
        const double *column = lower[g];
        double squares = 0.0, u[FEATURES] = {0.0};
        for (int k = 0; k < FEATURES; column += FEATURES - k, k++)
            for (int i = 0; i < FEATURES - k; i++) u[k + i] += column[i] * phi[k];
        for (int i = 0; i < FEATURES; i++) squares += u[i] * u[i];
"""
_SPREAD = Template("        spread[g] = scale[g] * scale[g] * ($left + noise[g]);\n")
_MIXED = """\
    }
    for (int j = 0; j < OUTPUTS; j++) {
        mean[j] = 0.0;
        for (int g = j; g < DRAWS * OUTPUTS; g += OUTPUTS) mean[j] += each[g] / DRAWS;
"""
_MIXED_VARIANCE = """\
        if (!variance) continue;
        variance[j] = 0.0;
        for (int g = j; g < DRAWS * OUTPUTS; g += OUTPUTS) {
            const double off = each[g] - mean[j];
            variance[j] += (spread[g] + off * off) / DRAWS;
        }
"""


def c_source(
    fitted: Any,
    name: str,
    *,
    variance: bool = True,
    observation_noise: bool = False,
    parameters: bool = False,
) -> str:
    r"""Return a fitted model or a physics as a file of C99.

    It needs ``math.h`` alone and allocates nothing.

    Of a model it has ``void NAME_predict(const double *x, const double *f_p, double *mean, double
    *variance)``, which is :meth:`~gpadjust.CKA.predict` at one point. Of dynamics it has ``void
    NAME_step(const double *state, const double *action, const double *f_p, double *mean, double
    *variance)``, which is :meth:`LearnedDynamics.predict`; ``mean`` may be ``state`` itself.
    ``f_p`` is what the physics returns there, of several physics side by side. It is no argument
    without physics, and of a :class:`FormulaPhysics`, or an :class:`ODEPhysics` of one with a fixed
    step: these are in the file. A ``variance`` that is ``NULL`` is not computed, which is faster.
    The same model makes the same file.

    Of such a physics itself it has ``void NAME_predict(const double *x, double *mean)``; of
    dynamics that are one, such as :func:`~gpadjust.records.identify` finds, ``void
    NAME_step(const double *state, const double *action, double *mean)``.

    Args:
        fitted: The model, dynamics that have learnt, an identification, or a physics.
        name: What the names of functions begin with. One unit of compilation takes several files.
        variance: Whether there is a variance. Its tables are the most of the file: the square of
            the number of points or features, for each output and draw.
        observation_noise: If True, the variance includes that of the noise.
        parameters: Of a physics, or dynamics that are one: if True, its unknown parameters are an
            argument, ``const double *parameters`` before ``mean``, in the order of the physics.
            Default: they are at their posterior means, of a physics itself at the guesses.

    Raises:
        TypeError: If it is none of these, or a physics that is not written in formulas.
        ValueError: If ``name`` is none in C, the model is no finite sum, or ``parameters`` are not
            for it; with the way out.
        RuntimeError: If the dynamics have learnt nothing yet.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.export import c_source
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> code = c_source(CKA(X, X.sin(), physics=lambda X: X), "pump")
        >>> "void pump_predict(const double *x, const double *f_p, double *mean" in code
        True
    """
    check_name(name)
    fitted = own_dynamics(fitted)
    if isinstance(fitted, OfPhysics):
        return "\n".join(equations_source(fitted, name, parameters)) + "\n"
    refuse_parameters(parameters)
    model = model_of(fitted)
    found, data = finite_sum(model, variance, observation_noise), model.data
    is_step, body = isinstance(fitted, LearnedDynamics), "".join(_body(found, variance))
    tables = {n: t for n, t in _tables(found).items() if re.search(rf"\b{n}\[", body)}
    within = equations_within(model)
    values = ["double *mean", *["double *variance"] * variance]
    f_p, written = ["const double *f_p"], ["", *_written(within or [], name)]
    given = f_p * (within is None or (is_step and bool(within))) + values
    if within and not is_step:
        body = "".join(f"    {line}\n" for line in _own_f_p(within, name, "x")) + body
    about = [
        f"{model!r}. Made by gpadjust; numbers are in the units of the data.",
        f"x: {', '.join(data.input_names)}.",
        f"f_p: {found.num_physics} values that the physics returns at x"
        f"{', which is in this file' * bool(within)}.",
        *_told(fitted, model),
        f"mean: {', '.join(data.output_names)}.",
        "variance: in their square, "
        f"{'with' if observation_noise else 'without'} the noise; NULL if it is not wanted.",
        f"Numbers in tables: {sum(table.numel() for table in tables.values())}.",
    ]
    head = ["/*", *(f" * {line.replace('*/', '* /')}" for line in about), " */", ""]
    sizes = _sizes(found, model.num_outputs)
    lines = [f"enum {{ {', '.join(f'{n} = {size}' for n, size in sizes.items())} }};"]
    lines += [*(_declared(*table) for table in tables.items()), ""]
    lines += [f"{'static ' * is_step}void {name}_predict(const double *x, {', '.join(given)})"]
    lines += [f"{{\n{body}    }}\n}}"]
    # Sizes and tables have names of their own, so that one unit may contain several models.
    own = "|".join([*sizes, *tables])
    code = re.sub(rf"(?<!_)\b({own})\b", rf"{name}_\1", "\n".join(lines))
    more = []
    if isinstance(fitted, LearnedDynamics):
        given = f_p * (within is None) + values
        more = ["", *_step(fitted, name, given, found.num_physics, within or [])]
    return "\n".join([*head, "#include <math.h>", *written, code, *more]) + "\n"


def _written(within: list[Equations], name: str) -> Iterator[str]:
    """Yield functions of the physics that are written in formulas, ``NAME_f_p0`` and so on."""
    for i, each in enumerate(within):
        yield from physics_lines(each, f"{name}_f_p{i}")


def _own_f_p(within: list[Equations], name: str, x: str) -> Iterator[str]:
    """Yield lines that call them."""
    size = len(within[0].formula.outputs)
    yield f"double f_p[{size * len(within)}];"
    yield from (f"{name}_f_p{i}({x}, f_p + {i * size});" for i in range(len(within)))


def _told(fitted: GP | LearnedDynamics, model: GP) -> Iterator[str]:
    """Return lines on the parameters of f_p in this model, and on the step of dynamics."""
    if model.physics_parameters:
        means = model.physics_parameters.mean.tolist()
        pairs = zip(model.physics_parameters, means, strict=True)
        yield f"Its parameters are {', '.join(f'{name} = {value!r}' for name, value in pairs)}."
    if isinstance(fitted, LearnedDynamics) and fitted.spec.step is not None:
        yield f"A step lasts {fitted.spec.step!r}."


def _sizes(s: FiniteSum, num_outputs: int) -> dict[str, int]:
    """Return the sizes of the tables."""
    return {
        "INPUTS": len(s.columns),
        "OUTPUTS": num_outputs,
        "DRAWS": len(s.weights) // num_outputs,
        "FEATURES": s.weights.shape[-1],
        "POINT_SETS": len(s.points),
    }


def _tables(s: FiniteSum) -> dict[str, Tensor]:
    """Return all numbers, by their names in C."""
    found = s._asdict()
    for t, term in enumerate(s.terms):
        found |= {f"{name}{t}": value for name, value in term._asdict().items()}
    if s.lower is not None:  # by columns: loops along them have no sum to wait for
        rows, columns = torch.triu_indices(*2 * s.weights.shape[-1:])
        found["lower"] = s.lower[:, columns, rows]
    return {name: value for name, value in found.items() if isinstance(value, Tensor)}


def _body(s: FiniteSum, variance: bool) -> Iterator[str]:
    """Return the sum at one point."""
    yield f"    const double z[INPUTS] = {{{', '.join(map(_input, s.columns))}}};\n"
    more = {"spread": ", spread[DRAWS * OUTPUTS]" * variance}
    more["prior"] = ", prior = 0.0" * (variance and s.is_remainder)
    yield _BEGIN.substitute(more)
    first = 0
    for t, term in enumerate(s.terms):
        basis = "1.0" if term.column is None else f"f_p[column{t}[g % OUTPUTS]] / unit{t}[g]"
        yield _TERM.substitute(t=t, basis=basis, name=term.name.replace("*/", "* /"))
        if more["prior"]:
            yield _PRIOR.substitute(t=t)
        if term.frequencies is not None:
            half = len(term.frequencies)
            yield _WAVES.substitute(t=t, half=half, first=first)
            first += 2 * half
            if term.has_constant:
                yield f"        phi[{first}] = b{t} * sqrt(constant{t}[g]);\n"
                first += 1
        elif term.kind:
            yield _KERNEL.substitute(t=t, kernel=_KERNELS[term.kind])
    yield _MEAN
    if variance:
        left = f"fmax(prior - squares, {s.least} * prior)" if s.is_remainder else "squares"
        yield _SOLVED if s.is_solved else _MULTIPLIED
        yield _SPREAD.substitute(left=left)
    yield _MIXED
    if variance:
        yield _MIXED_VARIANCE


def _input(column: Column) -> str:
    """Return an input of the kernels in C."""
    value = f"x[{column.source}]"
    value = f"{column.function}({value})" if column.function else value
    plain = (column.offset, column.size) == (0.0, 1.0)
    return value if plain else f"({value} - {column.offset!r}) / {column.size!r}"


def _declared(name: str, table: Tensor) -> str:
    """Return a table in C."""
    kind = "double" if table.is_floating_point() else "int"
    shape = "".join(f"[{size}]" for size in table.shape)
    return f"static const {kind} {name}{shape} = {_braces(table.tolist())};"


def _braces(values: list[Any]) -> str:
    """Return nested numbers in C, a few in a line."""
    if isinstance(values[0], list):
        return "{" + ",\n".join(map(_braces, values)) + "}"
    parts = [", ".join(map(repr, values[i : i + 6])) for i in range(0, len(values), 6)]
    return "{" + ",\n ".join(parts) + "}"


def _step(
    dynamics: LearnedDynamics,
    name: str,
    given: list[str],
    num_physics: int,
    within: list[Equations],
) -> Iterator[str]:
    """Return the function of dynamics, which calls that of their model."""
    spec, m = dynamics.spec, dynamics.model.num_outputs
    state, action = _entries("state", spec.state_dim), _entries("action", spec.action_dim)
    yield f"/* state, mean: {', '.join(spec.states)}; action: {', '.join(spec.actions)}."
    yield f" * f_p: the next {', '.join(spec.states[i] for i in spec.moving)} by the physics. */"
    yield f"void {name}_step(const double *state, const double *action, {', '.join(given)})"
    yield "{"
    x, arguments = [(*state, *action)[i] for i in spec.model_columns], ["x"]
    yield f"    const double x[{len(x)}] = {{{', '.join(x)}}};"
    if within:
        read = [(*state, *action)[i] for i in spec.physics_columns]
        yield f"    const double read[{len(read)}] = {{{', '.join(read)}}};"
        yield from (f"    {line}" for line in _own_f_p(within, name, "read"))
    if num_physics:
        f_p = _entries("f_p", num_physics // m * len(spec.moving))
        columns = target_columns(dynamics, state, f_p, _wrapped)
        yield f"    const double columns[{num_physics}] = {{{', '.join(columns)}}};"
        arguments.append("columns")
    has_variance = "double *variance" in given
    yield f"    double learnt[{m}]{f', spread[{m}]' * has_variance};"
    arguments += ["learnt"] + ["variance ? spread : 0"] * has_variance
    yield f"    {name}_predict({', '.join(arguments)});"
    values = next_state(dynamics, state, action, _entries("learnt", m))
    # All of them are there before `mean` is written, which may be `state`.
    yield f"    const double next[{len(values)}] = {{{', '.join(values)}}};"
    yield f"    for (int i = 0; i < {len(values)}; i++) mean[i] = next[i];"
    if has_variance:
        yield "    if (!variance) return;"
        variances = next_variance(dynamics, _entries("spread", m), _Text("0.0"))
        yield from (f"    variance[{i}] = {value};" for i, value in enumerate(variances))
    yield "}"


class _Text(str):
    """An expression in C."""

    def __add__(self, other: str) -> _Text:
        return _Text(f"({self} + {other})")

    def __sub__(self, other: str) -> _Text:
        return _Text(f"({self} - {other})")

    def __rmul__(self, number: Any) -> _Text:
        return _Text(f"{number!r} * {self}")


def _entries(name: str, size: int) -> list[_Text]:
    return [_Text(f"{name}[{i}]") for i in range(size)]


def _wrapped(angle: _Text) -> _Text:
    return _Text(f"atan2(sin{angle}, cos{angle})")
