"""Identification of a machine by its log, and the free run that judges it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from scipy.stats import t
from torch import Tensor

import gpadjust
from gpadjust.checks import checked_number, checked_whole
from gpadjust.display import Display, html_table, text_table
from gpadjust.dynamics import FreeRun, IdentifiedDynamics, PhysicsDynamics, Windows
from gpadjust.dynamics.physics_dynamics import one_physics
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import advice
from gpadjust.records.advice import Combinations, combinations_of
from gpadjust.records.lack import Lack, clearest_lack, robust_moments
from gpadjust.records.records import Records, control_steps
from gpadjust.records.smoothing import (
    SmoothedRecords,
    SmoothingWarning,
    drawn_parameters,
    smooth,
)
from gpadjust.states import Sensors, StateSpec
from gpadjust.words import listed, number, percent, plural

GUESSES = "guesses"
IDENTIFIED = "identified"
PERSISTENCE = "persistence"
FEW = 0.9  # of measurements in intervals of 95 %
_PARTICLES = 199  # of the free run that is judged
_NO_NOISE = 1e-100  # standard deviation: the smoother takes the least that it computes with
_LEAST = 8  # steps of a stretch, of which the last part is held out
_MORE = 0.1  # of the measurements in intervals: clearly more
_BLOCKS = 5  # of a window, whose errors are compared
_JUMPY = 0.005  # of the steps: more jumps make a search end where it is
_LARGE = 2.0  # times the noise of the sensor: an error that something missing may have made

_UNSETTLED = (
    "The search for states and parameters did not settle, so that all of this may change: raise "
    "num_starts, give narrower priors, or a start of hidden states."
)
_JUMPS = (
    "The physics jumps near {} of the steps, as sign(x) does at 0: the search ends at any of the "
    "jumps, and intervals of parameters are too narrow. Write tanh(x/d) in place of sign(x), with "
    "d some 5 % of the usual size of x, and identify again."
)
_BY = {False: "no less", True: "less by chance"}
_OTHERS = {GUESSES: "the guesses", PERSISTENCE: "a state that stays"}


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
    def combinations(self) -> Combinations:
        """Ratios and products of two parameters that the log tells better than these."""
        return combinations_of(self.smoothed.parameters)

    @property
    def verdicts(self) -> dict[str, tuple[str, list[str]]]:
        """Whether the physics follows the log, by each state that was measured, and why.

        ``"Yes"`` if the free run has a smaller error than the guesses and than a state that stays,
        both beyond chance, the intervals cover 90 %, the search settled, and no error that is more
        than the sensor's has a cause that :attr:`lack` shows. ``"No"`` if its error is no smaller
        than that of a state that stays, or larger than the guesses' beyond chance; else
        ``"In part"``.
        """
        return {
            name: self._verdict(i)
            for i, name in enumerate(self.spec.states)
            if not self.coverage[i].isnan()
        }

    def _verdict(self, i: int) -> tuple[str, list[str]]:
        """Return the answer on state i, and why."""
        errors = self.errors
        error = errors[IDENTIFIED][i]
        share = self.coverage[i]
        reasons = [f"Intervals of 95 % cover {percent(share)} of {self.spec.states[i]} there."]
        reasons += self._doubts
        if self.lack is not None and error > _LARGE * self.smoothed.noise[i]:
            reasons.append(str(self.lack))
        answer = "Yes"
        if float(share) < FEW or len(reasons) > 1:
            answer = "In part"
        for other, words in _OTHERS.items():
            if other not in errors:
                continue
            path = self._paths[other]
            is_less = bool(error < errors[other][i])
            if is_less and self._beats(path, i):
                continue
            is_no = not is_less and (other == PERSISTENCE or self._beats(path, i, -1))
            if is_no:
                answer = "No"
            elif answer == "Yes":
                answer = "In part"
            reasons.append(f"Its error is {_BY[is_less]} than that of {words}.")
        return answer, reasons

    @property
    def _doubts(self) -> list[str]:
        """Return sentences on a search whose end decides nothing."""
        sentences = []
        if not self.smoothed.is_settled:
            sentences.append(_UNSETTLED)
        if self.smoothed.jumps > _JUMPY:
            sentences.append(_JUMPS.format(percent(self.smoothed.jumps)))
        return sentences

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
        smoothed = self.smoothed
        sentences = [*self._doubts, *self.remarks, *advice.on_parameters(smoothed.parameters)]
        sentences += self._of_starts()
        sentences += map(str, self.combinations)
        if self.parameters is not None and self.robust_parameters is not None:
            sentences += advice.on_forces(self.parameters, self.robust_parameters)
        if self.lack is not None:
            sentences.append(str(self.lack))
        sentences += advice.on_process_noise(
            smoothed.records, smoothed.noise, smoothed.process_noise, self.lack is not None
        )
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

    def _of_starts(self) -> list[str]:
        """Return a sentence if another start ended elsewhere, as likely as this one."""
        rival = self.smoothed.rival
        if rival is None:
            return []
        names = self.smoothed.parameters.unknowns
        values = [f"{name} = {number(x)}" for name, x in zip(names, rival, strict=True)]
        return [
            f"Another start ended at {', '.join(values)}, about as likely, and intervals are about "
            "one end only: give narrower priors, or a longer log."
        ]

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
        """Tables of parameters, combinations, noises, and errors of free runs."""
        steps = sum(len(record.times) - 1 for record in self.smoothed.records)
        windows, length = self.windows.measured.shape[:2]
        held = windows * round(length * self.step / self._control_step)
        head = f"Identification by {plural(steps, 'step')}, {held:,} held out"
        tables = []
        if self.parameters is not None:
            tables.append(repr(self.parameters))
        if self.combinations:
            tables.append(repr(self.combinations))
        columns = ["", "noise", "process noise", *(f"error, {name}" for name in self.errors)]
        rows = [[*columns, "in 95 %"]]
        noises = zip(self.smoothed.noise, self.smoothed.process_noise, strict=True)
        for (noise, process_noise), (name, *texts) in zip(noises, self._rows(), strict=True):
            sensor = number(noise)
            if name in self.hidden:
                sensor = "hidden"
            rows.append([name, sensor, number(process_noise), *texts])
        return "\n".join([head, *tables, text_table(rows)])

    def _rows(self) -> list[list[str]]:
        """Return rows of the states' names, errors of free runs, and shares in the intervals."""
        columns = [*map(torch.Tensor.tolist, self.errors.values())]
        rows = []
        for i, name in enumerate(self.spec.states):
            texts = [name, *(number(errors[i]) for errors in columns), percent(self.coverage[i])]
            if name in self.hidden:
                texts[-1] = "hidden"
            rows.append(texts)
        return rows

    def _repr_html_(self) -> str:
        parameters = ""
        if self.parameters is not None:
            parameters = self.parameters._repr_html_()
        caption = f"Errors of free runs of {self.windows.measured.shape[1]} steps"
        return parameters + html_table(caption, ["", *self.errors, "in 95 %"], self._rows())


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
    checked_whole("seed", seed, 0)
    held = _steps_to_hold_out(steps, held_out)
    f_p = one_physics(physics, spec, "identify one of them")
    beginnings, places = _without_ends(steps, held)
    process_noise = None
    if by_free_runs:
        process_noise = torch.full((spec.state_dim,), _NO_NOISE, dtype=torch.float64)
    fit: dict[str, Any] = {"start": start, "sensors": sensors, "num_starts": num_starts}
    smoothed = smooth(beginnings, f_p, process_noise=process_noise, **fit)
    windows = _ends(steps, smoothed, places, held)
    within = smoothed.chain.within.shape[1]  # steps of the physics in a control step
    length = steps.records[0].sampling_step / within
    # A control step adds the process noise of its steps of the physics.
    process_noise = smoothed.process_noise / math.sqrt(within)
    noise = smoothed.noise.nan_to_num()
    dynamics = IdentifiedDynamics(
        replace(spec, step=length), f_p, smoothed.physics_parameters, noise, process_noise
    )
    start_noise = torch.stack([smoothed.sd[i][-1] for i in places]).square().mean(0).sqrt()
    runs = _free_runs(dynamics, windows, process_noise, start_noise, noise, seed)
    remarks = advice.on_log(records, length)
    if len(steps) > len(records):
        text = f"Gaps part the log into {len(steps)} stretches, each smoothed by itself."
        remarks = [text, *remarks]
    again = None
    if not by_free_runs:
        fit |= {"held_out": held_out, "by_free_runs": True, "seed": seed}
        again = partial(identify, records, physics, step, **fit)
    return Identification(smoothed, dynamics, windows, runs, length, tuple(remarks), again)


