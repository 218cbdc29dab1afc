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
from torch import Tensor

from gpadjust.core import GP, Fourier, Stationary, Term
from gpadjust.core.gaussian import Conditioning
from gpadjust.dynamics import LearnedDynamics
from gpadjust.dynamics.learned_dynamics import AngleInput
from gpadjust.many import VariationalCKA

_PROFILES = ("rbf", "matern1/2", "matern3/2", "matern5/2")


class Column(NamedTuple):
    """An input of the kernels: a raw one, its sine or its cosine, less an offset, over a size."""

    source: int
    function: str = ""  # "sin", "cos", or nothing
    offset: float = 0.0
    size: float = 1.0


class TermTables(NamedTuple):
    r"""The numbers of a term :math:`b(x) g(x)` of each of ``G`` Gaussians, in the model's units.

    Its basis b is 1, or a column of f_p over a unit, less a center. Its features are :math:`b(x)
    \, b(x_i) (a\, k(x, x_i) + c)` at points :math:`x_i`; or, of waves, :math:`b(x) \sqrt{2 a / D}`
    times cosines and sines, and :math:`b(x) \sqrt c`.

    Args:
        name: As of :meth:`~gpadjust.CKA.term`.
        column: Which column of f_p is the basis of each output, ``m``; None for 1.
        unit: That of f_p, ``G``.
        center: ``G``.
        mean: The prior mean of g, ``G``.
        kind: ``"rbf"``, ``"matern1/2"``, ``"matern3/2"``, ``"matern5/2"``, ``"waves"``, or
            ``"constant"`` without a kernel; empty of a term without features.
        amplitude: a, ``G``.
        constant: c, the prior variance of an unknown constant, ``G``.
        rate: One over the lengthscales, ``G x d``.
        at_points: The basis at the points, ``G x P``; of waves ``G x 0``.
        frequencies: Of waves, ``D/2 x d``; else None.
        has_constant: Whether there is an unknown constant.
    """

    name: str
    column: Tensor | None
    unit: Tensor
    center: Tensor
    mean: Tensor
    kind: str
    amplitude: Tensor
    constant: Tensor
    rate: Tensor
    at_points: Tensor
    frequencies: Tensor | None
    has_constant: bool


class FiniteSum(NamedTuple):
    r"""A fitted model of ``m`` outputs: of each a mixture of ``S`` Gaussians, those of its draws.

    There are ``G = S m`` Gaussians, those of all outputs for each draw in turn. With the features
    :math:`\varphi(x)` of all terms, the mean of one is that of the prior, plus :math:`\varphi^T w`.
    With :math:`u = L^{-1} \varphi`, or :math:`u = R \varphi` of a model of inducing points, its
    variance is that of the prior, less :math:`|u|^2`; of waves it is :math:`|u|^2` itself.

    Args:
        columns: The ``d`` inputs of the kernels.
        num_physics: Number of columns of f_p.
        terms: The terms.
        scale: The unit of the targets, ``G``.
        noise: The variance of the noise in the model's units, ``G``.
        points: Points of the kernels, ``1 x P x d``, or those of each output, ``m x P x d``.
        weights: w, ``G x P``.
        lower: L, or R, lower triangles ``G x P x P``, or None.
        is_solved: Whether it is L.
        is_remainder: Whether the variance is that of the prior, less :math:`|u|^2`.
    """

    columns: list[Column]
    num_physics: int
    terms: list[TermTables]
    scale: Tensor
    noise: Tensor
    points: Tensor
    weights: Tensor
    lower: Tensor | None
    is_solved: bool
    is_remainder: bool

    @property
    def least(self) -> float:
        """The share of the prior variance below which there are rounding errors alone."""
        return 4 * self.weights.shape[-1] * torch.finfo(torch.float64).eps


def model_of(fitted: Any) -> GP:
    """Return a model, or that of dynamics; a TypeError if it is neither."""
    model = fitted.model if isinstance(fitted, LearnedDynamics) else fitted
    if not isinstance(model, GP):
        raise TypeError(
            "Expected a CKA, RRA, PhysicsMeanGP, ScaleGP or ZeroMeanGP, or LearnedDynamics of one, "
            f"a physics of formulas, or what identify returns; found {type(model).__name__}."
        )
    return model


