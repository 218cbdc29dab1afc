"""Identification of a machine by its log, and the free run that judges it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from typing import Any, NamedTuple

import torch
from scipy.stats import t
from torch import Tensor

import gpadjust
from gpadjust.checks import checked_number, checked_whole
from gpadjust.display import Display, html_table
from gpadjust.dynamics import FreeRun, IdentifiedDynamics, PhysicsDynamics, Windows
from gpadjust.dynamics.physics_dynamics import one_physics
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records.lack import Lack, clearest_lack, robust_moments
from gpadjust.records.records import Records, control_steps
from gpadjust.records.smoothing import (
    SmoothedRecords,
    SmoothingWarning,
    drawn_parameters,
    smooth,
)
from gpadjust.states import Sensors, StateSpec
from gpadjust.words import listed, number, percent

GUESSES = "guesses"
IDENTIFIED = "identified"
PERSISTENCE = "persistence"
FEW = 0.9  # of measurements in intervals of 95 %
_NO_NOISE = 1e-100  # standard deviation: the smoother takes the least that it computes with
_LEAST = 8  # steps of a stretch, of which the last part is held out
_FAR = 3.0  # standard deviations of a prior
_VARIES = 1e-3  # share of the variance of an action that is within steps
_NEAR_A_TURN = 0.12
_TOGETHER = 0.95  # a correlation of two parameters, in logarithms
_CLEARER = 0.15  # of the least standard deviation of the two: that of their combination
_POWERS = ((1, -1), (1, 1), (1, -2), (1, 2), (2, -1), (2, 1))
_MORE = 0.1  # of the measurements in intervals: clearly more
_BLOCKS = 5  # of a window, whose errors are compared
_LARGE = 2.0  # times the noise of the sensor: an error that something missing may have made
_WIDER = 1.5  # an interval that allows for missing forces, in place of the one that does not
_OUTLYING = 20.0  # robust standard deviations of changes, by which a row is off both neighbours
_TURNS = {2 * math.pi: "add it to `angles`", 360.0: "convert it to rad, and add it to `angles`"}
_NAMED = 5  # rows in a sentence
_UNSURE = 0.05  # of a prior's standard deviation: uncertainty that matters
_MOVES = 0.01  # of a state's changes in a step: process noise that matters

_UNSETTLED = (
    "The search for states and parameters did not settle, so that all of this may change: raise "
    "num_starts, give narrower priors, or a start of hidden states."
)
_BY = {False: "no less", True: "less by chance"}
_OTHERS = {GUESSES: "the guesses", PERSISTENCE: "a state that stays"}
_ENDS = torch.tensor([0.025, 0.5, 0.975])


class Combination(NamedTuple):
    """A product of powers of two parameters that the log tells better than either of them."""

    name: str  # such as "k/J"
    first: str
    second: str
    unit: str
    draws: Tensor  # K

    def __str__(self) -> str:
        """Return a sentence on the value by the log."""
        low, mid, high = self.draws.quantile(_ENDS.to(self.draws)).tolist()
        return (
            f"The log tells {self.name}, {mid:.4g} [{low:.4g}, {high:.4g}], and hardly "
            f"{self.first} and {self.second} each. Measure one of them, and the other follows."
        )


@dataclass(frozen=True, repr=False, eq=False)
class Identification(Display):
    """A machine as its log shows it, as :func:`identify` finds it.

    Attributes:
        smoothed: States, parameters and noises, by all but the last part of the log.
        dynamics: The physics, whose sampled functions have parameters drawn from their posterior.
        windows: The last part, held out: one window from the last smoothed state of each long
            stretch.
        runs: Free runs along the windows: ``"identified"``, whose ``mean`` is the path by
            ``parameters.center`` without noise, and ``"guesses"`` by the parameters that were
            guessed, if there are any.
        step: The step of the dynamics, in the unit of the times: the control step, or that of a
            physics which makes several of them in a control step.
        remarks: Sentences on the log itself: gaps, actions that vary within a step, angles that
            jump.
    """

    smoothed: SmoothedRecords
    dynamics: IdentifiedDynamics
    windows: Windows
    runs: Mapping[str, FreeRun]
    step: float
    remarks: tuple[str, ...] = ()
    _again: Callable[[], Identification] | None = None  # by free runs

    def task(self, reward: Callable[[Tensor, Tensor, Tensor], Tensor], **options: Any) -> Any:
        """Return a task in these dynamics, for :class:`~gpadjust.control.MPC` or an agent.

        Args:
            reward: As of :class:`~gpadjust.control.Task`.
            options: The other arguments of a task. ``state_bounds`` are by default the range of the
                states in the log, and as much again on either side; angles have none. If states
                are hidden, ``sensors`` are by default those of the log, with its noise, for
                measurements corrected by their gain and offset, and ``initial_states`` any states
                of the log.
        """
        states = torch.cat([record.states for record in self.smoothed.records])
        low, high = states.amin(0), states.amax(0)
        bounds = torch.stack([2 * low - high, 2 * high - low])
        bounds[:, self.spec.angle_columns] = torch.tensor([[-math.inf], [math.inf]]).to(bounds)
        defaults: dict[str, Any] = {"state_bounds": bounds}
        if self.hidden:
            pairs = zip(self.spec.states, self.smoothed.noise.tolist(), strict=True)
            noise = {name: sd for name, sd in pairs if name not in self.hidden}
            defaults["sensors"] = Sensors([*noise], noise=noise)
            defaults["initial_states"] = lambda n: states[torch.randint(len(states), (n,))]
        # An update sets attributes, so that a shallow copy leaves the identification as it is.
        return gpadjust.control.Task(copy(self.dynamics), reward, **defaults | options)

    @property
    def spec(self) -> StateSpec:
        """The names and kinds of states and actions."""
        return self.smoothed.records.spec

    @property
    def parameters(self) -> PhysicsParameters | None:
        """The posterior of the unknown parameters of physics and sensors; None without any."""
        return self.smoothed.parameters if self.smoothed.chain.unknowns else None

    @cached_property
    def robust_parameters(self) -> PhysicsParameters | None:
        """The posterior that allows for smooth forces the equations lack; None without parameters.

        White process noise averages out, what equations lack does not: with dry friction missing,
        the damping stands for it, and its interval is too narrow. Here each equation also has a
        function of each state, twice as large as its process noise, which right equations lack.
        Of a fit to free runs, which has no process noise, it is the posterior as it is.
        """
        if self.parameters is None:
            return None
        chain, estimate = self.smoothed.chain, self.smoothed.estimate
        return drawn_parameters(
            chain.unknowns, *robust_moments(chain, estimate, self._control_step)
        )

    @property
    def hidden(self) -> list[str]:
        """The states that were not measured."""
        pairs = zip(self.spec.states, self.smoothed.noise.isnan().tolist(), strict=True)
        return [name for name, is_hidden in pairs if is_hidden]

    @property
    def errors(self) -> dict[str, Tensor]:
        """Root mean square errors of the runs, and of ``"persistence"``: the state stays.

        They are along the windows, ``state_dim``, NaN of hidden states.
        """
        return {
            name: self.spec.change(path, self.windows.measured).square().nanmean((0, 1)).sqrt()
            for name, path in self._paths.items()
        }

    @property
    def coverage(self) -> Tensor:
        """Shares of the measurements that the identified run's intervals cover, ``state_dim``."""
        run, measured = self.runs[IDENTIFIED], self.windows.measured
        # Of angles, the measured one within half a turn of the mean.
        measured = run.mean + self.spec.change(run.mean, measured)
        is_covered = (run.lower <= measured) & (measured <= run.upper)
        return is_covered.double().where(~measured.isnan(), torch.nan).nanmean((0, 1))

    @cached_property
    def lack(self) -> Lack | None:
        """What the equations lack most clearly, by what was learnt from; None if nothing."""
        return clearest_lack(self.smoothed.chain, self.smoothed.estimate, self._control_step)

    @cached_property
    def by_free_runs(self) -> Identification | None:
        """The identification with ``by_free_runs=True``; None if this is one, or none settled."""
        if self._again is None:
            return None
        with warnings.catch_warnings(), suppress(PhysicsError, RuntimeError, SmoothingWarning):
            warnings.simplefilter("error", SmoothingWarning)
            return self._again()
        return None

    @property
    def _control_step(self) -> float:
        return self.smoothed.records.records[0].sampling_step

    @property
    def combinations(self) -> list[Combination]:
        """Ratios and products of two parameters that the log tells better than these."""
        return _told_together(self.smoothed.parameters)

    @property
    def verdicts(self) -> dict[str, tuple[str, list[str]]]:
        """Whether the physics follows the log, by each state that was measured, and why.

        ``"Yes"`` if the free run has a smaller error than the guesses and than a state that stays,
        both beyond chance, the intervals cover 90 %, the search settled, and no error that is more
        than the sensor's has a cause that :attr:`lack` shows. ``"No"`` if its error is no smaller
        than that of a state that stays, or larger than the guesses' beyond chance; else
        ``"In part"``.
        """
        verdicts = {}
        errors = self.errors
        shares = self.coverage.tolist()
        for i, name in enumerate(self.spec.states):
            if math.isnan(shares[i]):
                continue
            error = errors[IDENTIFIED][i]
            reasons = [f"Intervals of 95 % cover {percent(shares[i])} of {name} there."]
            if not self.smoothed.is_settled:
                reasons.append(_UNSETTLED)
            if self.lack is not None and error > _LARGE * self.smoothed.noise[i]:
                reasons.append(str(self.lack))
            answer = "In part" if shares[i] < FEW or len(reasons) > 1 else "Yes"
            for other, words in _OTHERS.items():
                if other not in errors:
                    continue
                path = self._paths[other]
                is_less = bool(error < errors[other][i])
                if is_less and self._beats(path, i):
                    continue
                is_no = not is_less and (other == PERSISTENCE or self._beats(path, i, -1))
                answer = "No" if is_no or answer == "No" else "In part"
                reasons.append(f"Its error is {_BY[is_less]} than that of {words}.")
            verdicts[name] = answer, reasons
        return verdicts

    @property
    def _paths(self) -> dict[str, Tensor]:
        """Paths along the windows, ``w x T x state_dim``: those of the runs, and of persistence."""
        still = self.windows.initial_states.unsqueeze(1).expand_as(self.windows.measured)
        return {name: run.mean for name, run in self.runs.items()} | {PERSISTENCE: still}

    def _beats(self, other: Tensor, i: int, sign: int = 1) -> bool:
        """Return whether errors of state i are below another path's by blocks, beyond chance."""
        measured = self.windows.measured
        logs = list[Tensor]()
        for path in (self.runs[IDENTIFIED].mean, other):
            squares = self.spec.change(path, measured)[..., i].square()
            blocks = squares.tensor_split(min(_BLOCKS, squares.shape[1]), 1)
            errors = torch.cat([block.nanmean(1) for block in blocks])
            logs.append(errors.clamp(1e-300, 1e300).log())
        # One-sided t-test of the mean gain of a block
        gains = sign * (logs[1] - logs[0])
        gains = gains[~gains.isnan()]
        if len(gains) < 2:
            return False
        least = float(t.ppf(0.95, len(gains) - 1)) * gains.std() / math.sqrt(len(gains))
        return bool(gains.mean() > least)

    @property
    def advice(self) -> list[str]:
        """Sentences on the log, on parameters, and on errors that are too large."""
        sentences = [] if self.smoothed.is_settled else [_UNSETTLED]
        sentences += [*self.remarks, *_of_parameters(self.smoothed.parameters)]
        sentences += map(str, self.combinations)
        sentences += self._of_forces()
        if self.lack is not None:
            sentences.append(str(self.lack))
        sentences += self._of_noise()
        cause = (
            "the physics lacks something whose errors last longer than process noise (dry "
            "friction, an input), or has a sign or unit wrong"
        )
        if self.lack is None and self.smoothed.parameters.untold:
            untold = listed(self.smoothed.parameters.untold)
            cause = f"the log shows no lack of the physics, and does not tell {untold}"
        for i, share in enumerate(self.coverage.tolist()):
            if share < FEW:
                sentences.append(
                    f"Of {self.spec.states[i]} the intervals of 95 % cover {100 * share:.0f} % of "
                    f"what was held out: {cause}. Rely neither on them nor on those of the "
                    "parameters."
                )
                sentences += self._of_free_runs(i)
        return sentences

    def _of_forces(self) -> list[str]:
        """Return a sentence on parameters that a force which may be missing makes uncertain."""
        if self.parameters is None or self.robust_parameters is None:
            return []
        low, high = self.robust_parameters.interval()
        wider = []
        times = self.robust_parameters.sd / self.parameters.sd
        for i, name in enumerate(self.parameters):
            z = self.parameters.unknowns[name].coordinate(self.robust_parameters[name])
            if times[i] > _WIDER and z.std() > _UNSURE:
                wider.append(f"{name} {low[i]:.3g} to {high[i]:.3g} ({times[i]:.2g} times as wide)")
        return wider and [
            "The intervals of parameters take errors of the equations for noise of each step. If "
            "they lack a force that depends on the states, as large as the process noise, the log "
            f"tells {', '.join(wider)}. Dry friction, for one, is hard to tell from damping."
        ]

    def _of_noise(self) -> list[str]:
        """Return sentences on process noise that is larger than the noise of the sensor."""
        sentences = []
        moves = torch.cat([record.states.diff(dim=0) for record in self.smoothed.records])
        sizes = moves.square().mean(0).sqrt()
        noises = (self.smoothed.noise, self.smoothed.process_noise, sizes)
        for i, (noise, added, size) in enumerate(zip(*noises, strict=True)):
            if not added > noise or added < _MOVES * size:  # of hidden states it is NaN
                continue
            cause = "it stands for what the equations lack, and falls with it"
            if self.lack is None:
                cause = (
                    "no state, action or lag explains it. Look for an input that was not logged; "
                    "vibration or weather it may be, too, which the intervals then allow for"
                )
            name = self.spec.states[i]
            sentences.append(
                f"Process noise of {name} is {added:.2g} a step, {added / noise:.2g} times the "
                f"noise of its sensor: {cause}."
            )
        return sentences

    def _of_free_runs(self, i: int) -> list[str]:
        """Return a sentence if the fit by free runs predicts state i better."""
        other = self.by_free_runs
        if other is None:
            return []
        covers_more = other.coverage[i] - self.coverage[i] > _MORE
        if not covers_more and not other._beats(self.runs[IDENTIFIED].mean, i):
            return []
        errors = [number(fit.errors[IDENTIFIED][i]) for fit in (self, other)]
        shares = [percent(fit.coverage[i]) for fit in (self, other)]
        return [
            f"Fitted to free runs (`by_free_runs=True`) the physics has an error of {errors[1]} in "
            f"{self.spec.states[i]} in place of {errors[0]}, and its intervals of 95 % cover "
            f"{shares[1]} in place of {shares[0]}: what it lacks lasts longer than a step."
        ]

    def __repr__(self) -> str:
        """Parameters, noises and errors."""
        lines = [f"Identification by {self.smoothed!r}"]
        if self.parameters is not None:
            lines.append(repr(self.parameters))
        places = [i for i, name in enumerate(self.spec.states) if name not in self.hidden]
        names = ", ".join(self.spec.states[i] for i in places)
        steps = self.windows.measured.shape[1]
        lines.append(f"free run of {steps} steps, root mean square error ({names}):")
        for name, error in self.errors.items():
            lines.append(f"  {name}: {', '.join(f'{e:.3g}' for e in error[places].tolist())}")
        shares = ", ".join(f"{100 * share:.0f} %" for share in self.coverage[places].tolist())
        return "\n".join([*lines, f"  in intervals of 95 %: {shares}"])

    def _repr_html_(self) -> str:
        parameters = ""
        if self.parameters is not None:
            parameters = self.parameters._repr_html_()
        caption = f"Errors of free runs of {self.windows.measured.shape[1]} steps"
        columns = [*map(torch.Tensor.tolist, self.errors.values()), self.coverage.tolist()]
        rows = [
            [name, *map(number, errors), "hidden" if name in self.hidden else percent(share)]
            for name, *errors, share in zip(self.spec.states, *columns, strict=True)
        ]
        return parameters + html_table(caption, ["", *self.errors, "in 95 %"], rows)


