"""Real episodes: what they tell, and how dynamics learn them."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import torch
from torch import Tensor

from gpadjust.control.delay import find_delay
from gpadjust.control.reach import reach
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, Trajectories
from gpadjust.dynamics.free_run import typical_change
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation.trust import trust

_NEAR = 0.05  # of half the width between bounds: a state that is so near may be held by them
_MOST = 10.0  # times as far they may be by what the physics reaches
_REACH = 10.0  # half ranges of the recorded states, from their middle to the bounds
_ROUNDING = 1e-5  # of set-points, in single precision
_WINDOWS = 4  # of which trajectories are scored: some half second for a model of an episode
_FAR = ("nlpd", "coverage", "energy")


@dataclass(frozen=True, eq=False)
class RecordedEpisodes:
    """Steps of real episodes, each after the one before it.

    Args:
        spec: The entries of states and actions.
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        next_states: ``N x state_dim``.
        rewards: ``N``.
        terminated: Whether the next state ended the episode, ``N`` booleans.
        episode: The number of the episode, ``N`` integers.
        begins: Whether the step is the first one of its episode, ``N`` booleans.
        whole: Whether the episode has ended, ``N`` booleans.
    """

    spec: StateSpec
    states: Tensor
    actions: Tensor
    next_states: Tensor
    rewards: Tensor
    terminated: Tensor
    episode: Tensor
    begins: Tensor
    whole: Tensor

    @property
    def num_transitions(self) -> int:
        """Number of steps."""
        return len(self.states)

    @property
    def trajectories(self) -> Trajectories:
        """States, actions and next states, of which dynamics learn."""
        return Trajectories(self.states, self.actions, self.next_states, self.episode)

    def some(self, rows: Any) -> Self:
        """The steps that an index of rows selects."""
        names = [field.name for field in fields(self)[1:]]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def draw_starts(self, n: int) -> Tensor:
        """Draw states at which episodes started, ``n x state_dim``, from PyTorch's generator."""
        starts = self.states[self.begins]
        return starts[torch.randint(len(starts), (n,))]

    @property
    def steps(self) -> Tensor:
        """The number of each step in its episode, from 1; 0 where its beginning is lost."""
        rows = torch.arange(self.num_transitions)
        first = torch.where(self.begins, rows, -1).cummax(0).values
        lost = (first < 0) | (self.episode[first] != self.episode)
        return (rows - first + 1).masked_fill(lost, 0)

    def with_still_set_points(self) -> Self:
        """These episodes, but the exogenous states of a step stay as they were before it."""
        next_states, still = self.next_states.clone(), self.spec.exogenous_columns
        next_states[:, still] = self.states[:, still]
        return replace(self, next_states=next_states)

    def bounds(self, reached: Tensor | None = None) -> Tensor | None:
        """Bounds ``2 x state_dim`` far beyond the states of episodes that have ended.

        They are infinite for angles, constants and previous values; None if no episode has ended.

        Args:
            reached: Least and greatest states that the physics reaches. The bounds leave room for
                them and half of their range beyond, within a hundred half ranges of what was seen:
                where the physics runs away, it says nothing of the system.
        """
        if not self.whole.any():
            return None
        seen = torch.cat([self.states[self.whole], self.next_states[self.whole]])
        low, high = seen.amin(0), seen.amax(0)
        room = _REACH * (high - low) / 2
        room[high == low] = torch.inf  # that it has not moved yet tells nothing
        for i, name in enumerate(self.spec.states):
            if name in (*self.spec.angles, *self.spec.exogenous, *self.spec.previous):
                room[i] = torch.inf
        middle = (low + high) / 2
        near = far = torch.stack([middle - room, middle + room])
        if reached is not None:
            beyond = (reached[1] - reached[0]) / 2
            far = torch.stack([reached[0] - beyond, reached[1] + beyond])
            far = torch.clamp(far, middle - _MOST * room, middle + _MOST * room)
        return torch.stack([torch.minimum(near[0], far[0]), torch.maximum(near[1], far[1])])

    def complete(self, task: Task, episode_length: int, action_bounds: Tensor) -> Task:
        """The task with length, starts and bounds of these episodes where it has none.

        The bounds are beyond what was seen and what the physics reaches within an episode from
        where these started, by actions within their bounds ``2 x action_dim``.
        """
        found: dict[str, Any] = {"episode_length": episode_length}
        if self.num_transitions:
            found["initial_states"] = self.draw_starts
        if self.whole.any() and task.state_bounds is None:
            physics, starts = task.dynamics.physics_alone(), self.states[self.begins]
            length = task.episode_length or episode_length
            reached = (
                reach(physics, starts, action_bounds, length) if physics and len(starts) else None
            )
            found["state_bounds"] = self.bounds(reached)
        return replace(task, **{k: v for k, v in found.items() if getattr(task, k) is None})

    def warn_of_bounds(self, bounds: Tensor) -> None:
        """Warn if states came to bounds ``2 x state_dim`` that nobody gave."""
        near = _NEAR * (bounds[1] - bounds[0]) / 2
        for bound, sign in zip(bounds, (-1, 1), strict=True):
            come = (sign * (bound - self.next_states) < near).any(0) & bound.isfinite()
            for i in come.nonzero().flatten().tolist():
                found = self.next_states[:, i]
                found = found.amax() if sign > 0 else found.amin()
                warnings.warn(
                    f"An episode came to {self.spec.states[i]} = {float(found):.3g}, where the "
                    f"model was not followed beyond {float(bound):.3g}: a bound of what had been "
                    "seen and what the physics reaches, which may have held it there. Give the "
                    "task state_bounds that leave room for where it is to go.",
                    UserWarning,
                    stacklevel=5,
                )

    def learnable(self, dynamics: Dynamics) -> Trajectories:
        """All steps but those at which the physics fails.

        Raises:
            PhysicsError: If it does not say where, or everywhere.
        """
        works = torch.ones(self.num_transitions, dtype=torch.bool)
        while True:
            try:
                dynamics.try_physics(self.states[works], self.actions[works])
            except PhysicsError as error:
                rows = works.nonzero().flatten()[list(error.rows)]
                if not len(rows) or len(rows) == works.sum():
                    raise
                warnings.warn(
                    f"The physics fails at {len(rows)} of {len(works)} new transitions, which the "
                    f"dynamics do not learn: {error}",
                    UserWarning,
                    stacklevel=4,
                )
                works[rows] = False
            else:
                return self.trajectories.some(works)

    def check(self, task: Task, tolerance: float = 1e-3) -> None:
        """Compare the functions of a task with the recorded rewards and terminations.

        Args:
            task: The user's.
            tolerance: Greatest error of the reward, relative to the largest recorded one.

        Raises:
            ValueError: If they differ; it shows the worst transition.
        """
        self._check_reference(task)
        rewards = task.rewards(self.states, self.actions, self.next_states).double()
        error = (rewards - self.rewards).abs()
        if (error > tolerance * self.rewards.abs().max().clamp_min(1e-6)).any():
            i = int(error.argmax())
            raise ValueError(
                "reward(states, actions, next_states) is not the environment's: transition "
                f"{i} gave {self.rewards[i]:.6g}, but the function says {rewards[i]:.6g}; "
                f"{self._row(i)}. Correct the function, or the spec of the state (its order, and "
                "which entries are angles, seen as sine and then cosine). If rewards or "
                "observations are noisy, raise reward_tolerance; None checks nothing."
            )
        says = task.terminations(self.next_states)
        wrong = says != self.terminated
        if wrong.any():
            i = int(wrong.nonzero()[0])
            given = (
                "the function says" if task.terminated is not None else "none was given, that is"
            )
            raise ValueError(
                f"terminated(states) is not the environment's: transition {i} was recorded with "
                f"terminated={bool(self.terminated[i])}, but {given} {bool(says[i])}; "
                f"{self._row(i)}. Pass the termination that the environment has."
            )

    def _check_reference(self, task: Task) -> None:
        """Compare the reference of a task with the exogenous states that were recorded."""
        known = self.steps > 0
        said = task.set_points(self.states[known], self.steps[known])
        if said is None:
            return
        columns, after = self.spec.exogenous_columns, self.next_states[known]
        found, expected = after[:, columns], after.clone()
        expected[:, columns] = said
        apart = self.spec.change(expected, after)[:, columns].abs()  # of angles the shortest way
        off = (apart > _ROUNDING * found.abs().clamp_min(1.0)).any(1).nonzero()
        if len(off):
            i = int(off[0])
            raise ValueError(
                "reference(states, steps) is not the environment's: after step "
                f"{int(self.steps[known][i])} of an episode it says {said[i].tolist()} for "
                f"{tuple(self.spec.exogenous)}, but {found[i].tolist()} was observed. Number the "
                "steps from 1, for the state after the first."
            )

    def _row(self, i: int) -> str:
        parts = ("states", "actions", "next_states")
        return ", ".join(f"{part}[{i}] = {getattr(self, part)[i].tolist()}" for part in parts)


