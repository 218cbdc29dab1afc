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
from gpadjust.export.c_equations import (
    Text,
    braced,
    comment,
    entries,
    equations_source,
    parameters_text,
    physics_lines,
)
from gpadjust.export.equations import Equations, OfPhysics, equations_within, exportable
from gpadjust.export.finite_sum import Column, FiniteSum, finite_sum, model_of
from gpadjust.export.transition import next_state, next_variance, target_columns

_KERNELS = {  # of r, the squared distance in lengthscales
    "rbf": "exp(-0.5 * r)",
    "matern1/2": "exp(-sqrt(r))",
    "matern3/2": "(1.0 + sqrt(3.0 * r)) * exp(-sqrt(3.0 * r))",
    "matern5/2": "(1.0 + sqrt(5.0 * r) + 5.0 / 3.0 * r) * exp(-sqrt(5.0 * r))",
    "constant": "0.0",
}
# Of each Gaussian g: its features phi, and the sum of its mean.
_BEGIN = Template("""\
    double each[DRAWS * OUTPUTS]$spread;
    for (int g = 0; g < DRAWS * OUTPUTS; g++) {
        double phi[FEATURES] = {0.0}, sum = 0.0$prior;
""")
# f m_g, and the basis b = f - center
_TERM = Template("""\
        const double f$t = $basis, b$t = f$t - center$t[g]; /* $name */
        sum += f$t * mean$t[g];
""")
# b^2 (a + c), as k(x, x) = 1
_PRIOR = Template("        prior += b$t * b$t * (amplitude$t[g] + constant$t[g]);\n")
# phi_i = b(x) b(x_i) (a k(x, x_i) + c)
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
# phi = b sqrt(2 a / D) (cos w^T x, sin w^T x), D / 2 frequencies
_WAVES = Template("""\
        for (int i = 0; i < $half; i++) {
            double angle = 0.0;
            for (int k = 0; k < INPUTS; k++) angle += z[k] * rate$t[g][k] * frequencies$t[i][k];
            phi[$first + i] = b$t * sqrt(amplitude$t[g] / $half) * cos(angle);
            phi[$first + $half + i] = b$t * sqrt(amplitude$t[g] / $half) * sin(angle);
        }
""")
# scale (prior mean + phi^T w)
_MEAN = """\
        for (int i = 0; i < FEATURES; i++) sum += phi[i] * weights[g][i];
        each[g] = scale[g] * sum;
"""
# |L^-1 phi|^2, by columns of L
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
# |R phi|^2, by columns of R
_MULTIPLIED = """\
        if (!variance) continue;
        const double *column = lower[g];
        double squares = 0.0, u[FEATURES] = {0.0};
        for (int k = 0; k < FEATURES; column += FEATURES - k, k++)
            for (int i = 0; i < FEATURES - k; i++) u[k + i] += column[i] * phi[k];
        for (int i = 0; i < FEATURES; i++) squares += u[i] * u[i];
"""
_SPREAD = Template("        spread[g] = scale[g] * scale[g] * ($left + noise[g]);\n")
# The mean of a mixture, and its variance: the mean variance, and the variance of the means.
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

    It needs ``math.h`` alone and allocates nothing. The same model makes the same file.

    Of a model it has ``void NAME_predict(const double *x, const double *f_p, double *mean, double
    *variance)``, which is :meth:`~gpadjust.CKA.predict` at one point. Of dynamics it has ``void
    NAME_step(const double *state, const double *action, const double *f_p, double *mean, double
    *variance)``, which is :meth:`LearnedDynamics.predict`; ``mean`` may be ``state`` itself.
    ``f_p`` are the values of the physics there, of several physics side by side. There is no such
    argument without physics, and of a :class:`FormulaPhysics`, or an :class:`ODEPhysics` of one:
    these are in the file. A ``variance`` that is ``NULL`` is not computed, which is faster.

    Of such a physics itself it has ``void NAME_predict(const double *x, double *mean)``; of
    dynamics that are one, such as :func:`~gpadjust.records.identify` finds, ``void
    NAME_step(const double *state, const double *action, double *mean)``.

    Args:
        fitted: The model, dynamics that have learnt, an identification, or a physics.
        name: The beginning of the names of functions. One unit of compilation takes several files.
        variance: If True, there is a variance. Its tables are the most of the file: the square of
            the number of points or features, for each output and draw.
        observation_noise: If True, the variance includes the noise.
        parameters: Of a physics, or dynamics that are one: if True, its unknown parameters are an
            argument, ``const double *parameters`` before ``mean``, in the order of the physics.
            Default: they are at their posterior means, of a physics itself at the guesses.

    Raises:
        TypeError: If it is another object, or a physics that is not written in formulas.
        ValueError: If C cannot have the ``name``, the model is not a finite sum, or ``parameters``
            are not for it; with the way out.
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
    fitted = exportable(fitted, name, parameters)
    if isinstance(fitted, OfPhysics):
        return "\n".join(equations_source(fitted, name, parameters)) + "\n"
    model = model_of(fitted)
    terms = finite_sum(model, variance, observation_noise)
    within = equations_within(model)
    is_argument = within is None  # f_p of the function
    within = within or []
    dynamics = fitted if isinstance(fitted, LearnedDynamics) else None
    spec = getattr(dynamics, "spec", None)
    about = [*_about(model, terms.num_physics, bool(within), spec, observation_noise)]
    body = "".join(_body(terms, variance))
    # A model calls equations of the file itself; dynamics do it in their step.
    has_f_p = is_argument
    if within and dynamics is not None:
        has_f_p = True
    elif within:
        body = "".join(f"    {line}\n" for line in _own_f_p(within, name, "x")) + body
    arguments = ["const double *x", *_arguments(has_f_p, variance)]
    tables = {n: t for n, t in _tables(terms).items() if re.search(rf"\b{n}\[", body)}
    about.append(f"Numbers in tables: {sum(table.numel() for table in tables.values())}.")
    sizes = {
        "INPUTS": len(terms.columns),
        "OUTPUTS": model.num_outputs,
        "DRAWS": len(terms.weights) // model.num_outputs,
        "FEATURES": terms.weights.shape[-1],
        "POINT_SETS": len(terms.points),
    }
    head = f"void {name}_predict({', '.join(arguments)})"
    if dynamics is not None:
        head = f"static {head}"
    lines = [
        f"enum {{ {', '.join(f'{n} = {size}' for n, size in sizes.items())} }};",
        *(_declared(*table) for table in tables.items()),
        "",
        head,
        f"{{\n{body}    }}\n}}",
    ]
    # Sizes and tables get a prefix, so that one unit may contain several models.
    local = "|".join([*sizes, *tables])
    code = [re.sub(rf"(?<!_)\b({local})\b", rf"{name}_\1", "\n".join(lines))]
    if dynamics is not None:
        arguments = _arguments(is_argument, variance)
        code += ["", *_step(dynamics, name, arguments, terms.num_physics, within)]
    beginning = [*comment(about), "#include <math.h>", ""]
    for i, equations in enumerate(within):
        beginning += physics_lines(equations, f"{name}_f_p{i}")
    return "\n".join(beginning + code) + "\n"