def identify(
    records: Records,
    physics: Physics | Callable[[Tensor], Tensor],
    step: float | None = None,
    *,
    start: Mapping[str, tuple[float, float]] | None = None,
    held_out: float = 0.25,
    sensors: Sensors | None = None,
    by_free_runs: bool = False,
    num_starts: int | None = None,
    seed: int = 0,
) -> Identification:
    """Find parameters, noise and hidden states of a machine, and judge them by a free run.

    All but the last part of the records is smoothed (:func:`smooth`). A free run follows the
    actions from there to the end, and is compared with the measurements. Its particles start where
    the state may be, have parameters drawn from their posterior, and are moved by process noise.

    Args:
        records: The records, of states that all move. One that is NaN throughout is hidden.
        physics: The next states, as of :func:`smooth`.
        step: The control step, as of :meth:`Records.trajectories`.
        start: Of hidden states by name, mean and standard deviation at the beginning.
        held_out: The share of the longest stretch without gaps that is held out at its end; as many
            steps are at the end of each other stretch that has twice as many.
        sensors: As of :func:`smooth`. What was held out is corrected by the center of their gains,
            offsets and delays, so that all errors are of states.
        by_free_runs: If True, fit by least squares of free runs, without process noise. Where the
            physics is right nothing changes; where it lacks something that lasts, intervals of free
            runs cover more, and those of parameters, which take errors for white, are too narrow.
        num_starts: As of :func:`smooth`.
        seed: Seed of the free runs.

    Returns:
        The identification; :func:`gpadjust.report.report` makes a page of it.

    Raises:
        ValueError: If states are exogenous or previous values, the longest stretch has fewer than 8
            steps, ``held_out`` is not above 0 and at most 0.5.
        TypeError, PhysicsError, RuntimeError: As :func:`smooth`.

    Example:
        >>> import torch
        >>> from gpadjust import FormulaPhysics, ODEPhysics, Unknown
        >>> from gpadjust.records import Record, Records, identify
        >>> from gpadjust.states import StateSpec
        >>> t = 0.1 * torch.arange(60, dtype=torch.float64)
        >>> x = (1 - (-t).exp() + 0.01 * torch.randn(60).double()).unsqueeze(-1)
        >>> law = FormulaPhysics("u - k * x", ["x", "u"], unknowns={"k": Unknown(2.0, factor=2.0)})
        >>> log = Records(Record(t, x, torch.ones_like(x)), StateSpec(["x"], ["u"]))
        >>> errors = identify(log, ODEPhysics(law, step=0.1, state_dim=1)).errors
        >>> bool(errors["identified"] < 0.1 * errors["guesses"])
        True
    """
    steps = control_steps(records, step)
    spec = records.spec
    if len(spec.moving) < spec.state_dim:
        raise ValueError(
            "Expected states that all move, found exogenous ones or previous values; `smooth` "
            "takes these."
        )
    share = checked_number("held_out", held_out, above=0, most=0.5)
    checked_whole("seed", seed, 0)
    longest = max(len(stretch.times) - 1 for stretch in steps)
    if longest < _LEAST:
        raise ValueError(
            f"Expected a stretch of {_LEAST} control steps or more, to hold some out, found "
            f"{longest}; take a shorter step, or a longer log."
        )
    held = max(1, int(share * longest))
    f_p = one_physics(physics, spec, "identify one of them")
    beginnings = []
    ends = list[int]()
    for i, stretch in enumerate(steps):
        end = len(stretch.times)
        if end - 1 >= 2 * held:
            end -= held
            ends.append(i)
        beginnings.append(stretch.part(slice(end)))
    learnt_from = Records(beginnings, spec)
    process_noise = None
    if by_free_runs:
        process_noise = torch.full((spec.state_dim,), _NO_NOISE, dtype=torch.float64)
    fit: dict[str, Any] = {"start": start, "sensors": sensors, "num_starts": num_starts}
    smoothed = smooth(learnt_from, f_p, process_noise=process_noise, **fit)
    last = torch.stack([smoothed.records.records[i].states[-1] for i in ends])
    within = smoothed.chain.within.shape[1]  # steps of the physics in a control step
    actions, measured = list[Tensor](), list[Tensor]()
    for i in ends:
        stretch = steps.records[i]
        acting = stretch.within if within > 1 else stretch.actions.unsqueeze(1)
        actions.append(acting[-held - 1 : -1].flatten(0, 1))
        states = torch.full((held * within, spec.state_dim), torch.nan, dtype=torch.float64)
        states[within - 1 :: within] = smoothed.corrected(stretch.states)[-held:]
        measured.append(states)
    windows = Windows(last, torch.stack(actions), torch.stack(measured))
    length = steps.records[0].sampling_step / within
    spec = replace(spec, step=length)
    options: dict[str, Any] = {
        "start_noise": torch.stack([smoothed.sd[i][-1] for i in ends]).square().mean(0).sqrt(),
        "noise": smoothed.noise.nan_to_num(),
        "seed": seed,
    }
    runs = {}
    if f_p.unknowns:
        guesses = PhysicsDynamics(spec, f_p)
        runs[GUESSES] = guesses.free_run(last, windows.actions, **options)
    # A control step adds the process noise of its steps of the physics.
    process_noise = smoothed.process_noise / math.sqrt(within)
    dynamics = IdentifiedDynamics(
        spec, f_p, smoothed.physics_parameters, options["noise"], process_noise
    )
    # Paths of a skewed posterior are skewed about the one by its center, which judges.
    center = PhysicsParameters(f_p.unknowns, [*dynamics.physics_parameters.center.unsqueeze(-1)])
    at_center = IdentifiedDynamics(spec, f_p, center, options["noise"], process_noise)
    path = at_center.free_run(last, windows.actions, noise=False).mean
    options |= {"process_noise": process_noise, "num_functions": 199}
    run = dynamics.free_run(last, windows.actions, **options)._replace(mean=path)
    runs = {IDENTIFIED: run, **runs}
    remarks = []
    if len(steps) > len(records):
        remarks = [f"Gaps part the log into {len(steps)} stretches, each smoothed by itself."]
    remarks += [*_of_actions(records, length), *_of_jumps(records), *_of_outliers(records)]
    again = None
    if not by_free_runs:
        fit |= {"held_out": held_out, "by_free_runs": True, "seed": seed}
        again = partial(identify, records, physics, step, **fit)
    return Identification(smoothed, dynamics, windows, runs, length, tuple(remarks), again)


