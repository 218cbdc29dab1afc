"""A fitted model as a finite sum: plain numbers, which programs of other languages are made of."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from botorch.models.transforms.input import (
    AffineInputTransform,
    ChainedInputTransform,
    InputStandardize,
    Normalize,
)
from gpytorch.kernels import RBFKernel, RFFKernel
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.gp import AppendedPhysics, PhysicsInput, Term
from gpadjust.gp.kernels import stationary_parts
from gpadjust.models import RRA, TermsModel, VariationalCKA
from gpadjust.models.sparse_conditioning import inducing_root


class Column(NamedTuple):
    """An input of the kernels: a raw one, its sine or its cosine, less an offset, over a size."""

    source: int
    function: str = ""  # "sin", "cos", or nothing
    offset: float = 0.0
    size: float = 1.0


class TermTables(NamedTuple):
    r"""The numbers of a term :math:`b(x) g(x)` of each of ``G`` Gaussians, in the model's units.

    Its basis b is 1, or a column of f_p less an origin, over a unit. Its features are :math:`b(x)
    \, b(x_i) (a\, k(x, x_i) + c)` at points :math:`x_i`; or, of waves, :math:`b(x) \sqrt{2 a / D}`
    times cosines and sines, and :math:`b(x) \sqrt c` if there is c.

    Args:
        name: As of :meth:`~gpadjust.CKA.term`.
        column: Which column of f_p is the basis of each output, ``m``; None for 1.
        origin: That of the basis, ``G``.
        unit: Likewise.
        mean: The prior mean of g, ``G``.
        kind: ``"rbf"``, ``"matern0.5"``, ``"matern1.5"``, ``"matern2.5"``, ``"waves"``, or
            ``"constant"`` without a kernel; empty of a term without features.
        amplitude: a, ``G``.
        constant: c, the prior variance of an unknown mean, ``G``.
        rate: One over the lengthscales, ``G x d``.
        at_points: The basis at the points, ``G x P``; none of waves.
        frequencies: Of waves, ``D/2 x d``; else None.
    """

    name: str
    column: Tensor | None
    origin: Tensor
    unit: Tensor
    mean: Tensor
    kind: str
    amplitude: Tensor
    constant: Tensor
    rate: Tensor
    at_points: Tensor
    frequencies: Tensor | None


class ErrorTables(NamedTuple):
    """The numbers of a model's ``LocalErrors``, which variances are multiplied by."""

    points: Tensor  # n x d
    squares: Tensor  # m x n
    rate: Tensor  # one over the lengthscales, m x d
    factor: Tensor  # by recent errors, m


class FiniteSum(NamedTuple):
    r"""A fitted model of ``m`` outputs: of each a Gaussian, or a mixture of ``S`` of them.

    There are ``G = S m`` Gaussians, those of all outputs for each sample in turn. With the features
    :math:`\varphi(x)` of all terms, the mean of one is that of the prior, plus :math:`\varphi^T w`.
    With :math:`u = L^{-1} \varphi` its variance is that of the prior, less :math:`|u|^2`, plus
    :math:`|R^T u|^2`. Without L, u is :math:`\varphi`, and the last part is all.

    Args:
        columns: The ``d`` inputs of the kernels.
        num_physics: Number of columns of f_p.
        terms: The terms.
        start: What the prior mean has beside those of the terms, ``G``.
        shift: From the model's units to those of the targets, ``G``.
        scale: Likewise.
        noise: The variance of the noise in the model's units, ``G``.
        points: Points of the kernels, ``1 x P x d``, or those of each output, ``m x P x d``.
        weights: w, ``G x P``.
        lower: L, ``G x P x P``, or None.
        root: R, an upper triangle, ``G x P x P``, or None.
        errors: Larger errors, if there are any.
    """

    columns: list[Column]
    num_physics: int
    terms: list[TermTables]
    start: Tensor
    shift: Tensor
    scale: Tensor
    noise: Tensor
    points: Tensor
    weights: Tensor
    lower: Tensor | None
    root: Tensor | None
    errors: ErrorTables | None

    @property
    def least(self) -> float:
        """The share of the prior variance below which there are rounding errors alone."""
        return 4 * self.weights.shape[-1] * torch.finfo(torch.float64).eps


