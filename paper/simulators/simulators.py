"""How often intervals of a simulator's parameters cover the true ones, and errors of free runs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.physics import Unknown
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import Identification, SmoothingWarning, identify
from paper.common.experiment import Run, Table
from paper.common.tables import markdown, number
from paper.simulators import Simulators
from paper.simulators.machines import MACHINES, STEP, Log, Machine, log_of

Ends = Mapping[str, tuple[float, float, float]]
"""Of each parameter the estimate, and the ends of its 95 % interval."""

_AT_REST = 1e-3  # sd of the first angles and rates, which are known
_FRICTION = Unknown(0.05, factor=3.0, unit="N m")  # where advice names it
_RANGE = 8.0  # times the guess, and a part of it: bounds of mujoco.sysid


def run(experiment: Simulators, machine: str, friction: str, method: str, seed: int) -> Run:
    """Identify a machine by its log; run the model of the estimates freely from the true state."""
    settings, known = experiment, MACHINES[machine]
    rows, ahead = settings.rows, settings.ahead
    log = log_of(known, friction == "lacking", rows + ahead, seed)
    begin = time.process_time()
    if method.startswith("sysid"):
        more = dict.fromkeys(known.friction, _FRICTION) if method == "sysid-told" else {}
        found = by_sysid(known, log, rows, more)
    else:
        found, more = by_identify(known, log, experiment, is_advised=method == "advised")
    seconds = time.process_time() - begin
    physics = known.physics(**more)
    values = torch.tensor([found[name][0] for name in physics.unknowns], dtype=torch.float64)
    angles = len(known.start)
    errors = []
    for parameters in (values, physics.unknowns.guess):
        state, squares = log.states[rows - 1 : rows], []
        for i in range(rows - 1, rows + ahead - 1):
            state = physics(torch.cat([state, log.torques[i : i + 1]], -1), parameters)
            squares.append((state - log.states[i + 1])[0, :angles].square().mean())
        errors.append(torch.stack(squares).mean().sqrt().item())
    return {
        "estimates": {name: [*found[name]] for name in found},
        "true": dict(log.true),
        "free_run": errors[0],
        "free_run_guesses": errors[1],
        "seconds": seconds,
    }


def by_identify(
    machine: Machine, log: Log, experiment: Simulators, *, is_advised: bool
) -> tuple[Ends, dict[str, Unknown]]:
    """Return intervals by the log but for its last rows; with friction, if that is the advice."""
    settings, spec = experiment, log.records.spec
    first = [*machine.start, *[0.0] * len(machine.start)]
    start = {name: (x, _AT_REST) for name, x in zip(spec.states, first, strict=True)}

    def identified(**more: Unknown) -> Identification:
        share = settings.ahead / (settings.rows + settings.ahead)
        physics = machine.physics(**more)
        options: Any = {"num_starts": settings.starts, "held_out": share, "start": start}
        return identify(log.records, physics, STEP, **options)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        found, more = identified(), dict[str, Unknown]()
        if is_advised and "dry friction" in str(found.lack):
            more = dict.fromkeys(machine.friction, _FRICTION)
            found = identified(**more)
    parameters = found.parameters
    assert parameters is not None, "there are unknowns"
    return _ends(parameters), more


def _ends(parameters: PhysicsParameters) -> Ends:
    columns = torch.stack([parameters.mean, *parameters.interval()], -1).tolist()
    return {name: (e, low, high) for name, (e, low, high) in zip(parameters, columns, strict=True)}


def by_sysid(machine: Machine, log: Log, rows: int, more: Mapping[str, Unknown]) -> Ends:
    """Return intervals by mujoco.sysid, which knows the first state.

    Its prediction of a sensor is stamped a simulation step late, and so are the measurements here.
    """
    import mujoco
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(machine.mjcf)
    model = spec.compile()
    dt, angles = model.opt.timestep, len(machine.start)
    times = np.arange(round(rows * STEP / dt)) * dt
    held: Tensor = log.torques[:rows].repeat_interleave(round(STEP / dt), 0)
    measured = log.records.records[0].states[:rows, :angles].numpy()
    parameters = sysid.ParameterDict()
    unknowns = {**machine.unknowns, **more}
    for name, unknown in unknowns.items():
        element, _, field = name.partition(".")
        bounds = unknown.guess / _RANGE, unknown.guess * _RANGE
        write = _write_mass if field == "mass" else _write_of_joint
        parameters.add(
            sysid.Parameter(
                name,
                unknown.guess,
                *bounds,
                modifier=lambda s, p, w=write, e=element, f=field: w(s, e, f, p.value[0]),
            )
        )
    sequences = sysid.ModelSequences(
        "machine",
        spec,
        "log",
        sysid.create_initial_state(model, np.array(machine.start)),
        sysid.TimeSeries(times, held.numpy()),
        sysid.TimeSeries.from_names(STEP * np.arange(rows) + dt, measured, model),
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    with redirect_stdout(StringIO()):  # its iterations
        best, result = sysid.optimize(parameters, residual, verbose=False)
    residuals, _, _ = residual(result.x, best)
    _, widths = sysid.calculate_intervals(residuals, result.jac)
    triples = zip(result.x.tolist(), np.asarray(widths).tolist(), strict=True)
    return {name: (x, x - w, x + w) for name, (x, w) in zip(unknowns, triples, strict=True)}


def _write_mass(spec: Any, body: str, field: str, value: float) -> None:
    spec.body(body).geoms[0].mass = value


def _write_of_joint(spec: Any, joint: str, field: str, value: float) -> None:
    element = spec.joint(joint)
    polynomial = np.ravel(getattr(element, field))  # since MuJoCo 3.6 of three coefficients
    polynomial[0] = value
    setattr(element, field, polynomial if len(polynomial) > 1 else value)


def tables(runs: Sequence[Run], experiment: Simulators) -> dict[str, Table]:
    """Return a table of each machine and friction: a row for each method and parameter."""
    found = load(runs)
    header = ["", "parameter", "logs", "95 % coverage", "median half width [%]"]
    header += ["median error [%]", "free run: median RMSE [rad]", "by the guesses", "CPU [s]"]
    shown = {}
    for machine, title in experiment.axes["machine"].items():
        for friction, kind in experiment.axes["friction"].items():
            part = found[(found["machine"] == machine) & (found["friction"] == friction)]
            if len(part):
                rows = _rows(part, experiment)
                table = Table(f"{title}: {kind}", markdown(header, rows))
                shown[f"{machine}-{friction}"] = table
    return shown


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """Return a row for each parameter of each log and method."""
    rows = []
    for each in runs:
        keys = ("machine", "friction", "method", "free_run", "free_run_guesses", "seconds")
        for name, true in each["true"].items():
            estimate, low, high = each["estimates"][name]
            row = {"parameter": name, "covers": float(low <= true <= high)}
            row |= {"width": 50 * (high - low) / true, "error": 100 * abs(estimate / true - 1)}
            rows.append({**{key: each[key] for key in keys}, **row})
    return pd.DataFrame(rows)


def _rows(found: pd.DataFrame, experiment: Simulators) -> list[list[str]]:
    rows = []
    for method, label in experiment.axes["method"].items():
        own = found[found["method"] == method]
        for i, (parameter, part) in enumerate(own.groupby("parameter", sort=False)):
            of_parameter = [
                *(label if i == 0 else "", str(parameter), f"{len(part)}"),
                number(part["covers"].mean(), ".2f"),
                number(part["width"].median(), ".2g"),
                number(part["error"].median(), ".2g"),
            ]
            whole = [number(part[key].median(), ".2g") for key in ("free_run", "free_run_guesses")]
            whole.append(number(part["seconds"].median(), ".2g"))
            rows.append([*of_parameter, *(whole if i == 0 else [""] * 3)])
    return rows