def _arguments(has_f_p: bool, variance: bool) -> list[str]:
    """Return the arguments of a function of C after its inputs."""
    arguments = ["double *mean"]
    if has_f_p:
        arguments.insert(0, "const double *f_p")
    if variance:
        arguments.append("double *variance")
    return arguments


def _own_f_p(within: list[Equations], name: str, x: str) -> Iterator[str]:
    """Yield lines that call the physics of the file, ``NAME_f_p0`` and so on."""
    size = len(within[0].formula.outputs)
    yield f"double f_p[{size * len(within)}];"
    yield from (f"{name}_f_p{i}({x}, f_p + {i * size});" for i in range(len(within)))


def _about(model: GP, num_physics: int, is_within: bool, spec: Any, noise: bool) -> Iterator[str]:
    """Yield lines on the content of the file."""
    yield f"{model!r}. Made by gpadjust; numbers are in the units of the data."
    yield f"x: {', '.join(model.data.input_names)}."
    place = ""
    if is_within:
        place = ", which is in this file"
    yield f"f_p: {num_physics} values that the physics returns at x{place}."
    if model.physics_parameters:
        means = model.physics_parameters.mean.tolist()
        yield parameters_text(model.physics_parameters, means)
    if spec is not None and spec.step is not None:
        yield f"A step lasts {spec.step!r}."
    yield f"mean: {', '.join(model.data.output_names)}."
    with_noise = "with" if noise else "without"
    yield f"variance: in their square, {with_noise} the noise; NULL if it is not wanted."


def _tables(s: FiniteSum) -> dict[str, Tensor]:
    """Return all numbers, by their names in C."""
    tables = s._asdict()
    for t, term in enumerate(s.terms):
        tables |= {f"{name}{t}": value for name, value in term._asdict().items()}
    if s.lower is not None:  # by columns: loops along them have no sum to wait for
        rows, columns = torch.triu_indices(*2 * s.weights.shape[-1:])
        tables["lower"] = s.lower[:, columns, rows]
    return {name: value for name, value in tables.items() if isinstance(value, Tensor)}


