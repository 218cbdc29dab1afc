"""A simulator, emulated from its runs, as physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust.checks import check_kind, checked_whole
from gpadjust.core import MATERN52, RBF, Stationary, ZeroMeanGP, fit
from gpadjust.core.model import GP
from gpadjust.core.posterior import MixturePosterior
from gpadjust.core.terms import WeightedSum
from gpadjust.physics import ParameterValues, Physics, Unknown

_PLACES = 128  # at which the errors of the emulator are decomposed


class EmulatedPhysics(Physics):
    r"""A simulator, emulated from its runs, with the uncertainty of the emulator.

    The emulator is a Gaussian process of the runs, fitted when the physics is made. f_p is a
    function from its posterior,

    .. math:: f_p(x) = m(x) + \sum_{k=1}^K z_k v_k(x), \quad z_k \sim N(0, 1),

    with the mean m and the principal components v of the errors. The z are further unknown
    parameters, ``emulator_1`` and so on, 0 before a fit. Intervals are wide where there are no
    runs, and measurements correct the emulator, too. With unknown parameters that are inputs of the
    runs, ``CKA`` and ``PhysicsMeanGP`` are the calibration of Kennedy and O'Hagan (2001), with the
    emulator fitted to the runs alone.

    Args:
        runs_X: Inputs of the runs, ``N x (d + p)``: the inputs of the data, and then values of the
            unknown parameters. In a frame, columns with the names of the parameters, with or
            without a unit, such as ``"drag [1]"``.
        runs_Y: Outputs of the runs, ``N x m``; NaN where one is missing.
        inputs: The columns of the data that are the first ``d`` inputs of the runs. Default: all.
        unknowns: The unknown parameters by name.
        model_factory: Makes the emulator of ``X`` and ``Y``. Default: ``ZeroMeanGP`` with an RBF or
            a Matern 5/2 kernel, whichever predicts left-out runs with the higher density.
            ``functools.partial(CKA, physics=...)`` of a formula needs fewer runs.
        fit_options: Options of its :func:`~gpadjust.fit`, such as ``{"method": "map"}``.
        num_components: Number ``K`` of components; their size includes the omitted components.
        name: The name in messages. Default: the name of the class.

    Raises:
        TypeError: If the factory does not make an exact model of this library.
        ValueError: If there are fewer columns than unknown parameters, or the runs are not data.

    Example:
        >>> from gpadjust.core import PhysicsMeanGP
        >>> runs_X = torch.linspace(0, 3, 9, dtype=torch.float64).unsqueeze(-1)
        >>> simulator = EmulatedPhysics(runs_X, torch.sin(2 * runs_X), num_components=4)
        >>> X = runs_X[::2]
        >>> model = PhysicsMeanGP(X, torch.sin(2 * X) + X, physics=simulator)
        >>> result = fit(model)
        >>> round(model.predict(torch.tensor([[1.1]]).double()).mean.item(), 1)
        1.9
    """

    def __init__(
        self, runs_X: Any, runs_Y: Any, *, inputs: Sequence[int] | None = None,
        unknowns: Mapping[str, Unknown] | None = None,
        model_factory: Callable[[Any, Any], GP] | None = None,
        fit_options: Mapping[str, Any] | None = None, num_components: int = 8,
        name: str | None = None,
    ) -> None:  # fmt: skip
        number = checked_whole("num_components", num_components, 1)
        parameters = dict(unknowns or {})
        components = {f"emulator_{k + 1}": Unknown(0.0, sd=1.0) for k in range(number)}
        if taken := sorted(parameters.keys() & components.keys()):
            raise ValueError(
                f"Expected other names than {taken}, which are components of the emulator's error."
            )
        super().__init__(unknowns=parameters | components, inputs=inputs, name=name)
        runs_X = _with_unknowns_last(runs_X, [*parameters], self.name)
        self.num_inputs = runs_X.shape[-1] - len(parameters)
        if self.num_inputs < 1:
            raise ValueError(
                f"Expected runs N x (d + {len(parameters)}): the inputs of the data, and then "
                f"{len(parameters)} unknown parameter(s); found shape {tuple(runs_X.shape)}."
            )
        emulator = _fitted(runs_X, runs_Y, model_factory, dict(fit_options or {}))
        self.num_outputs = emulator.num_outputs
        # A tuple hides the emulator from torch: fits do not change it, copies share it.
        self._emulator = (emulator,)
        self._components = _Components(emulator, number)
        self._last: tuple[Tensor, Tensor] | None = None  # the last rows, and the components there

    @property
    def emulator(self) -> GP:
        """The fitted model of the runs, for inspection: ``emulator.left_out()``."""
        return self._emulator[0]

    def read(self, X: Tensor) -> Tensor:
        """Return the columns of ``X`` that the runs have, and check their number."""
        columns = super().read(X)
        if columns.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected {self.num_inputs} columns, as the runs of {self.name!r} have in "
                f"addition to the unknown parameters; found {columns.shape[-1]}. Choose columns of "
                "the data by inputs=[...], and name the unknown inputs in unknowns={...}."
            )
        return columns

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the data have the inputs of the runs in another order."""
        of_runs = self.emulator.data.input_names[: self.num_inputs]
        columns = tuple(names) if self.inputs is None else tuple(names[i] for i in self.inputs)
        if columns != of_runs and {*columns} == {*of_runs}:
            raise ValueError(
                f"Expected the inputs {of_runs} of the runs of {self.name!r} in this order; found "
                f"{columns}. Give inputs=[...], the numbers of the columns."
            )

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs ``N x m`` of the function with each row's parameters."""
        p = self.emulator.data.X.shape[-1] - self.num_inputs
        values = parameters[0].rows
        rows = torch.cat([X, values[:, :p]], -1).double()
        if rows.requires_grad and torch.is_grad_enabled():
            parts = self._components.evaluate(rows)
        else:  # draws of z ask for the same rows again and again
            rows, place = rows.unique(dim=0, return_inverse=True)
            if self._last is None or not torch.equal(self._last[0], rows):
                self._last = (rows, self._components.evaluate(rows))
            parts = self._last[1][place]
        # m(x) + sum_k z_k v_k(x)
        z = values[:, p:].to(parts).unsqueeze(-1)
        return parts[..., 0] + (parts[..., 1:] @ z).squeeze(-1)


