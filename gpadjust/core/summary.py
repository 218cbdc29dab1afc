"""Summary of a model, in words and in the user's units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gpadjust.core.noise import KnownNoise, Noise
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Values


@torch.no_grad()
def summary(model: Any) -> str:
    """Return the unknown numbers of a model, medians of its draws and ranges of 95 % of them."""
    values, X = model.table.values(model.draws), model.data.X
    reads_physics = type(model.noise) not in (Noise, KnownNoise)
    variance = model.noise.variance(values, model.places(X, values, reads_physics), True)
    lines = [_title(model), *_of_physics(model)]
    for j, name in enumerate(model.data.output_names):
        own = {key: v[:, j] if v.dim() == 3 else v for key, v in values.items()}
        lines += [f"{name}:", *_choices(model, values, j)]
        for term in model.terms:
            lines += _of_term(model, term, own, j)
        lines += _of_noise(model, variance[..., j, :].sqrt() * model.unit[j], j)
    return "\n".join(lines)


def _title(model: Any) -> str:
    """Return the class, the sizes of the data, and the number of draws."""
    n, d = model.data.X.shape[-2:]
    counts = {"point": n, "input": d, "output": model.num_outputs, "draw": len(model.draws)}
    parts = [f"{n} {noun}" + "s" * (n != 1) for noun, n in counts.items()]
    parts += [] if model.draws.any() else ["not fitted"]
    parts += [f"of {model.scale}"] if model.scale else []
    return f"{type(model).__name__}: {', '.join(parts)}"


def _of_physics(model: Any) -> list[str]:
    """Return the unknown parameters of the physics, and their priors."""
    unknowns = {name: unknown for each in model.physics for name, unknown in each.unknowns.items()}
    lines = ["parameters of the physics:"] if unknowns else []
    for name, draws in model.physics_parameters.items():
        unknown = unknowns[name]
        unit = f" {unknown.unit}" if unknown.unit else ""
        lines.append(f"  {name}: {_text(draws)}{unit} (prior {unknown.prior_text}{unit})")
    return lines


def _choices(model: Any, values: Values, j: int) -> list[str]:
    """Return the probabilities of nested models of an output, their shares of the draws."""
    choices = model.table.choices
    if not choices or len(model.draws) < 2:
        return []
    chosen = model.table.chosen(values)[:, j].tolist()
    shares = [f"{c.text} {chosen.count(k) / len(chosen):.0%}" for k, c in enumerate(choices)]
    return [f"  probabilities: {', '.join(shares)}"]


def _of_term(model: Any, term: Term, values: Values, j: int) -> list[str]:
    """Return the numbers of a term of an output, at the draws that contain them."""
    unit = float(model.unit[j]) if term.physics is None else 1.0  # a scaling has none
    everywhere = torch.ones(len(model.draws), 1)
    kept = values.get(f"{term.name}.process", everywhere).squeeze(-1) != 0
    head = f"  {term.name}: prior mean {term.mean:.4g}"
    if term.kernel is not None and not kept.all():
        head += f", varies in {int(kept.sum())} of {len(kept)} draws"
    lines, start = [head], f"{term.name}.kernel."
    for name in values if kept.any() else ():
        if name.startswith(start):
            names = getattr(term.kernel, "input_names", None)
            own = values[name][kept]
            lines += _of_kernel(model, name.removeprefix(start), own, unit, names)
    constant = values.get(f"{term.name}.constant", torch.zeros(1))
    if constant.any():
        lines.append(f"    standard deviation of the constant: {_sd(constant[constant > 0], unit)}")
    if f"{term.name}.center" in values:
        c = model.term_sum.center(term, model.table.values(model.draws))
        lines.append(f"    center: {_text(c[:, j] * model.unit[j])}")
    return lines


def _of_kernel(
    model: Any, name: str, numbers: Tensor, unit: float, names: Sequence[str] | None
) -> list[str]:
    """Return some numbers ``N x k`` of a kernel."""
    name = name.replace("raw_", "")
    if name.endswith("outputscale"):
        return [f"    {name.replace('outputscale', 'standard deviation')}: {_sd(numbers, unit)}"]
    columns = [""] if numbers.shape[-1] == 1 else [f" {i + 1}" for i in range(numbers.shape[-1])]
    after = ""
    if name.endswith("lengthscale"):
        if names is None:
            names, transform = model.data.input_names, model.data.transform
            if hasattr(transform, "column_names"):
                names = transform.column_names(names)
            elif transform is not None:
                after = " after the transform"
        if len(columns) == len(names):
            columns = [f" of {each}" for each in names]
    pairs = zip(columns, numbers.unbind(-1), strict=True)
    return [f"    {name}{column}{after}: {_text(each)}" for column, each in pairs]


def _of_noise(model: Any, sd: Tensor, j: int) -> list[str]:
    """Return standard deviations ``S x n`` of an output, how far they differ, and outliers."""
    lines, mask = [], model.noise.is_outlier
    if mask is not None and mask[:, j].any():
        rows = mask[:, j].nonzero().flatten().tolist()
        lines = [f"  outliers: rows {', '.join(map(str, rows))}"]
        sd = sd[..., ~mask[:, j]]
    mean = sd.square().mean(-1).sqrt()
    ends = sd.reshape(-1, sd.shape[-1]).median(0).values
    low, high = (f"{float(end):.3g}" for end in (ends.min(), ends.max()))
    text = f"  noise: standard deviation {_text(mean)}"
    text = text if low == high else f"{text}, from {low} to {high} at the training inputs"
    return [text, *lines]


def _sd(variances: Tensor, unit: float) -> str:
    return _text(variances.sqrt() * unit)


def _text(values: Tensor) -> str:
    """Return a number, or the median and the range of 95 % of several."""
    levels = torch.tensor([0.5, 0.025, 0.975]).to(values)
    middle, low, high = (f"{float(end):.3g}" for end in values.flatten().quantile(levels))
    return middle if low == high else f"{middle} ({low} to {high})"
