"""A simulator that is known by its runs, as physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from botorch.models.transforms.outcome import Standardize
from gpytorch.kernels import MaternKernel, ScaleKernel
from torch import Size, Tensor

from gpadjust.emulation.error_kernel import ErrorKernel, unresolved
from gpadjust.inference import fit
from gpadjust.inference.fitting import FitOptions
from gpadjust.models import ZeroMeanGP
from gpadjust.models.factory import ModelFactory, make_model
from gpadjust.models.parameters import LogInterval, scaled_rbf
from gpadjust.models.term_builder import KernelLike
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.training_data import ArrayLike, training_data
from gpadjust.physics import Physics, Unknown
from gpadjust.physics.unknown import ParameterValues, Unknowns
from gpadjust.validation import leave_one_out


class EmulatedPhysics(Physics):
    r"""A simulator that is known by its runs, with what an emulator of them does not know.

    The emulator is a Gaussian process of the runs, fitted when the physics is made. f_p is its
    posterior mean, which is differentiable; its error e, with the emulator's posterior covariance
    :math:`k_e`, is a term of every model of this physics,

    .. math:: f_a(x) = \rho(x) (f_p(x, \theta) + e(x, \theta)) + \delta(x),
        \quad e \sim GP(0, k_e),

    as a Gaussian process of the same mean and covariance, so that intervals are wide where there
    are no runs, and measurements correct the emulator, too. With unknown parameters :math:`\theta`
    that are inputs of the runs, ``CKA`` and ``PhysicsMeanGP`` are the calibration of Kennedy and
    O'Hagan (2001), with the emulator fitted to the runs alone.

    Args:
        runs_X: Inputs of the runs, ``N x (d + p)``: those that the data have, and then values of
            the unknown parameters; in a frame these are the columns of their names, with or
            without a unit, as ``"drag [1]"``.
        runs_Y: Outputs of the runs, ``N x m``; NaN where one is missing, a row of NaN is a run
            that failed.
        inputs: The columns of the data that are the first ``d`` inputs of the runs, in their order.
            Default: all.
        unknowns: The unknown parameters by name.
        is_random: Whether the simulator is random, and f_p its mean. Else what the emulator takes
            for noise in the runs is their finest detail, which other rows have unseen: a part of
            its error.
        model_factory: Makes the emulator of ``X`` and ``Y``. Default: :class:`~gpadjust.ZeroMeanGP`
            of standardised outputs, with an RBF kernel or one of Matern (5/2), whichever predicts
            runs that are left out with the higher density. ``functools.partial(CKA, physics=...)``
            of a formula of the simulator's inputs needs fewer runs.
        fit_options: Options of its :func:`~gpadjust.fit`, such as ``{"method": "map"}``.
        name: The name in messages. Default: the class's.

    Attributes:
        emulator: The fitted model of the runs, to look at: ``leave_one_out(physics.emulator)``.

    Raises:
        TypeError: If the factory makes no exact model of this library.
        ValueError: If there are fewer columns than unknown parameters, or the runs are no data.

    References:
        M. C. Kennedy and A. O'Hagan, *Bayesian calibration of computer models*, Journal of the
        Royal Statistical Society B 63, 2001.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, EmulatedPhysics, fit
        >>> runs_X = torch.linspace(0, 3, 9, dtype=torch.float64).unsqueeze(-1)
        >>> simulator = EmulatedPhysics(runs_X, torch.sin(2 * runs_X))
        >>> X = torch.linspace(0, 3, 5, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 1.5 * torch.sin(2 * X) + X, physics=simulator)
        >>> result = fit(model)
        >>> round(model.predict(torch.tensor([[1.1]]).double()).mean.item(), 1)
        2.3
    """

    is_emulated = True

    def __init__(
        self,
        runs_X: ArrayLike,
        runs_Y: ArrayLike,
        *,
        inputs: Sequence[int] | None = None,
        unknowns: Mapping[str, Unknown] | None = None,
        is_random: bool = False,
        model_factory: ModelFactory | None = None,
        fit_options: FitOptions | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__(unknowns=unknowns, inputs=inputs, name=name)
        columns = getattr(runs_X, "columns", None)
        if columns is not None and self._p:
            bare = {str(each).partition(" [")[0]: each for each in columns}  # "drag [1]" is drag
            bare |= {each: each for each in columns}
            absent = [each for each in self.unknowns.names if each not in bare]
            if absent:
                raise ValueError(
                    f"The runs of {self.name!r} have the columns {[*columns]}, none named "
                    f"{', '.join(absent)}: call the columns of unknown parameters by their names."
                )
            unknown = [bare[each] for each in self.unknowns.names]
            others = [each for each in columns if each not in unknown]
            runs_X = runs_X[[*others, *unknown]]
        failed = torch.as_tensor(_missing_rows(runs_Y))
        if failed.any():
            runs_X, runs_Y = (_rows(each, ~failed) for each in (runs_X, runs_Y))
        data = training_data(runs_X, runs_Y, None)
        self.num_inputs = data.X.shape[-1] - self._p
        if self.num_inputs < 1 or data.X.dim() != 2:
            raise ValueError(
                f"Expected runs N x (d + {self._p}): the inputs that the data have, and then "
                f"{self._p} unknown parameter(s), got shape {tuple(data.X.shape)}."
            )
        if self.inputs is not None and len(self.inputs) != self.num_inputs:
            raise ValueError(
                f"The runs have {self.num_inputs} input(s) beside the unknown parameters, but "
                f"inputs={self.inputs} names {len(self.inputs)} columns of the data."
            )
        factories = [model_factory] if model_factory else [*map(_standardised, _KERNELS)]
        fitted = []
        for factory in factories:
            emulator = make_model(factory, runs_X, runs_Y, kind=TermsGP)
            fit(emulator, **(fit_options or {}))
            fitted.append(emulator)
        emulator = max(fitted, key=_left_out_density) if len(fitted) > 1 else fitted[0]
        self.num_outputs = emulator.num_outputs
        # In a tuple, no submodule: it is no part of a model that a fit changes, or a copy copies.
        self._emulator = (emulator, emulator.mean_functions())
        with torch.no_grad():
            self._white = (None if is_random else unresolved(emulator),)

    @property
    def emulator(self) -> TermsGP:
        """The fitted model of the runs."""
        return self._emulator[0]

    def read(self, X: Tensor) -> Tensor:
        """The columns of ``X`` that the runs have, checked."""
        found = super().read(X)
        if found.shape[-1] != self.num_inputs:
            raise ValueError(
                f"The runs of {self.name!r} have {self.num_inputs} input(s) beside the unknown "
                f"parameters, but X has {found.shape[-1]} columns. Say which of them the runs have "
                "with inputs=[...], and which inputs of the runs are unknown with unknowns={...}."
            )
        return found

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The emulator's posterior mean, ``N x m``."""
        rows = torch.cat([X, parameters[0].rows], dim=-1) if parameters else X
        mean: Tensor = self._emulator[1](rows.double())
        return mean.mean(0).to(X)

    def error_kernel(self, unknowns: Unknowns, columns: Sequence[int], unit: Tensor) -> ErrorKernel:
        """The kernel of the emulator's error; see :class:`ErrorKernel` for the arguments."""
        return ErrorKernel(self, self.emulator, unknowns, columns, unit, *self._white)


