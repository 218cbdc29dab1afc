"""Summary of a fitted model, in words and in the user's units."""

from __future__ import annotations

from typing import Any

import torch
from botorch.models.transforms.input import Normalize
from botorch.models.transforms.outcome import nanstd
from torch import Tensor

from gpadjust.gp import AppendedPhysics, PhysicsInput
from gpadjust.gp.categories import OffsetKernel
from gpadjust.gp.term import Unit
from gpadjust.models.hyperparameter_samples import adjusts, take_samples, uses_physics
from gpadjust.models.parameters import Hyperparameter, hyperparameters

_ROUNDING = 1e-12  # of a term's unit
_NEAR = 1.01  # times a bound is at the bound
_NEAR_BOUND = 0.1  # of the range of draws of a parameter is at its bound
_MANY = 0.25  # share of the draws, with which the parameter is


def title(model: Any) -> str:
    """Return one line: the structure, its data, and whether it was fitted."""
    transform = getattr(model, "input_transform", None)
    of = f" of {transform.physics.name!r}" if isinstance(transform, PhysicsInput) else ""
    counts = [model.train_targets.shape[-1], len(model.input_names), model.num_outputs]
    counts += [] if model.num_samples is None else [model.num_samples]
    nouns = zip(counts, ("point", "input", "output", "sample"), strict=False)
    parts = [f"{n} {noun}" + ("" if n == 1 else "s") for n, noun in nouns]
    parts += [] if getattr(model, "is_fitted", True) else ["not fitted"]
    return f"{type(model).__name__}{of}: {', '.join(parts)}"


@torch.no_grad()
def summary(model: Any) -> str:
    """The text of :meth:`~gpadjust.CKA.summary`."""
    model.eval()
    lines = [title(model)]
    if model.link is not None:
        lines.append(f"link: terms and noise are those of {model.link.formula}")
    if model.has_unknowns:
        lines += ["parameters of the physics:", *_of_physics(model)]
    for i, name in enumerate(model.output_names):
        own = model.subset_output([i])
        lines.append(f"{name}:")
        if own.num_samples is not None:
            has_physics, has_functions = uses_physics(own).flatten(), adjusts(own).flatten()
            for kept, what in ((has_physics, "left out"), (has_functions, "left as it is")):
                if not kept.all():
                    out = f"{int((~kept).sum())} of {len(kept)} samples"
                    lines.append(f"  the physics is {what} in {out}")
            kept = has_physics & has_functions
            if kept.any() and not kept.all():
                lines.append("  of the others:")
                own = take_samples(own, kept.nonzero().flatten(), as_mixture=True)
        lines += _lines(own)
    return "\n".join(lines)


def _lines(model: Any) -> list[str]:
    scale, rows = model.units()[1].squeeze(-1), hyperparameters(model)
    evidence, value = model.log_evidence()
    lines = [*_alone(model), f"  {evidence}" + ("" if value is None else f" {_text(value)}")]
    for term in model.terms:
        if term.scaled_by is not None:
            error = term.covariance(model.train_inputs[0], None, True).mean(-1).sqrt() * scale
            lines.append(f"  {term.name} of the emulated physics: sd {_text(error)}")
            continue
        variance = None if term.form is None else term.form.variance()
        is_left_out = isinstance(term.basis, AppendedPhysics) and not term.mean.any()
        is_left_out = is_left_out and bool(term.given_mean.any())
        if is_left_out or (variance is not None and (variance < _ROUNDING**2).all()):
            lines.append(f"  {term.name}: none")
            continue
        unit = torch.ones_like(scale) if term.unit is Unit.NONE else scale
        mean = model.term_mean(term.name)
        mean = mean if abs(mean) > _ROUNDING * float(unit.flatten()[0]) else 0.0
        lines.append(f"  {term.name}: {'learnt ' * term.learns_mean}mean {mean:.4g}")
        if isinstance(term.basis, AppendedPhysics) and term.basis.learns_center:
            lines.append(f"    center {_text(term.basis.origin)}")
        own = set() if term.kernel is None else {*map(id, term.kernel.parameters())}
        lines += _of_kernel(model, [row for row in rows if id(row.raw) in own], unit)
    noise = model.noise.at(model.train_inputs[0]).mean(-1)
    at = [_at_bound(noise, row.limits()) for row in rows if row.kind == "noise"]
    if hasattr(model.likelihood, "said"):
        constant, relative = model.likelihood.said(scale)
        of = "f_p" if model.likelihood.weights.shape[-1] else "the mean"
        lines.append(f"  noise: sd {_text(constant)}, and {_text(100 * relative)} % of {of}")
    else:
        lines.append(f"  noise: sd {_text(noise.sqrt() * scale)}{''.join(at)}")
    if model.has_heavy_tails:
        which = _outliers(model)
        numbers = ", ".join(map(str, which.nonzero().flatten().tolist()))
        lines.append(f"  outliers: {f'rows {numbers}, counted from 0' if numbers else 'none'}")
    return lines


