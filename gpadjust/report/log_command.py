"""The command ``gpadjust identify``."""

from __future__ import annotations

import re
import shlex
import warnings
from argparse import Namespace
from ast import unparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from gpadjust.files.table_columns import TableColumns
from gpadjust.physics import FormulaPhysics, ODEPhysics, Physics, PhysicsError, Unknown, as_physics
from gpadjust.physics.formula import names_in, parse
from gpadjust.records import Records, identify
from gpadjust.report.given_physics import imported, is_path, needs_inf, unknown_of, unknowns_of
from gpadjust.report.inputs import digest_of, mark_of, names_of, notes_of, open_table, say
from gpadjust.report.log_page import LogOrigin, headline, write
from gpadjust.report.markup import listed, name_and_unit
from gpadjust.report.page import checked_path
from gpadjust.states import StateSpec

_EQUATION = re.compile(r"\s*([^\W\d]\w*)\s*('?)\s*=(?!=)(.*)", flags=re.DOTALL)
_DEGREES = ("deg", "degree", "degrees", "°")
_DIGITS = 6  # of a sampling step, which is a mean of differences


class _Columns(NamedTuple):
    """Columns of the log by the names of states and actions, and units by these and "time"."""

    states: dict[str, str | None]
    actions: dict[str, str]
    time: str | float
    units: dict[str, str]