def _matern(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """A Matern kernel with one lengthscale per input and an outputscale."""
    base = MaternKernel(
        2.5, ard_num_dims=num_inputs, batch_shape=batch_shape, lengthscale_constraint=LogInterval()
    )
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=LogInterval())


_KERNELS: tuple[KernelLike, ...] = (scaled_rbf, _matern)


def _standardised(kernel: KernelLike) -> ModelFactory:
    """A factory of models of standardised outputs with a kernel."""

    def make(X: Any, Y: Any) -> ZeroMeanGP:
        transform = Standardize(Y.shape[-1])
        return ZeroMeanGP(X, Y, covar_module=kernel, outcome_transform=transform)

    return make


def _left_out_density(emulator: TermsGP) -> float:
    return float(leave_one_out(emulator).log_density.nansum())


def _missing_rows(Y: Any) -> Tensor:
    """Which rows of outputs are missing altogether."""
    values = Y if torch.is_tensor(Y) else torch.as_tensor(np.array(Y))
    missing = values.isnan() if values.is_floating_point() else torch.zeros_like(values).bool()
    return missing.reshape(len(missing), -1).all(-1)


def _rows(values: Any, kept: Tensor) -> Any:
    chosen = kept if torch.is_tensor(values) else kept.numpy()
    return values.loc[chosen] if hasattr(values, "loc") else values[chosen]