def model_of(fitted: Any) -> TermsModel:
    """A model, or that of dynamics; a TypeError if it is neither."""
    model = fitted.model if isinstance(fitted, LearnedDynamics) else fitted
    if not isinstance(model, TermsModel):
        raise TypeError(
            "Expected a CKA, RRA, VariationalCKA, PhysicsMeanGP, ScaleGP or ZeroMeanGP, or "
            f"LearnedDynamics of one, got {type(model).__name__}."
        )
    return model


@torch.no_grad()
def finite_sum(model: TermsModel, variance: bool, observation_noise: bool) -> FiniteSum:
    """Return a fitted model as a finite sum; a ValueError, with the way out, if it is none."""
    check_finite_sum(model, observation_noise)
    model.eval()
    lead = [] if model.num_samples is None else [model.num_samples]
    lead += [model.num_outputs] * (model.num_outputs > 1)

    def each(values: Tensor, *tail: int) -> Tensor:
        """The values of each Gaussian, ``G x tail``."""
        return values.expand(*lead, *tail).reshape(-1, *tail)

    conditioning: Any = model.conditioning()
    d, lower, root, basis = model.terms[0].num_inputs, None, None, {}
    if isinstance(model, RRA):
        weights, root = conditioning.weights()
        points = weights.new_zeros(1, 0, d)
    else:
        weights, is_sparse = conditioning.mean_cache, isinstance(model, VariationalCKA)
        at = model.covar_module.at(model.inducing_points) if is_sparse else conditioning.train
        points = at.x[..., :d].reshape(-1, *at.x[..., :d].shape[-2:])
        points = points if is_sparse and (points != points[0]).any() else points[:1]
        basis = {term.name: weight for term, weight in at.parts}
        if is_sparse:
            lower = inducing_root(at.covariance())
            root = torch.linalg.qr(model.inducing_root.flip(-2).mT).R.mT.flip((-2, -1))
        elif variance:
            base, rows, _ = conditioning.factors()
            base = base.expand(*rows.shape[:-2], *base.shape[-2:])
            lower = torch.cat([torch.nn.functional.pad(base, (0, rows.shape[-2])), rows], dim=-2)
    size = weights.shape[-1]
    lower, root = (
        None if triangle is None or not variance else each(triangle, size, size)
        for triangle in (lower, root)
    )
    transform: Any = getattr(model, "input_transform", None)
    has_physics = isinstance(transform, PhysicsInput)
    terms = [_tables(term, each, size, model.num_outputs, basis) for term in model.terms]
    shift, scale = model.units()
    moved = [getattr(term.basis, "moved_mean", 0.0) for term in model.terms]
    start = torch.zeros_like(scale) + sum(moved)
    noise = torch.zeros_like(scale)
    if observation_noise:
        noise = model.observation_noise(model.train_inputs[0][..., :1, :])
    start, shift, scale, noise = (each(t, 1).squeeze(-1) for t in (start, shift, scale, noise))
    return FiniteSum(
        columns=_columns(transform.base if has_physics else transform, len(model.input_names)),
        num_physics=transform.physics.num_outputs if has_physics else 0,
        terms=terms,
        start=start,
        shift=shift,
        scale=scale,
        noise=noise,
        points=points,
        weights=each(weights, size),
        lower=lower,
        root=root,
        errors=_errors(model) if variance else None,
    )


def check_finite_sum(model: TermsModel, observation_noise: bool) -> None:
    """Raise an error for a model that is no finite sum of these kinds."""
    noise, why = model.noise, ""
    if model.link is not None:
        why = "outputs with a link: build it of the link of the data, and invert that in your code"
    elif model.train_targets.dim() > 1 + (model.num_outputs > 1) + (model.num_samples is not None):
        why = "several data sets: build and export a model of each"
    elif model.has_unknowns and model.num_samples is not None:
        why = "samples of a physics' parameters, each with its own f_p: fit(model, method='map')"
    elif not model.term_names:
        why = "known terms alone, which is its physics: take model.physics_parameters to yours"
    elif any(term.scaled_by for term in model.terms):
        why = "an emulated physics, which has errors: give FunctionPhysics(physics), without them"
    elif not all(isinstance(term.basis, AppendedPhysics | None) for term in model.terms):
        why = f"a {type(model).__name__}, whose inputs have levels: take CKA"
    elif observation_noise and type(model.likelihood) is not GaussianLikelihood:
        why = (
            f"noise of a {type(noise.likelihood).__name__}, which is not the same everywhere: "
            "leave observation_noise out, and add the variance that you know"
        )
    if why:
        raise ValueError(f"Cannot export a model of {why}.")