@torch.no_grad()
def finite_sum(model: GP, variance: bool, observation_noise: bool) -> FiniteSum:
    """Return a fitted model as a finite sum; a ValueError, with the way out, if it is none."""
    if model.batch_shape:
        raise ValueError("Cannot export fantasies, a batch of models: export each of them.")
    conditioning, X = model.conditioning(), model.data.X[:2]
    shape, values = conditioning.alpha.shape[:-1], conditioning.train.values
    places = model.places(X, values)
    noise = model.noise.variance(values, places)
    why = _why_not(model, places.f, noise, observation_noise)
    if why:
        raise ValueError(f"Cannot export a model of {why}.")
    varying = [term for term in model.terms if term.varies]
    is_remainder = any(type(term.kernel) is not Fourier for term in varying)
    terms = [_tables(term, model, conditioning, is_remainder) for term in model.terms]
    lower, weights = conditioning.chol, conditioning.alpha
    is_solved = not isinstance(model, VariationalCKA)
    if not is_solved:  # |F k|^2 = |R k|^2, F = Q R
        lower = torch.linalg.qr(conditioning.inverse_factor().flip(-1)).R.flip((-2, -1))
    if not is_remainder:
        lower, weights = _of_waves(conditioning)
    size = weights.shape[-1]
    return FiniteSum(
        columns=_columns(model.data.transform, len(model.data.input_names)),
        num_physics=len(model.physics) * model.num_outputs,
        terms=terms,
        scale=model.unit.squeeze(-1).expand(shape).reshape(-1),
        noise=noise.squeeze(-1).expand(shape).reshape(-1) * observation_noise,
        points=conditioning.train.x[0],
        weights=weights.reshape(-1, size),
        lower=lower.reshape(-1, size, size) if variance else None,
        is_solved=is_solved,
        is_remainder=is_remainder,
    )


def _why_not(model: GP, f: Any, noise: Tensor, observation_noise: bool) -> str:
    """Return why a model is no finite sum, with the way out; nothing if it is one."""
    own = type(model)
    if own.on_gaussian_scale is not GP.on_gaussian_scale:
        return "outputs with a link: build it of the link of the data, and invert that in your code"
    if (
        own.components not in (GP.components, VariationalCKA.components)
        or own.marginals_of is not GP.marginals_of
    ):
        return f"predictions of its own, a {own.__name__}: take CKA"
    if any(each.shape[-3] > 1 for each in f):
        return "draws that have an f_p each: fit(model, 'map')"
    if not any(term.varies for term in model.terms):
        return "known terms alone, which is its physics: take model.physics_parameters to yours"
    if observation_noise and noise.shape[-1] > 1:
        return (
            f"noise that depends on x, a {type(model.noise).__name__}: leave observation_noise "
            "out, and add the variance that you know"
        )
    return ""


def _tables(term: Term, model: GP, conditioning: Conditioning, is_remainder: bool) -> TermTables:
    """Return the numbers of a term."""
    values, (S, m, n) = conditioning.train.values, conditioning.alpha.shape
    one = torch.ones(S, m, 1, dtype=torch.float64)
    d = conditioning.train.x.shape[-1]

    def each(number: Any) -> Tensor:
        """Return a number of each Gaussian, ``G``."""
        return (one * number).reshape(-1)

    kind, amplitude, rate, frequencies = "", 0.0 * one, one.expand(-1, -1, d), None
    if term.kernel is not None:
        kernel: Any = term.kernel
        own = conditioning.train.own(term)
        if type(kernel) is Stationary and kernel.profile.name in _PROFILES:
            kind = kernel.profile.name
        elif type(kernel) is Fourier and not is_remainder:
            kind, frequencies = "waves", kernel.frequencies.mT
        else:
            raise ValueError(
                f"Cannot export the kernel of {term.name!r}, {kernel!r}: expected RBF or Matern, "
                "as Stationary(MATERN52), or a model with Fourier kernels alone, as RRA."
            )
        amplitude = own["outputscale"] * values.get(f"{term.name}.process", 1.0)
        rate = 1 / own["lengthscale"] * one
    elif term.constant is not None:
        kind = "constant"
    if term.name not in conditioning.train.weights:
        kind = ""  # what inducing points cannot show
    is_basis = term.physics is not None
    weight = conditioning.train.weights.get(term.name)
    at_points = (one if weight is None else weight).expand(S, m, n) * conditioning.observed
    if not is_remainder:
        at_points = at_points[..., :0]
    columns = torch.arange(m) + m * (term.physics or 0) if is_basis else None
    return TermTables(
        name=term.name,
        column=columns,
        unit=each(model.unit if is_basis else 1.0),
        center=each(model.term_sum.center(term, values) if term.has_center else 0.0),
        mean=each(model.term_sum.mean_of(term, values)),
        kind=kind,
        amplitude=each(amplitude),
        constant=each(0.0 if term.constant is None else values[f"{term.name}.constant"]),
        rate=rate.reshape(-1, d),
        at_points=at_points.reshape(S * m, -1),
        frequencies=frequencies,
        has_constant=term.constant is not None,
    )


