"""Learn from the first part of a record, choose there, and follow its rest without looking.

Parts are those of PR-SSM's code (boschresearch/PR-SSM at 87d2488: 500, 148 and 250 rows teach), of
the tanks those of RGP's (1,250 rows), and errors are in the unit of the file, as there. A free run
begins at the last row that was learnt from and reads no output of the test part; those of PR-SSM
read its first 16.

f_p, its process noise, the number of earlier actions that a GP reads, and the learner that the
verdicts are of are those with the least error of two folds of the training part: its first half
teaches, its third quarter is followed; its first three quarters teach, its last quarter is
followed. Tried by these folds before the first run, and not kept: of the ball a level, a bent beam
and a lag, GPs of 2 to 5 outputs or 30 actions; of the tanks a constant inflow and levels of the
outlets. The furnace's test part was seen in a trial run of 40 transitions, other test parts and the
upper level in a plot of the files.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.core import SamplingWarning
from gpadjust.dynamics import FreeRun, LearnedDynamics, PhysicsDynamics
from gpadjust.records import SmoothedRecords, SmoothingWarning, smooth
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.tables import markdown, number
from paper.common.verdicts import Difference
from paper.published import AFTER, FREE_GPS, RECORDS, Freeruns, FreerunsSettings
from paper.published.freeruns_systems import SYSTEMS, narx_spec, records

PUBLISHED = {
    "DKF": (0.144, 5.589, 0.735),
    "vGPSSM": (0.268, 3.676, 0.740),
    "CO-GPSSM": (0.079, 1.898, 0.736),
    "ODGPSSM": (0.068, 1.704, 0.708),
    "VCDT": (0.065, 2.052, 0.735),
    "AD-EnKF": (0.057, 1.408, 0.756),
    "PR-SSM": (0.074, 1.503, 0.647),
    "EnVI": (0.055, 1.388, 0.703),
}
"""Errors of ball and beam, furnace and drive in table II of Lin et al. 2024 (arXiv 2312.05910)."""
_ROWS = 250  # of a path that is kept
Candidate = tuple[str, str]


@cache
def smoothed(
    record: str, candidate: Candidate, rows: int, settings: FreerunsSettings
) -> SmoothedRecords:
    """States and parameters by the first rows of a record."""
    system, (name, noise) = SYSTEMS[record], candidate
    structure = system.structure(name)
    scatter = structure.noises[noise]
    given: dict[str, Any] = {}
    if scatter is not None:
        whole = (*scatter, *[1.0] * structure.delay)  # earlier actions have none
        given["process_noise"] = torch.tensor(whole, dtype=torch.float64)
    output = system.column(system.output)[:rows, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return smooth(
            records(output, system.column(system.action)[:rows], structure.spec()),
            structure.physics(),
            start=structure.start,
            num_starts=settings.starts,
            max_rounds=settings.rounds,
            **given,
        )


def path(
    record: str, candidate: Candidate, rows: int, end: int, settings: FreerunsSettings
) -> Tensor:
    """States of f_p alone, without noise, from the last of the first rows on: ``n x d``."""
    structure, actions = SYSTEMS[record].structure(candidate[0]), _actions(record)
    known = smoothed(record, candidate, rows, settings)
    f_p = structure.physics(known.physics_parameters.mean.tolist())
    step = PhysicsDynamics(structure.spec(), f_p).mean_function()
    state, found = _last(record, candidate, rows, 0, settings), []
    for action in actions[rows - 1 : end - 1]:
        state = step(state[None], action.view(1, 1, 1))[0]
        found.append(state)
    return torch.cat(found)[:, : len(structure.states)]


@cache
def chosen(record: str, settings: FreerunsSettings) -> tuple[Candidate, dict[str, list[float]]]:
    """The candidate with the least error of the folds, and the errors of all."""
    system, errors = SYSTEMS[record], dict[Candidate, list[float]]()
    for name, structure in system.structures.items():
        for noise in structure.noises:
            found = []
            for rows, end in system.folds():
                try:
                    followed = path(record, (name, noise), rows, end, settings)[:, 0]
                    found.append(_error(record, followed, rows, end))
                except RuntimeError:  # states that diverged
                    found.append(math.inf)
            errors[name, noise] = found
    best = min(errors, key=lambda candidate: _mean_square(errors[candidate]))
    return best, {f"{name}; {noise}": found for (name, noise), found in errors.items()}


def run(experiment: Freeruns, record: str, learner: str, seed: int) -> Run:
    """Choose by the folds, learn from the training part, and follow the rest."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings, system = experiment.settings, SYSTEMS[record]
    begin = time.perf_counter()
    end = len(system.column(system.output))
    if learner == AFTER:
        candidate, errors = ("equal holes", "even"), dict[str, list[float]]()
        name = "; ".join(candidate)
        errors[name] = [
            _error(record, path(record, candidate, *fold, settings)[:, 0], *fold)
            for fold in system.folds()
        ]
    else:
        candidate, errors = chosen(record, settings)
    if learner in ("fitted", AFTER):
        free = _free_run_of_physics(record, candidate, system.train, end, settings)
        mean = path(record, candidate, system.train, end, settings)
        found = _scores(record, mean[:, 0], free, end)
        found |= {"folds": errors, "chosen": "; ".join(candidate)}
        found["cv"] = _mean_square(errors["; ".join(candidate)])
        of = smoothed(record, candidate, system.train, settings).physics_parameters
        ends = torch.stack([of.mean, *of.interval()]).T.tolist()
        found["parameters"] = dict(zip(of, ends, strict=True))
        if system.hidden is not None:
            found["hidden"] = _hidden(record, candidate, mean, settings)
    else:
        options = system.narx if learner == "gp" else system.earlier
        tried: dict[str, list[float]] = {}
        for option in options:
            tried[str(option)] = []
            for fold in system.folds():
                ahead = _learnt(record, learner, option, seed, *fold, settings)
                tried[str(option)].append(_error(record, ahead.mean[0, :, 0], *fold))
        best = min(options, key=lambda option: _mean_square(tried[str(option)]))
        free = _learnt(record, learner, best, seed, system.train, end, settings)
        found = _scores(record, free.mean[0, :, 0], free, end)
        found |= {"folds": tried, "chosen": str(best), "cv": _mean_square(tried[str(best)])}
    return {**found, "seconds": time.perf_counter() - begin}