def run(arguments: Namespace, command: Sequence[str]) -> None:
    """Read a log, identify the machine, and write the page; nothing if anything fails.

    Args:
        arguments: A command line as parsed by :func:`gpadjust.__main__.parser`.
        command: The command line, for the page.

    Raises:
        OSError: If a file cannot be read or written.
        ValueError: If an option, the log or the physics are wrong, or the states diverge.
        PhysicsError: If the physics fails at measured states.
    """
    path = checked_path(arguments.out, *arguments.data, model=False)
    hidden, starts = _hidden(arguments.hidden)
    unknowns = unknowns_of(arguments.unknown)
    marks = {"delimiter": mark_of(arguments.delimiter), "decimal": arguments.decimal}
    tables = [open_table(file, **marks) for file in arguments.data]
    log = listed(f"{Path(file).name} (SHA-256 {digest_of(file)}...)" for file in arguments.data)
    columns = _columns(arguments, tables, hidden)
    angles = names_of(arguments.angles, "--angles") if arguments.angles else []
    _check_angles(angles, columns)
    given = {
        "states": columns.states,
        "actions": columns.actions,
        "time": columns.time,
        "segment": None if arguments.segment is None else _header(tables, arguments.segment),
        **marks,
    }
    names = [*columns.states], [*columns.actions]
    read = Records.read_csv(arguments.data, StateSpec(*names, angles=angles), **given)
    physics, code = _physics(arguments.physics, *names, unknowns, _step(arguments, read))
    step = physics.step if isinstance(physics, ODEPhysics) else _step(arguments, read)
    if arguments.step not in (None, step):
        raise ValueError(
            f"Expected no --step, as the physics has a step of {step:g}, found {arguments.step:g}."
        )
    spec = StateSpec(*names, angles=angles, step=step)
    records = Records(read.records, spec)
    say(f"{listed(arguments.data)}: {listed(map(repr, read))}.")
    options = {
        "start": starts or None,
        "held_out": arguments.held_out,
        "num_starts": arguments.starts,
        "seed": arguments.seed,
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            found = identify(records, physics, **options, progress=True)
        except PhysicsError:
            raise
        except RuntimeError as error:  # the states diverged
            raise ValueError(str(error)) from error
    notes = notes_of(caught)
    for note in notes:
        say(f"Warning: {note}")
    settings = {
        "command": f"gpadjust {shlex.join(command)}",
        "log": log,
        "step": f"{step:g} {columns.units.get('time', 's')}",
        "physics": f"{physics.name} ({type(physics).__name__})",
        "seed": str(arguments.seed),
    }
    program = _program(arguments.data, spec, given, code, options)
    origin = LogOrigin(settings, columns.units, notes, program)
    write(found, path, arguments.title, origin)
    print(f"{headline(found, origin)}\nWrote {arguments.out}.")


def _hidden(texts: Sequence[str]) -> tuple[dict[str, str], dict[str, tuple[float, float]]]:
    """Units of hidden states, and mean and standard deviation at the beginning, by their names."""
    units, starts = dict[str, str](), dict[str, tuple[float, float]]()
    for text in texts:
        told = (
            "Expected --hidden with what is known of its beginning, mean and standard deviation, "
            f"such as 'rate [rad/s]=0 +- 2', found {text!r}."
        )
        try:
            name, prior = unknown_of(text)
        except ValueError as error:
            raise ValueError(told) from error
        if prior.sd is None:
            raise ValueError(told)
        units[name], starts[name] = prior.unit, (prior.guess, prior.sd)
    return units, starts


def _columns(
    arguments: Namespace, tables: Sequence[TableColumns], hidden: Mapping[str, str]
) -> _Columns:
    """The columns that a command line names, which all tables have."""
    states = _pairs(arguments.states, "--states")
    if unknown := [name for name in hidden if name not in states]:
        raise ValueError(f"--hidden names {unknown[0]!r}, which is none of --states.")
    time: str | float = arguments.time
    try:
        time = float(time)
    except ValueError:
        time = _numbers(tables, arguments.time)
    if not arguments.actions and not isinstance(time, str):
        raise ValueError("Expected --actions, as there is no column of times to stand for them.")
    actions = _pairs(arguments.actions or f"time={arguments.time}", "--actions")
    units = {name: unit for name, unit in hidden.items() if unit}
    found = dict[str, str | None]()
    for name, column in states.items():
        try:
            found[name] = None if name in hidden else _numbers(tables, column, may_miss=True)
        except ValueError as error:
            way = f" A state that was not measured: --hidden '{name}=0 +- 1'."
            raise ValueError(f"{error}{way * ('expected a column' in str(error))}") from error
    taken = {name: _numbers(tables, column) for name, column in actions.items()}
    for name, header in [*found.items(), *taken.items(), ("time", time)]:
        if isinstance(header, str) and (unit := name_and_unit(header)[1]):
            units[name] = unit
    return _Columns(found, taken, time, units)


def _pairs(text: str, option: str) -> dict[str, str]:
    """The column of each name, of ``"angle=q,rate"``."""
    parts = [name.partition("=") for name in names_of(text, option)]
    found = {name.strip(): (column or name).strip() for name, _, column in parts}
    if len(found) < len(parts) or "" in found:
        raise ValueError(f"Expected different names, found {option} {text!r}.")
    return found


def _header(tables: Sequence[TableColumns], name: str) -> str:
    """The column of this name, with its unit."""
    names = tables[0].names
    bare = [name_and_unit(each)[0] for each in names]
    return names[bare.index(name)] if name not in names and bare.count(name) == 1 else name


def _numbers(tables: Sequence[TableColumns], name: str, *, may_miss: bool = False) -> str:
    """The column of this name; an error of the command line unless all tables have its numbers."""
    header = _header(tables, name)
    for table in tables:
        table.numbers(header, may_miss=may_miss)
    return header


def _check_angles(angles: Sequence[str], columns: _Columns) -> None:
    """Raise a ValueError unless angles are states in rad."""
    for name in angles:
        if name not in columns.states:
            raise ValueError(f"--angles names {name!r}, which is none of --states.")
        if columns.units.get(name, "rad") in _DEGREES:
            raise ValueError(
                f"Expected the angle {name!r} in rad, found {columns.units[name]!r}; convert it, "
                "or do without --angles, which is for angles that go round."
            )


def _step(arguments: Namespace, records: Records) -> float:
    """The control step: as given, or the sampling step."""
    if arguments.step is not None:
        return float(arguments.step)
    return float(f"{next(iter(records)).sampling_step:.{_DIGITS}g}")


def _physics(
    texts: Sequence[str],
    states: Sequence[str],
    actions: Sequence[str],
    unknowns: Mapping[str, Unknown],
    step: float,
) -> tuple[Physics, tuple[str, str]]:
    """The physics of a command line, and code that imports and makes it."""
    if paths := [text for text in texts if is_path(text)]:
        if len(texts) > 1 or unknowns:
            raise ValueError(
                f"Expected {paths[0]} alone: it has the next values of all states, and its own "
                "unknown parameters, as of ODEPhysics(f, ..., unknowns=...)."
            )
        module, name = paths[0].split(":", 1)
        try:
            return as_physics(imported(paths[0])), (f"import {module}", f"{module}.{name}")
        except (ValueError, TypeError) as error:
            raise ValueError(f"--physics {paths[0]}: {error}") from error
    formula, is_rate = _formula(texts, states)
    if absent := [name for name in unknowns if name not in names_in(formula)]:
        raise ValueError(f"--unknown names {absent[0]!r}, which is in no equation.")
    columns = [*states, *actions]
    physics: Physics = FormulaPhysics(formula, columns, unknowns=unknowns)
    priors = "".join(f"        {name!r}: {own!r},\n" for name, own in unknowns.items())
    own = f"{formula!r},\n    {columns},\n    unknowns={{\n{priors}    }},\n"
    made = f"FormulaPhysics(\n    {own})"
    if not is_rate:
        return physics, ("from gpadjust import FormulaPhysics, Unknown", made)
    physics = ODEPhysics(physics, step, len(states))
    made = f"ODEPhysics({made}, step={step!r}, state_dim={len(states)})"
    return physics, ("from gpadjust import FormulaPhysics, ODEPhysics, Unknown", made)


def _formula(texts: Sequence[str], states: Sequence[str]) -> tuple[str, bool]:
    """The right-hand sides in the order of the states, and whether they are time derivatives."""
    sides, primes = dict[str, str](), set[str]()
    for text in texts:
        found = _EQUATION.fullmatch(text)
        trees = [] if found is None else parse(found[3])
        if found is None or len(trees) != 1 or found[1] in sides:
            raise ValueError(
                'Expected --physics as one equation for each state, such as "rate\'=-sin(angle)" '
                "(a time derivative) or 'level=0.9*level' (its next value), or module:name, found "
                f"{text!r}."
            )
        sides[found[1]] = unparse(trees[0])
        primes.add(found[2])
    if {*sides} != {*states} or len(primes) > 1:
        raise ValueError(
            f"Expected an equation for each of {', '.join(states)}, all of time derivatives or all "
            f"of next values, found those of {', '.join(sides)}."
        )
    return ", ".join(sides[name] for name in states), primes == {"'"}


def _program(
    files: Sequence[str],
    spec: StateSpec,
    given: Mapping[str, object],
    physics: tuple[str, str],
    options: Mapping[str, object],
) -> str:
    """Python code that does the same, and follows further actions."""
    states, actions = [*spec.states], [*spec.actions]
    angles = f", angles={[*spec.angles]!r}" if spec.angles else ""
    read = "".join(f"    {name}={value!r},\n" for name, value in given.items() if value is not None)
    chosen = "".join(f", {name}={value!r}" for name, value in options.items() if value is not None)
    imports = "from math import inf\n\n" if needs_inf(physics[1]) else ""
    return f"""\
{imports}import torch

{physics[0]}
from gpadjust.records import Records, identify
from gpadjust.states import StateSpec

spec = StateSpec({states!r}, {actions!r}, step={spec.step!r}{angles})
records = Records.read_csv(
    {[*files]!r},
    spec,
{read})
physics = {physics[1]}
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
