"""The builder of a model's terms, from data and physics."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypedDict

import torch
from botorch.exceptions.errors import BotorchTensorDimensionError
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import OutcomeTransform, Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import Likelihood
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import AppendedPhysics, PhysicsInput, Term, VanishingKernel
from gpadjust.gp.categories import CategoricalInput
from gpadjust.gp.gaussian import least_squares
from gpadjust.gp.noise import Noise, RowSource
from gpadjust.gp.physics_columns import check_one_to_one
from gpadjust.gp.term import Unit
from gpadjust.models.levels import values_of
from gpadjust.models.links import Logit
from gpadjust.models.parameters import scaled_offsets, scaled_rbf
from gpadjust.models.plausibility import complaint
from gpadjust.models.training_data import (
    ArrayLike,
    TrainingData,
    estimated,
    residual_scale,
    training_data,
)
from gpadjust.physics import Physics, PhysicsWarning, as_physics
from gpadjust.physics.function import AnyPhysics, Parts

PhysicsLike = AnyPhysics | Parts
KernelLike: TypeAlias = Kernel | Callable[[int, Size], Kernel]
Kernels: TypeAlias = KernelLike | Sequence[KernelLike] | None
Means = float | Sequence[float] | Literal["learn"]
Center = float | Tensor | Literal["mean", "learn"]
Columns: TypeAlias = str | int | Sequence[str | int]
LikelihoodLike: TypeAlias = (
    Likelihood | str | Sequence[str] | Callable[["TermBuilder"], Likelihood] | None
)
Outcomes: TypeAlias = OutcomeTransform | tuple[float, float] | str | _DefaultType | None


class ModelOptions(TypedDict, total=False):
    """The arguments that all structures share, see :class:`~gpadjust.CKA`."""

    likelihood: LikelihoodLike
    outcome_transform: Outcomes
    input_transform: InputTransform | None
    train_Xvar: ArrayLike | float | Sequence[float]
    categorical: Columns | Mapping[Any, Any] | None
    batch: Columns | None


class TermBuilder:
    """The data of a model, their units and physics, and what makes terms for them.

    Args:
        data: The data.
        input_transform: What makes the columns that terms read out of raw inputs, or None.
        units: Shift and scale of the targets, or None.
        num_inputs: Number ``d`` of these columns without those of the physics.
        likelihood: The user's, a function that makes it of the builder, names of ours, or None.

    Attributes:
        batch_shape: That of the model with its outputs last, for its kernels.
        f: Each physics at the training inputs, ``batch_shape x n x m``.
        given: What the user brought, whose parameters stay as they are.
        sources: What sets the noise of training rows apart between fits.
        link: That of the targets, of which data and physics are then, or None.
        noisy_inputs: The inputs as they were measured, if with noise, or None.
        categories: The part of the input transform that is of categories, or None.
    """

    link: Any = None
    noisy_inputs: Any = None
    categories: Any = None

    def __init__(
        self,
        data: TrainingData,
        input_transform: InputTransform | None,
        units: Standardize | None,
        num_inputs: int,
        likelihood: LikelihoodLike = None,
    ) -> None:
        self.data = data
        self.input_transform = input_transform
        self.units = units
        self.num_inputs = num_inputs
        self.likelihood = likelihood
        _, self.batch_shape = BatchedMultiOutputGPyTorchModel.get_batch_dimensions(data.X, data.Y)
        m = data.Y.shape[-1]
        self._zero = torch.zeros_like(data.X[..., :1, :1]).expand(*data.X.shape[:-2], 1, m)
        self._shift = self._zero if units is None else units.means
        self._scale = self._zero + 1 if units is None else units.stdvs
        self.given: list[object] = [likelihood]
        self.sources: list[RowSource] = []
        # Of each physics: its values, and the mean of its rho and its center, batch_shape x 1 x m.
        self.f: list[Tensor] = []
        self._means: list[Tensor] = []
        self._centers: list[Tensor] = []
        self._rhos: list[Term] = []
        self._learns_mean = self._learns_center = self._learns_offset = False
        self._offset = 0.0

    @classmethod
    def of_adjustment(
        cls,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        physics: PhysicsLike | None = None,
        *,
        rho_mean: Means | None = None,
        center: Center = "learn",
        likelihood: LikelihoodLike = None,
        outcome_transform: Outcomes = DEFAULT,
        input_transform: InputTransform | None = None,
        train_Xvar: ArrayLike | float | Sequence[float] = None,
        categorical: Columns | Mapping[Any, Any] | None = None,
        batch: Columns | None = None,
    ) -> TermBuilder:
        r"""The builder of the terms of :math:`f_a(x) = \sum_i \rho_i(x) f_i(x) + \delta(x)`.

        The model's input transform appends all f_i to the inputs
        (:class:`~gpadjust.gp.PhysicsInput`), once; the terms read those columns.

        With a center c the basis of rho is :math:`f_p - c`. The bias is then :math:`\delta =
        \delta_0 - \sum_i c_i \rho_i` for the model's own term :math:`\delta_0`. A center that is
        learnt is in standard deviations of f_p from its mean.

        The arguments are those of :class:`~gpadjust.CKA`; a model without physics has None.
        """
        check_one_to_one(input_transform)
        data = training_data(train_X, train_Y, train_Yvar, categorical=categorical, batch=batch)
        if data.levels:
            input_transform = CategoricalInput(
                values_of(data.levels),
                data.batches,
                data.X.shape[-1],
                data.input_names,
                input_transform,
            )
        m, k, unknowns, link = data.Y.shape[-1], 0, False, None
        if not isinstance(outcome_transform, _DefaultType | None):
            link = Logit.of(outcome_transform)
        if link is not None:
            data, outcome_transform = link.of_data(data), DEFAULT
        noisy: Any = None
        if train_Xvar is not None:
            from gpadjust.models.noisy_inputs import NoisyInputs

            noisy = NoisyInputs.of(train_Xvar, data)
            data = data._replace(X=noisy.points)
        transform = input_transform
        if physics is not None:
            physics = as_physics(physics)
            physics.check_names(data.input_names)
            if link is not None and physics.is_emulated:
                raise ValueError(
                    "An emulated physics is uncertain in the units of its runs, which a link would "
                    "bend: emulate g(runs_Y), build the model of g(train_Y), and leave "
                    "outcome_transform out."
                )
            transform = PhysicsInput(physics, data.X.shape[-1], input_transform, link)
            k, unknowns = len(getattr(physics, "parts", [physics])), bool(physics.unknowns)
        X = transformed(data.X, transform)
        if isinstance(physics, Physics) and physics.num_outputs != k * m:
            raise ValueError(
                f"The physics '{physics.name}' returned {(physics.num_outputs or 0) // k} columns, "
                f"expected {m}, one for each column of train_Y."
            )
        d = X.shape[-1] - k * m
        f = [X[..., d + i * m : d + (i + 1) * m] for i in range(k)]
        d -= getattr(transform, "num_of_error", 0)
        means = _starting_means(rho_mean, data.Y, f)
        if isinstance(outcome_transform, _DefaultType):
            mean = sum((w * v for w, v in zip(means, f, strict=True)), torch.zeros_like(data.Y))
            if unknowns:  # their guesses may be farther off than the mean of the targets
                own = data.Y.nanmean(-2, keepdim=True).expand_as(mean)
                far, near = ((data.Y - v).square().nanmean(-2, keepdim=True) for v in (mean, own))
                mean = own.where((near > 0) & (near < far), mean)
            units: Standardize | None = residual_scale(data.Y, mean)
        else:
            units = estimated(outcome_transform, data.Y, X)
        make = cls(data, transform, units, d, likelihood)
        make.link, make.categories = link, input_transform if data.levels else None
        if noisy is not None:
            make.noisy_inputs, make.sources = noisy, [noisy]
        make.f, make._means, make._centers = f, means, [_center(center, v) for v in f]
        make._learns_mean = rho_mean == "learn" or (rho_mean is None and k > 1)
        make._learns_center = isinstance(center, str) and center == "learn"
        return make

    def term(
        self,
        name: str,
        kernel: KernelLike | None,
        basis: Module | None = None,
        mean: float | Tensor = 0.0,
        learns_mean: bool = False,
        unit: Unit = Unit.DIFFERENCE,
        label: str | None = None,
    ) -> Term:
        """Make a term.

        Args:
            name: Its name.
            kernel: Its kernel, or a function of the number of inputs and the batch shape that makes
                it; None for a constant.
            basis: Its basis; None for 1.
            mean: Its prior mean, ``batch_shape x 1 x m`` or a number, in the model's units.
            learns_mean: Whether that is unknown.
            unit: The unit in which the model says it.
            label: What errors call it. Default: its name.
        """
        made: Kernel | None = None
        if kernel is not None:
            self.given.append(kernel)
            d, whose, shape = self.num_inputs, f"the kernel of {label or name}", self.batch_shape
            made = kernel if isinstance(kernel, Kernel) else None
            if made is None:
                if isinstance(kernel, Module | type) or not callable(kernel):
                    raise TypeError(f"Expected {whose} to be a GPyTorch kernel, got {kernel!r}.")
                of_data = getattr(kernel, "made_for", None)  # it asks for names and units
                made = kernel(d, shape) if of_data is None else of_data(self)
                if self.categories is not None:
                    made = self.categories.grouped(made)
            if made.batch_shape != shape:
                raise ValueError(
                    f"Expected {whose} with batch_shape {tuple(shape)}, one for each output, got "
                    f"{tuple(made.batch_shape)}; pass `batch_shape=torch.Size({list(shape)})` to "
                    "it and to the kernels inside it."
                )
            for part in made.modules():
                dims = part.active_dims if isinstance(part, Kernel) else None
                if dims is not None and int(dims.max()) >= d:
                    raise ValueError(
                        f"Expected {whose} with active_dims below {d}, the number of inputs, got "
                        f"{dims.tolist()}."
                    )
            reads = d if made.active_dims is None else len(made.active_dims)
            if made.has_lengthscale and made.ard_num_dims not in (None, 1, reads):
                raise ValueError(
                    f"Expected {whose} with ard_num_dims={reads}, one lengthscale for each input "
                    f"that it reads, got {made.ard_num_dims}."
                )
        mean = self._of_outputs(torch.as_tensor(mean).to(self._zero))
        variance = torch.ones_like(mean) if learns_mean else None
        return Term(name, made, self.num_inputs, basis, mean, variance, unit)

    def rhos(self, kernels: Kernels = scaled_rbf) -> list[Term]:
        """The terms that scale a physics, one for each: ``rho``, or ``rho_<name>`` of several.

        Args:
            kernels: What :meth:`term` takes for all, or one for each; None for constants.
        """
        k, m = len(self.f), self.data.Y.shape[-1]
        if not self.f or not isinstance(self.input_transform, PhysicsInput):
            raise TypeError("Expected a physics, got None; ZeroMeanGP is the model without one.")
        each = [*kernels] if isinstance(kernels, Sequence) else [kernels] * k
        if len(each) != k or (k > 1 and isinstance(kernels, Module)):
            found = len(each) if isinstance(kernels, Sequence) else "one"
            raise ValueError(
                f"Expected {k} kernels of rho, one for each physics, got {found}: pass a sequence, "
                "or a function of the number of inputs and the batch shape that makes one."
            )
        several = getattr(self.input_transform.physics, "names", ())
        names = [f"rho_{name}" for name in several] if k > 1 else ["rho"]
        columns = torch.eye(k * m).to(self._zero).split(m)  # of each physics, m x (k m)
        terms, first = list[Term](), self.num_inputs + self.input_transform.num_of_error
        for i, f_p in enumerate(self.f):
            select = columns[i].unsqueeze(-2) if m > 1 else columns[i]
            select = select.expand(*self.batch_shape, 1, -1)
            own = [self._centers[i], self._scale]
            if self._learns_center:
                spread = f_p.std(-2, keepdim=True)
                rounding = 8 * torch.finfo(f_p.dtype).eps * f_p.abs().amax(-2, keepdim=True)
                own += [spread * (spread > rounding), self._means[i]]
            basis = AppendedPhysics(first, select, *map(self._of_outputs, own))
            mean, unknown = self._means[i], self._learns_mean
            terms.append(self.term(names[i], each[i], basis, mean, unknown, Unit.NONE))
        self._rhos = terms
        emulated = self.input_transform.physics.is_emulated
        return [*terms, *self._errors(names)] if emulated else terms

    def _errors(self, rhos: Sequence[str]) -> list[Term]:
        """The terms of the errors of physics that are emulated, beside those that scale these."""
        transform: Any = self.input_transform
        physics = transform.physics
        parts = getattr(physics, "parts", [physics])
        d, unit = self.num_inputs, self._of_outputs(self._scale)
        columns = range(d, d + transform.num_of_error)
        return [
            Term(
                f"error{name.removeprefix('rho')}",
                part.error_kernel(physics.unknowns, columns, unit),
                columns.stop,
                None,
                torch.zeros_like(unit),
                scaled_by=name,
            )
            for name, part in zip(rhos, parts, strict=True)
            if part.is_emulated
        ]

    def delta(
        self,
        kernel: KernelLike | None = scaled_rbf,
        mean: float | Literal["learn"] = 0.0,
        name: str = "delta",
    ) -> Term:
        """The term of the bias.

        Args:
            kernel: As in :meth:`term`.
            mean: Its prior mean, a number in the user's units or ``"learn"``.
            name: Its name.
        """
        known = 0.0 if mean == "learn" else mean
        if not isinstance(known, int | float):
            raise ValueError(f"Expected delta_mean to be 'learn' or a number, got {known!r}.")
        self._offset, self._learns_offset = known, mean == "learn"
        # f = sum rho_i (f_i - c_i) + delta_0, so that delta_0 has the mean sum rho_i c_i.
        offset = sum(c * w for c, w in zip(self._centers, self._means, strict=True))
        mean_0 = (self._zero + known + offset - self._shift) / self._scale
        term = self.term(name, kernel, None, mean_0, mean == "learn", Unit.TARGET, "delta")
        centerd = self._learns_center or any(bool(each.any()) for each in self._centers)
        stays = all(isinstance(t.kernel, VanishingKernel) and not t.learns_mean for t in self._rhos)
        if isinstance(term.kernel, VanishingKernel) and centerd and not stays:
            raise ValueError(
                "Expected center=0.0 of a delta that vanishes somewhere beside a rho that does not "
                "stay at a known mean there, as delta is delta_0 - center * rho; or give the rho "
                "vanishing_rbf, too (rho_covar_module)."
            )
        return term

    @property
    def means(self) -> Sequence[Tensor]:
        """The prior mean of the rho of each physics, ``batch_shape x 1 x m`` or a number."""
        return self._means

    def prior_mean(self) -> Tensor:
        """The sum of all physics with these at the training inputs, ``batch_shape x n x m``."""
        return sum((w * v for w, v in zip(self._means, self.f, strict=True)), self._zero)

    def columns(self) -> Tensor:
        """The training inputs that kernels read, ``batch_shape x n x d``."""
        return transformed(self.data.X, self.input_transform)[..., : self.num_inputs]

    def noise(self) -> Likelihood | None:
        """The likelihood, after all terms are made; None for the model's own.

        Of names, what they say of training rows is entered in ``sources``.
        """
        likelihood: Any = self.likelihood
        if isinstance(likelihood, str | list | tuple):
            from gpadjust.models.named_noise import named_noise

            likelihood = named_noise(likelihood, self)
        elif callable(likelihood) and not isinstance(likelihood, Module | type):
            likelihood = likelihood(self)
        if likelihood is None:
            return None
        if not isinstance(likelihood, _GaussianLikelihoodBase):
            raise TypeError(f"Expected a Gaussian likelihood of GPyTorch, got {likelihood!r}.")
        learnt = Noise(likelihood).learnt
        if learnt is not None and learnt.shape[:-1] != self.batch_shape:
            raise ValueError(
                f"Expected a likelihood with batch_shape {tuple(self.batch_shape)}, one for each "
                f"output, got {tuple(learnt.shape[:-1])}."
            )
        return likelihood

    def offsets(self) -> list[Term]:
        """The terms of batches, one for each column: its name, and an offset for each level."""
        found = []
        for i in self.data.batches:
            columns = [j for j, group in enumerate(self.categories.groups) if group == i]
            kernel = scaled_offsets(columns, self.num_inputs, self.batch_shape)
            found.append(self.term(self.data.input_names[i], kernel))
        return found

    def warn_of_physics(self, stacklevel: int) -> None:
        """Warn if the physics is obviously off at the training inputs, after all terms are made.

        Of a physics with unknown or trainable parameters nothing is said: they are to be learnt.

        Args:
            stacklevel: Of the caller, as ``warnings.warn`` has it.
        """
        transform = self.input_transform
        if not (self.f and isinstance(transform, PhysicsInput)):
            return
        physics = transform.physics
        if physics.unknowns or any(p.requires_grad for p in physics.parameters()):
            return
        with torch.no_grad():
            f = sum((w * v for w, v in zip(self._means, self.f, strict=True)), self._zero)
            f, Y = f + self._offset, self.data.Y
            f, Y = (v if self.link is None else self.link.inverse(v) for v in (f, Y))
            f, Y = (physics.in_user_units(v) for v in (f, Y))
            data = self.data._replace(Y=Y)
            text = complaint(data, f, self._learns_mean, self._learns_offset)
        if text:
            warnings.warn(
                f"Physics {physics.name!r}: {text} Look at `physics(train_X) - train_Y`, and "
                "correct f_p rather than leave that to the fit: away from the data the model falls "
                "back to f_p as it is.",
                PhysicsWarning,
                stacklevel=stacklevel + 1,
            )

    def _of_outputs(self, values: Tensor) -> Tensor:
        """From ``batch_shape x 1 x m``, or what broadcasts to it, to ``... x (m) x 1``."""
        values = values + self._zero
        return values.mT if values.shape[-1] > 1 else values.squeeze(-1)


def transformed(X: Tensor, transform: InputTransform | None) -> Tensor:
    """The columns that terms read out of raw training inputs."""
    try:
        with torch.no_grad():
            return X if transform is None else transform(X)
    except BotorchTensorDimensionError as error:
        raise ValueError(
            f"The input transform does not fit inputs of shape {tuple(X.shape)}: {error}"
        ) from error


def _starting_means(mean: Means | None, Y: Tensor, f: list[Tensor]) -> list[Tensor]:
    """The prior mean of each rho to begin with, ``batch_shape x 1 x m`` or a number.

    Unknown weights of several physics, whose scales may be anything, are at least squares.
    """
    k = len(f)
    if mean is None or mean == "learn":
        if k < 2:
            return [Y.new_tensor(1.0)] * k
        basis, y = torch.stack(f, dim=-1).transpose(-2, -3), Y.mT  # ... x m x n x k, ... x m x n
        basis = basis * ~y.isnan().unsqueeze(-1)
        identity = torch.eye(y.shape[-1]).to(y).expand(*y.shape, -1)
        weights, _ = least_squares(identity, y.nan_to_num(nan=0.0), basis)
        return [weight.unsqueeze(-2) for weight in weights.unbind(-1)]
    means = [mean] * k if isinstance(mean, int | float) else [*mean]
    if len(means) != k or not all(isinstance(each, int | float) for each in means):
        raise ValueError(
            f"Expected rho_mean to be 'learn', a number, or {k} numbers, one for each physics, got "
            f"{mean!r}."
        )
    return [Y.new_tensor(float(each)) for each in means]


def _center(center: Center, f_p: Tensor) -> Tensor:
    """The constant c of the basis ``f_p - c``, as ``batch_shape x 1 x m``."""
    m, mean = f_p.shape[-1], f_p.mean(-2, keepdim=True)
    if isinstance(center, str) and center in ("mean", "learn"):
        return mean
    try:
        offset = torch.as_tensor(center, dtype=f_p.dtype, device=f_p.device)
    except (TypeError, ValueError, RuntimeError):
        offset = f_p.new_full((), torch.nan)
    if offset.dim() > 1 or offset.numel() not in (1, m) or not offset.isfinite().all():
        raise ValueError(
            "Expected center to be 'mean' (the mean of f_p at the training inputs), 'learn', a "
            f"finite number, or a tensor of {m}, one for each output, got {center!r}."
        )
    return offset.expand(mean.shape).clone()