def _of_waves(conditioning: Conditioning) -> tuple[Tensor, Tensor]:
    r"""Return the posterior of the weights of waves: L, ``S x m x P x P``, and means ``S x m x P``.

    They are N(0, I) a priori, so that with the noise N and the waves :math:`\Phi` at the data

    .. math:: L L^T = I + \Phi^T N^{-1} \Phi, \quad w = \Phi^T \alpha.
    """
    f, columns = conditioning.train, list[Tensor]()
    for term in f.terms:
        if term.kernel is None:
            continue
        kernel: Any = term.kernel
        own, weight = f.own(term), f.weights[term.name]
        angle = (f.x / own["lengthscale"].unsqueeze(-2)) @ kernel.frequencies
        process = own["outputscale"] * f.values.get(f"{term.name}.process", 1.0)
        size = (process / angle.shape[-1]).sqrt().unsqueeze(-1)
        waves = [size * angle.cos(), size * angle.sin()]
        if term.constant is not None:
            constant = f.values[f"{term.name}.constant"].sqrt().unsqueeze(-1)
            waves.append(constant.expand(*angle.shape[:-1], 1))
        phi = torch.cat(waves, -1)
        columns.append(phi * weight.unsqueeze(-1))
    phi = torch.cat(columns, -1)
    # What the factor has beside the terms is noise, with its nugget.
    noise = conditioning.chol.square().sum(-1) - f.variance()
    white = phi * (conditioning.observed / noise.maximum(conditioning.noise).sqrt()).unsqueeze(-1)
    eye = torch.eye(phi.shape[-1]).to(phi)
    lower: Tensor = torch.linalg.cholesky(eye + white.mT @ white)
    return lower, (phi.mT @ conditioning.alpha.unsqueeze(-1)).squeeze(-1)


def _columns(transform: Any, num_inputs: int) -> list[Column]:
    """Return the inputs of the kernels, by the transform of raw ones."""
    columns = [Column(i) for i in range(num_inputs)]
    is_chain = isinstance(transform, ChainedInputTransform)
    for part in transform.values() if is_chain else [transform] * (transform is not None):
        is_plain = [column[1:] == Column(0)[1:] for column in columns]
        if isinstance(part, AngleInput) and all(is_plain[i] for i in part.columns):
            columns = [
                column._replace(function=function)
                for i, column in enumerate(columns)
                for function in (("sin", "cos") if i in part.columns else (column.function,))
            ]
        elif type(part) in (AffineInputTransform, Normalize, InputStandardize):
            offset, size = torch.zeros(len(columns)).double(), torch.ones(len(columns)).double()
            scaled = getattr(part, "indices", slice(None))
            offset[scaled], size[scaled] = part.offset.flatten(), part.coefficient.flatten()
            pairs = zip(columns, offset.tolist(), size.tolist(), strict=True)
            columns = [
                c._replace(offset=c.offset + c.size * o, size=c.size * s) for c, o, s in pairs
            ]
        else:
            raise ValueError(
                f"Cannot export the input transform {type(part).__name__}: expected Normalize, "
                "InputStandardize or angles, or transform the data before you build the model."
            )
    return columns