def _outliers(model: Any) -> Tensor:
    """Return which observations of one output are likelier outliers than not, ``n``."""
    return (model.outliers().squeeze(-1) > 0.5).reshape(-1, model.train_targets.shape[-1])[0]


def _alone(model: Any) -> list[str]:
    """Return a line on the error of each physics alone, at the observations of one output."""
    inputs, y, link = model.train_inputs[0], model.outputs_first(model.user_targets()), model.link
    named = [term for term in model.terms if isinstance(term.basis, AppendedPhysics)]
    fitted = ", with these parameters" if model.has_unknowns else ""
    judged = y.masked_fill(_outliers(model), torch.nan) if model.has_heavy_tails else y
    lines = []
    for term in named:
        f_p = (inputs[..., term.basis.num_inputs :] * term.basis.select).sum(-1)
        f_p = f_p if model.num_samples is None else f_p.mean(0)
        f_p = f_p if link is None else link.inverse(f_p)
        rmse = (judged - f_p).square().nanmean().sqrt()
        spread = float(nanstd(y.reshape(-1, y.shape[-1]), dim=-1).mean())
        of = f" of {term.name.removeprefix('rho_')}" if len(named) > 1 else ""
        lines.append(
            f"  physics alone{of}{fitted}: RMSE {rmse:.3g} (sd of the targets {spread:.3g})"
        )
    return lines


def _of_physics(model: Any) -> list[str]:
    lines = []
    for name, unknown in model.physics_parameters.unknowns.items():
        draws = model.physics_parameters[name]
        reach = _NEAR_BOUND * (draws.amax() - draws.amin())
        shares = [float(((draws - end).abs() < reach).double().mean()) for end in unknown.bounds]
        near = [end for end, share in zip(unknown.bounds, shares, strict=True) if share > _MANY]
        at = f", at the bound {near[0]:.4g}" if near else ""
        unit = f" {unknown.unit}" if unknown.unit else ""
        lines.append(f"  {name}: {_text(draws)}{unit}{at}")
    return lines


def _of_kernel(model: Any, rows: list[Hyperparameter], unit: Tensor) -> list[str]:
    lines: list[str] = []
    for row in rows:
        value = row.parameter(row.raw)
        limits = row.limits() if row.is_log else []
        if row.kind in ("outputscale", "scaling"):
            lines.append(f"    sd {_text(value.sqrt() * unit)}{_at_bound(value, limits)}")
        elif isinstance(row.owner, OffsetKernel):
            continue
        elif row.kind == "lengthscale":
            for j, (column, length) in enumerate(_columns(model, value.shape[-1], row.owner)):
                at = _at_bound(value[..., j], [limit[..., j] for limit in limits])
                lines.append(f"    lengthscale{column}: {_text(value[..., j] * length)}{at}")
        else:
            lines.append(f"    {row.leaf.removeprefix('raw_')} {_text(value)}")
    return lines


def _columns(model: Any, number: int, kernel: Any) -> list[tuple[str, float]]:
    """Return the names of a kernel's inputs, and a length of one in the user's units."""
    if getattr(kernel, "names", ()):
        return [(f" of {name}", 1.0) for name in kernel.names]
    base: Any = getattr(model, "input_transform", None)
    base, names = getattr(base, "base", base), model.input_names
    lengths = [1.0] * len(names)
    if isinstance(base, Normalize):
        lengths = base.coefficient.flatten()[-len(names) :].tolist()
    elif hasattr(base, "column_names"):
        names = base.column_names(names)
        lengths = [1.0] * len(names)
    elif base is not None:
        names = [f"transformed input {i + 1}" for i in range(number)]
    read = [*range(len(names))] if kernel.active_dims is None else kernel.active_dims.tolist()
    if number != len(read) or max(read) >= len(names):  # of all that it reads, or of a part of them
        return [("" if number == 1 else f" {i + 1}", 1.0) for i in range(number)]
    return [(f" of {names[i]}", lengths[i]) for i in read]


def _at_bound(value: Tensor, limits: list[Tensor]) -> str:
    """A remark on a value at the ends of a search, which are given by their logarithms."""
    if not limits:
        return ""
    low, high = (limit.flatten()[0].exp() for limit in limits)
    middle = value.flatten().median()
    if middle <= _NEAR * low:
        return " (at its lower bound)"
    return " (at its upper bound)" if middle >= high / _NEAR else ""


def _text(values: Tensor) -> str:
    """A number, or the median of samples with the range of 95 % of them."""
    if values.numel() == 1:
        return f"{float(values):.4g}"
    levels = torch.tensor([0.025, 0.5, 0.975]).to(values)
    low, middle, high = torch.quantile(values.flatten(), levels)
    return f"{middle:.4g} ({low:.3g} to {high:.3g})"