def learn_dynamics(
    task: Task,
    new: RecordedEpisodes,
    recorded: RecordedEpisodes,
    horizons: tuple[int, ...],
) -> dict[str, float]:
    """Score the dynamics of a task on new episodes, and update them with these.

    With sensors they forget what they have learnt, and learn all episodes again, as the states
    behind all of them are estimated better by now.

    PyTorch's generator is left as it is by the scores. Scores that are not defined (densities of
    dynamics without variances, horizons longer than the episodes) are left out.

    Args:
        task: The task, with bounds of the states.
        new: Episodes that the dynamics have not learnt.
        recorded: All episodes; energy scores are in units of their typical changes, so that those
            of different episodes can be compared.
        horizons: Numbers of steps over which trajectories are scored; none for scores of single
            steps alone.

    Returns:
        ``nlpd`` and ``coverage`` of a step, ``rmse/<state>``; ``overrides``, the share of
        predictions in which data override the physics; ``nlpd_15``, ``coverage_15`` and
        ``energy_15`` of a horizon of 15; ``score_seconds``, ``fit_seconds``.
    """
    start, found = time.perf_counter(), {}
    if task.reference is not None:  # set-points stay as they are in the dynamics
        new, recorded = (each.with_still_set_points() for each in (new, recorded))
    learnable = new.learnable(task.dynamics)
    if task.dynamics.is_fitted:
        before = time.perf_counter()
        found = _scores(task, learnable, recorded, horizons)
        found["score_seconds"] = time.perf_counter() - before
    if task.sensors is None:
        task.dynamics.update(*learnable)
    else:
        _learn_again(task.dynamics, recorded)
    _warn_of_delay(task.dynamics, new, recorded)
    found["fit_seconds"] = time.perf_counter() - start - found.get("score_seconds", 0.0)
    return {name: value for name, value in found.items() if not math.isnan(value)}


