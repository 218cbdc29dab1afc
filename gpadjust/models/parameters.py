"""The learnable parameters of a model: one table, and vectors of them for optimiser and sampler."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood, Likelihood
from gpytorch.priors import LogNormalPrior, NormalPrior
from torch import Size, Tensor
from torch.func import functional_call
from torch.nn import Module, Parameter

from gpadjust.gp import OrthogonalKernel, PhysicsScaledKernel, SumOfTerms, Unit
from gpadjust.gp.noise import Noise


@dataclass(frozen=True)
class Kind:
    """What is assumed of a kind of parameter, in multiples of its typical size.

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
_ROUNDING = 1e-12
_LITTLE_NOISE = (1e-11, 1e-6)  # the noise of half of the starts, in typical sizes
_GUESSED = 0.3  # spread of the starts of a physics' parameters around the user's guesses


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
        """Whether all elements are valid values of the parameter."""
        return bool((tensor >= 0).all()) if self.is_default else bool(super().check(tensor))

    def check_raw(self, tensor: Tensor) -> bool:
        """Whether all elements are valid raw parameters."""
        return self.check(self.transform(tensor))


def scaled_rbf(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """An RBF kernel with one lengthscale per input and an outputscale."""
    base = RBFKernel(num_inputs, batch_shape=batch_shape, lengthscale_constraint=LogInterval())
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=LogInterval())


def orthogonal_rbf(num_inputs: int, batch_shape: Size) -> OrthogonalKernel:
    """The same, orthogonal to what unknown parameters of the physics explain: for a delta."""
    return OrthogonalKernel(scaled_rbf(num_inputs, batch_shape))


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
        """What vectors have of it: the raw parameter, or the logarithm of the parameter."""
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

    What each is, its place in the model tells: the lengthscale of a kernel, the outputscale of a
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
    for variances in Noise(model.likelihood).raw_variances:
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


def register_priors(model: BatchedMultiOutputGPyTorchModel) -> None:
    r"""Register a prior on each learnable hyper-parameter that has none.

    With the inputs in units of their range at the training points, their number d, and
    :math:`v` the mean square of the targets' residual from the prior mean:

    .. math::
        \log \ell &\sim N(\log d, \; 2^2) \\
        \log s_\delta &\sim N(\log v, \; 6^2), \quad
        \log s_\rho \sim N(\log 10^{-2}, \; 4^2) \\
        \log \sigma^2 &\sim N(\log(10^{-3} v), \; 4^2)

    The lengthscales grow with the dimension, after Hvarfner et al. (2024), and faster: in eight
    dimensions short ones take noise for a function. All are wide: functions that are nearly
    polynomial (long lengthscales, a large variance), a rho that is nearly constant, and data
    without noise are not ruled out. They were chosen on other data sets than those that are
    reported. A centre that is learnt has N(0, 3^2), in standard deviations of
    f_p from its mean. The constant rho of an :class:`~gpadjust.AR1` has N(1, 1 + r^2) for levels
    whose targets have standard deviations of the ratio r, high to low, and the noise of each level
    has the variance of its own targets for v. Give a kernel or likelihood
    priors of your own (``lengthscale_prior=...``, or ``register_prior``) to replace them.

    Args:
        model: A model of this library. They are made for sampling: :func:`gpadjust.fit` with
            ``"bayes"``, and GPyTorch's ``pyro_sample_from_prior``. The mode of a wide
            log-normal density lies far below its median, so a maximum a posteriori fit with them
            finds too little noise.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.inference import register_priors
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, X.sin(), physics=lambda X: X)
        >>> register_priors(model)
        >>> {name.rsplit(".", 1)[-1] for name, *_ in model.named_priors()} == {
        ...     "lengthscale_prior", "outputscale_prior", "noise_prior", "center_prior"
        ... }
        True
    """
    for row in hyperparameters(model):
        owner, name = row.owner, row.leaf.removeprefix("raw_")
        if not row.raw.requires_grad or f"{name}_prior" in getattr(owner, "_priors", ()):
            continue
        if row.kind == "constant":
            given = (torch.as_tensor(number).to(row.raw) for number in owner.prior_of_learnt)
            mean, sd = (number.expand_as(row.raw).clone() for number in given)
            owner.register_prior(f"{name}_prior", NormalPrior(mean, sd), name)
        elif row.size is not None:
            kind, size = KINDS[row.kind], row.size
            median, spread = kind.prior
            median *= size.shape[-1] if row.kind == "lengthscale" else 1.0
            location = (size if kind.has_unit else torch.ones_like(size)).log() + math.log(median)
            prior = LogNormalPrior(location, torch.full_like(location, spread))
            read, write = getattr(owner, f"_{name}_param"), getattr(owner, f"_{name}_closure")
            owner.register_prior(f"{name}_prior", prior, read, write)


