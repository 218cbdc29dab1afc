"""A fitted model as a finite sum: the numbers of programs in other languages."""

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
    """

    name: str
    column: Tensor | None  # of f_p, the basis of each output, m; None for 1
    unit: Tensor  # of the basis, G
    center: Tensor  # of the basis, G
    mean: Tensor  # of g by the prior, G
    kind: str  # a name of _PROFILES, "waves", "constant", or nothing without features
    amplitude: Tensor  # a, G
    constant: Tensor  # c, the prior variance of an unknown constant, G
    rate: Tensor  # one over the lengthscales, G x d
    at_points: Tensor  # b(x_i), G x P; of waves G x 0
    frequencies: Tensor | None  # of waves, D/2 x d
    has_constant: bool


class FiniteSum(NamedTuple):
    r"""A fitted model of ``m`` outputs, each a mixture of ``S`` Gaussians, one of each draw.

    There are ``G = S m`` Gaussians, those of all outputs for each draw in turn. With the features
    :math:`\varphi(x)` of all terms, the mean of one is that of the prior, plus :math:`\varphi^T w`.
    With :math:`u = L^{-1} \varphi`, or :math:`u = R \varphi` of a model of inducing points, its
    variance is that of the prior, less :math:`|u|^2`; of waves it is :math:`|u|^2` itself.
    """

    columns: list[Column]  # the d inputs of the kernels
    num_physics: int  # columns of f_p
    terms: list[TermTables]
    scale: Tensor  # the unit of the targets, G
    noise: Tensor  # its variance in the model's units, G
    points: Tensor  # of the kernels, 1 x P x d, or m x P x d of each output
    weights: Tensor  # w, G x P
    lower: Tensor | None  # L or R, lower triangles G x P x P; None without variance
    is_solved: bool  # lower is L
    is_remainder: bool  # the variance is that of the prior, less |u|^2

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
    """Return a fitted model as a finite sum, or raise a ValueError with the way out."""
    if model.batch_shape:
        raise ValueError("Cannot export fantasies, a batch of models: export each of them.")
    conditioning = model.conditioning()
    X = model.data.X[:2]  # enough to see whether the noise depends on x
    shape, values = conditioning.alpha.shape[:-1], conditioning.train.values  # S x m
    places = model.places(X, values)
    noise = model.noise.variance(values, places)
    obstacle = _obstacle(model, places.f, noise, observation_noise)
    if obstacle:
        raise ValueError(f"Cannot export a model of {obstacle}.")
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
    if not observation_noise:
        noise = torch.zeros_like(noise)
    return FiniteSum(
        columns=_columns(model.data.transform, len(model.data.input_names)),
        num_physics=len(model.physics) * model.num_outputs,
        terms=terms,
        scale=model.unit.squeeze(-1).expand(shape).reshape(-1),
        noise=noise.squeeze(-1).expand(shape).reshape(-1),
        points=conditioning.train.x[0],
        weights=weights.reshape(-1, size),
        lower=lower.reshape(-1, size, size) if variance else None,
        is_solved=is_solved,
        is_remainder=is_remainder,
    )


def _obstacle(model: GP, f: Any, noise: Tensor, observation_noise: bool) -> str:
    """Return why a model is not a finite sum, with the way out; nothing if it is one."""
    kind = type(model)
    if kind.on_gaussian_scale is not GP.on_gaussian_scale:
        return "outputs with a link: build it of the link of the data, and invert that in your code"
    has_components = kind.components in (GP.components, VariationalCKA.components)
    if not has_components or kind.marginals_of is not GP.marginals_of:
        return f"predictions of its own, a {kind.__name__}: take CKA"
    if any(values.shape[-3] > 1 for values in f):
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
    train = conditioning.train
    S, m, n = conditioning.alpha.shape
    d = train.x.shape[-1]
    one = torch.ones(S, m, 1, dtype=torch.float64)

    def repeat(number: Any) -> Tensor:
        """Return a number of each Gaussian, ``G``."""
        return (one * number).reshape(-1)

    kind = ""  # no features
    amplitude: Tensor = 0.0 * one
    rate, frequencies = one.expand(-1, -1, d), None
    if term.kernel is not None:
        kernel: Any = term.kernel
        numbers = train.own(term)
        if type(kernel) is Stationary and kernel.profile.name in _PROFILES:
            kind = kernel.profile.name
        elif type(kernel) is Fourier and not is_remainder:
            kind = "waves"
            frequencies = kernel.frequencies.mT
        else:
            raise ValueError(
                f"Cannot export the kernel of {term.name!r}, {kernel!r}: expected RBF or Matern, "
                "as Stationary(MATERN52), or a model with Fourier kernels alone, as RRA."
            )
        amplitude = numbers["outputscale"] * train.values.get(f"{term.name}.process", 1.0)
        rate = 1 / numbers["lengthscale"] * one
    elif term.constant is not None:
        kind = "constant"
    weight = train.weights.get(term.name)
    if weight is None:  # inducing points do not show the term
        kind = ""
        weight = one
    at_points = weight.expand(S, m, n) * conditioning.observed  # 0 where an output is missing
    if not is_remainder:
        at_points = at_points[..., :0]
    column: Tensor | None = None
    unit: Any = 1.0
    center: Any = 0.0
    constant: Any = 0.0
    if term.physics is not None:
        column = torch.arange(m) + m * term.physics  # of all physics side by side
        unit = model.unit
    if term.has_center:
        center = model.term_sum.center(term, train.values)
    if term.constant is not None:
        constant = train.values[f"{term.name}.constant"]
    return TermTables(
        name=term.name,
        column=column,
        unit=repeat(unit),
        center=repeat(center),
        mean=repeat(model.term_sum.mean_of(term, train.values)),
        kind=kind,
        amplitude=repeat(amplitude),
        constant=repeat(constant),
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
    f = conditioning.train
    columns = list[Tensor]()
    for term in f.terms:
        if term.kernel is None:
            continue
        kernel: Any = term.kernel
        numbers = f.own(term)
        # sqrt(2 a / D) cos(w^T x / l), and sines
        angle = (f.x / numbers["lengthscale"].unsqueeze(-2)) @ kernel.frequencies
        process = numbers["outputscale"] * f.values.get(f"{term.name}.process", 1.0)
        size = (process / angle.shape[-1]).sqrt().unsqueeze(-1)
        waves = [size * angle.cos(), size * angle.sin()]
        if term.constant is not None:
            constant = f.values[f"{term.name}.constant"].sqrt().unsqueeze(-1)
            waves.append(constant.expand(*angle.shape[:-1], 1))
        columns.append(torch.cat(waves, -1) * f.weights[term.name].unsqueeze(-1))
    phi = torch.cat(columns, -1)
    # The rest of the factor is noise, with its nugget.
    noise = conditioning.chol.square().sum(-1) - f.variance()
    white = phi * (conditioning.observed / noise.maximum(conditioning.noise).sqrt()).unsqueeze(-1)
    eye = torch.eye(phi.shape[-1]).to(phi)
    lower: Tensor = torch.linalg.cholesky(eye + white.mT @ white)
    return lower, (phi.mT @ conditioning.alpha.unsqueeze(-1)).squeeze(-1)


def _columns(transform: Any, num_inputs: int) -> list[Column]:
    """Return the inputs of the kernels, by the transform of raw ones."""
    columns = [Column(i) for i in range(num_inputs)]
    parts = [transform]
    if transform is None:
        parts = []
    elif isinstance(transform, ChainedInputTransform):
        parts = [*transform.values()]
    for part in parts:
        is_plain = [column[1:] == Column(0)[1:] for column in columns]
        if isinstance(part, AngleInput) and all(is_plain[i] for i in part.columns):
            replaced = list[Column]()
            for i, column in enumerate(columns):
                functions = ("sin", "cos") if i in part.columns else (column.function,)
                replaced += [column._replace(function=function) for function in functions]
            columns = replaced
        elif type(part) in (AffineInputTransform, Normalize, InputStandardize):
            offset = torch.zeros(len(columns), dtype=torch.float64)
            size = torch.ones_like(offset)
            scaled = getattr(part, "indices", slice(None))
            offset[scaled], size[scaled] = part.offset.flatten(), part.coefficient.flatten()
            pairs = zip(columns, offset.tolist(), size.tolist(), strict=True)
            # ((x - a) / b - o) / s = (x - (a + b o)) / (b s)
            columns = [
                c._replace(offset=c.offset + c.size * o, size=c.size * s) for c, o, s in pairs
            ]
        else:
            raise ValueError(
                f"Cannot export the input transform {type(part).__name__}: expected Normalize, "
                "InputStandardize or angles, or transform the data before you build the model."
            )
    return columns
