"""What a model has learnt, in words and in the user's units."""

from __future__ import annotations

from typing import Any

import torch
from botorch.models.transforms.input import Normalize
from torch import Tensor

from gpadjust.gp import AppendedPhysics, PhysicsInput, Term
from gpadjust.gp.gaussian import negative_log_likelihood, noise_variances
from gpadjust.models.hyperparameters import KINDS, is_rho, kind_of, typical_sizes

_ROUNDING = 1e-12  # of a term's unit
_NEAR = 1.01  # times a bound is at the bound
_NEAR_BOUND = 0.1  # of the range of draws of a parameter is at its bound
_MANY = 0.25  # share of the draws, with which the parameter is


def title(model: Any) -> str:
    """One line: the structure, and of what data it is."""
    transform = getattr(model, "input_transform", None)
    of = f" of {transform.physics.name!r}" if isinstance(transform, PhysicsInput) else ""
    counts = [model.train_targets.shape[-1], len(model.input_names), model.num_outputs]
    counts += [] if model.num_samples is None else [model.num_samples]
    nouns = zip(counts, ("point", "input", "output", "sample"), strict=False)
    parts = [f"{n} {noun}" + ("" if n == 1 else "s") for n, noun in nouns]
    return f"{type(model).__name__}{of}: {', '.join(parts)}"


@torch.no_grad()
def summary(model: Any) -> str:
    """The text of :meth:`~gpadjust.CKA.summary`."""
    model.eval()
    lines = [title(model)]
    if model.has_unknowns:
        lines += ["parameters of the physics:", *_of_physics(model)]
    for i, name in enumerate(model.output_names):
        lines += [f"{name}:", *_lines(model.subset_output([i]))]
    return "\n".join(lines)


def log_likelihood(model: Any) -> Tensor:
    """The log marginal likelihood of the observations, in the user's units, ``... x (m)``."""
    strategy, scale = model.strategy(), model._units()[1].squeeze(-1)
    residual = model.train_targets - strategy.train_prior_dist.mean
    value = negative_log_likelihood(residual, strategy.noisy_covariance(model.covar_module)).value
    return -value - (~residual.isnan()).sum(-1) * scale.log()


def _lines(model: Any) -> list[str]:
    """What there is to say of one output."""
    scale, sizes = model._units()[1].squeeze(-1), typical_sizes(model)
    evidence, value = model._evidence()
    lines = [f"  {evidence}" + ("" if value is None else f" {_text(value)}")]
    for i, term in enumerate(model.terms):
        variance = term.variance()
        if variance is not None and (variance < _ROUNDING**2).all():
            lines.append(f"  {term.name}: none")
            continue
        unit = torch.ones_like(scale) if is_rho(term.basis) else scale
        mean = model.term_mean(term.name) if hasattr(model, "term_mean") else 0.0
        mean = mean if abs(mean) > _ROUNDING * float(unit.flatten()[0]) else 0.0
        lines.append(f"  {term.name}: {'learnt ' * term.learns_mean}mean {mean:.4g}")
        if isinstance(term.basis, AppendedPhysics) and term.basis.learns_center:
            lines.append(f"    centre {_text(term.basis.origin)}")
        lines += _of_term(model, term, f"covar_module.terms.{i}.kernel", unit, sizes)
    name = "likelihood.noise_covar.raw_noise"
    noise = noise_variances(model.likelihood, model.train_inputs[0]).mean(-1)
    sd = _text(noise.sqrt() * scale)
    return [*lines, f"  noise: sd {sd}{_at_bound(noise, 'noise', sizes.get(name))}"]


def _of_physics(model: Any) -> list[str]:
    """A line for each unknown parameter of the physics."""
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


def _of_term(
    model: Any, term: Term, path: str, unit: Tensor, sizes: dict[str, Tensor]
) -> list[str]:
    """A line for each hyper-parameter of a term's kernel."""
    lines: list[str] = []
    kernel: Any = term.kernel
    for name, _ in [] if kernel is None else kernel.named_parameters():
        module, _, leaf = name.rpartition(".")
        kind, size = kind_of(leaf), sizes.get(f"{path}.{name}")
        value: Tensor = getattr(kernel.get_submodule(module), kind)
        if kind == "outputscale":
            lines.append(f"    sd {_text(value.sqrt() * unit)}{_at_bound(value, kind, size)}")
        elif kind == "lengthscale":
            for j, (column, length) in enumerate(_columns(model, value.shape[-1])):
                part = value[..., j]
                at = _at_bound(part, kind, None if size is None else size[..., j])
                lines.append(f"    lengthscale of {column}: {_text(part * length)}{at}")
        else:
            lines.append(f"    {kind} {_text(value)}")
    return lines


def _columns(model: Any, number: int) -> list[tuple[str, float]]:
    """The names of a kernel's inputs, and what a length of one is in the user's units."""
    base: Any = getattr(model, "input_transform", None)
    base = getattr(base, "base", base)
    if number == len(model.input_names):
        if isinstance(base, Normalize):
            lengths = base.coefficient.flatten()[-number:].tolist()
            return list(zip(model.input_names, lengths, strict=True))
        if base is None:
            return [(name, 1.0) for name in model.input_names]
    if hasattr(base, "column_names"):
        names = base.column_names(model.input_names)
        if len(names) == number:
            return [(name, 1.0) for name in names]
    return [(f"transformed input {i + 1}", 1.0) for i in range(number)]


def _at_bound(value: Tensor, kind: str, size: Tensor | None) -> str:
    """A remark on a value at the bounds of a search."""
    if size is None:
        return ""
    low, high = (bound * size.flatten()[0] for bound in KINDS[kind].bounds)
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