def _learnt(
    record: str, learner: str, option: Any, seed: int, rows: int, end: int,
    settings: FreerunsSettings,
) -> FreeRun:  # fmt: skip
    """A free run of a GP: without f_p it reads outputs and actions, beside f_p its states."""
    system, actions = SYSTEMS[record], _actions(record)
    if learner == "gp":
        spec = narx_spec(*option)
        output = system.column(system.output)
        known, states = None, output[:rows, None]
        dynamics = LearnedDynamics(spec, model=ZeroMeanGP)
        columns = [output[rows - 1 - k] for k in range(option[0])]
        columns += [actions[rows - 1 - k] for k in range(1, option[1])]
        start, given = torch.stack(columns)[None], dict[str, Any](start_noise="learnt")
    else:
        candidate, _ = chosen(record, settings)
        structure = system.structure(candidate[0])
        spec, known = structure.spec(option), smoothed(record, candidate, rows, settings)
        states = known.draw(seed).records[0].states[:, : len(structure.states)]
        f_p = structure.physics(known.physics_parameters.mean.tolist())
        model = PhysicsMeanGP if learner == "delta" else CKA
        dynamics = LearnedDynamics(spec, f_p, model=model)
        start = _last(record, candidate, rows, option, settings)
        given = _noises(known, len(structure.states), spec.state_dim)
        given["process_noise"] = "learnt"
    taught = actions[
        rows - len(states) : rows
    ]  # smoothing leaves out rows whose action is not known
    data = records(states, taught, spec).trajectories()
    dynamics.update(*data.spread(min(settings.transitions, len(data.states)), seed))
    followed = actions[None, rows - 1 : end - 1, None]
    return dynamics.free_run(start, followed, num_functions=settings.num_functions, **given)


def _free_run_of_physics(
    record: str, candidate: Candidate, rows: int, end: int, settings: FreerunsSettings
) -> FreeRun:
    """Particles of f_p alone, with all noise but that of its parameters."""
    structure = SYSTEMS[record].structure(candidate[0])
    known, spec = smoothed(record, candidate, rows, settings), structure.spec()
    dynamics = PhysicsDynamics(spec, structure.physics(known.physics_parameters.mean.tolist()))
    return dynamics.free_run(
        _last(record, candidate, rows, 0, settings),
        _actions(record)[None, rows - 1 : end - 1, None],
        num_functions=settings.num_functions,
        process_noise=known.process_noise,
        **_noises(known, len(structure.states), spec.state_dim),
    )


def _noises(known: SmoothedRecords, moving: int, dim: int) -> dict[str, Any]:
    """Noise of sensors, and what is not known of the last state."""
    noise, start_noise = torch.zeros(2, dim, dtype=torch.float64)
    noise[:moving] = known.noise[:moving].nan_to_num()
    start_noise[:moving] = known.sd[0][-1, :moving]
    return {"noise": noise, "start_noise": start_noise}