def _steps_to_hold_out(steps: Records, held_out: float) -> int:
    """Return the number of control steps that are held out at the end of long stretches."""
    share = checked_number("held_out", held_out, above=0, most=0.5)
    longest = max(len(stretch.times) - 1 for stretch in steps)
    if longest < _LEAST:
        raise ValueError(
            f"Expected a stretch of {_LEAST} control steps or more, to hold some out, found "
            f"{longest}; take a shorter step, or a longer log."
        )
    return max(1, int(share * longest))


def _without_ends(steps: Records, held: int) -> tuple[Records, list[int]]:
    """Return stretches without what is held out, and the places of those that are shorter now."""
    beginnings = []
    places = []
    for i, stretch in enumerate(steps):
        end = len(stretch.times)
        if end - 1 >= 2 * held:
            end -= held
            places.append(i)
        beginnings.append(stretch.part(slice(end)))
    return Records(beginnings, steps.spec), places


def _ends(steps: Records, smoothed: SmoothedRecords, places: list[int], held: int) -> Windows:
    """Return windows of what is held out, in steps of the physics, from the last smoothed states.

    What was measured is corrected by the sensors, and NaN within control steps.
    """
    within = smoothed.chain.within.shape[1]
    actions, measured = list[Tensor](), list[Tensor]()
    for i in places:
        stretch = steps.records[i]
        acting = stretch.actions.unsqueeze(1)
        if within > 1:
            acting = stretch.within
        actions.append(acting[-held - 1 : -1].flatten(0, 1))
        states = torch.full((held * within, steps.spec.state_dim), torch.nan, dtype=torch.float64)
        states[within - 1 :: within] = smoothed.corrected(stretch.states)[-held:]
        measured.append(states)
    last = torch.stack([smoothed.records.records[i].states[-1] for i in places])
    return Windows(last, torch.stack(actions), torch.stack(measured))


def _free_runs(
    dynamics: IdentifiedDynamics,
    windows: Windows,
    process_noise: Tensor,
    start_noise: Tensor,
    noise: Tensor,
    seed: int,
) -> dict[str, FreeRun]:
    """Return free runs along the windows, of the machine and, with parameters, of the guesses."""
    f_p = dynamics.physics
    last, actions = windows.initial_states, windows.actions
    options: dict[str, Any] = {"start_noise": start_noise, "noise": noise, "seed": seed}
    # Paths of a skewed posterior are skewed about the one by its center, which judges.
    center = PhysicsParameters(f_p.unknowns, [*dynamics.physics_parameters.center.unsqueeze(-1)])
    at_center = IdentifiedDynamics(dynamics.spec, f_p, center, noise, process_noise)
    path = at_center.free_run(last, actions, noise=False).mean
    run = dynamics.free_run(
        last, actions, process_noise=process_noise, num_functions=_PARTICLES, **options
    )
    runs = {IDENTIFIED: run._replace(mean=path)}
    if f_p.unknowns:
        runs[GUESSES] = PhysicsDynamics(dynamics.spec, f_p).free_run(last, actions, **options)
    return runs
