"""The commands ``gpadjust report`` and ``gpadjust identify``: read, work, write, in one way."""

from __future__ import annotations

import shlex
import sys
import warnings
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gpadjust.core import CKA, Noise, fit
from gpadjust.kinds import Categories, HeavyTails, NoisyInputs, RelativeNoise, with_options
from gpadjust.physics import PhysicsError, PhysicsWarning
from gpadjust.progress import progress_bar
from gpadjust.records import Identification, Records, identify
from gpadjust.report import inputs as read
from gpadjust.report.page import checked_path, write
from gpadjust.report.subject import Origin, Subject, subject_of
from gpadjust.states import StateSpec
from gpadjust.validation import compare, leave_one_out
from gpadjust.validation.faults import faults
from gpadjust.validation.verdict import difference
from gpadjust.words import bare, listed, plural

_DEGREES = ("deg", "degree", "degrees", "°")  # units that a jumping angle cannot have
_HOW = "the same command, without --fit."  # compares a model with others
_SPAN = 10**0.5  # of positive outputs, from which kinds of noise are compared
_DIGITS = 6  # of a sampling step, which is a mean of differences
_NO_NOTES = (DeprecationWarning, PendingDeprecationWarning)  # of libraries, not of the fit

Job = tuple[Sequence[str], Origin, Callable[[], Subject | Identification]]
"""Lines on the data for the terminal, the origin of the page, and the work itself."""


def run(arguments: Namespace, command: Sequence[str]) -> None:
    """Read files, work, and write the page of a command line, parsed and as it is.

    Nothing is written if anything fails: an OSError of files, a ValueError of options, data, or a
    physics that fails, or of a machine whose states diverge.
    """
    is_log = arguments.command == "identify"
    path = checked_path(arguments.out, *arguments.data, model=not is_log)
    readers = {"report": _of_table, "identify": _of_log}
    lines, origin, work = readers[arguments.command](arguments)
    _print(*lines)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            subject = work()
        texts = [str(w.message) for w in caught if not issubclass(w.category, _NO_NOTES)]
        notes = tuple(dict.fromkeys(texts))  # each once
        _print(*(f"Warning: {note}" for note in notes))
        command_line = f"gpadjust {shlex.join(command)}"
        settings = {"command": command_line, **origin.settings, "seed": str(arguments.seed)}
        origin = replace(origin, settings=settings, notes=notes, how=_HOW)
        headline = write(subject, path, arguments.title, origin, progress=True)
    except PhysicsError as error:
        raise ValueError(str(error)) from error
    written = [arguments.out]
    if not is_log and path.with_suffix(".pt").exists():
        written.append(str(Path(arguments.out).with_suffix(".pt")))
    print(f"{headline}\nWrote {listed(written)}.")


def _print(*lines: str) -> None:
    """Print lines to stderr, while a command works; its result goes to stdout."""
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def _of_table(arguments: Namespace) -> Job:
    """Read the table and the physics of ``gpadjust report``."""
    outputs = read.pairs(arguments.outputs, "--outputs", short=True)
    variances = None  # a fitted noise
    if arguments.noise not in (None, "constant", "relative"):
        sds = dict.fromkeys(outputs, arguments.noise)
        if "=" in arguments.noise:
            sds = read.pairs(arguments.noise, "--noise")
        variances = read.variances_of(sds, "--noise", [*outputs], "--outputs", all_of=True)
    unknowns = read.unknowns_of(arguments.unknown)
    (file,) = arguments.data
    table = read.open_table(file, arguments)
    batches = read.names_of(arguments.batches, "--batches")
    groups = [*read.names_of(arguments.categories, "--categories"), *batches]
    inputs = read.pairs(arguments.inputs, "--inputs", short=True)

    # The inputs are those of the option, those that formulas name, and groups.
    formulas = [text for text in arguments.physics if ":" not in text]
    taken = {table.label(column) for column in (*inputs.values(), *outputs.values())}
    others = [name for name in table.names if name and table.label(name) not in taken]
    read.check_constants(formulas, [*inputs, *others, *unknowns])
    if paths := [text for text in arguments.physics if ":" in text]:
        if not inputs:
            raise ValueError(
                f"Expected --inputs, the columns that {paths[0]} reads, in its order; only "
                "formulas name their own."
            )
    else:
        named = [table.bare(name) if name == column else name for name, column in inputs.items()]
        columns = read.columns_of(formulas, others, named, [*unknowns])
        inputs |= {name: name for name in columns}
        inputs |= {name: name for name in groups if name not in {*inputs, *map(bare, inputs)}}
    data = read.read_table(table, inputs, outputs, groups, arguments)
    options = _options(arguments, [*inputs], batches, data)
    physics, code, modules = read.given_physics(arguments.physics, data, unknowns)

    def work() -> Subject:
        seed = arguments.seed
        if arguments.noise is None and not options.keys() & {"noise", "link"}:
            options.update(_noise_of(data, physics, options, seed))
        X = data.X
        noise = options.get("noise")
        if isinstance(noise, NoisyInputs):  # it has copies of the inputs, which it corrects
            X = read.Columns(X.columns, noise.points)
        if arguments.fit == "compare":
            model: Any = compare(X, data.Y, physics, variances, seed=seed, progress=True, **options)
        else:
            _print(f"Fitting CKA by {arguments.fit!r} ...")
            model = with_options(CKA, options)(X, data.Y, variances, physics=physics)
            fit(model, arguments.fit, seed=seed)
            for text in faults(model):
                warnings.warn(text, PhysicsWarning, stacklevel=1)
        return subject_of(model, [f"line {line}" for line in data.lines])

    rows = f"{file}: {plural(len(data.lines), 'row')}"
    first = f"{rows}, {listed(data.Y.columns)} from {listed(data.X.columns)}."
    settings = {"data file": read.digest_of(file)}
    origin = Origin(settings, data.remarks, physics=code, modules=modules)
    return [first, *data.remarks], origin, work


