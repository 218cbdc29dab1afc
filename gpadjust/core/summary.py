"""Summary of a model, in words and in the user's units."""

from __future__ import annotations

from textwrap import indent
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.core.kernels import STANDARD_DEVIATION as _SD
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Values
from gpadjust.display import html_table

_MEANINGS = {
    "lengthscale": "distance over which {} changes",
    _SD: "size of the changes of {}",
}


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
    if model.physics_parameters:
        table += model.physics_parameters._repr_html_()
    return table


@torch.no_grad()
def _lines(model: Any) -> list[str]:
    """Return the kind and size of the model, and the numbers of each output."""
    values, X = model.table.values(model.draws), model.data.X
    f = None if model.noise.has_shares else ()
    variance = model.noise.variance(values, model.places(X, values, f), True)
    parts = [counted(model)]
    if not model.is_fitted:
        parts.append("not fitted")
    if model.scale_formula:
        parts.append(f"of {model.scale_formula}")
    lines = [f"{type(model).__name__}: {', '.join(parts)}"]
    for j, name in enumerate(model.data.output_names):
        lines.append(f"{name}:")
        if model.table.choices and len(model.draws) > 1:
            shares = model.table.chosen(values)[:, j].bincount(minlength=len(model.table.choices))
            shares = shares.double() / len(model.draws)
            pairs = zip(model.table.choices, shares.tolist(), strict=True)
            lines.append(f"  probabilities: {', '.join(f'{c.text} {p:.0%}' for c, p in pairs)}")
        for term in model.terms:
            lines += _of_term(model, term, values, j)
        lines += _of_noise(model, variance[..., j, :].sqrt() * model.unit[j], j)
    return lines


def counted(model: Any) -> str:
    """Return the sizes of a model, such as "8 points, 1 input, 1 output, 16 draws"."""
    n, d = model.data.X.shape[-2:]
    counts = {"point": n, "input": d, "output": model.num_outputs, "draw": len(model.draws)}
    nouns = [noun if count == 1 else f"{noun}s" for noun, count in counts.items()]
    return ", ".join(f"{count} {noun}" for noun, count in zip(nouns, counts.values(), strict=True))


def _of_term(model: Any, term: Term, values: Values, j: int) -> list[str]:
    """Return the numbers of a term of an output, at the draws that contain them."""
    numbers = numbers_of_term(model, term, values, j)
    process = values.get(f"{term.name}.process", torch.ones(len(model.draws), j + 1, 1))
    varies = process[:, j, 0] != 0
    head = f"  {term.name}: prior mean {term.mean:.4g}"
    if term.kernel is not None and not varies.all():
        head += f", varies in {int(varies.sum())} of {len(varies)} draws"
    lines = [head]
    for number in numbers:
        draws = number.draws
        if number.is_of_kernel:
            draws = draws[varies]
        elif number.name.endswith("constant"):
            draws = draws[draws > 0]
        if len(draws):
            lines.append(f"    {number.name}: {_text(draws)}")
    return lines


class Number(NamedTuple):
    """An unknown number in the user's units."""

    name: str
    draws: Tensor  # N
    meaning: str
    is_of_kernel: bool = False


def numbers_of_term(model: Any, term: Term, values: Values, j: int) -> list[Number]:
    """Return the numbers of a term of an output, at values ``N x m x k``."""
    unit = float(model.unit[j]) if term.physics is None else 1.0  # a scaling has no unit
    numbers = []
    kernel: Any = term.kernel
    start = f"{term.name}.kernel."
    for key in (key for key in values if key.startswith(start)):
        name = key.removeprefix(start).replace("raw_", "")
        name, draws = kernel.in_user_units(name, values[key][:, j], unit)
        meaning = _MEANINGS.get(name, f"a number of the kernel of {term.name}").format(term.name)
        labels = _labels(model, term, name, draws.shape[-1])
        for label, column in zip(labels, draws.unbind(-1), strict=True):
            numbers.append(Number(name + label, column, meaning, True))
    constant, z = (values.get(f"{term.name}.{part}") for part in ("constant", "center"))
    if constant is not None:
        size = constant[:, j, 0].sqrt() * unit
        meaning = f"size of the constant in {term.name}"
        numbers.append(Number(f"{_SD} of the constant", size, meaning))
    if z is not None:
        center = (model.term_sum.center(term, values) * model.unit)[:, j, 0]
        numbers.append(Number("center", center, "value of f_p where its scaling changes nothing"))
    return numbers


def numbers_of(model: Any, u: Tensor) -> dict[tuple[str, str], Number]:
    """Return all numbers at coordinates ``N x B x P``, by output ("" if shared) and name.

    Those of a term that a nested model lacks are its prior's.
    """
    values = model.table.values(u)
    numbers = {}
    parameters = model.physics_parameters_at(u)
    for i, (name, unknown) in enumerate(parameters.unknowns.items()):
        meaning = "a parameter of the physics"
        if unknown.unit:
            meaning += f", in {unknown.unit}"
        numbers["", name] = Number(name, parameters.draws[:, i], meaning)
    noise = model.noise.variance(values, model.places(model.data.X, values), True)
    for j, output in enumerate(model.data.output_names):
        for term in model.terms:
            for number in numbers_of_term(model, term, values, j):
                name = f"{term.name} {number.name}"
                numbers[output, name] = number._replace(name=name)
        if model.noise.names:
            sd = noise[..., j, :].mean(-1).sqrt() * float(model.unit[j])
            meaning = "noise of an observation, in the mean"
            numbers[output, f"noise {_SD}"] = Number(f"noise {_SD}", sd, meaning)
    return numbers


def _labels(model: Any, term: Term, name: str, number: int) -> list[str]:
    """Return labels of a kernel's numbers: the inputs, if it has a lengthscale of each."""
    labels = [""] if number == 1 else [f" {i + 1}" for i in range(number)]
    if not name.endswith("lengthscale"):
        return labels
    names, transform, after = getattr(term.kernel, "input_names", None), model.data.transform, ""
    if names is None:
        names = model.data.input_names
        if hasattr(transform, "column_names"):
            names = transform.column_names(names)
        elif transform is not None:
            after = " after the transform"
    if number == len(names):
        labels = [f" of {name}" for name in names]
    return [f"{label}{after}" for label in labels]


def _of_noise(model: Any, sd: Tensor, j: int) -> list[str]:
    """Return standard deviations ``S x n`` of an output, how far they differ, and outliers."""
    lines = []
    mask = model.noise.is_outlier
    if mask is not None and mask[:, j].any():
        rows = mask[:, j].nonzero().flatten().tolist()
        lines = [f"  outliers: rows {', '.join(map(str, rows))}"]
        sd = sd[..., ~mask[:, j]]
    ends = sd.reshape(-1, sd.shape[-1]).median(0).values
    low, high = (f"{float(end):.3g}" for end in (ends.min(), ends.max()))
    text = f"  noise: {_SD} {_text(sd.square().mean(-1).sqrt())}"
    if low != high:
        text += f", from {low} to {high} at the training inputs"
    return [text, *lines]


def _text(values: Tensor) -> str:
    """Return a number, or the median and the range of 95 % of several."""
    levels = torch.tensor([0.5, 0.025, 0.975]).to(values)
    middle, low, high = (f"{float(end):.3g}" for end in values.flatten().quantile(levels))
    return middle if low == high else f"{middle} ({low} to {high})"