def shared_parameters(model: BatchedMultiOutputGPyTorchModel) -> list[str]:
    """The names of the learnable parameters that are no output's own, as those of a physics."""
    return [r.name for r in hyperparameters(model) if r.raw.requires_grad and r.is_shared]


Values = dict[str, Tensor]
"""What vectors have of parameters, by their names: ``k x`` their shape, or their shape."""


class Parameters:
    """Vectors of a model's learnable parameters: logarithms of lengthscales and variances.

    Parameters of other kinds stay as they are. A model's outputs (and batches) are ``B`` problems
    apart; where parameters are shared, by several outputs or with the input transform (a physics
    that learns), all outputs make up one problem.

    Bounds and starts are multiples of sizes read off the data, so that units do not matter; a
    constraint that the user gave takes their place. Parameters of other kinds start around their
    current values (those of the physics within about a third, the others one to ten times as wide),
    and are bounded by nothing but their constraints.

    Attributes:
        table: The rows of all its parameters, by the ``id`` of the raw one.
        rows: Those that are learnable, and ``names`` their names.
        batch_shape: The shape whose elements are the ``num_problems`` = ``B`` problems; empty for
            one.
        is_batched: Whether outputs are problems of their own.
        learns_inputs: Whether parameters of the input transform are among them.
        lower: Lower bounds, ``B x p``; ``upper`` upper ones.
        variances: 1 for a variance that nothing but the data bounds, 0 for others, ``B x p``.
        noise: 1 for such a noise variance, ``B x p``.
        is_constrained: Where bounds are those of the user's constraints, ``B x p``.

    Raises:
        ValueError: If no parameter is learnable, nor any of the physics unknown.
    """

    def __init__(self, model: BatchedMultiOutputGPyTorchModel) -> None:
        self._model = model
        every = hyperparameters(model)
        self.table = {id(row.raw): row for row in every}
        self.rows = [row for row in every if row.raw.requires_grad]
        if not self.rows and not getattr(model, "has_unknowns", False):
            raise ValueError(
                "The model has no learnable parameter: all have `requires_grad=False`."
            )
        self.names = [row.name for row in self.rows]
        self.learns_inputs = any(row.kind == "physics" for row in self.rows)
        self.is_batched = not any(row.is_shared for row in self.rows)
        self.batch_shape = model._aug_batch_shape if self.is_batched else Size()
        self.num_problems = self.batch_shape.numel()
        self.noise = self.mask(lambda row: row.kind == "noise" and row.is_free)
        self.variances = self.mask(lambda row: row.kind != "lengthscale" and row.is_free)
        self.is_constrained = self.mask(lambda row: row.is_log and not row.is_free).bool()
        lower = self._pack(lambda row: row.limits()[0])
        upper = self._pack(lambda row: row.limits()[1])
        # A start that the user gives may lie outside, but not below the least noise.
        current = self.current()[0]
        self.lower = torch.where(self.noise > 0, lower, torch.minimum(lower, current))
        self.upper = torch.maximum(upper, current)

    def flatten(self, values: Values) -> Tensor:
        """Pack values, ``k x`` each parameter's shape (or its shape), into ``k x B x p``."""
        lead = len(self.batch_shape)
        parts = [
            values[row.name].detach().reshape(-1, self.num_problems, row.raw.shape[lead:].numel())
            for row in self.rows
        ]
        return (
            torch.cat(parts, -1)
            if parts
            else self._model.train_targets.new_zeros(1, self.num_problems, 0)
        )

    def unflatten(self, vectors: Tensor) -> Values:
        """The reverse of :meth:`flatten`."""
        shapes = [row.raw.shape[len(self.batch_shape) :] for row in self.rows]
        parts = vectors.split([shape.numel() for shape in shapes], dim=-1) if shapes else ()
        return {
            name: part.reshape(-1, *self.batch_shape, *shape)
            for name, part, shape in zip(self.names, parts, shapes, strict=True)
        }

    def mask(self, which: Callable[[Hyperparameter], bool]) -> Tensor:
        """1 where a function of the row says so, 0 elsewhere, ``B x p``."""
        return self._pack(lambda row: torch.full_like(row.raw, float(which(row))))

    def current(self) -> Tensor:
        """The model's own vectors, ``1 x B x p``."""
        return self._pack(Hyperparameter.value).unsqueeze(0)

    def to_raw(self, values: Values) -> Values:
        """Turn values into GPyTorch's raw parameters; differentiable."""
        return {row.name: row.to_raw(values[row.name]) for row in self.rows}

    def call_at(self, values: Values, function: Callable[[], Any]) -> Any:
        """Call a function that reads the model, at other values of it; differentiable."""
        named = {f"model.{name}": value for name, value in self.to_raw(values).items()}
        return functional_call(_Call(self._model, function), named, ())

    @torch.no_grad()
    def assign(self, vector: Tensor) -> None:
        """Give the model a vector, ``B x p``."""
        raw = self.to_raw(self.unflatten(vector.unsqueeze(0)))
        for row in self.rows:
            row.raw.copy_(raw[row.name][0])

    def clipped(self, vectors: Tensor) -> Tensor:
        """The vectors (``k x B x p``) moved into the bounds."""
        return torch.minimum(torch.maximum(vectors, self.lower), self.upper)

    def is_allowed(self, vectors: Tensor) -> Tensor:
        """Whether vectors keep to constraints and to the least noise, ``k x B``.

        Bounds that the data suggest to a search do not count.
        """
        counts = self.is_constrained | self.noise.bool()
        inside = (vectors >= self.lower) & ((vectors <= self.upper) | ~self.is_constrained)
        return (inside | ~counts).all(-1)

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random vectors, ``num_starts x B x p``.

        A function with a lengthscale of r times the data's range looks linear there, with a
        variation of 1 / r of its standard deviation: so half of the starts raise the outputscale
        by up to r^2. The first half of the starts has next to no noise.
        """
        options: Any = {"generator": generator, "dtype": self.lower.dtype}
        multiples, lengths, values = dict[str, Tensor](), dict[int, Tensor](), dict[str, Tensor]()
        half = num_starts // 2
        for row in self.rows:
            if not row.is_log:
                continue
            share = torch.rand(num_starts, *row.raw.shape, **options).to(row.raw.device)
            low, high = map(math.log, KINDS[row.kind].starts)
            multiples[row.name] = (low + share * (high - low)).exp()
            if row.kind == "noise":
                low, high = map(math.log, _LITTLE_NOISE)
                multiples[row.name][:half] = (low + share[:half] * (high - low)).exp()
            if row.kind == "lengthscale":
                lengths[id(row.owner)] = multiples[row.name].amin((-1, -2)).clamp_min(1.0)
        for row in self.rows:
            stretch = lengths.get(id(getattr(row.owner, "base_kernel", None)))
            if row.name in multiples and stretch is not None:
                power = torch.rand(num_starts, *row.raw.shape, **options).to(row.raw.device)
                multiples[row.name] *= stretch.pow((4 * power - 2).clamp_min(0.0))
        for row in self.rows:
            if row.name in multiples:
                values[row.name] = row.log_of(multiples[row.name])
                continue
            value, shape = row.value(), (num_starts, *row.raw.shape)
            away = torch.randn(shape, **options).to(value.device)
            spread = 10 ** torch.rand(shape, **options).to(value.device)
            spread = torch.full_like(spread, _GUESSED) if row.kind == "physics" else spread
            values[row.name] = value + magnitude(value) * spread * away
        return self.clipped(self.flatten(values))

    def _pack(self, function: Callable[[Hyperparameter], Tensor]) -> Tensor:
        """Pack what a function makes of each row, of the parameter's shape, into ``B x p``."""
        return self.flatten({row.name: function(row) for row in self.rows})[0]


