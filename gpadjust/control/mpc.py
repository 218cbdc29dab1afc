"""Model predictive control: a controller that plans at every step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self, TypeVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, seeded
from gpadjust.control.episodes import check_observation, decoded
from gpadjust.control.learning import teach, warn_of_delay
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.state_filter import Estimate, StateFilter, smooth_episodes
from gpadjust.control.task import Moment, Task
from gpadjust.dynamics import Trajectories
from gpadjust.progress import long_work

_PART = 1.5  # horizons of a step that a part of an episode's first plan looks ahead
_FIRST_ROUNDS = 5  # of the plan of an episode that begins
_SHORTEST, _LONGEST = 8, 30  # steps ahead


class MPC:
    """Model predictive control: at each step plan the steps ahead, and make the first.

    :meth:`step` maps a measurement to an action, in a loop of your own; :meth:`learn` updates the
    dynamics by the measurements. Before that it plans in the physics.

    Args:
        task: The task; :meth:`learn` updates its dynamics.
        action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        each_step: Plans at each step but the first. A horizon must be as long as the manoeuvre:
            try it in f_p alone (:class:`~gpadjust.dynamics.PhysicsDynamics`) first.
        first: Plans when an episode begins, without a time limit. Default: five rounds of the whole
            episode, or as far as ``each_step`` if it has no length.
        tolerance: Largest loss of a plan compared with the promised rewards, per step, as a share
            of their range; beyond it all the rest is planned again. None for no limit.
        state_filter: Filter of a task with sensors. Default: the one before there are data.

    Raises:
        TypeError: If the task or a planner has another type.
        ValueError: If a horizon is shorter than a step, or ``action_bounds`` are not bounds.

    Example:
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> from gpadjust.states import StateSpec
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
        state_filter: StateFilter | None = None,
    ) -> None:
        check_kind("task", task, Task, "a Task(dynamics, reward, ...)")
        check_kind("each_step", each_step, Planner | None, "a Planner(...)")
        check_kind("first", first, Planner | None, "a Planner(...)")
        if tolerance is not None:
            checked_number("tolerance", tolerance, above=0)
        length, spec = task.episode_length, task.dynamics.spec
        each_step = each_step or Planner()
        if each_step.horizon is None:
            steps = min(max((length or 0) // 3, _SHORTEST), _LONGEST)
            each_step = replace(each_step, horizon=steps * (spec.step or 1.0))
        if first is None:
            first = Planner(
                each_step.objective,
                rounds=_FIRST_ROUNDS,
                num_functions=each_step.num_functions,
                horizon=each_step.horizon if length is None else None,
            )
        for planner in (each_step, first):
            planner.steps_ahead(spec, length)  # or an error
        self.task = task
        self.action_bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        self.filter = state_filter
        if task.sensors is not None and state_filter is None:
            self.filter = StateFilter.guessed(self.model, self.action_bounds)
        self._steps: list[tuple[Tensor, Tensor, Tensor, int]] = []  # with the number of the run
        self._num_learnt = 0  # of these
        self._run = 0
        self.reset()

    @property
    def model(self) -> Task:
        """The task in the updated dynamics, or in the physics before that."""
        dynamics = self.task.dynamics
        newest = dynamics.before_data() or dynamics
        return self.task if newest is dynamics else replace(self.task, dynamics=newest)

    # The loop of the user

    def reset(self) -> None:
        """Begin an episode: discard plan and estimate; keep the transitions."""
        self._plan: tuple[Plan, ...] | None = None
        self._last: tuple[Tensor, Tensor] | None = None  # measurement and action

    def step(self, measurement: ArrayLike) -> NDArray[np.float64]:
        """Choose the action, ``action_dim``, after a measurement, ``observation_dim``.

        Both are recorded for :meth:`learn`.

        Raises:
            ValueError: If the measurement has another shape, or numbers that are not finite. No
                transition crosses it; the plan stays.
            RuntimeError: If there is neither a physics nor an update.
        """
        row = self._record(measurement)
        actions, self._plan = self._advance(row.unsqueeze(0), self._plan or [None], 0)
        self._last = row, actions[0]
        return actions[0].numpy().copy()

    def observe(self, measurement: ArrayLike) -> None:
        """Record the last measurement of an episode; a ValueError as of :meth:`step`."""
        self._record(measurement)

    def _record(self, measurement: ArrayLike) -> Tensor:
        """Return a measurement, checked, and record the transition to it."""
        last = self._last
        self._last = None  # no transition crosses an error from here on
        values = np.atleast_1d(np.asarray(measurement, dtype=np.float64))
        spec = self.task.observed
        check_observation(values, names=spec.observations)
        if values.ndim != 1:
            raise ValueError(
                f"Expected a measurement of {spec.observation_dim} numbers, found shape "
                f"{values.shape}; `predict` takes the measurements of several episodes."
            )
        row = torch.tensor(values)
        spec.check_observations(row)
        if last is None:
            self._run += 1
        else:
            self._steps.append((*last, row, self._run))
        return row

    def learn(self, data: Trajectories | None = None) -> Self:
        """Update the dynamics by trajectories of states, and continue in the newest model.

        Default: by the new transitions between measurements; with sensors, the states behind all
        of them are estimated first.

        Raises:
            ValueError: If there is no new transition; or trajectories of a task with sensors.
            PhysicsError: If the physics fails at a transition.
        """
        number = self._num_learnt
        if data is None:
            number = len(self._steps)
            data = self._new_transitions()
        else:
            expected = "Trajectories(states, actions, next_states, episode) of tensors"
            check_kind("data", data, Trajectories, expected)
            if self.filter is not None:
                raise ValueError(
                    "The states behind sensors are estimated from the measurements of `step`; "
                    "call learn() without data."
                )
        teach(self.task, data)
        self._num_learnt = number
        return self

    def _new_transitions(self) -> Trajectories:
        """Return the transitions to learn; with sensors all, as their states are estimated."""
        if len(self._steps) == self._num_learnt:
            raise ValueError(
                "There is no new transition to learn: call `step` and measure again, or pass "
                "trajectories."
            )
        *columns, run = zip(*self._steps, strict=True)
        before, actions, after = (torch.stack(column) for column in columns)
        observed = Trajectories(before, actions, after, torch.tensor(run))
        new = slice(self._num_learnt, None)
        if self.filter is None:
            states = decoded(self.task.dynamics.spec, observed)
        else:
            new = slice(0, None)
            seed = len(observed.episodes())
            self.filter, states = smooth_episodes(self.model, self.filter, observed, seed)
        warn_of_delay(self.task.dynamics, states, len(self._steps) - self._num_learnt)
        return states.subset(new)

    def __repr__(self) -> str:
        """Name the dynamics, and the number of their transitions."""
        learnt = getattr(self.task.dynamics, "num_transitions", self._num_learnt)
        return f"MPC({type(self.task.dynamics).__name__}, {learnt} transitions learnt)"

    # A decision

    def predict(
        self,
        observation: NDArray[Any],
        state: Sequence[Plan] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], tuple[Plan, ...]]:
        """Plan actions, as :meth:`~gpadjust.control.Agent.predict`; record nothing.

        The state is the plan of each episode. If ``deterministic``, the search always uses the same
        random numbers.
        """
        check_observation(observation)
        rows = torch.as_tensor(np.atleast_2d(observation), dtype=torch.float64)
        episodes = continued(state, episode_start, len(rows))
        chosen, plans = self._advance(rows, episodes, 0 if deterministic else None)
        actions = chosen.numpy().astype(np.float32)
        return (actions if np.ndim(observation) > 1 else actions[0]), plans

    def _advance(
        self, rows: Tensor, episodes: Sequence[Plan | None], seed: int | None
    ) -> tuple[Tensor, tuple[Plan, ...]]:
        """Return the actions of episodes at observations, and their plans from there on."""
        task = self.model
        estimates: list[Estimate | None] = [None] * len(rows)
        if self.filter is None:
            states = [*task.dynamics.spec.decode(rows)]
        else:
            before = [plan and plan.estimate for plan in episodes]
            filtered = self.filter.follow(task, rows, before)
            states = [estimate.mean for estimate in filtered]
            estimates = [*filtered]
        plans = []
        for state, earlier, estimate in zip(states, episodes, estimates, strict=True):
            # The seed makes a plan the same whatever the other rows are.
            with seeded(seed), long_work("plan", "rounds"):
                plan = self._plan_step(state, earlier, estimate and estimate.covariance)
            plans.append(plan.after(1, estimate))
        actions = [cast(Tensor, plan.moment.action) for plan in plans]
        return torch.stack(actions), tuple(plans)

    def _plan_step(self, state: Tensor, earlier: Plan | None, covariance: Tensor | None) -> Plan:
        """Return the steps ahead of an episode at a state with this covariance."""
        begun = time.perf_counter()
        seconds = self.each_step.seconds
        moment = Moment() if earlier is None else earlier.moment
        length = self.task.episode_length
        left = None  # beyond the episode's length it looks as far ahead as ever
        if length is not None and moment.steps_done < length:
            left = length - moment.steps_done
        at: Any = self.model, state, self.action_bounds, left
        options: dict[str, Any] = {"moment": moment, "covariance": covariance}
        if earlier is None or not len(earlier.actions):
            return _with_promise(self._plan_anew(*at, **options), earlier)
        if seconds is not None:
            options["deadline"] = begun + seconds
        plan = self.each_step.plan(*at, earlier=earlier, **options)
        # Beyond its horizon the earlier plan stays.
        rest = earlier.after(len(plan.actions))
        merged = earlier._replace(
            actions=torch.cat([plan.actions, rest.actions]),
            next_states=torch.cat([plan.next_states, rest.next_states]),
            left_bounds=plan.left_bounds,
            violation=plan.violation,
        )
        if not self._disappoints(plan, earlier):
            return merged
        if seconds is None:
            return _with_promise(self._plan_anew(*at, **options), earlier)
        if begun + seconds - time.perf_counter() < seconds / 2:
            return merged
        plan = self.first.plan(*at, earlier=merged, **options)
        is_complete = len(plan.actions) >= len(merged.actions)
        return _with_promise(plan, earlier) if is_complete else merged

    def _plan_anew(
        self, task: Task, state: Tensor, bounds: Tensor, left: int | None, **options: Any
    ) -> Plan:
        """Return the better of two plans: from random sequences, or from one made in parts."""
        plan = self.first.plan(task, state, bounds, left, **options)
        horizon = self.each_step.horizon
        is_limited = self.first.horizon or self.first.seconds
        if horizon is None or left is None or is_limited:
            return plan
        ahead = replace(self.first, horizon=_PART * horizon)
        if ahead.steps_ahead(task.dynamics.spec, left) >= left:
            return plan
        # Random sequences tell nothing of a whole episode of an unstable system; parts do.
        here = state
        moment = options["moment"]
        part: Plan | None = None
        parts: list[tuple[Tensor, Tensor]] = []
        done = 0
        while done < left:
            part = ahead.plan(task, here, bounds, left - done, earlier=part, moment=moment)
            num_made = len(part.actions)
            if done + num_made < left:
                num_made = -(-num_made // 2)  # half of the part is made, rounded up
            parts.append((part.actions[:num_made], part.next_states[:num_made]))
            here = part.next_states[num_made - 1]
            part = part.after(num_made)
            moment = part.moment
            done += num_made
        actions, states = (torch.cat(column) for column in zip(*parts, strict=True))
        rough = plan._replace(actions=actions, next_states=states)
        other = self.first.plan(task, state, bounds, left, earlier=rough, **options)
        return max(plan, other, key=lambda candidate: candidate.value)

    def _disappoints(self, plan: Plan, earlier: Plan) -> bool:
        """Return whether a plan is worth much less than the promise of its steps."""
        if self.tolerance is None:
            return False
        if plan.left_bounds > earlier.left_bounds:
            return True  # its missing rewards would look like good ones
        promised = earlier.promised[earlier.moment.steps_done :][: len(plan.rewards)]
        if not len(promised):  # an episode may be longer than its plan
            return False
        loss = (promised - plan.rewards[: len(promised)]).mean()
        return bool(loss > self.tolerance * (earlier.promised.max() - earlier.promised.min()))


def _with_promise(plan: Plan, earlier: Plan | None) -> Plan:
    """Return a plan of all steps ahead, with the rewards that it promises of the episode."""
    made = plan.rewards[:0]
    if earlier is not None:
        made = earlier.promised[: plan.moment.steps_done]
    return plan._replace(promised=torch.cat([made, plan.rewards]))


State = TypeVar("State")


def continued(state: Sequence[State] | None, episode_start: Any, n: int) -> list[State | None]:
    """Return the states of a policy in ``n`` episodes; None in an episode that begins."""
    if state is None:
        return [None] * n
    begins = np.zeros(n, dtype=bool) if episode_start is None else np.atleast_1d(episode_start)
    return [None if new else before for before, new in zip(state, begins, strict=True)]
