"""Advice on a log, and on the parameters that it determines: sentences, and combinations."""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.display import text_table
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records.records import Records
from gpadjust.words import number

_VARIES = 1e-3  # share of the variance of an action that is within steps
_NEAR_A_TURN = 0.12
_TURNS = {2 * math.pi: "add it to `angles`", 360.0: "convert it to rad, and add it to `angles`"}
_OUTLYING = 20.0  # robust standard deviations of changes, by which a row is off both neighbours
_NAMED = 5  # rows in a sentence
_FAR = 3.0  # standard deviations of a prior
_WIDER = 1.5  # an interval that allows for missing forces, in place of the one that does not
_UNSURE = 0.05  # of a prior's standard deviation: uncertainty that matters
_MOVES = 0.01  # of a state's changes in a step: process noise that matters
_TOGETHER = 0.95  # a correlation of two parameters, in logarithms
_CLEARER = 0.15  # of the least standard deviation of the two: that of their combination
_POWERS = ((1, -1), (1, 1), (1, -2), (1, 2), (2, -1), (2, 1))


def on_log(records: Records, step: float) -> list[str]:
    """Return sentences on actions that vary within a step, jumps by a turn, and outliers."""
    return [*on_actions(records, step), *on_turns(records), *on_outliers(records)]


def on_actions(records: Records, step: float) -> list[str]:
    """Return a sentence if actions vary within control steps, over which they are averaged."""
    size = round(step / records.records[0].sampling_step)
    if size <= 1:
        return []
    shares = []
    for record in records:
        steps = record.actions[: len(record.actions) // size * size].unflatten(0, (-1, size))
        shares.append(steps.var(1, correction=0).nanmean(0) / record.actions.var(0, correction=0))
    if torch.cat(shares).nan_to_num().max() <= _VARIES:
        return []
    return [
        f"The actions vary within a step of {size} samples, over which they are averaged: "
        "parameters and their intervals may be off. Give an ODEPhysics the step of the samples, "
        "which follows each action, or take a shorter step and compare."
    ]


def on_turns(records: Records) -> list[str]:
    """Return sentences on states that jump by a turn."""
    sentences = []
    for i, name in enumerate(records.spec.states):
        if name in records.spec.angles:
            continue
        values = torch.cat([record.states[:, i] for record in records])
        values = values[~values.isnan()]
        moves = [record.states[:, i].diff() for record in records]
        for turn, way in _TURNS.items():
            # An angle that is wrapped has values within a turn, and jumps back as it moves on.
            if len(values) == 0 or values.max() - values.min() > (1 + _NEAR_A_TURN) * turn:
                continue
            is_slow = torch.cat(moves).abs().nanmedian() < 0.1 * turn
            if is_slow and sum(_returns(move, turn) for move in moves) > 0:
                sentences.append(f"{name} jumps by a turn: if it is an angle, {way}.")
    return sentences


def _returns(moves: Tensor, turn: float) -> float:
    """Return by how much the moves beside jumps by a turn go against these."""
    jumps = moves.sign().where((moves.abs() / turn - 1).abs() < _NEAR_A_TURN, 0.0)
    moves = moves.nan_to_num()
    return -float((jumps[1:] * moves[:-1]).sum() + (jumps[:-1] * moves[1:]).sum())


def on_outliers(records: Records) -> list[str]:
    """Return sentences on rows that are far off both neighbours, on the same side."""
    spec = records.spec
    sentences = []
    moves = [spec.change(record.states[:-1], record.states[1:]) for record in records]
    # Robust standard deviations of the changes: 1.4826 medians of their sizes
    far = _OUTLYING * 1.4826 * torch.cat(moves).abs().nanmedian(0).values
    for i, name in enumerate(spec.states):
        rows = []
        for record, move in zip(records, moves, strict=True):
            there, back = move[:-1, i], -move[1:, i]
            # The nearer neighbour is `far` below, or above
            off = torch.minimum(there, back).maximum(-torch.maximum(there, back))
            places = (off > far[i]).nonzero().flatten() + 1
            rows += [f"{row} of {record.name!r}" for row in places.tolist()]
        if not rows or far[i] <= 0:
            continue
        text = ", ".join(rows[:_NAMED])
        if len(rows) > _NAMED:
            text += f" and {len(rows) - _NAMED} more"
        sentences.append(
            f"{name} is far off both neighbours, by more than {_OUTLYING:g} times its usual "
            f"change, in row {text}: one such outlier can spoil all estimates. If the sensor "
            "failed there, make it NaN."
        )
    return sentences


def on_parameters(parameters: PhysicsParameters) -> list[str]:
    """Return sentences on parameters that contradict their prior, or that the log leaves open."""
    sentences = []
    for name, unknown in parameters.unknowns.items():
        off = float(unknown.coordinate(parameters[name]).mean().abs())
        if off > _FAR:
            sentences.append(
                f"{name} is {off:.1f} standard deviations of its prior from its guess: a sign, a "
                "unit, or a physics that lacks something?"
            )
    untold = "The log hardly constrains {}: it stays as known before."
    return [*sentences, *map(untold.format, parameters.untold)]


def on_forces(parameters: PhysicsParameters, robust: PhysicsParameters) -> list[str]:
    """Return a sentence on parameters that a force which may be missing makes uncertain."""
    low, high = robust.interval()
    times = robust.sd / parameters.sd
    wider = []
    for i, name in enumerate(parameters):
        z = parameters.unknowns[name].coordinate(robust[name])
        if times[i] > _WIDER and z.std() > _UNSURE:
            wider.append(f"{name} {low[i]:.3g} to {high[i]:.3g} ({times[i]:.2g} times as wide)")
    if not wider:
        return []
    return [
        "The intervals of parameters take errors of the equations for noise of each step. If they "
        f"lack a force that depends on the states, as large as the process noise, the log tells "
        f"{', '.join(wider)}. Dry friction, for one, is hard to tell from damping."
    ]


def on_process_noise(
    smoothed: Records, noise: Tensor, process_noise: Tensor, has_cause: bool
) -> list[str]:
    """Return sentences on process noise that is larger than the noise of the sensor."""
    cause = "it stands for what the equations lack, and falls with it"
    if not has_cause:
        cause = (
            "no state, action or lag explains it. Look for an input that was not logged; vibration "
            "or weather it may be, too, which the intervals then allow for"
        )
    changes = torch.cat([record.states.diff(dim=0) for record in smoothed])
    matters = _MOVES * changes.square().mean(0).sqrt()
    return [
        f"Process noise of {name} is {process_noise[i]:.2g} a step, "
        f"{process_noise[i] / noise[i]:.2g} times the noise of its sensor: {cause}."
        for i, name in enumerate(smoothed.spec.states)
        if process_noise[i] > noise[i] and process_noise[i] >= matters[i]  # false of hidden states
    ]


class Combination(NamedTuple):
    """A product of powers of two parameters that the log tells better than either of them."""

    name: str  # such as "k/J"
    first: str
    second: str
    unit: str
    draws: Tensor  # K

    def __str__(self) -> str:
        """Return a sentence on the value by the log."""
        low, middle, high = self._ends
        return (
            f"The log tells {self.name}, {middle:.4g} [{low:.4g}, {high:.4g}], and hardly "
            f"{self.first} and {self.second} each. Measure one of them, and the other follows."
        )

    def __repr__(self) -> str:
        return f"Combination({' '.join(self.row)})".replace(" )", ")")

    @property
    def row(self) -> tuple[str, str, str, str]:
        """Name, median, central interval of 95 % and unit."""
        low, middle, high = (number(end, 4) for end in self._ends)
        return self.name, middle, f"{low} to {high}", self.unit

    @property
    def _ends(self) -> list[float]:
        """The ends of the central 95 %, and the median between them."""
        ends: list[float] = self.draws.quantile(self.draws.new_tensor([0.025, 0.5, 0.975])).tolist()
        return ends


class Combinations(list[Combination]):
    """Combinations, printed as a table of names, medians, intervals and units."""

    def __repr__(self) -> str:
        if not self:
            return "[]"
        head = ("", "median", "95 % interval", "unit")
        return text_table([head, *(combination.row for combination in self)])


def combinations_of(parameters: PhysicsParameters) -> Combinations:
    """Return the clearest combination of parameters that are only known together, tree by tree."""
    clear = []
    numbers = [name for name, unknown in parameters.unknowns.items() if not unknown.function_of]
    names = [name for name in numbers if (parameters[name] > 0).all()]
    for first, second in combinations(names, 2):
        logs = torch.stack([parameters[first], parameters[second]]).log()
        sd = logs.std(1)
        if sd.min() == 0 or logs.corrcoef()[0, 1].abs() <= _TOGETHER:
            continue
        sizes = [(p * logs[0] + q * logs[1]).std() / math.hypot(p, q) for p, q in _POWERS]
        least = min(range(len(sizes)), key=sizes.__getitem__)
        if sizes[least] < _CLEARER * sd.min():
            clear.append((float(sizes[least] / sd.min()), first, second, _POWERS[least]))
    combined = Combinations()
    group = {name: name for name in names}
    for _, first, second, (p, q) in sorted(clear):
        if group[first] == group[second]:  # it follows from others
            continue
        joined = [name for name in names if group[name] == group[second]]
        group |= dict.fromkeys(joined, group[first])
        powers = parameters[first] ** p * parameters[second] ** q
        units = [_bracketed(parameters.unknowns[name].unit) for name in (first, second)]
        unit = _product(units[0], units[1], p, q) if all(units) else ""
        combined.append(Combination(_product(first, second, p, q), first, second, unit, powers))
    return combined


def _product(first: str, second: str, p: int, q: int) -> str:
    """Return such as ``k/J`` and ``k²*J``."""
    powers = {1: "", 2: "²"}
    sign = "/" if q < 0 else "*"
    return f"{first}{powers[p]}{sign}{second}{powers[abs(q)]}"


def _bracketed(unit: str) -> str:
    return f"({unit})" if {" ", "/"} & {*unit} else unit