class LogPriors:
    """The sum of the log densities of the priors registered on a model, at vectors of it.

    They are densities of the hyper-parameters themselves, as GPyTorch has it, or of the vectors,
    their logarithms: the log determinant between the two is the sum of the latter. Where all of
    them are log-normal (or normal, of a parameter that is not taken as its logarithm) they are
    computed and differentiated by hand.

    Args:
        model: The model.
        parameters: Its learnable parameters.
        of_logs: Whether densities are those of the vectors' elements.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        parameters: Parameters,
        of_logs: bool = False,
    ) -> None:
        self._model, self._parameters = model, parameters
        # What the density of the logarithms has in addition, by each of them.
        self._slope = parameters.mask(lambda row: of_logs and row.is_log)
        at, precision, logs = (
            {r.name: torch.zeros_like(r.raw) for r in parameters.rows} for _ in "123"
        )
        self._is_normal = True
        for _, module, prior, read, _ in model.named_priors():
            rows = [row for row in parameters.rows if row.owner is module]
            of_log, seen = type(prior) is LogNormalPrior, read(module).detach()
            is_first = len(rows) == 1 and not precision[rows[0].name].any()
            if not is_first or type(prior) not in (LogNormalPrior, NormalPrior):
                self._is_normal = False
                return
            row, value, name = rows[0], rows[0].value(), rows[0].name
            if (
                row.is_log != of_log
                or seen.shape != value.shape
                or not torch.allclose(seen, value.exp() if of_log else value)
                or torch.broadcast_shapes(prior.loc.shape, value.shape) != value.shape
            ):
                self._is_normal = False
                return
            at[name] = prior.loc.expand_as(value)
            precision[name] = prior.scale.square().reciprocal().expand_as(value)
            logs[name] = torch.full_like(value, of_log)
        self._location, self._precision = (parameters.flatten(each)[0] for each in (at, precision))
        self._pull = self._slope - parameters.flatten(logs)[0]
        constant = (self._precision / (2 * math.pi)).where(
            self._precision > 0, torch.ones_like(self._precision)
        )
        self._constant = 0.5 * constant.log().sum(-1)

    def __call__(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The log density at ``vectors`` (``k x B x p``), ``k x B``, and its gradient."""
        if not self._is_normal:
            return self._by_autograd(vectors)
        away = vectors - self._location
        back, out = self._precision * away, self._pull
        return self._constant + (out * vectors - 0.5 * back * away).sum(-1), out - back

    def _by_autograd(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        parameters, leaf = self._parameters, vectors.detach().requires_grad_()
        batch = (len(vectors), *parameters.batch_shape)
        with torch.enable_grad():
            values = parameters.unflatten(leaf)
            densities: list[Tensor] = parameters.call_at(values, self._densities)
            total = leaf.new_zeros(batch)
            for density, own in zip(densities, self._densities(), strict=True):
                # That of a parameter which is not learnt has no dimension of vectors.
                shape = batch if density.dim() > own.dim() else batch[1:]
                shape = shape if density.dim() >= len(shape) else ()
                total = total + density.reshape(*shape, -1).sum(-1)
            total = total.reshape(len(vectors), -1) + (self._slope * leaf).sum(-1)
        gradient = torch.autograd.grad(total, leaf, torch.ones_like(total))[0]
        return total.detach(), gradient

    def _densities(self) -> list[Tensor]:
        """The log density of each prior at the model's parameters."""
        return [prior.log_prob(read(m)) for _, m, prior, read, _ in self._model.named_priors()]


class _Call(Module):
    """A function beside a model, for `functional_call` to replace the model's parameters."""

    def __init__(self, model: Module, function: Callable[[], Any]) -> None:
        super().__init__()
        self.model = model
        self.forward = function


def magnitude(values: Tensor) -> Tensor:
    """The absolute values, and 1 for zeros."""
    return torch.where(values == 0, torch.ones_like(values), values.abs())
