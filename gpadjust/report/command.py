"""The commands ``gpadjust report`` and ``gpadjust identify``: read, work, write, in one way."""

from __future__ import annotations

import shlex
import sys
import warnings
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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

_DEGREES = ("deg", "degree", "degrees", "°")
_HOW = "the same command, without --fit."
_SPAN = 10**0.5  # of positive outputs, from which kinds of noise are compared
_DIGITS = 6  # of a sampling step, which is a mean of differences
_NO_NOTES = (DeprecationWarning, PendingDeprecationWarning)


class Job(NamedTuple):
    """A command whose options, files and physics are read."""

    lines: Sequence[str]  # on the data, for the terminal
    origin: Origin
    work: Callable[[], Subject | Identification]


def run(arguments: Namespace, command: Sequence[str]) -> None:
    """Read files, work, and write the page of a command line, parsed and as it is.

    Nothing is written if anything fails: an OSError of files, a ValueError of options, data, or a
    physics that fails, or of a machine whose states diverge.
    """
    is_log = arguments.command == "identify"
    files = arguments.data if is_log else [arguments.data]
    path = checked_path(arguments.out, *files, model=not is_log)
    lines, origin, work = (_of_log if is_log else _of_table)(arguments)
    _say(*lines)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            subject = work()
        texts = [str(w.message) for w in caught if not issubclass(w.category, _NO_NOTES)]
        notes = tuple(dict.fromkeys(texts))
        _say(*(f"Warning: {note}" for note in notes))
        words = f"gpadjust {shlex.join(command)}"
        settings = {"command": words, **origin.settings, "seed": str(arguments.seed)}
        origin = replace(origin, settings=settings, notes=notes, how=_HOW)
        headline = write(subject, path, arguments.title, origin, progress=True)
    except PhysicsError as error:
        raise ValueError(str(error)) from error
    written = [arguments.out]
    if not is_log and path.with_suffix(".pt").exists():
        written.append(str(Path(arguments.out).with_suffix(".pt")))
    print(f"{headline}\nWrote {listed(written)}.")


def _say(*lines: str) -> None:
    """Print lines beside the result, while a command works."""
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def _of_table(arguments: Namespace) -> Job:
    """Read the table and the physics of ``gpadjust report``."""
    outputs = read.pairs(arguments.outputs, "--outputs", short=True)
    variances, text = None, arguments.noise
    if text not in (None, "constant", "relative"):
        sds = read.pairs(text, "--noise") if "=" in text else dict.fromkeys(outputs, text)
        variances = read.variances_of(sds, "--noise", [*outputs], "--outputs", all_of=True)
    unknowns = read.unknowns_of(arguments.unknown)
    table = read.open_table(arguments.data, arguments)
    batches = read.names_of(arguments.batches, "--batches")
    groups = [*read.names_of(arguments.categories, "--categories"), *batches]
    inputs = read.pairs(arguments.inputs, "--inputs", short=True)
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
        found = read.columns_of(formulas, others, named, [*unknowns])
        inputs |= {name: name for name in found}
        inputs |= {name: name for name in groups if name not in {*inputs, *map(bare, inputs)}}
    data = read.read_table(table, inputs, outputs, groups, arguments)
    options = _options(arguments, [*inputs], batches, data)
    physics, code, modules = read.given_physics(arguments.physics, data, unknowns)

    def work() -> Subject:
        if arguments.noise is None and not options.keys() & {"noise", "link"}:
            options.update(_noise_of(data, physics, options, arguments.seed))
        X, noise = data.X, options.get("noise")
        if isinstance(noise, NoisyInputs):
            X = read.Columns(X.columns, noise.points)
        if arguments.fit == "compare":
            seed = arguments.seed
            model: Any = compare(X, data.Y, physics, variances, seed=seed, progress=True, **options)
        else:
            _say(f"Fitting CKA by {arguments.fit!r} ...")
            model = with_options(CKA, options)(X, data.Y, variances, physics=physics)
            fit(model, arguments.fit, seed=arguments.seed)
            for text in faults(model):
                warnings.warn(text, PhysicsWarning, stacklevel=1)
        return subject_of(model, [f"line {line}" for line in data.lines])

    rows = f"{arguments.data}: {plural(len(data.lines), 'row')}"
    first = f"{rows}, {listed(data.Y.columns)} from {listed(data.X.columns)}."
    settings = {"data file": read.digest_of(arguments.data)}
    origin = Origin(settings, data.remarks, physics=code, modules=modules)
    return Job([first, *data.remarks], origin, work)


