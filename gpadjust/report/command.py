"""The commands ``gpadjust report`` and ``gpadjust identify``, run in one way."""

from __future__ import annotations

import shlex
import sys
import warnings
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from gpadjust.core import CKA, GP, Noise, fit
from gpadjust.kinds.categories import Categories
from gpadjust.kinds.factory import with_options
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.physics import ODEPhysics, PhysicsError, PhysicsWarning
from gpadjust.records import Identification, Records, identify
from gpadjust.report.given_physics import (
    GivenPhysics,
    columns_of,
    given_physics,
    hidden_of,
    imports_of,
    is_path,
    motion,
    unknowns_of,
)
from gpadjust.report.inputs import (
    Columns,
    TableData,
    check_names,
    digest_of,
    log_columns,
    mark_of,
    names_of,
    noise_variances,
    number_of,
    open_table,
    pairs,
    read_table,
    variances_of,
)
from gpadjust.report.markup import bare, listed, plural
from gpadjust.report.page import checked_path, write
from gpadjust.report.subject import Origin, Subject, subject_of
from gpadjust.states import StateSpec
from gpadjust.validation import Comparison, compare
from gpadjust.validation.plausibility import complaint

_DEGREES = ("deg", "degree", "degrees", "°")
_DIGITS = 6  # of a sampling step, which is a mean of differences
_NO_NOTES = (DeprecationWarning, PendingDeprecationWarning)


class Job(NamedTuple):
    """A command whose options and files are read, and whose physics was evaluated.

    Attributes:
        lines: Sentences on the data, for the terminal.
        origin: What the page says of data, physics and settings.
        work: What takes time, and gives the subject of the page.
    """

    lines: Sequence[str]
    origin: Origin
    work: Callable[[], Subject | Identification]


def run(arguments: Namespace, command: Sequence[str]) -> None:
    """Read files, work, and write the page; nothing is written if anything fails.

    Args:
        arguments: A command line as parsed by :func:`gpadjust.__main__.parser`.
        command: The command line, for the page.

    Raises:
        OSError: If a file cannot be read or written.
        ValueError: If an option, the data or the physics are wrong, the physics fails where it is
            evaluated, or the states of a machine diverge.
    """
    is_log = arguments.command == "identify"
    files = arguments.data if is_log else [arguments.data]
    path = checked_path(arguments.out, *files, model=not is_log)
    lines, origin, work = (_of_log if is_log else _of_table)(arguments)
    for line in lines:
        print(line, file=sys.stderr, flush=True)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            subject = work()
        texts = [str(w.message) for w in caught if not issubclass(w.category, _NO_NOTES)]
        notes = tuple(dict.fromkeys(texts))
        for note in notes:
            print(f"Warning: {note}", file=sys.stderr, flush=True)
        settings = {"command": f"gpadjust {shlex.join(command)}", **origin.settings}
        settings["seed"] = str(arguments.seed)
        origin = replace(origin, settings=settings, notes=notes, how=_comparing(command))
        headline = write(subject, path, arguments.title, origin, progress=True)
    except PhysicsError as error:
        raise ValueError(str(error)) from error
    written = [arguments.out]
    if not is_log and path.with_suffix(".pt").exists():
        written.append(str(Path(arguments.out).with_suffix(".pt")))
    print(f"{headline}\nWrote {listed(written)}.")


def _comparing(command: Sequence[str]) -> str:
    """Return the command that compares structures: the same without ``--fit``."""
    kept: list[str] = []
    words = iter(command)
    for word in words:
        option, equals, _ = word.partition("=")
        if not (option.startswith("--f") and "--fit".startswith(option)):
            kept.append(word)
        elif not equals:
            next(words, None)
    return f"gpadjust {shlex.join(kept)}"


