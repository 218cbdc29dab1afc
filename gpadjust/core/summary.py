"""Summary of a model, in words and in the user's units."""

from __future__ import annotations

from textwrap import indent
from typing import Any

import torch
from torch import Tensor

from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Values
from gpadjust.display import html_table

_SD = "standard deviation"


def summary(model: Any) -> str:
    """Return the unknown numbers of a model, medians of its draws and ranges of 95 % of them."""
    first, *lines = _lines(model)
    if model.physics_parameters:
        table = indent(repr(model.physics_parameters), "  ")
        lines = ["parameters of the physics:", table, *lines]
    return "\n".join([first, *lines])


def summary_html(model: Any) -> str:
    """Return the same as tables of HTML."""
    first, *lines = _lines(model)
    table = html_table(first, (), [line.partition(": ")[::2] for line in lines])
    parameters = model.physics_parameters
    return table + parameters._repr_html_() if parameters else table


@torch.no_grad()
def _lines(model: Any) -> list[str]:
    """Return what the model is, and the numbers of each output."""
    values, X = model.table.values(model.draws), model.data.X
    variance = model.noise.variance(values, model.places(X, values, model.noise.has_shares), True)
    n, d = X.shape[-2:]
    counts = {"point": n, "input": d, "output": model.num_outputs, "draw": len(model.draws)}
    parts = [counted(counts)]
    parts += [] if model.is_fitted else ["not fitted"]
    parts += [f"of {model.scale_formula}"] if model.scale_formula else []
    lines = [f"{type(model).__name__}: {', '.join(parts)}"]
    for j, name in enumerate(model.data.output_names):
        own = {key: v[:, j] if v.dim() == 3 else v for key, v in values.items()}
        lines.append(f"{name}:")
        if model.table.choices and len(model.draws) > 1:
            shares = model.table.chosen(values)[:, j].bincount(minlength=len(model.table.choices))
            shares = shares.double() / len(model.draws)
            pairs = zip(model.table.choices, shares.tolist(), strict=True)
            lines.append(f"  probabilities: {', '.join(f'{c.text} {p:.0%}' for c, p in pairs)}")
        for term in model.terms:
            lines += _of_term(model, term, own, j)
        lines += _of_noise(model, variance[..., j, :].sqrt() * model.unit[j], j)
    return lines


def counted(counts: dict[str, int]) -> str:
    """Return numbers of things by their nouns, such as "8 points, 1 input"."""
    return ", ".join(f"{n} {noun}" + "s" * (n != 1) for noun, n in counts.items())


def _of_term(model: Any, term: Term, values: Values, j: int) -> list[str]:
    """Return the numbers of a term of an output, ``N x k``, at the draws that contain them."""
    unit = float(model.unit[j]) if term.physics is None else 1.0  # a scaling has none
    everywhere = torch.ones(len(model.draws), 1)
    kept = values.get(f"{term.name}.process", everywhere).squeeze(-1) != 0
    head = f"  {term.name}: prior mean {term.mean:.4g}"
    if term.kernel is not None and not kept.all():
        head += f", varies in {int(kept.sum())} of {len(kept)} draws"
    lines, start = [head], f"{term.name}.kernel."
    for key in values if kept.any() else ():
        if key.startswith(start):
            numbers, name = values[key][kept], key.removeprefix(start).replace("raw_", "")
            if name.endswith("outputscale"):
                numbers, name = numbers.sqrt() * unit, name.replace("outputscale", _SD)
            labels = _labels(model, term, name, numbers.shape[-1])
            pairs = zip(labels, numbers.unbind(-1), strict=True)
            lines += [f"    {name}{label}: {_text(each)}" for label, each in pairs]
    constant = values.get(f"{term.name}.constant", torch.zeros(1))
    if constant.any():
        lines.append(f"    {_SD} of the constant: {_text(constant[constant > 0].sqrt() * unit)}")
    if f"{term.name}.center" in values:
        c = model.term_sum.center(term, model.table.values(model.draws))
        lines.append(f"    center: {_text(c[:, j] * model.unit[j])}")
    return lines


def _labels(model: Any, term: Term, name: str, number: int) -> list[str]:
    """Return labels of a kernel's numbers: the inputs, if it has a lengthscale of each."""
    labels = [""] if number == 1 else [f" {i + 1}" for i in range(number)]
    if not name.endswith("lengthscale"):
        return labels
    names, transform = getattr(term.kernel, "input_names", None), model.data.transform
    after = "" if transform is None or names is not None else " after the transform"
    if names is None:
        names = model.data.input_names
        if hasattr(transform, "column_names"):
            names, after = transform.column_names(names), ""
    labels = [f" of {each}" for each in names] if number == len(names) else labels
    return [label + after for label in labels]


def _of_noise(model: Any, sd: Tensor, j: int) -> list[str]:
    """Return standard deviations ``S x n`` of an output, how far they differ, and outliers."""
    lines, mask = [], model.noise.is_outlier
    if mask is not None and mask[:, j].any():
        rows = mask[:, j].nonzero().flatten().tolist()
        lines = [f"  outliers: rows {', '.join(map(str, rows))}"]
        sd = sd[..., ~mask[:, j]]
    ends = sd.reshape(-1, sd.shape[-1]).median(0).values
    low, high = (f"{float(end):.3g}" for end in (ends.min(), ends.max()))
    text = f"  noise: {_SD} {_text(sd.square().mean(-1).sqrt())}"
    text = text if low == high else f"{text}, from {low} to {high} at the training inputs"
    return [text, *lines]


def _text(values: Tensor) -> str:
    """Return a number, or the median and the range of 95 % of several."""
    levels = torch.tensor([0.5, 0.025, 0.975]).to(values)
    middle, low, high = (f"{float(end):.3g}" for end in values.flatten().quantile(levels))
    return middle if low == high else f"{middle} ({low} to {high})"
