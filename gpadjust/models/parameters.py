"""The learnable parameters of a model: one table of what they are, and what is assumed of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood, Likelihood
from torch import Size, Tensor
from torch.nn import Module, Parameter

from gpadjust.gp import OrthogonalKernel, PhysicsScaledKernel, SumOfTerms
from gpadjust.gp.categories import GroupedRBFKernel, OffsetKernel
from gpadjust.gp.noise import Noise
from gpadjust.gp.term import Unit


@dataclass(frozen=True)
class Kind:
    """Assumptions on a kind of parameter, in multiples of its typical size.

    Attributes:
        initial: Its value in a new model.
        bounds: Where a fit looks for it.
        starts: The range of the random starts, uniform in the logarithm.
        prior: Median and standard deviation of the logarithm, of a log-normal prior.
        has_unit: Whether the prior follows the typical size; else the median is the value itself.
    """

    initial: float
    bounds: tuple[float, float] = (1e-9, 1e9)
    starts: tuple[float, float] = (1e-2, 1e2)
    prior: tuple[float, float] = (1.0, 6.0)
    has_unit: bool = True


KINDS = {
    # Typical size: the range of the input. Priors are longer in more dimensions, by d.
    "lengthscale": Kind(0.5, bounds=(1e-2, 1e3), starts=(0.05, 50.0), prior=(1.0, 2.0)),
    # The mean square of the targets' residual from the prior mean, v, over that of the basis. The
    # prior is all but flat, so that near-polynomial functions, of long lengthscales and large
    # variance, are not ruled out.
    "outputscale": Kind(0.5, prior=(1.0, 6.0)),
    # That of a rho, whose prior is one of rho itself, which has no units.
    "scaling": Kind(0.5, prior=(0.01, 4.0), has_unit=False),
    # v, or of a level. Noise with an sd of less than three millionths of it is as good as none.
    "noise": Kind(1e-2, bounds=(1e-11, 1e1), starts=(1e-6, 1.0), prior=(1e-3, 4.0)),
    # As an outputscale: the prior variance of an unknown mean before a fit.
    "mean": Kind(1e2),
}
"""The kinds of parameters that have a typical size."""
SIZES = ("outputscale", "scaling")
"""Those that are the variance of a function."""
_ROUNDING = 1e-12


class LogInterval(Interval):
    """Positive parameters in an interval, with their logarithm as the raw parameter.

    BoTorch's L-BFGS keeps to the bounds, and GPyTorch refuses values beyond them, but the transform
    does not squash, so that gradients stay honest. Without a lower bound both are read off the
    data, and any positive value may be set, as samplers do that follow a prior.
    """

    def __init__(
        self, lower_bound: float | Tensor | None = None, upper_bound: float | Tensor = 1e12
    ) -> None:
        lower = 1e-12 if lower_bound is None else lower_bound
        super().__init__(lower, upper_bound, transform=torch.exp, inv_transform=torch.log)
        self.is_default = lower_bound is None

    def transform(self, tensor: Tensor) -> Tensor:
        """Map the raw parameter to the parameter."""
        return tensor.exp()

    def inverse_transform(self, transformed_tensor: Tensor) -> Tensor:
        """Map the parameter to the raw parameter."""
        return transformed_tensor.log()

    def check(self, tensor: Tensor) -> bool:
        """Return whether all elements are valid values of the parameter."""
        return bool((tensor >= 0).all()) if self.is_default else bool(super().check(tensor))

    def check_raw(self, tensor: Tensor) -> bool:
        """Return whether all elements are valid raw parameters."""
        return self.check(self.transform(tensor))


def scaled_rbf(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """An RBF kernel with one lengthscale per input and an outputscale."""
    base = RBFKernel(num_inputs, batch_shape=batch_shape, lengthscale_constraint=LogInterval())
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=LogInterval())


def orthogonal_rbf(num_inputs: int, batch_shape: Size) -> OrthogonalKernel:
    """The default kernel, orthogonal to what unknown parameters explain: for a delta."""
    return OrthogonalKernel(scaled_rbf(num_inputs, batch_shape))


def scaled_offsets(columns: Sequence[int], num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """Independent offsets of the levels that some input columns stand for."""
    own: Any = {"batch_shape": batch_shape, "lengthscale_constraint": LogInterval()}
    base = OffsetKernel(columns, num_inputs, **own)
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=LogInterval())


def learnt_noise(batch_shape: Size) -> Likelihood:
    """Gaussian noise of one variance per output."""
    return GaussianLikelihood(batch_shape=batch_shape, noise_constraint=LogInterval())


@dataclass(eq=False)
class Hyperparameter:
    """A row of the table: a parameter of a model, and what is assumed of it.

    A ``kind`` is a key of :data:`KINDS`; or ``"constant"`` of one that a basis is affine in,
    ``"physics"`` of one of the input transform, ``"other"``.

    Attributes:
        is_log: Whether vectors have its logarithm; ``squashes``: which the raw parameter is not.
        is_default: Whether its bounds are read off the data.
        is_free: Whether it is positive, and nothing but the data bounds it.
    """

    name: str  # in `model.named_parameters()`
    raw: Parameter  # GPyTorch's
    owner: Any  # the module that has it
    leaf: str  # its name there
    kind: str
    size: Tensor | None  # its typical size, of its shape, if it is of one of KINDS
    constraint: Any  # GPyTorch's, or None
    is_shared: bool  # it is no output's own, as that of a physics

    def __post_init__(self) -> None:
        constraint, is_ours = self.constraint, isinstance(self.constraint, LogInterval)
        self.is_log = self.size is not None and constraint is not None
        self.squashes = self.is_log and not is_ours
        self.is_default = is_ours and constraint.is_default
        self.is_free = self.is_log and self.is_default
        if self.squashes:
            lower, upper = constraint.lower_bound, constraint.upper_bound
            self.is_free = bool((lower <= 0).all() and upper.isinf().all())

    def parameter(self, raw: Tensor) -> Tensor:
        """The parameter itself, of raw ones of any batch."""
        return raw if self.constraint is None else self.constraint.transform(raw)

    def value(self) -> Tensor:
        """Its entry in vectors: the raw parameter, or the logarithm of the parameter."""
        raw = self.raw.detach()
        return self.parameter(raw).log() if self.squashes else raw

    def to_raw(self, value: Tensor) -> Tensor:
        """The reverse of :meth:`value`, of any batch; differentiable."""
        return self.constraint.inverse_transform(value.exp()) if self.squashes else value

    def log_of(self, multiple: Tensor) -> Tensor:
        """The logarithm of a multiple of the typical size, within the user's constraint."""
        value = multiple if self.size is None else multiple * self.size
        if self.is_free:
            return value.log()
        ends = self.constraint.lower_bound.to(value), self.constraint.upper_bound.to(value)
        if self.constraint.enforced and self.squashes:
            # At its ends the raw parameter of a constraint that squashes is infinite.
            width = ends[1] - ends[0]
            margin = 1e-6 * width.where(ends[1].isfinite(), value.new_ones(()))
            ends = ends[0] + margin, ends[1] - margin
        return value.clamp(*ends).log()

    def limits(self) -> list[Tensor]:
        """The lower and upper bound of what vectors have of it, of its shape."""
        one, ends = torch.ones_like(self.raw), (-math.inf, math.inf)
        if self.is_log:
            return [self.log_of(bound * one) for bound in KINDS[self.kind].bounds]
        if self.constraint is not None and not self.constraint.enforced:
            ends = self.constraint.lower_bound.item(), self.constraint.upper_bound.item()
        return [end * one for end in ends]