def _noise_of(
    data: read.TableData, physics: Any, options: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Return the option of the noise that left-out observations prefer, and print it.

    Noise of one size stays unless positive outputs span half a decade, and another kind predicts
    better by a nat and by two standard errors.
    """
    Y = data.Y.values
    are_positive = (Y.nan_to_num(nan=1.0) > 0).all()
    lowest = Y.nan_to_num(nan=torch.inf).amin(0)
    highest = Y.nan_to_num(nan=-torch.inf).amax(0)
    if not are_positive or not (highest > _SPAN * lowest).all():
        return {}
    kinds: dict[str, dict[str, Any]] = {
        "noise of one size": {},
        "noise that grows with the formula (--noise relative)": {"noise": RelativeNoise()},
        "noise of the logarithm (--positive)": {"link": "log"},
    }
    densities: dict[str, Tensor] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the chosen kind is fitted again, and then warns
        for kind, noise in progress_bar(True, kinds.items(), unit="noise", leave=False):
            model = with_options(CKA, {**options, **noise})(data.X, data.Y, physics=physics)
            fit(model, seed=seed)
            densities[kind] = leave_one_out(model).log_density.nansum(-1)
    # The simplest kind stays unless another one is better by more than a standard error.
    first, *_ = kinds
    best = max(kinds, key=lambda kind: float(densities[kind].sum()))
    gain, se = difference(densities[best], densities[first])
    if gain <= max(1.0, se):
        return {}
    _print(f"Assumed: {best}, which predicts left-out observations better; else --noise constant.")
    return kinds[best]


def _options(
    arguments: Namespace, inputs: Sequence[str], batches: Sequence[str], data: read.TableData
) -> dict[str, Any]:
    """Return the options of a model: noise, link and categories."""
    options: dict[str, Any] = {}
    noise: Noise | None = None
    if arguments.noise == "relative":
        noise = RelativeNoise()
    if arguments.outliers:
        noise = HeavyTails(base=noise)
    if arguments.input_noise is not None:
        sds = read.pairs(arguments.input_noise, "--input-noise")
        variances = read.variances_of(sds, "--input-noise", inputs, "--inputs", all_of=False)
        noise = NoisyInputs(data.X.values, variances, noise)
    if noise is not None:
        options["noise"] = noise
    if arguments.positive:
        options["link"] = "log"
    if (text := arguments.bounds) is not None:
        ends = [read.number_of(end) for end in text.split(",")]
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise ValueError(
                f"Expected --bounds as two numbers, the lower first: 0,1; found {text!r}."
            )
        options["link"] = (ends[0], ends[1])
    if data.levels:  # columns have their units in the levels, but not in the option
        with_unit = {bare(name): name for name in data.levels}
        named = [with_unit.get(name, name) for name in batches]
        columns = [name for name in data.levels if name not in named]
        options["input_transform"] = Categories(columns, named, data.levels)
    return options


def _of_log(arguments: Namespace) -> Job:
    """Read the log and the equations of ``gpadjust identify``."""
    # Read the columns of the log.
    hidden = read.hidden_of(arguments.hidden)
    unknowns = read.unknowns_of(arguments.unknown)
    way = " A state that was not measured: --hidden 'rate=0 +- 1'. Other times: --time Zeit."
    tables = [read.open_table(file, arguments, way) for file in arguments.data]
    hidden_units = {name: prior.unit for name, prior in hidden.items()}
    columns, units = read.log_columns(tables[0], hidden_units, arguments)
    names = [*columns["states"]], [*columns["actions"]]
    angles = read.names_of(arguments.angles, "--angles")
    read.check_names(angles, "--angles", names[0], "--states")
    if wrong := [name for name in angles if units.get(name) in _DEGREES]:
        raise ValueError(
            f"Expected the angle {wrong[0]!r} in rad, found {units[wrong[0]]!r}; convert it, or do "
            "without --angles, which is for angles that go round."
        )
    spec = StateSpec(*names, angles=angles)
    records = Records.read_csv(tables, spec, **columns)

    # Read the equations, whose step is the sampling step by default.
    renamed = {**columns["states"], **columns["actions"]}
    bare_names = {tables[0].bare(column) for column in renamed.values() if column is not None}
    others = [name for name in tables[0].names if name not in bare_names]
    sides = [text.partition("=")[2] for text in arguments.physics if ":" not in text]
    read.check_constants(sides, [*renamed, *others, *unknowns])
    # Equations are integrated along the recorded actions, also within a control step.
    sampling = float(f"{records.records[0].sampling_step:.{_DIGITS}g}")
    motion = read.motion(arguments.physics, *names, unknowns, sampling)
    physics = motion.physics
    step = arguments.step
    if step is None:
        step = physics.step or sampling
    if motion.modules and physics.step not in (None, step):
        raise ValueError(
            f"Expected no --step, as the physics has a step of {physics.step:g}, found "
            f"{arguments.step:g}."
        )
    options = {
        "step": step,
        "start": {name: (prior.guess, prior.sd) for name, prior in hidden.items()} or None,
        "held_out": arguments.held_out,
        "num_starts": arguments.starts,
        "seed": arguments.seed,
    }

    def work() -> Identification:
        try:
            return identify(records, physics, **options)
        except RuntimeError as error:  # the states diverged, or the physics failed
            raise ValueError(str(error)) from error

    settings = {
        "log": listed(read.digest_of(file) for file in arguments.data),
        "step": f"{step:g} {units.get('time', 's')}",
        "physics": f"{physics.name} ({type(physics).__name__})",
    }
    reading = {**columns, **read.table_options(arguments)}
    program = _program(arguments.data, spec, reading, motion, options)
    line = f"{listed(arguments.data)}: {listed(map(repr, records))}."
    remarks = [remark for table in tables for remark in table.remarks]
    return [line, *remarks], Origin(settings, units=units, program=program), work


def _program(
    files: Sequence[str],
    spec: StateSpec,
    reading: Mapping[str, object],
    physics: read.GivenPhysics,
    options: Mapping[str, object],
) -> str:
    """Return Python code of the same identification, which follows further actions."""
    states = [*spec.states]
    actions = [*spec.actions]
    names = f"{states!r}, {actions!r}"
    if spec.angles:
        names += f", angles={[*spec.angles]!r}"
    columns = "".join(f"    {name}={v!r},\n" for name, v in reading.items() if v is not None)
    further = "".join(f", {name}={v!r}" for name, v in options.items() if v is not None)
    return f"""\
{read.imports_of(physics.code, physics.modules)}
from gpadjust.records import Records, identify
from gpadjust.states import StateSpec

spec = StateSpec({names})
records = Records.read_csv(
    {[*files]!r},
    spec,
{columns})
physics = {physics.code}
machine = identify(records, physics{further})
print(machine)

# From the last state of the fitted part, under other actions: {", ".join(actions)}
smoothed = machine.smoothed
state = smoothed.records.records[-1].states[-1:]
plan = torch.zeros(1, 100, {len(actions)}, dtype=torch.float64)  # of 100 steps, machine.step each
noises = {{"start_noise": smoothed.sd[-1][-1], "process_noise": machine.dynamics.process_noise}}
run = machine.dynamics.free_run(state, plan, noise=False, **noises)
print(run.mean, run.lower, run.upper)
"""