def _learn_again(dynamics: Dynamics, recorded: RecordedEpisodes) -> None:
    """Let dynamics forget what they have learnt, and learn all episodes; not if this fails."""
    data, before = recorded.learnable(dynamics), dynamics.state_dict()
    dynamics.load_state_dict({})
    try:
        dynamics.update(*data)
    except BaseException:
        dynamics.load_state_dict(before)
        raise


def _warn_of_delay(dynamics: Dynamics, new: RecordedEpisodes, recorded: RecordedEpisodes) -> None:
    """Warn of a delay that was not told, after the episode that has shown it first."""
    physics = dynamics.physics_alone()
    if physics is None:
        return
    found = find_delay(physics, recorded.trajectories)
    earlier = recorded.some(recorded.episode < new.episode.min()).trajectories
    if found is not None and find_delay(physics, earlier) is None:
        warnings.warn(str(found), UserWarning, stacklevel=4)


def _scores(
    task: Task, new: Trajectories, recorded: RecordedEpisodes, horizons: tuple[int, ...]
) -> dict[str, float]:
    dynamics, spec = task.dynamics, task.dynamics.spec
    score = dynamics.score(*new)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [spec.states[i] for i in spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    if isinstance(dynamics, LearnedDynamics):
        model, inputs = dynamics.model, dynamics.targets.inputs(new.states, new.actions)
        if any(term.physics is not None for term in model.terms):
            found["overrides"] = float(trust(model, inputs).data.mean())
    possible = [k for k in horizons if k <= new.longest]
    if not possible:
        return found
    windows = new.windows(possible[-1], stride=1)
    last = len(windows.actions) - 1
    windows = windows.some(torch.linspace(0, last, min(last + 1, _WINDOWS)).round().long())
    try:
        run = dynamics.free_run(
            windows.initial_states,
            windows.actions,
            state_bounds=task.widened(new.states).state_bounds,
        )
    except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
        warnings.warn(
            f"There are no scores of trajectories, as their particles cannot move: {error} Pass "
            "score_horizons=() to do without.",
            UserWarning,
            stacklevel=4,
        )
        return found
    units = typical_change(spec, recorded.states, recorded.next_states)
    far = run.score(windows.measured, horizons=possible, units=units)
    for i, horizon in enumerate(possible):
        for name in _FAR:
            values = getattr(far, name)[i]
            values = values if name == "energy" else values[spec.moving]
            found[f"{name}_{horizon}"] = float(values.mean())
    return found