def _last(
    record: str, candidate: Candidate, rows: int, earlier: int, settings: FreerunsSettings
) -> Tensor:
    """The last smoothed state with earlier actions, ``1 x state_dim``."""
    structure, actions = SYSTEMS[record].structure(candidate[0]), _actions(record)
    known = smoothed(record, candidate, rows, settings)
    state = known.records.records[0].states[-1, : len(structure.states)]
    lags = [actions[rows - 1 - k] for k in range(1, max(earlier, structure.delay) + 1)]
    return torch.cat([state, torch.stack(lags)] if lags else [state])[None]


def _actions(record: str) -> Tensor:
    return SYSTEMS[record].column(SYSTEMS[record].action)


def _error(record: str, followed: Tensor, rows: int, end: int) -> float:
    output = SYSTEMS[record].column(SYSTEMS[record].output)[rows:end]
    return float((followed - output).square().mean().sqrt())


def _mean_square(errors: Sequence[float]) -> float:
    """The root mean square of errors; infinite if one is not finite."""
    found = math.sqrt(sum(e**2 for e in errors) / len(errors))
    return found if math.isfinite(found) else math.inf


def _scores(record: str, mean: Tensor, free: FreeRun, end: int) -> Run:
    """Error, coverage and half width, and some of the path."""
    system = SYSTEMS[record]
    output = system.column(system.output)[system.train : end]
    low, high = free.lower[0, :, 0], free.upper[0, :, 0]
    every = _every(output)
    kept = {"mean": mean, "low": low, "high": high}
    return {
        "rmse": _error(record, mean, system.train, end),
        "coverage": float(((low <= output) & (output <= high)).double().mean()),
        "half_width": float((high - low).mean() / 2),
        "path": {k: [round(x, 5) for x in v[::every].tolist()] for k, v in kept.items()},
    }


