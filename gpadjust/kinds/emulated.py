"""A simulator that is known by its runs, as physics."""

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

_PLACES = 128  # at which errors are told apart


class EmulatedPhysics(Physics):
    r"""A simulator that is known by its runs, with what an emulator of them does not know.

    The emulator is a Gaussian process of the runs, fitted when the physics is made. f_p is one of
    the functions that the simulator may be by its posterior,

    .. math:: f_p(x) = m(x) + \sum_{k=1}^K z_k v_k(x), \quad z_k \sim N(0, 1),

    with its mean m and the principal components v of its errors. The z are further unknown
    parameters ``emulator_1`` and so on, 0 before a fit, so that each draw of a model contains one
    function, intervals are wide where there are no runs, and measurements correct the emulator,
    too. With unknown parameters that are inputs of the runs, ``CKA`` and ``PhysicsMeanGP`` are the
    calibration of Kennedy and O'Hagan (2001), with the emulator fitted to the runs alone.

    Args:
        runs_X: Inputs of the runs, ``N x (d + p)``: those that the data have, and then values of
            the unknown parameters; in a frame these are the columns of their names, with or
            without a unit, as ``"drag [1]"``.
        runs_Y: Outputs of the runs, ``N x m``; NaN where one is missing.
        inputs: The columns of the data that are the first ``d`` inputs of the runs, in their order.
            Default: all.
        unknowns: The unknown parameters by name.
        model_factory: Makes the emulator of ``X`` and ``Y``. Default: ``ZeroMeanGP`` with an RBF
            kernel or a Matern one (5/2), whichever predicts runs that are left out with the higher
            density. ``functools.partial(CKA, physics=...)`` of a formula needs fewer runs.
        fit_options: Options of its :func:`~gpadjust.fit`, such as ``{"method": "map"}``.
        num_components: Number ``K`` of components; they have the variance of those left out, too.
        name: The name in messages. Default: the class's.

    Attributes:
        emulator: The fitted model of the runs, to look at: ``emulator.left_out()``.

    Raises:
        TypeError: If the factory makes no exact model of this library.
        ValueError: If there are fewer columns than unknown parameters, or the runs are no data.

    Example:
        >>> from gpadjust.core import PhysicsMeanGP
        >>> runs_X = torch.linspace(0, 3, 9, dtype=torch.float64).unsqueeze(-1)
        >>> simulator = EmulatedPhysics(runs_X, torch.sin(2 * runs_X), num_components=4)
        >>> X = torch.linspace(0, 3, 5, dtype=torch.float64).unsqueeze(-1)
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
        own, number = dict(unknowns or {}), checked_whole("num_components", num_components, 1)
        further = {f"emulator_{k + 1}": Unknown(0.0, sd=1.0) for k in range(number)}
        if taken := own.keys() & further.keys():
            raise ValueError(f"Expected other names than {sorted(taken)}, of the emulator's error.")
        super().__init__(unknowns=own | further, inputs=inputs, name=name)
        runs_X = _with_unknowns_last(runs_X, [*own], self.name)
        self.num_inputs = runs_X.shape[-1] - len(own)
        if self.num_inputs < 1:
            raise ValueError(
                f"Expected runs N x (d + {len(own)}): inputs that the data have, and then "
                f"{len(own)} unknown parameter(s); found shape {tuple(runs_X.shape)}."
            )
        emulator = _fitted(runs_X, runs_Y, model_factory, dict(fit_options or {}))
        self.num_outputs = emulator.num_outputs
        # In a tuple, no submodule: it is no part of a model that a fit changes or a copy copies.
        self._emulator = (emulator,)
        self._components = _Components(emulator, number)
        self._kept: tuple[Tensor, Tensor] | None = None  # the components at the last rows

    @property
    def emulator(self) -> GP:
        """The fitted model of the runs."""
        return self._emulator[0]

    def read(self, X: Tensor) -> Tensor:
        """Return the columns of ``X`` that the runs have, checked."""
        columns = super().read(X)
        if columns.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected {self.num_inputs} columns, as the runs of {self.name!r} have besides "
                f"the unknown parameters; found {columns.shape[-1]}. Name those of the data with "
                "inputs=[...], and which inputs of the runs are unknown with unknowns={...}."
            )
        return columns

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the data have the inputs of the runs in another order."""
        own = self.emulator.data.input_names[: self.num_inputs]
        columns = tuple(names) if self.inputs is None else tuple(names[i] for i in self.inputs)
        if columns != own and {*columns} == {*own}:
            raise ValueError(
                f"Expected the inputs {own} of the runs of {self.name!r} in this order; found "
                f"{columns}. Give inputs=[...], the numbers of the columns."
            )

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs ``N x m`` of the function that each row's parameters name."""
        p = self.emulator.data.X.shape[-1] - self.num_inputs
        values = parameters[0].rows
        rows, z = torch.cat([X, values[:, :p]], -1).double(), values[:, p:]
        if rows.requires_grad and torch.is_grad_enabled():
            parts = self._components.at(rows)
        else:
            rows, place = rows.unique(dim=0, return_inverse=True)
            if self._kept is None or not torch.equal(self._kept[0], rows):
                self._kept = (rows, self._components.at(rows))
            parts = self._kept[1][place]
        return parts[..., 0] + (parts[..., 1:] @ z.to(parts).unsqueeze(-1)).squeeze(-1)


