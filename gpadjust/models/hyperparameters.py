"""The hyper-parameters: one table of their kinds, in multiples of sizes read off the data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood, Likelihood
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import AppendedPhysics, OrthogonalKernel, PhysicsScaledKernel, SumOfTerms


@dataclass(frozen=True)
class Kind:
    """What is assumed of a kind of hyper-parameter, in multiples of its typical size.

    Attributes:
        initial: Its value in a new model.
        bounds: Where a fit looks for it.
        starts: The range of the random starts, uniform in the logarithm.
        prior: Median and standard deviation of the logarithm, of a log-normal prior.
    """

    initial: float
    bounds: tuple[float, float]
    starts: tuple[float, float]
    prior: tuple[float, float]


KINDS = {
    # Typical size: the range of the input. Priors are longer in more dimensions, by sqrt(d).
    "lengthscale": Kind(
        initial=0.5,
        bounds=(1e-2, 1e3),
        starts=(0.05, 50.0),
        prior=(3.0, 2.0),
    ),
    # The mean square of the targets' residual from the prior mean, v, over that of the basis. The
    # prior is all but flat, so that near-polynomial functions, of long lengthscales and large
    # variance, are not ruled out.
    "outputscale": Kind(initial=0.5, bounds=(1e-9, 1e9), starts=(1e-2, 1e2), prior=(1.0, 6.0)),
    # v. Noise with an sd of less than three millionths of the residual is not told from none.
    "noise": Kind(initial=1e-2, bounds=(1e-11, 1e1), starts=(1e-6, 1.0), prior=(1e-3, 6.0)),
}
RHO_VARIANCE = Kind(initial=0.5, bounds=(1e-9, 1e9), starts=(1e-2, 1e2), prior=(0.01, 4.0))
"""The outputscale of a rho: its prior is one of rho itself, which has no units."""
_ROUNDING = 1e-12
VAGUE_MEAN = 1e2
"""The prior variance of an unknown mean before a fit, in the typical size of an outputscale."""


class LogInterval(Interval):
    """Positive parameters in an interval, with their logarithm as the raw parameter.

    A step in the logarithm is a relative one, so that an optimiser does the same whatever the
    units. The bounds are those of the search: BoTorch's L-BFGS keeps to them, and GPyTorch refuses
    values beyond them, but the transform does not squash, so that gradients stay honest.

    Args:
        lower_bound: Lower bound, positive.
        upper_bound: Upper bound.
        is_default: Whether they are bounds that nobody gave, to be read off the data. Any positive
            value may then be set, as samplers do that follow a prior.
    """

    def __init__(
        self,
        lower_bound: float | Tensor = 1e-12,
        upper_bound: float | Tensor = 1e12,
        is_default: bool = False,
    ) -> None:
        super().__init__(lower_bound, upper_bound, transform=torch.exp, inv_transform=torch.log)
        self.is_default = is_default

    def transform(self, tensor: Tensor) -> Tensor:
        """Map the raw parameter to the parameter."""
        return tensor.exp()

    def inverse_transform(self, transformed_tensor: Tensor) -> Tensor:
        """Map the parameter to the raw parameter."""
        return transformed_tensor.log()

    def check(self, tensor: Tensor) -> bool:
        """Whether all elements are valid values of the parameter."""
        return bool((tensor >= 0).all()) if self.is_default else bool(super().check(tensor))

    def check_raw(self, tensor: Tensor) -> bool:
        """Whether all elements are valid raw parameters."""
        return self.check(self.transform(tensor))


def default_constraint() -> LogInterval:
    """The constraint of a parameter whose bounds are read off the data."""
    return LogInterval(is_default=True)


def scaled_rbf(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """An RBF kernel with one lengthscale per input and an outputscale."""
    constraint = default_constraint()
    base = RBFKernel(num_inputs, batch_shape=batch_shape, lengthscale_constraint=constraint)
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=default_constraint())


def orthogonal_rbf(num_inputs: int, batch_shape: Size) -> OrthogonalKernel:
    """The same, orthogonal to what unknown parameters of the physics explain: for a delta."""
    return OrthogonalKernel(scaled_rbf(num_inputs, batch_shape))


def learnt_noise(batch_shape: Size) -> Likelihood:
    """Gaussian noise of one variance per output."""
    return GaussianLikelihood(batch_shape=batch_shape, noise_constraint=default_constraint())


def kind_of(name: str) -> str:
    """What a raw parameter is: ``"lengthscale"``, ``"outputscale"``, ``"noise"`` and so on."""
    return name.rsplit(".", 1)[-1].removeprefix("raw_")


def constraint_of(model: Module, name: str) -> Any:
    """The GPyTorch constraint of a parameter, by its name, or None."""
    path, _, leaf = name.rpartition(".")
    constraint = getattr(model.get_submodule(path), f"{leaf}_constraint", None)
    return constraint if isinstance(constraint, Interval) else None


def kernels_of(
    model: BatchedMultiOutputGPyTorchModel,
) -> Iterator[tuple[str, Kernel, int | None, Module | None]]:
    """The kernels of a model's terms: path, kernel, number of inputs (None: all), basis (None: 1).

    The kernel of a model of another library is taken as that of its only term.
    """
    if not isinstance(model.covar_module, SumOfTerms):
        yield "covar_module", model.covar_module, None, None
        return
    for i, term in enumerate(model.covar_module.terms):
        if term.kernel is not None:
            yield f"covar_module.terms.{i}.kernel", term.kernel, term.num_inputs, term.basis


def typical_sizes(model: BatchedMultiOutputGPyTorchModel) -> dict[str, Tensor]:
    """Return the typical value of each lengthscale, outputscale and noise of a model.

    The keys are names of raw parameters, the values tensors of the (transformed) parameter's
    shape; what they are, :data:`KINDS` says. Parameters of other kinds are left out.
    """
    inputs, targets = training_set(model)
    sizes: dict[str, Tensor] = {}
    with torch.no_grad():
        unit = _mean_square_residual(model, inputs, targets)
        ranges = inputs.amax(-2, keepdim=True) - inputs.amin(-2, keepdim=True)
        ranges = ranges.where(ranges > 0, torch.ones_like(ranges))
        for path, kernel, num_inputs, basis in kernels_of(model):
            scale = unit if basis is None else _over_mean_square(unit, basis(inputs))
            _visit(kernel, path, inputs, ranges[..., :num_inputs], scale, sizes)
        for name, noise in model.likelihood.named_parameters():
            if name.endswith("raw_noise"):
                sizes[f"likelihood.{name}"] = unit.unsqueeze(-1).expand(noise.shape)
    return sizes


def set_initial_values(model: BatchedMultiOutputGPyTorchModel, *given: object) -> None:
    """Set initial values, and bounds of the search, to multiples of the typical sizes.

    The parameters of ``given``, modules that the user brought, stay as they are.
    """
    keep = {id(p) for module in given if isinstance(module, Module) for p in module.parameters()}
    named = dict(model.named_parameters())
    for name, size in typical_sizes(model).items():
        if id(named[name]) in keep:
            continue
        kind, constraint = KINDS[kind_of(name)], constraint_of(model, name)
        if isinstance(constraint, LogInterval) and constraint.is_default:
            # One bound for all outputs, as BoTorch's optimiser wants it.
            constraint.lower_bound = kind.bounds[0] * size.amin()
            constraint.upper_bound = kind.bounds[1] * size.amax()
        with torch.no_grad():
            named[name].copy_(constraint.inverse_transform(kind.initial * size))
    inputs, targets = training_set(model)
    with torch.no_grad():
        unit = _mean_square_residual(model, inputs, targets)
        for term in getattr(model.covar_module, "terms", ()):
            if term.learns_mean:
                basis = term.weights(inputs)
                size = unit if basis is None else _over_mean_square(unit, basis)
                term.mean_variance.copy_(VAGUE_MEAN * size.unsqueeze(-1))


def _mean_square_residual(
    model: BatchedMultiOutputGPyTorchModel, inputs: Tensor, targets: Tensor
) -> Tensor:
    """The mean square of what the prior mean leaves of the targets, or 1 for 0: ``... x (m)``."""
    unit = (targets - model.mean_module(inputs)).square().nanmean(-1)
    if getattr(model, "has_unknowns", False):  # a physics that is right leaves rounding errors
        unit = unit.maximum(_ROUNDING * targets.square().nanmean(-1))
    return unit.where(unit > 0, torch.ones_like(unit))


def training_set(model: BatchedMultiOutputGPyTorchModel) -> tuple[Tensor, Tensor]:
    """The transformed training inputs and targets, in whatever mode the model is."""
    inputs = model.train_inputs[0]
    if not model._has_transformed_inputs:
        with torch.no_grad():
            inputs = model.transform_inputs(inputs)
    return inputs, model.train_targets


def is_rho(basis: Module | None) -> bool:
    """Whether a term with that basis scales a physics."""
    return isinstance(basis, AppendedPhysics)


def _over_mean_square(unit: Tensor, basis: Tensor) -> Tensor:
    """The variance of a factor of the basis that makes up for that of the targets."""
    power = basis.square().mean(-1)
    return (unit / power).where(power > 0, torch.ones_like(unit))


def _visit(
    module: Module,
    name: str,
    inputs: Tensor,
    ranges: Tensor,
    scale: Tensor,
    sizes: dict[str, Tensor],
) -> None:
    """Walk down a kernel, following what each level does to its inputs and its scale."""
    if isinstance(module, PhysicsScaledKernel):
        scale = _over_mean_square(scale, module.physics(inputs))
    if isinstance(module, Kernel) and module.active_dims is not None:
        ranges = ranges.index_select(-1, module.active_dims)
    if isinstance(module, ScaleKernel):
        sizes[f"{name}.raw_outputscale"] = scale.expand(module.raw_outputscale.shape)
    if isinstance(module, Kernel) and module.has_lengthscale:
        shape = module.raw_lengthscale.shape
        size = ranges if shape[-1] == ranges.shape[-1] else ranges.mean(-1, keepdim=True)
        sizes[f"{name}.raw_lengthscale"] = size.expand(shape)
    for child_name, child in module.named_children():
        _visit(child, f"{name}.{child_name}", inputs, ranges, scale, sizes)
