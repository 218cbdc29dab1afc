"""The Gaussian process of an adjusted physics: what CKA and its special cases share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.models.utils import add_output_dim, gpt_posterior_settings
from botorch.posteriors import GPyTorchPosterior
from botorch.utils.datasets import SupervisedDataset
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal
from gpytorch.kernels import AdditiveKernel, Kernel
from gpytorch.likelihoods import Likelihood
from linear_operator import to_dense, to_linear_operator
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import (
    AdjustedMean,
    FixedStandardize,
    InputsKernel,
    PhysicsColumn,
    PhysicsInput,
    PhysicsMean,
    PhysicsScaledKernel,
    RescaledPosterior,
    UnknownMeanKernel,
)
from gpadjust.models.defaults import default_likelihood, make_kernel
from gpadjust.models.hyperparameter_samples import HyperparameterMixture
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import set_initial_values
from gpadjust.models.target_units import affine, kernel_center, residual_scale
from gpadjust.models.training_data import check_training_data
from gpadjust.physics import Physics, as_physics

Component = Literal["rho", "delta"]


class AdjustmentGP(MultiOutputGP):
    r"""The base of the models of :math:`f_a(x) = \rho(x) f_p(x) + \delta(x)`.

    With :math:`\rho \sim GP(1, k_\rho)` and :math:`\delta \sim GP(0, k_\delta)` the prior is

    .. math:: f_a \sim GP\left(f_p, \; F_p k_\rho F_p^T + k_\delta\right)

    (Wannawas and Faisal 2023, eq. 2). Either kernel may be left out, which fixes
    :math:`\rho \equiv 1` or :math:`\delta \equiv 0`. Users build :class:`~gpadjust.CKA`,
    :class:`~gpadjust.BiasGP`, :class:`~gpadjust.ScaleGP` and so on.

    The model is a ``SingleTaskGP`` whose input transform appends f_p to the inputs
    (:class:`~gpadjust.gp.PhysicsInput`); its mean and kernel read those columns. The arguments are
    those of :class:`~gpadjust.CKA`, except that a kernel may also be given by a function of the
    number of inputs (after their transform) and the batch shape, or be None.
    """

    _component: Component | None = None
    _rho_mean = 1.0  # the prior mean of rho

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None,
        physics: Physics | Callable[[Tensor], Tensor],
        rho_covar_module: Kernel | Callable[[int, Size], Kernel] | None,
        delta_covar_module: Kernel | Callable[[int, Size], Kernel] | None,
        center: float | Tensor | Literal["mean"] = 0.0,
        learn_rho_mean: bool = False,
        learn_delta_mean: bool = False,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        check_training_data(train_X, train_Y, train_Yvar)
        transform = PhysicsInput(as_physics(physics), train_X.shape[-1], input_transform)
        with torch.no_grad():
            X = transform(train_X)
        m = train_Y.shape[-1]
        if transform.physics.num_outputs != m:
            raise ValueError(
                f"The physics '{transform.physics.name}' returned {transform.physics.num_outputs} "
                f"columns, expected {m}, one for each column of train_Y."
            )
        d, f_p = X.shape[-1] - m, X[..., -m:]
        batch_shape = self.get_batch_dimensions(train_X, train_Y)[1]
        if isinstance(outcome_transform, _DefaultType):
            outcome_transform = residual_scale(train_Y, f_p)
        shift, scale = affine(outcome_transform, train_Y, X)
        if outcome_transform is not None:
            outcome_transform = FixedStandardize.of(shift, scale)
        offset = kernel_center(center, f_p)
        to_outputs = (lambda t: t.mT) if m > 1 else (lambda t: t.squeeze(-1))
        mean = PhysicsColumn(d, m, batch_shape, to_outputs(shift), to_outputs(scale))
        column = PhysicsColumn(d, m, batch_shape, to_outputs(offset), to_outputs(scale))

        terms: list[Kernel] = []
        rho = _prior_kernel(rho_covar_module, "rho", d, batch_shape, learn_rho_mean)
        if rho is not None:
            terms.append(PhysicsScaledKernel(InputsKernel(rho, d), column))
        delta = _prior_kernel(delta_covar_module, "delta", d, batch_shape, learn_delta_mean)
        if delta is not None:
            terms.append(InputsKernel(delta, d))
        learn_means = learn_rho_mean or learn_delta_mean
        num_unknown = int(learn_rho_mean) + int(learn_delta_mean)
        if train_X.shape[-2] < 2 + num_unknown and learn_means:
            raise ValueError(
                f"Expected at least {2 + num_unknown} points to learn {num_unknown} constant means "
                f"and a variance, got {train_X.shape[-2]}; leave `learn_rho_mean` and "
                "`learn_delta_mean` at False."
            )
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            likelihood=likelihood or default_likelihood(train_Yvar, batch_shape),
            covar_module=terms[0] if len(terms) == 1 else terms[0] + terms[1],
            mean_module=(
                AdjustedMean(mean, column, batch_shape) if learn_means else PhysicsMean(mean)
            ),
            outcome_transform=outcome_transform,
            input_transform=transform,
        )
        given = (rho_covar_module, delta_covar_module, likelihood)
        set_initial_values(self, *(module for module in given if isinstance(module, Module)))

    @property
    def physics(self) -> Physics:
        """The physics f_p."""
        physics: Physics = self.input_transform.physics
        return physics

    @property
    def rho_covar_module(self) -> Any:
        r"""The kernel :math:`k_\rho` on the inputs, or None if the model has no rho."""
        kernel = self._kernel("rho")
        return None if kernel is None else _without_constant(kernel.base_kernel.base_kernel)

    @property
    def delta_covar_module(self) -> Any:
        r"""The kernel :math:`k_\delta` on the inputs, or None if the model has no delta."""
        kernel = self._kernel("delta")
        return None if kernel is None else _without_constant(kernel.base_kernel)

    @property
    def constant_means(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """The unknown constant means, bases by the names of their (log) prior variances."""
        rho = self._kernel("rho")
        bases: dict[str, Callable[[Tensor], Tensor]] = {}
        for name, module in self.covar_module.named_modules(prefix="covar_module"):
            if isinstance(module, UnknownMeanKernel):
                of_rho = rho is not None and module in set(rho.modules())
                bases[f"{name}.raw_constant"] = self._column if of_rho else _ones
        return bases

    @property
    def constant_mean_values(self) -> Tensor:
        """The prior means of the unknown constants, ``batch_shape x (m) x q``."""
        return torch.cat([self._constant(basis) for basis in self.constant_means.values()], -1)

    def _constant(self, basis: Callable[[Tensor], Tensor]) -> Tensor:
        mean = self.mean_module
        return mean.delta_mean if basis is _ones else mean.rho_mean

    def set_constant_means(self, values: Tensor, variance: Tensor) -> None:
        r"""Set the prior means and variances of the unknown constants.

        With the generalised least squares estimate as its mean and many of its standard errors as
        its standard deviation, the prior of a constant is flat for all purposes, and the posterior
        that of universal kriging.

        Args:
            values: The prior means, ``batch_shape x (m) x q``.
            variance: The prior variances, of the same shape.
        """
        named = dict(self.named_parameters())
        with torch.no_grad():
            for i, (name, basis) in enumerate(self.constant_means.items()):
                self._constant(basis).copy_(values[..., i : i + 1])
                named[name].copy_(variance[..., i : i + 1].clamp_min(1e-100).log())

    @classmethod
    def construct_inputs(
        cls, training_data: SupervisedDataset, physics: Physics | Callable[[Tensor], Tensor]
    ) -> dict[str, Any]:
        """Construct keyword arguments of the model from a dataset and a physics."""
        return {**super().construct_inputs(training_data), "physics": physics}

    def _kernel(self, component: Component) -> Kernel | None:
        """The covariance of one adjustment, as it stands in ``covar_module``."""
        for kernel in getattr(self.covar_module, "kernels", [self.covar_module]):
            if isinstance(kernel, PhysicsScaledKernel) == (component == "rho"):
                return kernel
        return None

    @property
    def _column(self) -> PhysicsColumn:
        """How f_p enters the kernel, or the mean if the kernel does not read it."""
        rho = self._kernel("rho")
        column: PhysicsColumn = (self.mean_module if rho is None else rho).physics
        return column

    def _adjustment(self, X: Tensor, component: Component) -> GPyTorchPosterior:
        """The posterior of rho or delta at ``X``; f_p is not evaluated there."""
        self.eval()
        X = self.input_transform.without_physics(self._for_samples(X))
        X, output_dim = self._with_output_dim(X)
        with gpt_posterior_settings(), self._infer(component):
            mvn = self(X)
        posterior = self._as_posterior(mvn, output_dim)
        if component == "delta":
            posterior = self._rescaled(mvn, posterior, output_dim)
        else:
            posterior = RescaledPosterior(posterior.distribution, posterior, torch.ones(()))
        return posterior if self.num_samples is None else HyperparameterMixture(posterior)

    def _rescaled(
        self, mvn: MultivariateNormal, posterior: GPyTorchPosterior, output_dim: int | None
    ) -> GPyTorchPosterior:
        """A posterior in the units of the targets, brought to the user's."""
        scale = self._column.scale
        covariance = to_dense(mvn.lazy_covariance_matrix) * scale.unsqueeze(-1).square()
        rescaled = MultivariateNormal(mvn.mean * scale, to_linear_operator(covariance))
        return RescaledPosterior(
            self._as_posterior(rescaled, output_dim).distribution,
            posterior,
            scale.mT.square() if self._num_outputs > 1 else scale.unsqueeze(-1).square(),
        )

    def _with_output_dim(self, X: Tensor) -> tuple[Tensor, int | None]:
        """Insert the dimension of the outputs into ``X``, and tell where it is."""
        if self._num_outputs == 1:
            return X, None
        with_dim: tuple[Tensor, int] = add_output_dim(X, self._input_batch_shape)
        return with_dim

    def _as_posterior(self, mvn: MultivariateNormal, output_dim: int | None) -> GPyTorchPosterior:
        """The posterior of a batch of independent outputs."""
        if output_dim is not None:
            mvn = MultitaskMultivariateNormal.from_batch_mvn(mvn, task_dim=output_dim)
        return GPyTorchPosterior(mvn)

    @contextmanager
    def _infer(self, component: Component) -> Iterator[None]:
        self._component = component
        try:
            yield
        finally:
            self._component = None

    def _get_test_prior_mean_and_covariances(
        self, train_inputs: Any, test_inputs: Any, **kwargs: Any
    ) -> tuple[Any, ...]:
        r"""GPyTorch's hook for the prior at test points; here also that of one adjustment.

        With f_p centred at c in the kernel, :math:`f_a = f_p + (\rho - 1)(f_p - c) + \delta_0`,
        so the bias that makes :math:`f_a = \rho f_p + \delta` is
        :math:`\delta = \delta_0 - c (\rho - 1)`; its prior mean is zero, too.
        """
        if self._component is None:
            result: tuple[Any, ...] = super()._get_test_prior_mean_and_covariances(
                train_inputs=train_inputs, test_inputs=test_inputs, **kwargs
            )
            return result
        train, test = train_inputs[0], test_inputs[0]
        batch_shape = torch.broadcast_shapes(train.shape[:-2], test.shape[:-2])
        train, test = (x.expand(*batch_shape, *x.shape[-2:]) for x in (train, test))
        rho, delta = self._kernel("rho"), self._kernel("delta")
        test_test: Tensor | float = 0.0
        test_train: Tensor | float = 0.0
        if rho is not None:
            f_train = rho.physics(train).unsqueeze(-2)
            c = rho.physics.offset / rho.physics.scale
            weight = 1.0 if self._component == "rho" else -c.unsqueeze(-1)
            test_test = weight**2 * to_dense(rho.base_kernel(test, test))
            test_train = weight * to_dense(rho.base_kernel(test, train)) * f_train
        if self._component == "delta" and delta is not None:
            test_test = test_test + to_dense(delta(test, test))
            test_train = test_train + to_dense(delta(test, train))
        return (
            self._prior_mean(self._component, test[..., 0]),
            to_linear_operator(test_test),
            to_linear_operator(test_train),
            batch_shape,
            Size([test.shape[-2]]),
            MultivariateNormal,
        )

    def _prior_mean(self, component: Component, like: Tensor) -> Tensor:
        """The prior mean of rho or delta, of the shape ``... x n`` of ``like``."""
        constants = self.mean_module
        if not isinstance(constants, AdjustedMean):
            return torch.full_like(like, self._rho_mean if component == "rho" else 0.0)
        if component == "rho":
            return constants.rho_mean.expand_as(like)
        c = self._column.offset / self._column.scale
        return (constants.delta_mean - c * (constants.rho_mean - 1)).expand_as(like)


def _prior_kernel(
    kernel: Kernel | Callable[[int, Size], Kernel] | None,
    component: Component,
    num_inputs: int,
    batch_shape: Size,
    learn_mean: bool,
) -> Kernel | None:
    """The kernel of rho or delta: the user's or the default, and that of an unknown mean."""
    made = None
    if kernel is not None:
        made = make_kernel(kernel, f"the kernel of {component}", num_inputs, batch_shape)
    if not learn_mean:
        return made
    constant = UnknownMeanKernel(batch_shape)
    return constant if made is None else AdditiveKernel(made, constant)


def _without_constant(kernel: Kernel) -> Kernel:
    """The kernel that the user gave, without that of an unknown mean."""
    parts = getattr(kernel, "kernels", [kernel])
    return parts[0] if isinstance(parts[-1], UnknownMeanKernel) else kernel


def _ones(inputs: Tensor) -> Tensor:
    """The basis of a constant, ``... x n``."""
    return torch.ones_like(inputs[..., 0])