def _every(path: Tensor) -> int:
    """Of so many rows of a path one is kept."""
    return -(-len(path) // _ROWS)


def _hidden(record: str, candidate: Candidate, mean: Tensor, settings: FreerunsSettings) -> Run:
    """Errors of the hidden state in parts of its range, smoothed and in the free run."""
    system = SYSTEMS[record]
    assert system.hidden is not None
    column, name = system.hidden
    known = smoothed(record, candidate, system.train, settings)
    place = system.structure(candidate[0]).states.index(name)
    truth = system.column(column)
    span = float(truth.max() - truth.min())
    off = known.records.records[0].states[:, place] - truth[: system.train]
    ahead = mean[:, place] - truth[system.train :]
    every = _every(ahead)
    return {
        "smoothed": float(off.square().mean().sqrt()) / span,
        "ahead": float(ahead.square().mean().sqrt()) / span,
        "coverage": float((off.abs() <= 1.96 * known.sd[0][:, place]).double().mean()),
        "path": [round(x, 4) for x in mean[::every, place].tolist()],
    }


def tables(runs: Sequence[Run], experiment: Freeruns) -> dict[str, Table]:
    """All tables, by name."""
    return {
        "errors": Table("RMSE of free runs along the test part", _errors(runs, experiment)),
        "details": Table("Learners of each record", _details(runs, experiment)),
        "candidates": Table("Candidates for f_p, errors of the folds", _candidates(runs)),
    }


def _of(runs: Sequence[Run], record: str, learner: str) -> list[Run]:
    return [each for each in runs if (each["record"], each["learner"]) == (record, learner)]


def _mean(own: Sequence[Run], name: str) -> float:
    values = [math.inf if each[name] is None else each[name] for each in own]
    return sum(values) / len(values)


def best_of(runs: Sequence[Run], record: str) -> str:
    """The learner with the least error of the folds, in the mean over draws."""
    learners = [name for name in ("fitted", *FREE_GPS) if _of(runs, record, name)]
    return min(learners, key=lambda name: _mean(_of(runs, record, name), "cv"))


def _errors(runs: Sequence[Run], experiment: Freeruns) -> str:
    """A row for each learner, a column for each record."""
    names = [name for name in RECORDS if any(each["record"] == name for each in runs)]
    rows = []
    for learner, label in experiment.axes["learner"].items():
        cells = []
        for name in names:
            text = _with_error(_of(runs, name, learner), "rmse")
            cells.append(f"**{text}**" if best_of(runs, name) == learner else text)
        rows.append([label, *cells])
    trivial = []
    for name in names:
        output, train = SYSTEMS[name].column(SYSTEMS[name].output), SYSTEMS[name].train
        trivial.append(_number((output[train:] - output[:train].mean()).square().mean().sqrt()))
    rows.append(["mean of the training part", *trivial])
    for method, errors in PUBLISHED.items():
        shown = dict(zip(RECORDS, errors, strict=False))
        cells = [number(shown[name], ".3f") if name in shown else "not found" for name in names]
        rows.append([f"{method}, published", *cells])
    units = [f"{RECORDS[n]}" + f", {SYSTEMS[n].unit}" * bool(SYSTEMS[n].unit) for n in names]
    return markdown(["RMSE", *units], rows)


def _number(value: Any) -> str:
    return number(float(value), ".3f" if value < 10 else ".3g")


def _with_error(own: Sequence[Run], name: str) -> str:
    if not own:
        return ""
    found = Difference.of([math.inf if each[name] is None else each[name] for each in own])
    several = math.isfinite(found.error) and found.error > 1e-9  # equal where all rows are learnt
    error = f" ± {found.error:.1g}" if several else ""
    return _number(found.mean) + error


def _details(runs: Sequence[Run], experiment: Freeruns) -> str:
    rows = []
    for record, learner in product(RECORDS, experiment.axes["learner"]):
        if not (own := _of(runs, record, learner)):
            continue
        label = experiment.axes["learner"][learner]
        kinds = ", ".join(dict.fromkeys(each["chosen"] for each in own))
        rows.append(
            [
                RECORDS[record],
                f"**{label}**" if best_of(runs, record) == learner else label,
                kinds,
                f"{len(own)}",
                _with_error(own, "cv"),
                _with_error(own, "rmse"),
                number(np.mean([each["coverage"] for each in own]), ".2f"),
                _number(np.mean([each["half_width"] for each in own])),
                number(np.mean([each["seconds"] for each in own]), ".0f"),
            ]
        )
    header = ["record", "learner", "chosen", "runs", "folds, RMSE", "test, RMSE", "95 % hold"]
    return markdown([*header, "half width of 95 %", "seconds"], rows)


def _candidates(runs: Sequence[Run]) -> str:
    rows = []
    for record, label in RECORDS.items():
        for own in _of(runs, record, "fitted"):
            for name, errors in own["folds"].items():
                shown = ["diverged" if e is None or e > 1e3 else _number(e) for e in errors]
                bold = f"**{name}**" if name == own["chosen"] else name
                rows.append([label, bold, *shown])
    return markdown(["record", "f_p; process noise", "third quarter", "last quarter"], rows)


def draw(runs: Sequence[Run], experiment: Freeruns) -> list[Path]:
    """Draw the free run of the chosen learner of each record, and the hidden level."""
    names = [name for name in RECORDS if any(each["record"] == name for each in runs)]
    titles = [f"{RECORDS[n]}: {experiment.axes['learner'][best_of(runs, n)]}" for n in names]
    hidden = [own for own in _of(runs, "tanks", "fitted") if "hidden" in own]
    after = _of(runs, "tanks", AFTER)
    titles += ["two tanks: upper level, hidden; f_p"] * bool(hidden)
    figure, axes = panels(titles, 2, (5.0, 2.3), share=False)
    for ax, name in zip(axes, names, strict=False):
        system = SYSTEMS[name]
        shown = _of(runs, name, best_of(runs, name))[0]["path"]
        measured = system.column(system.output)[system.train :]
        rows = _every(measured) * np.arange(len(shown["mean"]))
        ax.fill_between(rows, shown["low"], shown["high"], color="tab:blue", alpha=0.25, lw=0,
                        label="95 %")  # fmt: skip
        ax.plot(rows, shown["mean"], color="tab:blue", label="free run")
        _measured(ax, measured, system.unit)
    for known in hidden:
        measured = SYSTEMS["tanks"].column("y2")[SYSTEMS["tanks"].train :]
        for later, color in ((known, "tab:blue"), *((r, "tab:red") for r in after)):
            path_of = later["hidden"]["path"]
            rows = _every(measured) * np.arange(len(path_of))
            label = "free run" if later is known else "free run, equal holes (afterwards)"
            axes[-1].plot(rows, path_of, color=color, label=label)
        _measured(axes[-1], measured, "V")
    one_legend(figure, axes)
    return [save(figure, experiment.out / "freeruns.png")]


def _measured(ax: Any, values: Tensor, unit: str) -> None:
    ax.plot(values.tolist(), color="black", lw=0.9, ls="--", label="measured")
    low, high = float(values.min()), float(values.max())
    ax.set_ylim(low - 0.6 * (high - low), high + 0.6 * (high - low))
    ax.set(xlabel="row of the test part", ylabel=unit)