class _Components:
    r"""The mean of an emulator and the principal components of its errors.

    With the posterior covariance :math:`C(R, R) = E \Lambda E^T` at some places R, the components
    are :math:`v_k(x) = C(x, R) \, e_k / \sqrt{\lambda_k}` (Nystrom). For an emulator with draws s,
    C is the covariance of the mixture, :math:`E_s C_s + Cov_s(m_s, m_s)`.
    """

    @torch.no_grad()
    def __init__(self, emulator: GP, number: int) -> None:
        X = emulator.data.X
        self.emulator = emulator
        self.low = X.amin(0)
        self.range = (X.amax(0) - self.low).where(X.amax(0) > self.low, torch.ones_like(self.low))
        # Places R in the box of the runs, and others between them.
        sobol = SobolEngine(X.shape[-1], seed=0, scramble=True)
        unit = sobol.draw(2 * _PLACES, dtype=X.dtype).to(X)
        places, others = (self.low + self.range * unit).chunk(2)
        self.data = emulator.conditioning()
        self.places = emulator.evaluate(places)
        mean, K = self.data.joint(self.places)  # S x m x Q (x Q)
        C = MixturePosterior(mean, K).distribution.covariance_matrix
        # C = E Lambda E^T; weights are e_k / sqrt(lambda_k) of the largest eigenvalues.
        size, vectors = torch.linalg.eigh(C)
        number = min(number, len(size))
        largest = size[-number:].flip(0).clamp_min(1e-300)
        weights = vectors[:, -number:].flip(1) / largest.sqrt()
        weights = weights.reshape(*mean.shape[1:], number)
        # C(x, R) e = k(x, R) e - k(x, runs) K^-1 k(runs, R) e + Cov_s(m_s(x), m_s(R)) e
        cross = self.places.cross(self.data.train) * self.data.observed.unsqueeze(-2)
        solved = torch.cholesky_solve(cross.mT, self.data.chol)  # S x m x n x Q
        of_means = torch.einsum("smq,mqk->sk", mean - mean.mean(0), weights)
        self.weights = [weights, solved @ weights, of_means]  # m x Q x K, S x m x n x K, S x K
        # Omitted components, and errors between places, increase the size of all components.
        function = emulator.evaluate(others)
        explained = self._moments(function)[1].square().sum().clamp_min(1e-300)
        factor = (self._variance(function).sum() / explained).sqrt()
        self.weights = [factor * part for part in self.weights]

    def evaluate(self, rows: Tensor) -> Tensor:
        """Return the mean and the components at rows ``N x D``, ``N x m x (1 + K)``."""
        function = self.emulator.evaluate(rows, self.data.train.values)
        mean, components = self._moments(function)
        # Outside the box of the runs there is no place: scale to the emulator's variance.
        is_outside = ((rows < self.low) | (rows > self.low + self.range)).any(-1)
        if is_outside.any():
            size = components[:, is_outside].square().sum(-1).clamp_min(1e-30)
            factor = torch.ones_like(mean)
            factor[:, is_outside] = (self._variance(function.of_rows(is_outside)) / size).sqrt()
            components = components * factor.unsqueeze(-1)
        parts = torch.cat([mean.unsqueeze(-1), components], -1)
        return (parts * self.emulator.unit.unsqueeze(-1)).movedim(0, 1)

    def _moments(self, function: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return the mean ``m x N`` and the components ``m x N x K``."""
        of_places, of_runs, of_means = self.weights
        both = torch.cat([of_runs, self.data.alpha.unsqueeze(-1)], -1)
        both = both * self.data.observed.unsqueeze(-1)
        by_runs = function.cross_times(self.data.train, both)
        components = function.cross_times(self.places, of_places) - by_runs[..., :-1]
        mean = function.mean + by_runs[..., -1]  # S x m x N
        away = (mean - mean.mean(0)).movedim(0, -1)  # m x N x S
        return mean.mean(0), components.mean(0) + away @ of_means / len(mean)

    def _variance(self, function: WeightedSum) -> Tensor:
        """Return the variance by the emulator, ``m x N``."""
        mean, variance = self.data.moments(function)
        # Var = E_s Var_s + Var_s m_s
        return variance.mean(0) + mean.var(0, correction=0)


def _fitted(
    runs_X: Any, runs_Y: Any, model_factory: Callable[[Any, Any], GP] | None, options: Any
) -> GP:
    """Return the fitted model of the runs, by default the better of two kernels."""
    kernels = [Stationary(profile) for profile in (RBF, MATERN52)]
    factories: list[Any] = [partial(ZeroMeanGP, covar_module=kernel) for kernel in kernels]
    if model_factory:
        factories = [model_factory]
    fitted = []
    for factory in factories:
        emulator = factory(runs_X, runs_Y)
        check_kind("model_factory's model", emulator, GP, "a GP")
        if type(emulator).on_gaussian_scale is not GP.on_gaussian_scale:
            raise ValueError(
                f"Expected an emulator without a link; found a {type(emulator).__name__}. Emulate "
                "log(Y), for example, and take its exponential as a physics."
            )
        fit(emulator, **options)
        fitted.append(emulator.eval().requires_grad_(False))
    # The sum of left-out log densities compares the kernels.
    return max(fitted, key=lambda e: float(e.left_out().log_density(e.data.Y).nansum()))


def _with_unknowns_last(runs_X: Any, names: list[str], physics: str) -> Any:
    """Return runs whose last columns are the unknown parameters, if columns have names."""
    columns = [*getattr(runs_X, "columns", ())]
    if not columns:
        return runs_X
    by_name = {str(column).partition(" [")[0]: column for column in columns}  # "drag [1]" is drag
    by_name |= {column: column for column in columns}
    if absent := [name for name in names if name not in by_name]:
        raise ValueError(
            f"Expected columns of the names {', '.join(absent)} in the runs of {physics!r}, the "
            f"unknown parameters; found {columns}."
        )
    last = [by_name[name] for name in names]
    return runs_X[[column for column in columns if column not in last] + last]