def _body(s: FiniteSum, variance: bool) -> Iterator[str]:
    """Yield the parts of the sum at one point."""
    yield f"    const double z[INPUTS] = {braced(map(_input, s.columns))};\n"
    has_prior = variance and s.is_remainder
    spread = prior = ""
    if variance:
        spread = ", spread[DRAWS * OUTPUTS]"
    if has_prior:
        prior = ", prior = 0.0"
    yield _BEGIN.substitute(spread=spread, prior=prior)
    first = 0  # feature of a term of waves
    for t, term in enumerate(s.terms):
        basis = "1.0"
        if term.column is not None:
            basis = f"f_p[column{t}[g % OUTPUTS]] / unit{t}[g]"
        yield _TERM.substitute(t=t, basis=basis, name=term.name.replace("*/", "* /"))
        if has_prior:
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
        yield _SOLVED if s.is_solved else _MULTIPLIED
        left = "squares"
        if s.is_remainder:
            left = f"fmax(prior - squares, {s.least} * prior)"
        yield _SPREAD.substitute(left=left)
    yield _MIXED
    if variance:
        yield _MIXED_VARIANCE


def _input(column: Column) -> str:
    """Return an input of the kernels in C."""
    value = f"x[{column.source}]"
    if column.function:
        value = f"{column.function}({value})"
    if (column.offset, column.size) == (0.0, 1.0):
        return value
    return f"({value} - {column.offset!r}) / {column.size!r}"


def _declared(name: str, table: Tensor) -> str:
    """Return a table in C."""
    kind = "double" if table.is_floating_point() else "int"
    shape = "".join(f"[{size}]" for size in table.shape)
    return f"static const {kind} {name}{shape} = {_braces(table.tolist())};"


def _braces(values: list[Any]) -> str:
    """Return nested numbers in C, a few in a line."""
    if isinstance(values[0], list):
        return "{" + ",\n".join(map(_braces, values)) + "}"
    # repr has all digits of a float64
    parts = [", ".join(map(repr, values[i : i + 6])) for i in range(0, len(values), 6)]
    return "{" + ",\n ".join(parts) + "}"


def _step(
    dynamics: LearnedDynamics,
    name: str,
    arguments: list[str],
    num_physics: int,
    within: list[Equations],
) -> Iterator[str]:
    """Yield the function of dynamics, which calls that of their model."""
    spec, m = dynamics.spec, dynamics.model.num_outputs
    state, action = entries("state", spec.state_dim), entries("action", spec.action_dim)
    yield f"/* state, mean: {', '.join(spec.states)}; action: {', '.join(spec.actions)}."
    yield f" * f_p: the next {', '.join(spec.states[i] for i in spec.moving)} by the physics. */"
    yield f"void {name}_step(const double *state, const double *action, {', '.join(arguments)})"
    yield "{"
    x = [(*state, *action)[i] for i in spec.model_columns]
    yield f"    const double x[{len(x)}] = {braced(x)};"
    values = ["x"]  # arguments of the model's function
    if within:
        read = [(*state, *action)[i] for i in spec.physics_columns]
        yield f"    const double read[{len(read)}] = {braced(read)};"
        yield from (f"    {line}" for line in _own_f_p(within, name, "read"))
    if num_physics:
        f_p = entries("f_p", num_physics // m * len(spec.moving))
        columns = target_columns(
            dynamics, state, f_p, lambda angle: Text(f"atan2(sin{angle}, cos{angle})")
        )
        yield f"    const double columns[{num_physics}] = {braced(columns)};"
        values.append("columns")
    has_variance = "double *variance" in arguments
    results = [f"learnt[{m}]"]
    values.append("learnt")
    if has_variance:
        results.append(f"spread[{m}]")
        values.append("variance ? spread : 0")
    yield f"    double {', '.join(results)};"
    yield f"    {name}_predict({', '.join(values)});"
    following = next_state(dynamics, state, action, entries("learnt", m))
    # All of them are there before `mean` is written, which may be `state`.
    yield f"    const double next[{len(following)}] = {braced(following)};"
    yield f"    for (int i = 0; i < {len(following)}; i++) mean[i] = next[i];"
    if has_variance:
        yield "    if (!variance) return;"
        variances = next_variance(dynamics, entries("spread", m), Text("0.0"))
        yield from (f"    variance[{i}] = {value};" for i, value in enumerate(variances))
    yield "}"