@torch.no_grad()
def hyperparameters(model: BatchedMultiOutputGPyTorchModel) -> list[Hyperparameter]:
    """The table of a model's parameters, in the order of ``model.named_parameters()``.

    Its place in the model decides its kind: the lengthscale of a kernel, the outputscale of a
    ``ScaleKernel``, the noise of the likelihood, the constant of a term's basis.
    """
    inputs, targets = model.train_inputs[0], model.train_targets
    inputs = inputs if model._has_transformed_inputs else model.transform_inputs(inputs)
    ranges = inputs.amax(-2, keepdim=True) - inputs.amin(-2, keepdim=True)
    ranges = ranges.where(ranges > 0, torch.ones_like(ranges))
    kernel = model.covar_module
    if isinstance(kernel, SumOfTerms):  # unknown means, which fits move, have no vote
        mean = kernel.at(inputs).combine({term.name: term.given_mean for term in kernel.terms})
    else:
        mean = model.mean_module(inputs)
    noise = Noise(model.likelihood)
    targets = targets if noise.rows is None else noise.trusted(targets)
    unit = (targets - mean).square().nanmean(-1)
    # A physics that misleads says nothing of how large functions and noise are.
    spread = (targets - targets.nanmean(-1, keepdim=True)).square().nanmean(-1)
    is_constant = spread <= _ROUNDING**2 * targets.square().nanmean(-1)
    unit = unit.where(is_constant, unit.minimum(spread))
    if getattr(model, "has_unknowns", False):  # a physics that is right leaves rounding errors
        unit = unit.maximum(_ROUNDING * targets.square().nanmean(-1))
    unit = unit.where(unit > 0, torch.ones_like(unit))
    found: dict[int, tuple[str, Tensor | None]] = {}
    terms = getattr(model, "terms", getattr(model.covar_module, "terms", None))
    if terms is None:
        _enter(found, model.covar_module, inputs, ranges, unit, "outputscale")
    for term in () if terms is None else terms:
        basis = term.weights(inputs)
        scale = unit if basis is None else _over_mean_square(unit, basis)
        if (constant := getattr(term.basis, "learnt", None)) is not None:
            found[id(constant)] = ("constant", None)
        if term.learns_mean:
            found[id(term.mean_variance)] = ("mean", scale.unsqueeze(-1))
        if term.kernel is not None:
            variance = "scaling" if term.unit is Unit.NONE else "outputscale"
            _enter(found, term.kernel, inputs, ranges[..., : term.num_inputs], scale, variance)
    for variances in noise.raw_variances:
        each = _units_of_groups(model, unit)
        each = each if each.shape == variances.shape else unit.unsqueeze(-1)
        found[id(variances)] = ("noise", each.expand(variances.shape))
    transform = getattr(model, "input_transform", None)
    for raw in () if transform is None else transform.parameters():
        found[id(raw)] = ("physics", None)
    outputs, rows = model._aug_batch_shape, dict[int, Hyperparameter]()
    for path, owner in model.named_modules():
        for leaf, raw in owner.named_parameters(recurse=False):
            kind, size = found.get(id(raw), ("other", None))
            constraint = getattr(owner, f"{leaf}_constraint", None)
            constraint = constraint if isinstance(constraint, Interval) else None
            shared = kind == "physics" or raw.shape[: len(outputs)] != outputs
            name = f"{path}.{leaf}".removeprefix(".")
            row = Hyperparameter(name, raw, owner, leaf, kind, size, constraint, shared)
            rows.setdefault(id(raw), row)
    return [*rows.values()]