def _of_table(arguments: Namespace) -> Job:
    """Read the table and the physics of ``gpadjust report``."""
    outputs = names_of(arguments.outputs, "--outputs")
    variances = noise_variances(arguments.noise, outputs)
    unknowns = unknowns_of(arguments.unknown)
    marks = (mark_of(arguments.delimiter), arguments.decimal, arguments.sheet)
    table = open_table(arguments.data, *marks)
    batches = names_of(arguments.batches, "--batches") if arguments.batches else []
    categories = names_of(arguments.categories, "--categories") if arguments.categories else []
    inputs = _inputs(arguments, table.names, outputs, [*unknowns], [*categories, *batches])
    data = read_table(table, inputs, outputs, [*categories, *batches], arguments)
    options = _options(arguments, inputs, batches, data)
    physics = given_physics(arguments.physics, data, unknowns)

    def work() -> Subject:
        model = _fitted(arguments, data, physics.physics, variances, options)
        return subject_of(model, [f"line {line}" for line in data.lines])

    rows = f"{arguments.data}: {plural(len(data.lines), 'row')}"
    first = f"{rows}, {listed(data.Y.columns)} from {listed(data.X.columns)}."
    settings = {"data file": digest_of(arguments.data)}
    origin = Origin(settings, data.remarks, physics=physics.code, modules=physics.modules)
    return Job([first, *data.remarks], origin, work)


def _inputs(
    arguments: Namespace, columns: Sequence[str], outputs: Sequence[str],
    unknowns: Sequence[str], groups: Sequence[str],
) -> list[str]:  # fmt: skip
    """Return the names of the inputs: by the option, or of formulas and groups."""
    if arguments.inputs is not None:
        return names_of(arguments.inputs, "--inputs")
    if paths := [text for text in arguments.physics if is_path(text)]:
        raise ValueError(
            f"Expected --inputs, the columns that {paths[0]} reads, in its order; only formulas "
            "name their own."
        )
    others = [name for name in columns if not {name, bare(name)} & {*outputs}]
    inputs = columns_of(arguments.physics, others, unknowns)
    known = {*inputs, *map(bare, inputs)}
    return inputs + [name for name in groups if name not in known]


def _options(
    arguments: Namespace, inputs: Sequence[str], batches: Sequence[str], data: TableData
) -> dict[str, Any]:
    """Return the options of a model: noise, link and categories."""
    options: dict[str, Any] = {}
    noise: Noise | None = RelativeNoise() if arguments.noise == "relative" else None
    if arguments.outliers:
        noise = HeavyTails(base=noise)
    if arguments.input_noise is not None:
        sds = pairs(arguments.input_noise, "--input-noise")
        check_names(sds, "--input-noise", inputs, "--inputs")
        variances = variances_of(sds, "--input-noise", inputs)
        noise = NoisyInputs(data.X.values, variances, noise)
    if noise is not None:
        options["noise"] = noise
    if arguments.positive:
        options["link"] = "log"
    if (text := arguments.bounds) is not None:
        ends = [number_of(end) for end in text.split(",")]
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise ValueError(
                f"Expected --bounds as two numbers, the lower first: 0,1; found {text!r}."
            )
        options["link"] = (ends[0], ends[1])
    if data.levels:
        full = {bare(name): name for name in data.levels}
        named = [full.get(name, name) for name in batches]
        columns = [name for name in data.levels if name not in named]
        options["input_transform"] = Categories(columns, named, data.levels)
    return options


def _fitted(
    arguments: Namespace, data: TableData, physics: Any,
    variances: list[float] | None, options: dict[str, Any],
) -> Comparison | GP:  # fmt: skip
    """Return the comparison of all structures, or one CKA, fitted."""
    X, Y = data.X, data.Y
    if isinstance(noise := options.get("noise"), NoisyInputs):
        X = Columns(X.columns, noise.points)
    if arguments.fit == "compare":
        return compare(X, Y, physics, variances, seed=arguments.seed, progress=True, **options)
    print(f"Fitting CKA by {arguments.fit!r} ...", file=sys.stderr, flush=True)
    model: GP = with_options(CKA, options)(X, Y, variances, physics=physics)
    for part in model.physics:
        if text := complaint(part, model.data):
            warnings.warn(text, PhysicsWarning, stacklevel=1)
    fit(model, arguments.fit, seed=arguments.seed)
    return model