def _of_actions(records: Records, step: float) -> list[str]:
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


def _of_jumps(records: Records) -> list[str]:
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


def _of_outliers(records: Records) -> list[str]:
    """Return sentences on rows that are far off both neighbours, on the same side."""
    spec = records.spec
    sentences = []
    moves = [spec.change(record.states[:-1], record.states[1:]) for record in records]
    together = torch.cat(moves)
    # Robust standard deviations of the changes: 1.4826 medians of their sizes
    far = _OUTLYING * 1.4826 * together.abs().nanmedian(0).values
    for i, name in enumerate(spec.states):
        rows = []
        for record, move in zip(records, moves, strict=True):
            there, back = move[:-1, i], -move[1:, i]
            # The nearer neighbour is `far` below, or above
            off = torch.minimum(there, back).maximum(-torch.maximum(there, back))
            places = (off > far[i]).nonzero().flatten() + 1
            rows += [f"{row} of {record.name!r}" for row in places.tolist()]
        if rows and far[i] > 0:
            more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
            sentences.append(
                f"{name} is far off both neighbours, by more than {_OUTLYING:g} times its usual "
                f"change, in row {', '.join(rows[:_NAMED])}{more}: one such outlier can spoil all "
                "estimates. If the sensor failed there, make it NaN."
            )
    return sentences


def _returns(moves: Tensor, turn: float) -> float:
    """Return by how much the moves beside jumps by a turn go against these."""
    jumps = moves.sign().where((moves.abs() / turn - 1).abs() < _NEAR_A_TURN, 0.0)
    moves = moves.nan_to_num()
    return -float((jumps[1:] * moves[:-1]).sum() + (jumps[:-1] * moves[1:]).sum())


def _of_parameters(parameters: PhysicsParameters) -> list[str]:
    """Return sentences on parameters that the log does not tell, or that contradict their prior."""
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


def _told_together(parameters: PhysicsParameters) -> list[Combination]:
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
    combined = []
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
    sign = "/" if q < 0 else "*"
    return f"{first}{'²' * (p == 2)}{sign}{second}{'²' * (abs(q) == 2)}"


def _bracketed(unit: str) -> str:
    return f"({unit})" if {" ", "/"} & {*unit} else unit