def _tables(
    term: Term, each: Any, size: int, num_outputs: int, basis: dict[str, Tensor | None]
) -> TermTables:
    """The numbers of a term, whose basis at the points is given by its name; of waves, none is."""
    zero, d = torch.zeros_like(term.mean), term.num_inputs
    kind, amplitude, lengthscale, frequencies = "", zero, zero.unsqueeze(-1) + 1.0, None
    if term.kernel is not None:
        kernel: Any = term.kernel
        if not basis and isinstance(getattr(kernel, "base_kernel", None), RFFKernel):
            kind, base, outer = "waves", kernel.base_kernel, kernel
            frequencies = base.randn_weights.reshape(-1, *base.randn_weights.shape[-2:])[0].mT
        elif (found := stationary_parts(kernel, d)) is not None:
            base, outer, _ = found
            kind = "rbf" if isinstance(base, RBFKernel) else f"matern{base.nu}"
        else:
            raise ValueError(
                f"Cannot export the kernel of {term.name!r}, a {type(kernel).__name__}: take one "
                "that is RBF or Matern, of all inputs."
            )
        amplitude = zero + (1.0 if outer is None else outer.outputscale.unsqueeze(-1))
        lengthscale = base.lengthscale
    elif term.learns_mean:
        kind = "constant"
    if kind != "waves" and term.name not in basis:
        kind = ""  # the points know nothing of it
    scaled: Any = term.basis
    at_points = basis.get(term.name)
    columns = None
    if scaled is not None:
        columns = each(scaled.select.squeeze(-2), scaled.select.shape[-1]).argmax(-1)[:num_outputs]
    pair = (zero, zero + 1.0) if scaled is None else (scaled.origin, scaled.scale)
    numbers = (*pair, term.mean, amplitude, term.mean_variance if term.learns_mean else zero)
    origin, unit, mean, amplitude, constant = (each(value, 1).squeeze(-1) for value in numbers)
    return TermTables(
        term.name,
        columns,
        origin,
        unit,
        mean,
        kind,
        amplitude,
        constant,
        1 / each(lengthscale, 1, d).squeeze(-2),
        each(zero.new_ones(size) if at_points is None else at_points, size),
        frequencies,
    )


def _columns(transform: Any, num_inputs: int) -> list[Column]:
    """The inputs of the kernels, by the transform of raw ones."""
    found = [Column(i) for i in range(num_inputs)]
    chained = isinstance(transform, ChainedInputTransform)
    for part in transform.values() if chained else [transform] * (transform is not None):
        plain = [column[1:] == Column(0)[1:] for column in found]
        if isinstance(part, AngleInput) and all(plain[i] for i in part.columns):
            found = [
                column._replace(function=function)
                for i, column in enumerate(found)
                for function in (("sin", "cos") if i in part.columns else (column.function,))
            ]
        elif type(part) in (AffineInputTransform, Normalize, InputStandardize):
            offset, size = torch.zeros(len(found)).double(), torch.ones(len(found)).double()
            scaled = getattr(part, "indices", slice(None))
            offset[scaled], size[scaled] = part.offset.flatten(), part.coefficient.flatten()
            pairs = zip(found, offset.tolist(), size.tolist(), strict=True)
            found = [c._replace(offset=c.offset + c.size * o, size=c.size * s) for c, o, s in pairs]
        else:
            raise ValueError(
                f"Cannot export the input transform {type(part).__name__}: expected Normalize, "
                "InputStandardize or angles, or transform the data before you build the model."
            )
    return found


def _errors(model: TermsModel) -> ErrorTables | None:
    """The numbers of larger errors, if there are any."""
    errors = model.larger_errors
    if errors is None:
        return None
    m, (n, d) = model.num_outputs, errors.points.shape
    anywhere = errors.lengthscale
    return ErrorTables(
        errors.points,
        errors.squares.reshape(m, n),
        1 / errors.lengthscale.reshape(m, d),
        (errors(anywhere) / errors(anywhere, recent=False)).reshape(m),
    )
