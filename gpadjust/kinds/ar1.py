"""AR1 co-kriging of two levels of fidelity."""

from __future__ import annotations

from typing import Any, Self

import torch
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.checks import checked_bounds, checked_whole
from gpadjust.core import GP, KnownNoise, Noise, Row, Term
from gpadjust.core.data import ArrayLike, Data, appended, as_tensor, names_of, unit_of
from gpadjust.core.kernels import STANDARD_DEVIATION, Features, Kernel, PullBack
from gpadjust.core.structures import DELTA_CONSTANT
from gpadjust.core.terms import Places, as_kernel
from gpadjust.core.unknowns import Values
from gpadjust.physics import as_physics

_EXACT = 1e-6  # noise of the low level, in its squared unit, if that of the high level is known


class AR1(GP):
    r"""Auto-regressive co-kriging, :math:`f_2(x) = \rho f_1(x) + \delta(x)` with a constant rho.

    The classic of multi-fidelity modelling (Kennedy and O'Hagan 2000; Wannawas and Faisal 2023,
    sec. 2.1.3), for comparison: a Gaussian process of the data and samples of f_p, each with its
    own noise variance. Far from the samples it does not use the physics. Data, predictions and
    left-out targets belong to the high level. Args and errors as of :class:`~gpadjust.core.GP`, and
    either ``physics`` with ``bounds``, or ``low_X`` with its values:

    Args:
        physics: The low level f_p, sampled in ``bounds``.
        bounds: ``2 x d`` lower and upper bounds of the inputs.
        num_low: Number of samples of f_p.
        low_X: Inputs of the low level, ``n_1 x d``, in place of samples in ``bounds``.
        low_Y: Values there, ``n_1 x m``, NaN where one is missing. Default: f_p.
        low_covar_module: The kernel of the low level. Default: RBF.
        delta_covar_module: The kernel of delta. Default: RBF.
        seed: Seed of the (scrambled Sobol) samples.
    """

    low: Any = None  # the data of the low level; set after the units of the high level

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any = None, bounds: Any = None, num_low: int = 40, low_X: ArrayLike = None,
        low_Y: ArrayLike = None, low_covar_module: Any = None, delta_covar_module: Any = None,
        input_transform: Any = None, seed: int = 0,
    ) -> None:  # fmt: skip
        has_inputs = low_X is not None or (physics is not None and bounds is not None)
        if not has_inputs or (physics is None and low_Y is None):
            raise ValueError(
                "Expected a low level: physics with bounds (2 x d) or low_X, or low_X with low_Y."
            )
        if low_X is None:
            box = checked_bounds("bounds", bounds, as_tensor(train_X, "train_X").shape[-1])
            number = checked_whole("num_low", num_low, 2)
            samples = draw_sobol_samples(box, n=number, q=1, seed=checked_whole("seed", seed))
            low_X = samples.squeeze(-2)
        if low_Y is None:
            f_p = as_physics(physics)
            if f_p.unknowns:
                raise ValueError(
                    f"Expected a physics without unknown parameters, as AR1 samples it once; found "
                    f"{', '.join(f_p.unknowns)} of {f_p.name!r}. CKA estimates them."
                )
            with torch.no_grad():
                low_Y = f_p(as_tensor(low_X, "low_X"))
        low = Data.read(low_X, low_Y, None, None)
        sizes = [len(names_of(train_X, "x")), len(names_of(train_Y, "y"))]
        if sizes != [low.X.shape[-1], low.Y.shape[-1]]:
            raise ValueError(
                f"Expected a low level with {sizes[0]} inputs and {sizes[1]} outputs, as the high "
                f"level; found {low.X.shape[-1]} and {low.Y.shape[-1]}."
            )
        # f_l = b_low(l) g_low + b_delta(l) delta, with b_low = rho^l and b_delta = l
        terms = [
            Term("low", AtLevels(as_kernel(low_covar_module), low.X, has_rho=True)),
            Term("delta", AtLevels(as_kernel(delta_covar_module), low.X)),
        ]
        super().__init__(
            train_X, train_Y, train_Yvar, terms=terms, noise=LevelNoise(("low", "high")),
            input_transform=input_transform,
            settings={
                "low_X": low.X, "low_Y": low.Y, "low_covar_module": low_covar_module,
                "delta_covar_module": delta_covar_module, "input_transform": input_transform,
            },
        )  # fmt: skip
        self.low = low

    def kernel_inputs(self, X: Tensor) -> Tensor:
        """Return inputs with their level, 1; put inputs of level 0 before the training inputs."""
        x = self.data.kernel_inputs(X)
        high = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        if self.low is None or X is not self.data.X:
            return high
        low_x = self.data.kernel_inputs(self.low.X.to(X))
        low = torch.cat([low_x, torch.zeros_like(low_x[..., :1])], -1)
        return appended(low, high)

    def targets(self) -> Tensor:
        """Return the targets of both levels, each in its unit, ``... x m x (n_1 + n)``."""
        high = super().targets()
        if self.low is None:
            return high
        return appended((self.low.Y.mT / self._low_unit()).to(high), high, -1)

    def left_out_at(self, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return means and variances of left-out targets of the high level."""
        high = slice(len(self.low.X), None)
        mean, variance = super().left_out_at(u)
        return mean[..., high, :], variance[..., high, :]

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; raise a ValueError for an unknown number."""
        new = super().subset_output(idcs)
        new.low = self.low.of_outputs(self.checked_outputs(idcs))
        return new

    def _low_unit(self) -> Tensor:
        """Return the unit of each output of the low level, ``m x 1``."""
        return unit_of(self.low.Y, torch.zeros_like(self.low.Y)).to(self.unit)


class AtLevels(Kernel):
    r"""The kernel :math:`b(l) \, (k(x, x') + \kappa) \, b(l')` of levels l, the last input.

    b is :math:`\rho^l`, with a normal prior of rho in units of both levels, or l.
    """

    def __init__(self, kernel: Kernel, low_x: Tensor, has_rho: bool = False) -> None:
        self.kernel, self.low_x, self.has_rho = kernel, low_x, has_rho

    def of_data(self, data: Data) -> AtLevels:
        """Return the kernel of the transformed inputs of a model."""
        low_x = data.kernel_inputs(self.low_x.to(data.X))
        return AtLevels(self.kernel.of_data(data), low_x, self.has_rho)

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the rows of k, kappa and rho."""
        one = x.new_ones(num_outputs, 1)
        rows = self.kernel.rows(torch.cat([self.low_x, x]), num_outputs)
        rows += [Row.positive("constant", DELTA_CONSTANT.median * one, DELTA_CONSTANT.factor)]
        if self.has_rho:
            rows.append(Row("rho", one, 3.0))
        return rows

    def in_user_units(self, name: str, numbers: Tensor, unit: float) -> tuple[str, Tensor]:
        """Return the name and numbers of a parameter in summaries.

        Standard deviations of the low level are shares of that of its values.
        """
        if self.has_rho:
            unit = 1.0
        if name == "constant":
            shown, numbers = f"{STANDARD_DEVIATION} of the constant", numbers.sqrt() * unit
        else:
            shown, numbers = self.kernel.in_user_units(name, numbers, unit)
        if self.has_rho:
            shown = shown.replace(STANDARD_DEVIATION, f"{STANDARD_DEVIATION} over that of low_Y")
        return shown, numbers

    def basis(self, own: Values, x: Tensor) -> Tensor:
        """Return b, ``... x S x m x n``."""
        level = x[..., -1]
        if not self.has_rho:
            return level
        return 1 + level * (own["rho"] - 1)  # rho^l for l in {0, 1}

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves."""
        right = self.basis(own, x)
        left = right.unsqueeze(-1)
        inner = None
        if other is not None:
            right = self.basis(own, other)
            inner = other[..., :-1]
        k = self.kernel.covariance(own, x[..., :-1], inner)
        # b(l) (k + kappa) b(l')
        return left * (k + own["constant"].unsqueeze(-1)) * right.unsqueeze(-2)

    def with_pull_back(self, own: Values, x: Tensor) -> tuple[Tensor, PullBack]:
        """Return the covariance, and the function of its derivatives by the parameters."""
        k, back = self.kernel.with_pull_back(own, x[..., :-1])
        k = k + own["constant"].unsqueeze(-1)
        b = self.basis(own, x)

        def pull_back(D: Tensor) -> Values:
            # K_ij = b_i k_ij b_j, so that dL/dk_ij = b_i D_ij b_j
            by_k = b.unsqueeze(-1) * D * b.unsqueeze(-2)
            by = back(by_k) | {"constant": by_k.sum((-1, -2)).unsqueeze(-1)}
            if self.has_rho:  # dL/db_i = 2 sum_j D_ij k_ij b_j, and db_i/drho = l_i
                by_b = 2 * ((D * k) @ b.unsqueeze(-1)).squeeze(-1)
                by["rho"] = (x[..., -1] * by_b).sum(-1, keepdim=True)
            return by

        return b.unsqueeze(-1) * k * b.unsqueeze(-2), pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return the features of k and the constant, times b."""
        kernel_features = self.kernel.features(own, number, generator)

        def features(x: Tensor) -> Tensor:
            # b(l) [phi(x), sqrt(kappa)]
            phi = kernel_features(x[..., :-1])
            root = own["constant"].sqrt().unsqueeze(-1).expand_as(phi[..., :1])
            return torch.cat([phi, root], -1) * self.basis(own, x).unsqueeze(-1)

        return features


class LevelNoise(Noise):
    """A noise with one unknown variance for each level."""

    def shares(self, places: Places) -> Tensor:
        """Return the shares of both variances at each input, ``... x 1 x 1 x n x 2``."""
        level = places.kernel_inputs[..., -1]
        return torch.stack([1 - level, level], -1)

    def with_known(self, known: KnownNoise) -> Noise:
        """Return a noise with known variances of the high level."""
        return KnownAtHigh(known.known)


class KnownAtHigh(KnownNoise):
    """Known variances of the high level, and a nearly exact low level."""

    def variance(self, values: Values, places: Places, is_training: bool = False) -> Tensor:
        """Return the variances; at the training inputs those of both levels."""
        variances = super().variance(values, places, is_training)
        if not is_training:
            return variances
        num_low = places.kernel_inputs.shape[-2] - variances.shape[-1]
        return torch.nn.functional.pad(variances, (num_low, 0), value=_EXACT)
