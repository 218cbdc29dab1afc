"""The command ``gpadjust report``."""

from __future__ import annotations

import math
import shlex
import warnings
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gpadjust.core import CKA, GP, Noise, fit
from gpadjust.files.table_columns import LARGEST
from gpadjust.kinds.categories import Categories
from gpadjust.kinds.factory import with_options
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.physics import PhysicsWarning
from gpadjust.report.given_physics import (
    GivenPhysics,
    columns_of,
    given_physics,
    is_path,
    unknowns_of,
)
from gpadjust.report.inputs import (
    Columns,
    TableData,
    mark_of,
    names_of,
    noise_variances,
    notes_of,
    open_table,
    pairs,
    read_table,
    say,
)
from gpadjust.report.markup import listed, name_and_unit, plural
from gpadjust.report.page import checked_path, write
from gpadjust.report.sections import Origin, headline
from gpadjust.report.subject import subject_of
from gpadjust.validation import Comparison, compare
from gpadjust.validation.plausibility import complaint


def run(arguments: Namespace, command: Sequence[str]) -> None:
    """Read a file, compare, and write the page; nothing is written if anything fails.

    Args:
        arguments: A command line as parsed by :func:`gpadjust.__main__.parser`.
        command: The command line, for the page.

    Raises:
        OSError: If a file cannot be read or written.
        ValueError: If an option, the data or the physics are wrong.
        PhysicsError: If the physics fails where the models evaluate it.
    """
    path = checked_path(arguments.out, arguments.data)
    outputs = names_of(arguments.outputs, "--outputs")
    units = {} if arguments.units is None else pairs(arguments.units, "--units")
    variances = noise_variances(arguments.noise, outputs)
    unknowns = unknowns_of(arguments.unknown)
    marks = (mark_of(arguments.delimiter), arguments.decimal, arguments.sheet)
    table = open_table(arguments.data, *marks)
    asked = ((arguments.categories, "--categories"), (arguments.batches, "--batches"))
    categories, batches = (names_of(names, o) if names else [] for names, o in asked)
    named = [*categories, *batches]
    inputs = _inputs(arguments, table.names, outputs, [*unknowns], named)
    data = read_table(table, inputs, outputs, units, named, arguments.rows, arguments.seed)
    options = _options(arguments, inputs, data)
    physics = given_physics(arguments.physics, data, unknowns)
    names = (listed(data.Y.columns), listed(data.X.columns))
    say(f"{arguments.data}: {plural(len(data.lines), 'row')}, {names[0]} from {names[1]}.")
    for remark in data.remarks:
        say(remark)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        model = _fitted(arguments, data, physics, variances, options)
        subject = subject_of(model, [f"line {line}" for line in data.lines])
    notes = notes_of(caught)
    for note in notes:
        say(f"Warning: {note}")
    settings = {
        "command": f"gpadjust {shlex.join(command)}",
        "data file": f"{Path(arguments.data).name} (SHA-256 {data.digest}...)",
        "seed": str(arguments.seed),
    }
    how = _comparing(command)
    origin = Origin(settings, data.remarks, notes, physics.code, physics.modules, how)
    write(subject, path, arguments.title, origin, progress=True)
    given = Path(arguments.out)
    written = [
        str(given.with_suffix(s)) for s in (given.suffix, ".pt") if path.with_suffix(s).exists()
    ]
    print(f"{headline(subject, how)}\nWrote {listed(written)}.")


def _comparing(command: Sequence[str]) -> str:
    """Return the command that compares structures: the same without ``--fit``."""
    kept: list[str] = []
    words = iter(command)
    for word in words:
        option, equals, _ = word.partition("=")
        if option.startswith("--f") and "--fit".startswith(option):
            if not equals:
                next(words, None)
            continue
        kept.append(word)
    return f"gpadjust {shlex.join(kept)}"


def _fitted(
    arguments: Namespace,
    data: TableData,
    physics: GivenPhysics,
    variances: list[float] | None,
    options: dict[str, Any],
) -> Comparison | GP:
    X, Y, f_p = data.X, data.Y, physics.physics
    if isinstance(noise := options.get("noise"), NoisyInputs):
        X = Columns(X.columns, noise.points)
    if arguments.fit == "compare":
        return compare(X, Y, f_p, variances, seed=arguments.seed, progress=True, **options)
    say(f"Fitting CKA by {arguments.fit!r} ...")
    model: GP = with_options(CKA, options)(X, Y, variances, physics=f_p)
    for part in model.physics:
        if text := complaint(part, model.data):
            warnings.warn(text, PhysicsWarning, stacklevel=1)
    fit(model, arguments.fit, seed=arguments.seed)
    return model


def _inputs(
    arguments: Namespace,
    names: Sequence[str],
    outputs: Sequence[str],
    unknowns: Sequence[str],
    groups: Sequence[str],
) -> list[str]:
    """Return the names of the inputs: by the option, or of formulas and groups."""
    if arguments.inputs is not None:
        return names_of(arguments.inputs, "--inputs")
    if paths := [text for text in arguments.physics if is_path(text)]:
        raise ValueError(
            f"Expected --inputs, the columns that {paths[0]} reads, in its order; only formulas "
            "name their own."
        )
    others = [
        name for name in names if name not in outputs and name_and_unit(name)[0] not in outputs
    ]
    found = columns_of(arguments.physics, others, unknowns)
    bare = {name_and_unit(name)[0] for name in found}
    return found + [name for name in groups if name not in found and name not in bare]


def _options(arguments: Namespace, inputs: Sequence[str], data: TableData) -> dict[str, Any]:
    """Return the options of a model that a command line has.

    Args:
        arguments: A command line as parsed by :func:`gpadjust.__main__.parser`.
        inputs: The names of the inputs as in the file, in the order of the columns.
        data: The data.

    Raises:
        ValueError: If one is not a number, or names what is not an input.
    """
    found: dict[str, Any] = {}
    noise: Noise | None = RelativeNoise() if arguments.noise == "relative" else None
    if arguments.outliers:
        noise = HeavyTails(base=noise)
    if arguments.input_noise is not None:
        noise = NoisyInputs(data.X.values, _variances(arguments.input_noise, inputs), noise)
    if noise is not None:
        found["noise"] = noise
    if arguments.positive:
        found["link"] = "log"
    if arguments.bounds is not None:
        found["link"] = _bounds(arguments.bounds)
    if data.levels:
        bare = {name_and_unit(name)[0]: name for name in data.levels}
        batches = names_of(arguments.batches, "--batches") if arguments.batches else []
        batches = [bare.get(name, name) for name in batches]
        columns = [name for name in data.levels if name not in batches]
        found["input_transform"] = Categories(columns, batches, data.levels)
    return found


def _bounds(text: str) -> tuple[float, float]:
    """Return the two numbers of ``"0,1"``."""
    ends = [_number(each) for each in text.split(",")]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"Expected --bounds as two numbers, the lower first: 0,1; found {text!r}.")
    return ends[0], ends[1]


def _variances(text: str, inputs: Sequence[str]) -> list[float]:
    """Return the variance of each input, of the standard deviations that a command line has."""
    given = pairs(text, "--input-noise")
    if unknown := [name for name in given if name not in inputs]:
        raise ValueError(f"--input-noise names {unknown[0]!r}, which is none of --inputs.")
    sds = [_number(given.get(name, "0")) for name in inputs]
    if not all(0 <= sd <= LARGEST for sd in sds):
        raise ValueError(
            "Expected --input-noise as standard deviations in the inputs' units, such as "
            f"{inputs[0]}=0.5, found {text!r}."
        )
    return [sd**2 for sd in sds]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
