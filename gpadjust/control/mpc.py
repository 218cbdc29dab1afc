"""A policy that plans at every step."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, seeded
from gpadjust.control.constraints import margins
from gpadjust.control.faults import check_observation
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.search import CrossEntropy
from gpadjust.control.smoothed_episodes import Seen, smooth_episodes
from gpadjust.control.state_filter import Estimate, StateFilter
from gpadjust.control.task import Task
from gpadjust.dynamics import Trajectories

_SHORTEST, _LONGEST = 8, 30  # steps ahead
_SEGMENT = 1.5  # horizons of a step

EACH_STEP = Planner(
    search=CrossEntropy(1, num_elites=12, correlation=0.5),
    num_random=128,
    spread=0.15,
)
"""The default plan of a step: two looks at 128 sequences, of eight to 30 steps."""

FIRST = Planner(
    search=CrossEntropy(5, num_elites=12, correlation=0.5),
    num_random=128,
    spread=0.15,
)
"""The default plan of an episode that begins: the whole of it, at once and in segments."""


class _Run(NamedTuple):
    """Measurements of steps that followed each other, and the actions taken there."""

    observations: list[Tensor]
    actions: list[Tensor]

    @property
    def num_transitions(self) -> int:
        return min(len(self.observations) - 1, len(self.actions)) if self.actions else 0

    def whole(self) -> Seen:
        """Those of whole transitions."""
        n = self.num_transitions
        return Seen(torch.stack(self.observations[: n + 1]), torch.stack(self.actions[:n]))


class Planned(NamedTuple):
    """The plan of an episode.

    Args:
        actions: Those of the steps ahead, ``T x action_dim``.
        promised: The rewards of all its steps, those made included, as they were foreseen when it
            was last planned to its end.
        steps_done: How many it has made.
        left_bounds: As of the newest :class:`Plan`.
        reward: What was promised of a step that is made, on average, when it was last planned to
            its end.
        next_states: Those to which the actions ahead lead, ``T x state_dim``.
        violation: As of the newest :class:`Plan`.
        before: The last action that was made, ``action_dim``; None where an episode begins.
        estimate: The state as sensors have shown it, and the action that was taken there; None of a
            task without sensors.
    """

    actions: Tensor
    promised: Tensor
    steps_done: int
    left_bounds: float = 0.0
    reward: float = math.nan
    next_states: Tensor = torch.zeros(0)
    violation: float = 0.0
    before: Tensor | None = None
    estimate: Estimate | None = None


PlanState = tuple[Planned, ...]
"""What is planned of each episode."""

Kept = TypeVar("Kept")


class MPC:
    """Model predictive control: at each step the steps ahead are planned, and the first is made.

    :meth:`step` maps a measurement to an action, in a loop of your own; :meth:`learn` lets the
    dynamics learn what was measured. Before that it plans in the physics.

    Args:
        task: The task. Its dynamics are what :meth:`learn` updates.
        action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        each_step: Plans at each step but the first. Default: two looks at 128 sequences of a third
            of the episode, of 8 to 30 steps. A horizon must be as long as the manoeuvre
            needs, as energy must be put into a pole before it can stand: try it in f_p alone
            (:class:`~gpadjust.dynamics.PhysicsDynamics`) first.
        first: Plans when an episode begins, which has not to be in time. Default: two searches of
            the whole episode, from random sequences and from a plan in segments, half as long again
            as ``each_step`` looks; as far as that if the task does not say how long an episode is.
            Objective and functions are those of ``each_step``.
        tolerance: Where the plan of a step is worth less than what was promised of its steps when
            the whole was planned, by more than this share of the range of the promised rewards (a
            step, on average), the rest is planned as when it began; where ``each_step`` has
            ``seconds``, about that plan, if half of these are left. None for never.
        seed: Of the searches of deterministic actions, which are the same for the same observation
            and plan.
        state_filter: Of a task with sensors, by which observations are states. Default: that before
            there are data.

    Raises:
        TypeError: If a planner is none.
        ValueError: If there is neither an episode length nor a horizon, or ``action_bounds`` are no
            bounds.

    Example:
        >>> import numpy as np
        >>> from gpadjust.control import MPC, Task
        >>> from gpadjust.dynamics import LearnedDynamics, StateSpec
        >>> spec = StateSpec(["level"], ["pump"])
        >>> dynamics = LearnedDynamics(spec, lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(dynamics, lambda states, actions, following: -following[:, 0].abs())
        >>> controller = MPC(task, [[-1.0], [1.0]], Planner(horizon=3))
        >>> level = np.array([0.9])
        >>> for _ in range(5):  # of the plant, whose pump is weaker
        ...     level = level + 0.7 * controller.step(level)
        >>> controller.learn()
        MPC(LearnedDynamics, 4 transitions learnt)
    """

    def __init__(
        self,
        task: Task,
        action_bounds: ArrayLike,
        each_step: Planner | None = None,
        *,
        first: Planner | None = None,
        tolerance: float | None = 0.25,
        seed: int = 0,
        state_filter: StateFilter | None = None,
    ) -> None:
        for name, planner in (("each_step", each_step), ("first", first)):
            check_kind(name, planner, Planner | None, "a Planner(...)")
        if tolerance is not None:
            checked_number("tolerance", tolerance, above=0)
        length, spec = task.episode_length, task.dynamics.spec
        if each_step is None:
            steps = min(max((length or 0) // 3, _SHORTEST), _LONGEST)
            each_step = replace(EACH_STEP, horizon=steps * (spec.step or 1.0))
        if first is None:
            first = replace(
                FIRST,
                objective=each_step.objective,
                num_functions=each_step.num_functions,
                horizon=each_step.horizon if length is None else None,
                segment=each_step.horizon and _SEGMENT * each_step.horizon,
            )
        for planner in (each_step, first):
            planner.steps_ahead(spec)  # or an error
        if length is None and None in (each_step.horizon, first.horizon):
            raise ValueError(
                "Nobody says how far to plan; give the task an episode_length, or the planners a "
                "horizon."
            )
        self.task = task
        self.action_bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        self.seed = seed
        self.filter = state_filter
        if task.sensors is not None and state_filter is None:
            self.filter = StateFilter.guessed(self.model, self.action_bounds)
        self._runs: list[_Run] = []
        self._num_learnt = 0  # of the recorded transitions
        self.reset()

    @property
    def model(self) -> Task:
        """The task in what its dynamics have learnt, or in the physics before that."""
        dynamics = self.task.dynamics
        newest = dynamics.before_data() or dynamics
        return self.task if newest is dynamics else replace(self.task, dynamics=newest)

    def reset(self) -> None:
        """Begin an episode: forget the plan, and go on with nothing but what was learnt."""
        self._plan: PlanState | None = None
        self._runs.append(_Run([], []))

    def step(self, measurement: ArrayLike) -> NDArray[np.float64]:
        """Choose the action after a measurement; both are recorded for :meth:`learn`.

        Args:
            measurement: ``observation_dim`` numbers of the task's spec, or of its sensors.

        Returns:
            The action, ``action_dim`` numbers within the bounds.

        Raises:
            ValueError: If the measurement has another shape, or numbers that are not finite. It is
                not recorded, and no transition goes across it; the plan stays.
            RuntimeError: If there is neither a physics nor anything learnt.
        """
        row = self._measured(measurement)
        with self._recording():
            actions, self._plan = self._advance(row.unsqueeze(0), self._plan or [None], self.seed)
        self._runs[-1].actions.append(actions[0])
        return actions[0].numpy().copy()

    def observe(self, measurement: ArrayLike) -> None:
        """Record a measurement without an action: the one with which an episode ends.

        Raises:
            ValueError: As :meth:`step`.
        """
        self._measured(measurement)
        self._runs.append(_Run([], []))

    def learn(self, data: Trajectories | None = None) -> Self:
        """Let the dynamics learn, and go on in the newest model.

        Args:
            data: Trajectories of states. Default: the transitions between measurements of
                :meth:`step` and :meth:`observe` that were not learnt yet. With sensors, the
                states behind all of them are estimated first.

        Raises:
            ValueError: If there is no new transition; or trajectories of a task with sensors.
            PhysicsError: If the physics fails at a transition.
        """
        dynamics, spec = self.task.dynamics, self.task.dynamics.spec
        if data is None:
            runs = [run for run in self._runs if run.num_transitions]
            number = sum(run.num_transitions for run in runs)
            if number == self._num_learnt:
                raise ValueError(
                    "There is no new transition to learn, which takes a measurement, an action and "
                    "the measurement after it: call `step` first, or pass trajectories."
                )
            data = self._trajectories(runs)
            if self.task.sensors is None:
                data = data.some(slice(self._num_learnt, None))
        elif self.task.sensors is not None:
            raise ValueError(
                "The states behind trajectories of sensors are estimated from what `step` has "
                "recorded; call learn() without data."
            )
        else:
            number = self._num_learnt
        following = data.next_states.clone()
        if self.task.reference is not None:  # set-points stay as they are in the dynamics
            following[:, spec.exogenous_columns] = data.states[:, spec.exogenous_columns]
        before = dynamics.state_dict() if self.task.sensors is not None else None
        if before is not None:  # the states behind all measurements are known better by now
            dynamics.load_state_dict({})
        try:
            dynamics.update(data.states, data.actions, following)
        except BaseException:
            if before is not None:
                dynamics.load_state_dict(before)
            raise
        self._num_learnt = number
        return self

    @contextmanager
    def _recording(self) -> Iterator[None]:
        """Begin another run if something fails, so that no transition goes across it."""
        try:
            yield
        except BaseException:
            self._runs.append(_Run([], []))
            raise

    def _measured(self, measurement: ArrayLike) -> Tensor:
        """Return a measurement, checked and recorded."""
        values = np.atleast_1d(np.asarray(measurement, dtype=np.float64))
        spec = self.task.observed
        with self._recording():
            check_observation(values)
            if values.ndim != 1:
                raise ValueError(
                    f"Expected a measurement of {spec.observation_dim} numbers, found shape "
                    f"{values.shape}; `predict` takes the measurements of several episodes."
                )
            row = torch.tensor(values)
            spec.check_observations(row)
        self._runs[-1].observations.append(row)
        return row

    def _trajectories(self, runs: Sequence[_Run]) -> Trajectories:
        """Return the transitions of runs; with sensors, of states estimated in the newest model."""
        spec, seen = self.task.dynamics.spec, [run.whole() for run in runs]
        if self.filter is None:
            paths = [spec.decode(each.observations) for each in seen]
        else:
            self.filter, paths = smooth_episodes(self.model, self.filter, seen, len(seen))
        return Trajectories(
            torch.cat([path[:-1] for path in paths]),
            torch.cat([each.actions for each in seen]),
            torch.cat([path[1:] for path in paths]),
            torch.arange(len(seen)).repeat_interleave(
                torch.tensor([len(each.actions) for each in seen])
            ),
        )

    def __repr__(self) -> str:
        """Name the dynamics, and how much they have learnt."""
        learnt = getattr(self.task.dynamics, "num_transitions", self._num_learnt)
        return f"MPC({type(self.task.dynamics).__name__}, {learnt} transitions learnt)"

    def predict(
        self,
        observation: NDArray[Any],
        state: PlanState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PlanState]:
        """Plan actions, as policies of Stable-Baselines3 do, whose ``evaluate_policy`` takes it.

        Arguments and result are those of :meth:`~gpadjust.control.Agent.predict`. The state is the
        plan. Without one all episodes begin. If ``deterministic``, the search is always the same.
        Nothing is recorded.
        """
        check_observation(observation)
        rows = torch.as_tensor(np.atleast_2d(observation), dtype=torch.float64)
        episodes = going_on(state, episode_start, len(rows))
        found, plans = self._advance(rows, episodes, self.seed if deterministic else None)
        actions = found.numpy().astype(np.float32)
        return (actions if np.ndim(observation) > 1 else actions[0]), plans

    def _advance(
        self, rows: Tensor, episodes: Sequence[Planned | None], seed: int | None
    ) -> tuple[Tensor, PlanState]:
        """The actions of episodes at observations, and their plans from there on."""
        task = self.model
        estimates: Sequence[Estimate | None] = [None] * len(rows)
        if self.filter is None:
            states = [*task.dynamics.spec.decode(rows)]
        else:
            before = [None if each is None else each.estimate for each in episodes]
            found = estimates = self.filter.follow(task, rows, before)
            states = [each.mean for each in found]
        plans = []
        for state, earlier, estimate in zip(states, episodes, estimates, strict=True):
            covariance = None if estimate is None else estimate.covariance
            with seeded(seed):  # whatever the other rows are
                plan = self.plan(state, earlier, covariance)
            action = plan.actions[0]
            plans.append(
                plan._replace(
                    actions=plan.actions[1:],
                    next_states=plan.next_states[1:],
                    steps_done=plan.steps_done + 1,
                    before=action,
                    estimate=None if estimate is None else estimate._replace(action=action),
                )
            )
        return torch.stack([cast(Tensor, plan.before) for plan in plans]), tuple(plans)

    def plan(
        self, state: Tensor, earlier: Planned | None = None, covariance: Tensor | None = None
    ) -> Planned:
        """Plan the steps ahead of an episode that is at a state.

        Args:
            state: Where it is, ``state_dim``.
            earlier: What was planned by then; None at the start.
            covariance: That of the state, ``state_dim x state_dim``, if it is estimated.
        """
        begun = time.perf_counter()
        steps_done = 0 if earlier is None else earlier.steps_done
        length = self.task.episode_length
        left = None if length is None else max(length - steps_done, 1)
        where = self.model, state, self.action_bounds, left
        before = None if earlier is None else earlier.before
        how: dict[str, Any] = {"before": before, "steps_done": steps_done}
        if earlier is not None and len(earlier.actions):
            horizon = self.each_step.steps_ahead(self.task.dynamics.spec)
            tight = self._margins(state, earlier.actions[:horizon], earlier, covariance)
            how["margins"] = tight
            known = earlier.actions
            plan = self._in_time(self.each_step, begun).plan(*where, known=known, **how)
            k = len(plan.actions)
            kept = earlier._replace(
                actions=torch.cat([plan.actions, known[k:]]),
                next_states=torch.cat([plan.next_states, earlier.next_states[k:]]),
                left_bounds=plan.left_bounds,
                violation=plan.violation,
            )
            if not self._disappoints(plan, earlier):
                return kept
            if self.each_step.seconds is not None:
                whole = self._in_time(self.first, begun)
                if (whole.seconds or 0.0) < self.each_step.seconds / 2:
                    return kept
                plan = whole.plan(*where, known=kept.actions, **how)
                if len(plan.actions) < len(kept.actions):
                    return kept
                return self._begun(plan, earlier, before)
        how["margins"] = None
        plan = self.first.plan(*where, **how)
        if self.task.constraints is not None:
            # The margins are those of a plan that has none yet.
            how["margins"] = self._margins(state, plan.actions, plan, covariance)
            plan = self.first.plan(*where, known=plan.actions, **how)
        return self._begun(plan, earlier, before)

    def _in_time(self, planner: Planner, begun: float) -> Planner:
        """The planner, for what is left of the time of a step that has begun."""
        if self.each_step.seconds is None:
            return planner
        left = begun + self.each_step.seconds - time.perf_counter()
        return replace(planner, seconds=max(left, 1e-9), segment=None)

    @staticmethod
    def _begun(plan: Plan, earlier: Planned | None, before: Tensor | None) -> Planned:
        """A plan of all steps ahead, with what it promises."""
        steps_done = 0 if earlier is None else earlier.steps_done
        made = plan.rewards[:0] if earlier is None else earlier.promised[:steps_done]
        promised = torch.cat([made, plan.rewards])
        reward = float(plan.rewards.sum() / plan.made.sum().clamp_min(1e-12))
        return Planned(
            plan.actions,
            promised,
            steps_done,
            plan.left_bounds,
            reward,
            plan.next_states,
            plan.violation,
            before,
        )

    def _margins(
        self, state: Tensor, actions: Tensor, along: Plan | Planned, covariance: Tensor | None
    ) -> Tensor | None:
        """The margins of the constraints along a plan from a state; None without constraints."""
        if self.task.constraints is None:
            return None
        states = torch.cat([state.unsqueeze(0), along.next_states])[: len(actions)]
        return margins(self.model, states, actions, self.action_bounds, covariance)

    def _disappoints(self, plan: Plan, earlier: Planned) -> bool:
        """Return whether a plan is worth much less than its steps had promised."""
        if self.tolerance is None:
            return False
        if plan.left_bounds > earlier.left_bounds:
            return True  # its missing rewards would look like good ones
        promised = earlier.promised[earlier.steps_done :][: len(plan.rewards)]
        if not len(promised):  # an episode may be longer than what was planned
            return False
        loss = (promised - plan.rewards[: len(promised)]).mean()
        return bool(loss > self.tolerance * (earlier.promised.max() - earlier.promised.min()))


def going_on(state: Sequence[Kept] | None, episode_start: Any, n: int) -> list[Kept | None]:
    """What a policy kept of each of ``n`` episodes, its state; None of those that begin."""
    if state is None:
        return [None] * n
    begins = np.zeros(n, dtype=bool) if episode_start is None else np.atleast_1d(episode_start)
    return [None if new else kept for kept, new in zip(state, begins, strict=True)]
