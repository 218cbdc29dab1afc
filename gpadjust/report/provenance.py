"""What data and settings the page rests on, and how to go on with the model."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from torch import Tensor

import gpadjust
from gpadjust.report.markup import Markup, bullets, code, join, table, tag
from gpadjust.report.numbers import listed, name_and_unit, number, plural, with_unit
from gpadjust.report.subject import Subject
from gpadjust.report.verdict import COMPARE

_LIBRARIES = ("torch", "gpytorch", "botorch", "numpy")


@dataclass(frozen=True)
class Origin:
    """Where what is reported on comes from, as far as the model does not know.

    Attributes:
        settings: Names and values of settings.
        remarks: Sentences on the data.
        notes: Sentences on the fit, such as warnings.
        physics: Python expressions of the physics by their names, for whoever loads the model; one
            of the name ``""`` if there is one physics. None: as far as the model's file knows.
        modules: The modules that these expressions need.
        how: Code or a command that compares the model with others.
    """

    settings: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    physics: Mapping[str, str] | None = None
    modules: tuple[str, ...] = ()
    how: str = COMPARE


def data(subject: Subject, origin: Origin) -> Markup:
    """An overview of the columns, and what is missing or repeated."""
    rows = []
    kinds = (("input", subject.inputs, subject.X), ("output", subject.outputs, subject.Y))
    for kind, names, values in kinds:
        for name, column in zip(names, values.unbind(-1), strict=True):
            seen = column[~column.isnan()]
            short, unit = name_and_unit(name)
            ends = [seen.min(), seen.median(), seen.max()]
            numbers = [number(float(end), 4) for end in ends]
            rows.append([short, kind, unit or "-", *numbers, str(len(column) - len(seen))])
    head = ["column", "is", "unit", "least", "median", "most", "missing"]
    remarks = [f"{plural(len(subject.X), 'row')} of data.", *_repeats(subject), *origin.remarks]
    return join([table("Columns", head, rows), bullets(remarks)])


def _repeats(subject: Subject) -> list[str]:
    """How many rows have the inputs of another, and how far their outputs differ."""
    _, index = subject.X.unique(dim=0, return_inverse=True)
    counts = index.bincount()
    repeated = int(counts[counts > 1].sum())
    if not repeated:
        return ["No two rows have the same inputs."]
    told = []
    for name, y in zip(subject.outputs, subject.Y.unbind(-1), strict=True):
        sd = _pooled_sd(y, index)
        told += [] if sd is None else [f"{with_unit(number(sd), name)} ({name_and_unit(name)[0]})"]
    differ = (
        f", and their outputs differ by a standard deviation of {', '.join(told)}" if told else ""
    )
    return [f"{plural(repeated, 'row')} share their inputs with another{differ}."]


def _pooled_sd(y: Tensor, index: Tensor) -> float | None:
    """The standard deviation within groups of the same inputs."""
    squares, freedom = 0.0, 0
    for group in index.unique():
        own = y[(index == group) & ~y.isnan()]
        if len(own) > 1:
            squares += float((own - own.mean()).square().sum())
            freedom += len(own) - 1
    return (squares / freedom) ** 0.5 if freedom else None


def settings(subject: Subject, origin: Origin) -> Markup:
    """The settings, versions, and the date."""
    physics = ", ".join(
        f"{name} ({type(each).__name__}{', learns' * bool([*each.parameters()])})"
        for name, each in subject.physics.items()
    )
    rows = [[name, value] for name, value in origin.settings.items()]
    physics = physics or ("known through samples" if subject.is_sampled else "none")
    rows += [["model", repr(subject.model)], ["physics", physics]]
    versions = [f"{name} {version(name)}" for name in _LIBRARIES]
    own = f"gpadjust {gpadjust.__version__}"
    rows.append(["versions", ", ".join([own, f"Python {platform.python_version()}", *versions])])
    rows.append(["date", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")])
    return table("How this page came about", ["setting", "value"], rows, kind="words")


def loading(subject: Subject, file: str, content: Mapping[str, Any], origin: Origin) -> Markup:
    """Code that loads the model beside the page, and predicts.

    Args:
        subject: What the page is of.
        file: The name of the model's file.
        content: What the file holds.
        origin: Where the physics comes from.
    """
    own = [content] if "models" not in content else [*content["models"].values()]
    missing = sorted({name for each in own for name in each["missing"]})
    paths = sorted({p for each in own for p in (each["physics"] or {}).values() if p is not None})
    words = [f"The model is in {file}, beside this page; run this in its folder."]
    imports, arguments = ["import torch"], []
    if origin.physics is not None:
        imports += [f"import {module}" for module in origin.modules]
        boxes = any("BlackBoxPhysics(" in each for each in origin.physics.values())
        imports.append(f"from gpadjust import {'BlackBoxPhysics, ' * boxes}load")
        where = f"module{'s' * (len(origin.modules) > 1)} {listed(origin.modules)}"
        words.append(f"Python has to find the {where}: there, or in a folder on PYTHONPATH.")
        arguments.append(f"physics={_expression(origin.physics)}")
        missing = [name for name in missing if name != "physics"]
    else:
        imports.append("from gpadjust import load")
        if "physics" in missing:
            words.append(
                "The file could not hold the physics, which has no name in a module: give what the "
                "model was built with as f_p."
            )
        elif paths:
            words.append(
                f"The physics is found by its name, {', '.join(paths)}: Python has to find it."
            )
    arguments += [f"{name}={'f_p' if name == 'physics' else name}" for name in missing]
    call = ", ".join([repr(file), *arguments])
    point = ", ".join(f"{x:.6g}" for x in subject.base.tolist())
    lines = [
        *imports,
        "",
        f"model = load({call})",
        f"# a row for each point: {', '.join(map(repr, subject.inputs))}",
        f"X = torch.tensor([[{point}]], dtype=torch.float64)",
        "",
        f"mean, variance = model.predict(X)  # of {', '.join(map(repr, subject.outputs))}",
        "lower, upper = model.interval(X, level=0.95)  # where the function is",
        "lower, upper = model.interval(X, level=0.95, observation_noise=True)  # a measurement",
    ]
    return join([tag("p", " ".join(words)), code("\n".join(lines))])


def _expression(physics: Mapping[str, str]) -> str:
    if [*physics] == [""]:
        return physics[""]
    pairs = ", ".join(f"{name!r}: {each}" for name, each in physics.items())
    return f"{{{pairs}}}"