def _noise_of(
    data: read.TableData, physics: Any, options: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Return the option of the noise that left-out observations prefer, and say which.

    Noise of one size stays unless positive outputs span half a decade, and another kind predicts
    better by a nat and by two standard errors.
    """
    Y = data.Y.values
    known = Y.nan_to_num(nan=1.0)
    if not (known > 0).all() or not (_max(Y) > _SPAN * -_max(-Y)).all():
        return {}
    kinds: dict[str, dict[str, Any]] = {
        "noise of one size": {},
        "noise that grows with the formula (--noise relative)": {"noise": RelativeNoise()},
        "noise of the logarithm (--positive)": {"link": "log"},
    }
    densities: dict[str, Tensor] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is chosen is fitted again, and then warns
        for kind, own in progress_bar(True, kinds.items(), unit="noise", leave=False):
            model = with_options(CKA, {**options, **own})(data.X, data.Y, physics=physics)
            fit(model, seed=seed)
            densities[kind] = leave_one_out(model).log_density.nansum(-1)
    first, *_ = kinds
    best = max(kinds, key=lambda kind: float(densities[kind].sum()))
    gain, se = difference(densities[best], densities[first])
    if gain <= max(1.0, se):
        return {}
    _say(f"Assumed: {best}, which predicts left-out observations better; else --noise constant.")
    return kinds[best]


def _max(Y: Tensor) -> Tensor:
    """Return the largest observation of each output."""
    return Y.nan_to_num(nan=-torch.inf).amax(0)


def _options(
    arguments: Namespace, inputs: Sequence[str], batches: Sequence[str], data: read.TableData
) -> dict[str, Any]:
    """Return the options of a model: noise, link and categories."""
    options: dict[str, Any] = {}
    noise: Noise | None = RelativeNoise() if arguments.noise == "relative" else None
    if arguments.outliers:
        noise = HeavyTails(base=noise)
    if (text := arguments.input_noise) is not None:
        sds = read.pairs(text, "--input-noise")
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
    if data.levels:
        full = {bare(name): name for name in data.levels}
        named = [full.get(name, name) for name in batches]
        columns = [name for name in data.levels if name not in named]
        options["input_transform"] = Categories(columns, named, data.levels)
    return options


def _of_log(arguments: Namespace) -> Job:
    """Read the log and the equations of ``gpadjust identify``."""
    hidden = read.hidden_of(arguments.hidden)
    unknowns = read.unknowns_of(arguments.unknown)
    way = " A state that was not measured: --hidden 'rate=0 +- 1'. Other times: --time Zeit."
    tables = [read.open_table(file, arguments, way) for file in arguments.data]
    log = listed(read.digest_of(file) for file in arguments.data)
    own_units = {name: prior.unit for name, prior in hidden.items()}
    columns, units = read.log_columns(tables[0], own_units, arguments)
    names = [*columns["states"]], [*columns["actions"]]
    angles = read.names_of(arguments.angles, "--angles")
    read.check_names(angles, "--angles", names[0], "--states")
    if wrong := [name for name in angles if units.get(name) in _DEGREES]:
        raise ValueError(
            f"Expected the angle {wrong[0]!r} in rad, found {units[wrong[0]]!r}; convert it, or do "
            "without --angles, which is for angles that go round."
        )
    whole = Records.read_csv(tables, StateSpec(*names, angles=angles), **columns)
    own = {**columns["states"], **columns["actions"]}
    renamed = {tables[0].bare(column) for column in own.values() if column is not None}
    others = [name for name in tables[0].names if name not in renamed]
    sides = [text.partition("=")[2] for text in arguments.physics if ":" not in text]
    read.check_constants(sides, [*own, *others, *unknowns])
    reading = {**columns, **read.table_options(arguments)}
    # Equations are integrated along the recorded actions, also within a control step.
    sampling = float(f"{whole.records[0].sampling_step:.{_DIGITS}g}")
    given = read.motion(arguments.physics, *names, unknowns, sampling)
    physics = given.physics
    step = arguments.step or (sampling if physics.step is None else physics.step)
    if given.modules and physics.step not in (None, step):
        raise ValueError(
            f"Expected no --step, as the physics has a step of {physics.step:g}, found "
            f"{arguments.step:g}."
        )
    spec = StateSpec(*names, angles=angles)
    options = {
        "step": step,
        "start": {name: (own.guess, own.sd) for name, own in hidden.items()} or None,
        "held_out": arguments.held_out,
        "num_starts": arguments.starts,
        "seed": arguments.seed,
    }

    def work() -> Identification:
        try:
            return identify(Records(whole.records, spec), physics, **options)
        except RuntimeError as error:  # the states diverged, or the physics failed
            raise ValueError(str(error)) from error

    time = units.get("time", "s")
    named = f"{physics.name} ({type(physics).__name__})"
    settings = {"log": log, "step": f"{step:g} {time}", "physics": named}
    program = _program(arguments.data, spec, reading, given, options)
    line = f"{listed(arguments.data)}: {listed(map(repr, whole))}."
    remarks = [remark for table in tables for remark in table.remarks]
    return Job([line, *remarks], Origin(settings, units=units, program=program), work)


def _program(
    files: Sequence[str],
    spec: StateSpec,
    reading: Mapping[str, object],
    physics: read.GivenPhysics,
    options: Mapping[str, object],
) -> str:
    """Return Python code that does the same, and follows further actions."""
    states, actions = [*spec.states], [*spec.actions]
    angles = f", angles={[*spec.angles]!r}" if spec.angles else ""
    columns = "".join(f"    {name}={v!r},\n" for name, v in reading.items() if v is not None)
    chosen = "".join(f", {name}={v!r}" for name, v in options.items() if v is not None)
    return f"""\
{read.imports_of(physics.code, physics.modules)}
from gpadjust.records import Records, identify
from gpadjust.states import StateSpec

spec = StateSpec({states!r}, {actions!r}{angles})
records = Records.read_csv(
    {[*files]!r},
    spec,
{columns})
physics = {physics.code}
found = identify(records, physics{chosen})
print(found)

# From the last state that was learnt from, under other actions: {", ".join(actions)}
smoothed = found.smoothed
state = smoothed.records.records[-1].states[-1:]
plan = torch.zeros(1, 100, {len(actions)}, dtype=torch.float64)  # of 100 steps, found.step each
noises = {{"start_noise": smoothed.sd[-1][-1], "process_noise": found.dynamics.process_noise}}
run = found.dynamics.free_run(state, plan, noise=False, **noises)
print(run.mean, run.lower, run.upper)
"""