class _Components:
    r"""The mean of an emulator and the principal components of its errors.

    With the posterior covariance :math:`C(R, R) = E \Lambda E^T` at some places R it is
    :math:`v_k(x) = C(x, R) \, e_k / \sqrt{\lambda_k}` (Nystrom). C is that of the mixture,
    :math:`E_s C_s + Cov_s(m_s, m_s)`, for an emulator that contains draws s.
    """

    @torch.no_grad()
    def __init__(self, emulator: GP, number: int) -> None:
        X = emulator.data.X
        self.emulator = emulator
        low, high = X.amin(0), X.amax(0)
        unit = SobolEngine(len(low), seed=0, scramble=True).draw(2 * _PLACES, dtype=low.dtype)
        self.low, self.range = low, (high - low).where(high > low, torch.ones_like(low))
        places, others = (low + self.range * unit.to(low)).chunk(2)
        self.data = emulator.conditioning()
        self.places = emulator.at(places)
        mean, K = self.data.joint(self.places)  # S x m x Q (x Q)
        C = MixturePosterior(mean, K).distribution.covariance_matrix
        size, vectors = torch.linalg.eigh(C)
        number = min(number, len(size))
        size, vectors = size[-number:].flip(0).clamp_min(1e-300), vectors[:, -number:].flip(1)
        weights = (vectors / size.sqrt()).reshape(*mean.shape[1:], number)
        cross = self.places.cross(self.data.train) * self.data.observed.unsqueeze(-2)
        solved = torch.cholesky_solve(cross.mT, self.data.chol)  # S x m x n x Q
        of_means = torch.einsum("smq,mqk->sk", mean - mean.mean(0), weights)
        self.weights = [weights, solved @ weights, of_means]  # m x Q x K, S x m x n x K, S x K
        # For components that are left out, and between places, all are as much larger.
        at = emulator.at(others)
        larger = self._variance(at).sum() / self._at(at)[1].square().sum().clamp_min(1e-300)
        self.weights = [larger.sqrt() * each for each in self.weights]

    def at(self, rows: Tensor) -> Tensor:
        """Return the mean and the components at rows ``N x D``, ``N x m x (1 + K)``."""
        at = self.emulator.at(rows, self.data.train.values)
        center, components = self._at(at)
        # Beyond the runs, where no place is, they have the emulator's variance.
        beyond = ((rows < self.low) | (rows > self.low + self.range)).any(-1)
        if beyond.any():
            size = components[:, beyond].square().sum(-1).clamp_min(1e-30)
            wider = torch.ones_like(center)
            wider[:, beyond] = (self._variance(at.of_rows(beyond)) / size).sqrt()
            components = components * wider.unsqueeze(-1)
        parts = torch.cat([center.unsqueeze(-1), components], -1)
        return (parts * self.emulator.unit.unsqueeze(-1)).movedim(0, 1)

    def _at(self, at: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return the mean ``m x N`` and the components ``m x N x K``."""
        of_places, of_runs, of_means = self.weights
        mean, cross = self.data.mean(at)  # S x m x N (x n)
        components = (at.cross(self.places) @ of_places - cross @ of_runs).mean(0)
        away = (mean - mean.mean(0)).movedim(0, -1)  # m x N x S
        return mean.mean(0), components + away @ of_means / len(mean)

    def _variance(self, at: WeightedSum) -> Tensor:
        """Return the variance by the emulator, ``m x N``."""
        mean, variance = self.data.marginals(at)
        return variance.mean(0) + mean.var(0, correction=0)


def _fitted(
    runs_X: Any, runs_Y: Any, model_factory: Callable[[Any, Any], GP] | None, options: Any
) -> GP:
    """Return the fitted model of the runs, by default the one of two that predicts them better."""
    kernels = [Stationary(profile) for profile in (RBF, MATERN52)]
    factories = [partial(ZeroMeanGP, covar_module=kernel) for kernel in kernels]
    fitted = []
    for factory in [model_factory] if model_factory else factories:
        emulator = factory(runs_X, runs_Y)
        check_kind("model_factory's model", emulator, GP, "a GP")
        if type(emulator).on_gaussian_scale is not GP.on_gaussian_scale:
            raise ValueError(
                f"Expected an emulator without a link; found a {type(emulator).__name__}. Emulate "
                "log(Y), say, and take its exponential as a physics."
            )
        fit(emulator, **options)
        fitted.append(emulator.eval().requires_grad_(False))
    return max(fitted, key=lambda e: float(e.left_out().log_density(e.data.Y).nansum()))


def _with_unknowns_last(runs_X: Any, names: list[str], physics: str) -> Any:
    """Return runs whose last columns are the unknown parameters, if columns have names."""
    columns = [*getattr(runs_X, "columns", ())]
    if not columns:
        return runs_X
    own = {str(each).partition(" [")[0]: each for each in columns}  # "drag [1]" is drag
    own |= {each: each for each in columns}
    if absent := [name for name in names if name not in own]:
        raise ValueError(
            f"Expected columns of the names {', '.join(absent)} in the runs of {physics!r}, the "
            f"unknown parameters; found {columns}."
        )
    last = [own[name] for name in names]
    return runs_X[[each for each in columns if each not in last] + last]