def _of_log(arguments: Namespace) -> Job:
    """Read the log and the equations of ``gpadjust identify``."""
    hidden = hidden_of(arguments.hidden)
    unknowns = unknowns_of(arguments.unknown)
    marks = {"delimiter": mark_of(arguments.delimiter), "decimal": arguments.decimal}
    tables = [open_table(file, **marks) for file in arguments.data]
    log = listed(digest_of(file) for file in arguments.data)
    own_units = {name: unit for name, (unit, _) in hidden.items()}
    columns, units = log_columns(tables, own_units, arguments)
    states, actions = [*columns["states"]], [*columns["actions"]]
    angles = names_of(arguments.angles, "--angles") if arguments.angles else []
    check_names(angles, "--angles", states, "--states")
    for name in angles:
        if units.get(name) in _DEGREES:
            raise ValueError(
                f"Expected the angle {name!r} in rad, found {units[name]!r}; convert it, or do "
                "without --angles, which is for angles that go round."
            )
    reading = {**columns, **marks}
    read = Records.read_csv(arguments.data, StateSpec(states, actions, angles=angles), **reading)
    step = arguments.step
    if step is None:
        step = float(f"{read.records[0].sampling_step:.{_DIGITS}g}")
    given = motion(arguments.physics, states, actions, unknowns, step)
    physics = given.physics
    if isinstance(physics, ODEPhysics):
        step = physics.step
    if arguments.step not in (None, step):
        raise ValueError(
            f"Expected no --step, as the physics has a step of {step:g}, found {arguments.step:g}."
        )
    spec = StateSpec(states, actions, angles=angles, step=step)
    options = {
        "start": {name: start for name, (_, start) in hidden.items()} or None,
        "held_out": arguments.held_out,
        "num_starts": arguments.starts,
        "seed": arguments.seed,
    }

    def work() -> Identification:
        try:
            return identify(Records(read.records, spec), physics, **options, progress=True)
        except RuntimeError as error:  # the states diverged, or the physics failed
            raise ValueError(str(error)) from error

    settings = {
        "log": log,
        "step": f"{step:g} {units.get('time', 's')}",
        "physics": f"{physics.name} ({type(physics).__name__})",
    }
    program = _program(arguments.data, spec, reading, given, options)
    lines = [f"{listed(arguments.data)}: {listed(map(repr, read))}."]
    return Job(lines, Origin(settings, units=units, program=program), work)


def _program(
    files: Sequence[str], spec: StateSpec, reading: Mapping[str, object],
    physics: GivenPhysics, options: Mapping[str, object],
) -> str:  # fmt: skip
    """Return Python code that does the same, and follows further actions."""
    states, actions = [*spec.states], [*spec.actions]
    angles = f", angles={[*spec.angles]!r}" if spec.angles else ""
    read = "".join(f"    {name}={v!r},\n" for name, v in reading.items() if v is not None)
    chosen = "".join(f", {name}={v!r}" for name, v in options.items() if v is not None)
    return f"""\
{imports_of(physics.code, physics.modules)}
from gpadjust.records import Records, identify
from gpadjust.states import StateSpec

spec = StateSpec({states!r}, {actions!r}, step={spec.step!r}{angles})
records = Records.read_csv(
    {[*files]!r},
    spec,
{read})
physics = {physics.code}
found = identify(records, physics{chosen})
print(found)

# From the last state that was learnt from, under other actions: {", ".join(actions)}
smoothed = found.smoothed
state = smoothed.records.records[-1].states[-1:]
plan = torch.zeros(1, 100, {len(actions)}, dtype=torch.float64)  # of 100 steps
noises = {{"start_noise": smoothed.sd[-1][-1], "process_noise": smoothed.process_noise}}
run = found.dynamics.free_run(state, plan, noise=False, **noises)
print(run.mean, run.lower, run.upper)
"""
