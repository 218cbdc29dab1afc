"""A fitted model, or the dynamics that hold one, as a function of CasADi."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from gpadjust.export.casadi_equations import equations_function, physics_function
from gpadjust.export.equations import OfPhysics, equations_within, exportable
from gpadjust.export.finite_sum import FiniteSum, finite_sum, model_of
from gpadjust.export.transition import next_state, next_variance, target_columns

ca: Any = None  # CasADi, once it is needed: its libraries and OpenSim's cannot share a process
_TINY = 1e-30  # of a squared distance, at which its root has a derivative


def casadi_function(
    fitted: Any,
    name: str = "predict",
    *,
    physics: Callable[[Any], Any] | None = None,
    variance: bool = True,
    observation_noise: bool = False,
    parameters: bool = False,
) -> Any:
    """Return a fitted model or a physics as a ``casadi.Function``, with derivatives.

    Of a model it maps columns ``x`` and ``f_p`` to ``mean`` and ``variance``, as of
    :meth:`~gpadjust.CKA.predict`; of dynamics ``state``, ``action`` and ``f_p`` as of
    :meth:`LearnedDynamics.predict`. ``f_p`` are the values of the physics there, of several physics
    below each other. There is no such argument without physics, and of a :class:`FormulaPhysics`,
    or an :class:`ODEPhysics` of one: these are in the function.

    Of such a physics itself it maps ``x`` to ``mean``; of dynamics that are one, such as
    :func:`~gpadjust.records.identify` finds, ``state`` and ``action`` to ``mean``.

    Args:
        fitted: As of :func:`c_source`.
        name: The name of the function.
        physics: f_p in CasADi, to take the place of that argument: a ``casadi.Function``, or one of
            Python, from the column of the inputs of f_p to the column of its outputs.
        variance: If True, there is a variance.
        observation_noise: If True, the variance includes the noise.
        parameters: As of :func:`c_source`; they are the last argument.

    Raises:
        ImportError: Without CasADi.
        TypeError, ValueError, RuntimeError: As :func:`c_source`; a ValueError also if ``physics``
            returns another number of values than the model's physics.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.export import casadi_function
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * X, physics=lambda X: X)
        >>> casadi_function(model, physics=lambda x: x)  # doctest: +SKIP
        Function(predict:(x)->(mean,variance) MXFunction)
    """
    fitted = exportable(fitted, name, parameters)
    is_physics = isinstance(fitted, OfPhysics)
    if is_physics and physics is not None:
        raise ValueError(
            "physics=... takes the place of f_p in a model; found a physics, or dynamics that are "
            "one, which have nothing else. Leave it out, or use that function itself."
        )
    if not is_physics:
        model = model_of(fitted)
        terms = finite_sum(model, variance, observation_noise)
    global ca
    try:
        import casadi as ca
    except ImportError as error:
        raise ImportError(
            'casadi_function needs CasADi; run `pip install "gpadjust[export]"`.'
        ) from error
    if is_physics:
        return equations_function(fitted, name, parameters)
    m, count = model.num_outputs, terms.num_physics
    dynamics = fitted if isinstance(fitted, LearnedDynamics) else None
    if dynamics is None:
        arguments = {"x": ca.MX.sym("x", len(model.data.input_names))}
        x = read = ca.vertsplit(arguments["x"])  # inputs of the model, and of f_p
    else:
        spec = dynamics.spec
        sizes = {"state": spec.state_dim, "action": spec.action_dim}
        arguments = {entry: ca.MX.sym(entry, size) for entry, size in sizes.items()}
        state, action = map(ca.vertsplit, arguments.values())
        x = [(*state, *action)[i] for i in spec.model_columns]
        read = [(*state, *action)[i] for i in spec.physics_columns]
        count = count // m * len(spec.moving)  # f_p moves states that the model does not predict
    if physics is None and (within := equations_within(model)):
        parts = [physics_function(equations, "f_p") for equations in within]
        values = ca.vertcat(*(part(ca.vertcat(*read)) for part in parts))
    elif physics is not None:
        values = ca.MX(physics(ca.vertcat(*read)))
    elif count:
        values = arguments["f_p"] = ca.MX.sym("f_p", count)
    else:
        values = ca.MX(0, 1)
    if values.shape != (count, 1):
        raise ValueError(
            f"Expected physics to return a column of {count} values, as the model's physics does, "
            f"got shape {values.shape}."
        )
    f_p = ca.vertsplit(values) if count else []
    if dynamics is None:
        mean, spread = _moments(terms, m, x, f_p)
    else:
        columns = target_columns(
            dynamics, state, f_p, lambda angle: ca.atan2(ca.sin(angle), ca.cos(angle))
        )
        mean, spread = _moments(terms, m, x, columns)
        mean = next_state(dynamics, state, action, mean)
        spread = next_variance(dynamics, spread, ca.MX(0))
    outputs = {"mean": ca.vertcat(*mean)}
    if variance:
        outputs["variance"] = ca.vertcat(*spread)
    return ca.Function(name, [*arguments.values()], [*outputs.values()], [*arguments], [*outputs])


def _moments(s: FiniteSum, m: int, x: list[Any], f_p: list[Any]) -> tuple[list[Any], list[Any]]:
    """Return the mean and variance of each of ``m`` outputs."""
    inputs = []
    for source, function, offset, size in s.columns:
        value = x[source]
        if function:
            value = getattr(ca, function)(value)
        inputs.append((value - offset) / size)
    z = ca.horzcat(*inputs)
    means, variances = list[Any](), list[Any]()
    for g in range(len(s.weights)):  # output g % m of draw g // m
        scale = float(s.scale[g])
        features, start, prior = _features(s, g, g % m, z, f_p)
        means.append(scale * (start + ca.dot(_matrix(s.weights[g]), features)))
        spread = 0.0
        if s.lower is not None:
            lower = ca.tril(_matrix(s.lower[g]))
            u = ca.solve(lower, features) if s.is_solved else lower @ features
            spread = ca.sumsqr(u)  # |L^-1 phi|^2, or |R phi|^2
            if s.is_remainder:
                spread = ca.fmax(prior - spread, s.least * prior)
        variances.append(scale**2 * (spread + float(s.noise[g])))
    mean = [sum(means[j::m]) * (m / len(means)) for j in range(m)]
    mixed = []
    for j in range(m):
        # of a mixture: the mean of the variances, and the variance of the means
        off = [(value - mean[j]) ** 2 for value in means[j::m] if len(means) > m]
        mixed.append((sum(variances[j::m]) + sum(off)) * (m / len(means)))
    return mean, mixed


def _features(s: FiniteSum, g: int, j: int, z: Any, f_p: list[Any]) -> tuple[Any, Any, Any]:
    """Return the features of a Gaussian of output j, its prior mean, and its prior variance."""
    kernels: Any = 0.0
    mean = variance = 0.0
    waves = list[Any]()
    for term in s.terms:
        amplitude, constant = float(term.amplitude[g]), float(term.constant[g])
        f = 1.0
        if term.column is not None:
            f = f_p[int(term.column[j])] / float(term.unit[g])
        basis = f - float(term.center[g])  # b(x)
        mean = mean + f * float(term.mean[g])
        variance = variance + basis * basis * (amplitude + constant)
        if term.frequencies is not None:
            # b(x) sqrt(2 a / D) times cosines and sines, and b(x) sqrt(c)
            angle = _matrix(term.frequencies * term.rate[g]) @ z.T
            size = basis * math.sqrt(amplitude / len(term.frequencies))
            waves += [size * ca.cos(angle), size * ca.sin(angle)]
            if term.has_constant:
                waves.append(basis * math.sqrt(constant))
        elif term.kind:
            # b(x) b(x_i) (a k(x, x_i) + c)
            points = s.points[j % len(s.points)]
            rate = term.rate[g]
            # squared distances in lengthscales, a column
            u = _matrix(points * rate) - ca.repmat(z * _matrix(rate).T, len(points), 1)
            squares = ca.sum2(u**2)
            kernel = amplitude * _kernel(term.kind, squares) + constant
            kernels = kernels + basis * _matrix(term.at_points[g]) * kernel
    if waves:
        return ca.vertcat(*waves), mean, variance
    return kernels, mean, variance


def _kernel(kind: str, squares: Any) -> Any:
    """Return a kernel of squared distances."""
    if kind == "rbf":
        return ca.exp(-squares / 2)
    if kind == "constant":
        return 0.0 * squares
    factor = int(kind.removeprefix("matern")[0])  # 2 nu
    t = ca.sqrt(factor * ca.fmax(squares, _TINY))
    return {1: 1.0, 3: 1.0 + t, 5: 1.0 + t + t**2 / 3}[factor] * ca.exp(-t)


def _matrix(values: Tensor) -> Any:
    """Return numbers in CasADi, a vector as a column."""
    return ca.DM(values.tolist())