def _units_of_groups(model: BatchedMultiOutputGPyTorchModel, unit: Tensor) -> Tensor:
    """The variance of the targets of each group that has a trend of its own, ``... x g``.

    Of one group, or one whose targets do not vary, it is the given unit.
    """
    groups = torch.ones_like(model.train_inputs[0][..., :1])
    if hasattr(model, "trend_inputs"):
        groups = model.trend_inputs(model.train_inputs[0])[1]
    if groups.shape[-1] == 1:
        return unit.unsqueeze(-1)
    targets = model.train_targets.unsqueeze(-1).where(groups > 0, math.nan)
    units = (targets - targets.nanmean(-2, keepdim=True)).square().nanmean(-2)
    return units.where(units > 0, unit.unsqueeze(-1))


def _enter(
    found: dict[int, tuple[str, Tensor | None]],
    module: Module,
    inputs: Tensor,
    ranges: Tensor,
    scale: Tensor,
    variance: str,
    is_scaled: bool = False,
) -> None:
    """Enter kinds and sizes of a kernel's parameters, following what each level does to both.

    A ``ScaleKernel`` selects the columns of the kernel that it scales.
    """
    if isinstance(module, PhysicsScaledKernel):
        scale = _over_mean_square(scale, module.basis(inputs))
    if isinstance(module, Kernel) and module.active_dims is not None and not is_scaled:
        ranges = ranges.index_select(-1, module.active_dims)
    if isinstance(module, ScaleKernel):
        raw = module.raw_outputscale
        found[id(raw)] = (variance, scale.expand(raw.shape))
    if isinstance(module, Kernel) and module.has_lengthscale:
        raw = module.raw_lengthscale
        size = ranges if raw.shape[-1] == ranges.shape[-1] else ranges.mean(-1, keepdim=True)
        size = module.sizes(ranges) if isinstance(module, GroupedRBFKernel) else size
        found[id(raw)] = ("lengthscale", size.expand(raw.shape))
    for child in module.children():
        _enter(found, child, inputs, ranges, scale, variance, isinstance(module, ScaleKernel))


def _over_mean_square(unit: Tensor, basis: Tensor) -> Tensor:
    """The variance of a factor of the basis that makes up for that of the targets."""
    power = basis.square().mean(-1)
    return (unit / power).where(power > 0, torch.ones_like(unit))


@torch.no_grad()
def set_initial_values(model: BatchedMultiOutputGPyTorchModel, *given: object) -> None:
    """Set initial values, and bounds of the search, to multiples of the typical sizes.

    The parameters of ``given``, modules that the user brought, stay as they are.
    """
    keep = {id(p) for module in given if isinstance(module, Module) for p in module.parameters()}
    for row in hyperparameters(model):
        if row.size is None or id(row.raw) in keep:
            continue
        kind, constraint = KINDS[row.kind], row.constraint
        if row.is_default:  # one bound for all outputs, as BoTorch's optimiser wants it
            constraint.lower_bound = kind.bounds[0] * row.size.amin()
            constraint.upper_bound = kind.bounds[1] * row.size.amax()
        value = kind.initial * row.size
        row.raw.copy_(value if constraint is None else constraint.inverse_transform(value))


def shared_parameters(model: BatchedMultiOutputGPyTorchModel) -> list[str]:
    """The names of the learnable parameters that are no output's own, as those of a physics."""
    return [r.name for r in hyperparameters(model) if r.raw.requires_grad and r.is_shared]
