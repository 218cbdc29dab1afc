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
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import Likelihood
from linear_operator import to_dense, to_linear_operator
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import (
    FixedStandardize,
    InputsKernel,
    PhysicsColumn,
    PhysicsInput,
    PhysicsMean,
    PhysicsScaledKernel,
    RescaledPosterior,
)
from gpadjust.models.defaults import default_likelihood, make_kernel
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import set_initial_values
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
        shift, scale = _affine(outcome_transform, train_Y, X)
        if outcome_transform is not None:
            outcome_transform = FixedStandardize.of(shift, scale)
        offset = _center(center, f_p)
        to_outputs = (lambda t: t.mT) if m > 1 else (lambda t: t.squeeze(-1))
        mean = PhysicsColumn(d, m, batch_shape, to_outputs(shift), to_outputs(scale))
        column = PhysicsColumn(d, m, batch_shape, to_outputs(offset), to_outputs(scale))

        terms: list[Kernel] = []
        if rho_covar_module is not None:
            kernel = make_kernel(rho_covar_module, "the kernel of rho", d, batch_shape)
            terms.append(PhysicsScaledKernel(InputsKernel(kernel, d), column))
        if delta_covar_module is not None:
            kernel = make_kernel(delta_covar_module, "the kernel of delta", d, batch_shape)
            terms.append(InputsKernel(kernel, d))
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            likelihood=likelihood or default_likelihood(train_Yvar, batch_shape),
            covar_module=terms[0] if len(terms) == 1 else terms[0] + terms[1],
            mean_module=PhysicsMean(mean),
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
        return None if kernel is None else kernel.base_kernel.base_kernel

    @property
    def delta_covar_module(self) -> Any:
        r"""The kernel :math:`k_\delta` on the inputs, or None if the model has no delta."""
        kernel = self._kernel("delta")
        return None if kernel is None else kernel.base_kernel

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
        X, output_dim = self._with_output_dim(self.input_transform.without_physics(X))
        with gpt_posterior_settings(), self._infer(component):
            mvn = self(X)
        if component == "rho":
            return self._as_posterior(mvn, output_dim)
        scale = self._column.scale  # from the units of the targets to the user's
        covariance = to_dense(mvn.lazy_covariance_matrix) * scale.unsqueeze(-1).square()
        rescaled = MultivariateNormal(mvn.mean * scale, to_linear_operator(covariance))
        return RescaledPosterior(
            self._as_posterior(rescaled, output_dim).distribution,
            self._as_posterior(mvn, output_dim),
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
        prior_mean = self._rho_mean if self._component == "rho" else 0.0
        return (
            test.new_full((*batch_shape, test.shape[-2]), prior_mean),
            to_linear_operator(test_test),
            to_linear_operator(test_train),
            batch_shape,
            Size([test.shape[-2]]),
            MultivariateNormal,
        )


def residual_scale(train_Y: Tensor, mean: Tensor) -> FixedStandardize:
    """The default outcome transform: divide by the root mean square of ``train_Y - mean``.

    Args:
        train_Y: Targets, ``batch_shape x n x m``.
        mean: The prior mean at the training inputs, of the same shape. Where it meets the targets
            exactly, the scale is a millionth of theirs (or 1 if they are zero).
    """

    def rms(values: Tensor) -> Tensor:
        return values.square().mean(-2, keepdim=True).sqrt()

    scale, size = rms(train_Y - mean), rms(train_Y)
    tiny = 1e-6 * size.where(size > 0, torch.full_like(size, 1e6))
    return FixedStandardize.of(torch.zeros_like(scale), scale.where(scale > 0, tiny))


def _affine(transform: Standardize | None, train_Y: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """Shift and scale (``batch_shape x 1 x m``) that an outcome transform puts on the targets."""
    if transform is None:
        return torch.zeros_like(train_Y[..., :1, :]), torch.ones_like(train_Y[..., :1, :])
    if type(transform) not in (Standardize, FixedStandardize):
        raise ValueError(
            f"The outcome transform {type(transform).__name__} is not supported: f_p lives in the "
            "units of the targets, so the transform must be one shift and scale per output. Use "
            "Standardize, None, or the default, which divides by the residual's scale; to model "
            "log(y), say, take the logarithm of both train_Y and the physics."
        )
    transform.train()
    transform(train_Y, X=X)
    return transform.means, transform.stdvs


def _center(center: float | Tensor | str, f_p: Tensor) -> Tensor:
    """The constant c of the kernel on ``f_p - c``, as ``batch_shape x 1 x m``."""
    mean = f_p.mean(-2, keepdim=True)
    if isinstance(center, str):
        if center != "mean":
            raise ValueError(
                f"Unknown center {center!r}; expected 'mean' (the mean of f_p at the training "
                "inputs), a number, or a tensor with one number per output."
            )
        return mean
    offset = torch.as_tensor(center, dtype=f_p.dtype, device=f_p.device)
    if offset.dim() > 1 or offset.numel() not in (1, f_p.shape[-1]) or not offset.isfinite().all():
        raise ValueError(
            f"Expected center to be 'mean', a finite number, or a tensor of {f_p.shape[-1]}, one "
            f"for each output, got {center}."
        )
    return offset.expand(mean.shape).clone()
