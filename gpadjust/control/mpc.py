"""Model predictive control: plans of actions, and a controller that plans at every step."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole, seeded
from gpadjust.control.constraints import margins
from gpadjust.control.episodes import decoded, teach, warn_of_delay
from gpadjust.control.faults import check_observation
from gpadjust.control.rollouts import (
    Objective,
    Return,
    Rollouts,
    check_objective,
    random_sequences,
)
from gpadjust.control.state_filter import Estimate, StateFilter, smooth_episodes
from gpadjust.control.task import Moment, Steps, Task
from gpadjust.dynamics import Trajectories
from gpadjust.progress import long_work, tick
from gpadjust.states import StateSpec

_PART = 1.5  # horizons of a step that a part of an episode's first plan looks ahead
_FIRST_ROUNDS = 5  # of the plan of an episode that begins
_SHORTEST, _LONGEST = 8, 30  # steps ahead


class Plan(NamedTuple):
    """Actions for an episode, or for the rest of it.

    Args:
        actions: The actions of the steps ahead, ``T x action_dim``.
        next_states: The states to which they lead, ``T x state_dim``, averaged over the functions.
        value: The score of the objective.
        rewards: Rewards of the steps by the model, ``T``, averaged over its functions; 0 after the
            end of the episode.
        reward: Their mean over the steps that are made, when it was last planned to the end.
        left_bounds: The share of the functions in which it leaves the bounds of the states, or
            meets a failure of the physics.
        violation: Violation of the constraints with their margins in the worst step; 0 if none.
        moment: The point of the episode at which the first of the steps is made.
        promised: Rewards of all steps of the episode, as it was last planned to the end.
        estimate: The state as sensors have shown it, with the action taken there; else None.
    """

    actions: Tensor
    next_states: Tensor
    value: float
    rewards: Tensor
    reward: float
    left_bounds: float
    violation: float
    moment: Moment
    promised: Tensor = torch.zeros(0)
    estimate: Estimate | None = None

    @classmethod
    def of(cls, rollout: Steps, n: int, value: float, moment: Moment) -> Plan:
        """Return the plan of the actions that were taken in the n-th episodes of a rollout."""
        made = rollout.made[:, n]
        rewards = rollout.rewards[:, n].masked_fill(~made, 0.0).mean(0)
        return cls(
            actions=rollout.actions[0, n],
            next_states=rollout.next_states[:, n].mean(0),
            value=value,
            rewards=rewards,
            reward=float(rewards.sum() / made.double().mean(0).sum().clamp_min(1e-12)),
            left_bounds=float(rollout.left_bounds[:, n].any(-1).double().mean()),
            violation=float(rollout.violation[:, n].mean(0).max()),
            moment=moment,
        )

    def taken(self, estimate: Estimate | None) -> Plan:
        """Return the plan after its first action was made."""
        action = self.actions[0]
        return self._replace(
            actions=self.actions[1:],
            next_states=self.next_states[1:],
            moment=self.moment.after(action),
            estimate=estimate and estimate._replace(action=action),
        )


@dataclass(frozen=True)
class Planner:
    """Plans actions by an objective, such as the return, in a model of the system.

    Sequences of actions are proposed, random piecewise constant ones, or ones about an earlier
    plan. Each is followed through the model, along its mean or through functions drawn from its
    posterior. The cross-entropy method improves them (Rubinstein 1999): each round draws as many
    from a normal distribution with mean and standard deviation of the best so far, step by step.

    Args:
        objective: What to look for: :class:`Return`, or your own.
        rounds: Rounds after the first sequences; 0 takes the best of these.
        num_elites: Number of best sequences that stay in a round.
        correlation: Of the deviations from the mean of a step and the next one, in [0, 1): higher
            for smoother actions (Pinneri et al. 2020).
        horizon: The most time to look ahead, in the time unit of ``spec.step``; in steps where the
            spec has none. Default: to the end of the episode (of a step's plan in :class:`MPC`: a
            third of the episode, of 8 to 30 steps).
        num_functions: Number of functions of the posterior that each sequence is followed through;
            None for the mean of the model, which takes least time
            (:meth:`~gpadjust.dynamics.LearnedDynamics.mean_function`).
        num_random: Number of random sequences, or of those drawn about an earlier plan.
        max_hold: The most steps that a random sequence holds an action.
        spread: Standard deviation about an earlier plan, as a share of the range of the actions.
        seconds: The most time that a plan takes. A round of the search that would take longer does
            not begin; if even the first one would, its sequences are followed, and compared, as far
            as there is time, one step of the model at least. Default: as long as it takes.

    Raises:
        TypeError: If the objective or a number is of another kind.
        ValueError: If a number is out of range.

    Example:
        >>> import torch
        >>> from gpadjust.control import Planner, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(point, lambda states, actions, next_states: -next_states[:, 0].abs())
        >>> plan = Planner().plan(task, torch.ones(1).double(), [[-1.0], [1.0]], num_steps=3)
        >>> plan.actions.shape, plan.value > -1
        (torch.Size([3, 1]), True)
    """

    objective: Objective = field(default_factory=Return)
    _: KW_ONLY
    rounds: int = 1
    num_elites: int = 12
    correlation: float = 0.5
    horizon: float | None = None
    num_functions: int | None = None
    num_random: int = 128
    max_hold: int = 5
    spread: float = 0.15
    seconds: float | None = None

    def __post_init__(self) -> None:
        """Check objective and numbers."""
        check_objective(self.objective, self.num_functions)
        for name, least in {"rounds": 0, "num_elites": 1, "num_random": 1, "max_hold": 1}.items():
            checked_whole(name, getattr(self, name), least)
        for name in ("horizon", "seconds"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), above=0)
        checked_number("correlation", self.correlation, least=0, below=1)
        checked_number("spread", self.spread, above=0, below=1)

    def steps_ahead(self, spec: StateSpec, left: int | None) -> int:
        """Return the number of steps to plan, of the steps ``left``; a ValueError if there is none.

        None is left where an episode has no length.
        """
        limits = [] if left is None else [left]
        if self.horizon is not None:
            step = spec.step or 1.0
            limits.append(round(self.horizon / step))
            if self.horizon < step * (1 - 1e-9):
                raise ValueError(
                    f"horizon must be one step at least, which takes {step:g} in the time unit of "
                    f"StateSpec(step=...); found {self.horizon:g}."
                )
        if not limits or min(limits) < 1:
            raise ValueError(
                f"Expected a number of steps >= 1 to plan, found {left}; give the task an "
                "episode_length, or the planner a horizon."
            )
        return min(limits)

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        state: Tensor,
        action_bounds: ArrayLike,
        num_steps: int | None = None,
        *,
        earlier: Plan | None = None,
        moment: Moment | None = None,
        covariance: Tensor | None = None,
        deadline: float | None = None,
    ) -> Plan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Args:
            task: The task, whose dynamics have learnt from transitions. Its constraints have
                margins along the earlier plan, or along one that was made without them first.
            state: Where the episode is, ``state_dim``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
            num_steps: Number of steps before the end. Default: the episode length of the task.
            earlier: A plan to begin with; its last action is held where it is shorter.
            moment: The point of the episode. Default: its beginning.
            covariance: That of the state, ``state_dim x state_dim``, if it is estimated.
            deadline: Until when, by ``time.perf_counter``. Default: for ``seconds``.

        Raises:
            ValueError: If ``state`` or ``action_bounds`` have another shape, bounds are not finite,
                or there is no number of steps.
            RuntimeError: If the dynamics have learnt nothing yet.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        if deadline is None:
            deadline = math.inf if self.seconds is None else time.perf_counter() + self.seconds
        moment, spec = Moment() if moment is None else moment, task.dynamics.spec
        bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        num_steps = self.steps_ahead(spec, task.episode_length if num_steps is None else num_steps)
        if task.constraints is not None:
            if earlier is None:
                rollouts = Rollouts(task, self.num_functions, moment, deadline=deadline)
                earlier = self._searched(rollouts, state, bounds, num_steps, None)
            actions = earlier.actions[:num_steps]
            path = torch.cat([state.unsqueeze(0), earlier.next_states])[: len(actions)]
            moment = moment._replace(margins=margins(task, path, actions, bounds, covariance))
        rollouts = Rollouts(task, self.num_functions, moment, deadline=deadline)
        return self._searched(rollouts, state, bounds, num_steps, earlier)

    def _searched(
        self,
        rollouts: Rollouts,
        state: Tensor,
        bounds: Tensor,
        num_steps: int,
        earlier: Plan | None,
    ) -> Plan:
        """Return the best plan that the cross-entropy method finds."""
        score = self.objective.of(rollouts.task)
        new = self._proposed(num_steps, bounds, earlier)
        sequences, scores, plan = new[:0], torch.zeros(0), cast(Plan, None)
        for number in range(self.rounds + 1):
            if number > 0:
                # The best so far, and as many new ones from their mean and standard deviation.
                elites = scores.topk(min(self.num_elites, len(scores))).indices
                sequences, scores = sequences[elites], scores[elites]
                mean, sd = sequences.mean(0), sequences.std(0, correction=0)
                drawn = mean + sd * _correlated_noise(new.shape, self.correlation)
                new = torch.clamp(drawn, bounds[0], bounds[1])
            rollout = rollouts.follow(state, new)
            tick("rounds")
            if number > 0 and rollout.made.shape[-1] < num_steps:  # no time left
                break
            found = score(rollout)
            if found.shape != (len(new),) or found.isnan().any():
                raise ValueError(
                    f"{type(self.objective).__name__} must return one score per sequence, shape "
                    f"({len(new)},), none of them nan; found shape {tuple(found.shape)}."
                )
            best = int(found.argmax())
            if number == 0 or found[best] > plan.value:
                plan = Plan.of(rollout, best, float(found[best]), rollouts.moment)
            sequences, scores = torch.cat([sequences, new]), torch.cat([scores, found])
            if not rollouts.has_time(num_steps):
                break
        return plan

    def _proposed(self, num_steps: int, bounds: Tensor, earlier: Plan | None) -> Tensor:
        """Return the sequences that a search begins with, ``n x num_steps x action_dim``."""
        if earlier is None:
            return random_sequences(self.num_random, num_steps, bounds, self.max_hold)
        held = torch.arange(num_steps).clamp_max(len(earlier.actions) - 1)
        known = earlier.actions[held]
        noise = _correlated_noise((self.num_random, *known.shape), 0.5)
        drawn = known + self.spread * (bounds[1] - bounds[0]) * noise
        return torch.cat([known.unsqueeze(0), torch.clamp(drawn, bounds[0], bounds[1])])


def _correlated_noise(shape: Sequence[int], correlation: float) -> Tensor:
    """Draw standard normal noise ``n x T x a`` whose steps are correlated."""
    noise = torch.randn(*shape, dtype=torch.float64)
    if correlation:
        fresh = math.sqrt(1 - correlation**2)
        for t in range(1, shape[1]):
            noise[:, t] = correlation * noise[:, t - 1] + fresh * noise[:, t]
    return noise


class MPC:
    """Model predictive control: at each step the steps ahead are planned, and the first is made.

    :meth:`step` maps a measurement to an action, in a loop of your own; :meth:`learn` lets the
    dynamics learn what was measured. Before that it plans in the physics.

    Args:
        task: The task. Its dynamics are what :meth:`learn` updates.
        action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        each_step: Plans at each step but the first. A horizon must be as long as the manoeuvre
            needs, as energy must be put into a pole before it can stand: try it in f_p alone
            (:class:`~gpadjust.dynamics.PhysicsDynamics`) first.
        first: Plans when an episode begins, which has not to be in time. Default: five rounds of
            the whole episode, or as far as ``each_step`` if it has no length; objective and
            functions are those of ``each_step``.
        tolerance: Where the plan of a step is worth less than was promised of its steps by more
            than this share of the range of the promised rewards (a step, on average), the rest is
            planned as when the episode began; where ``each_step`` has ``seconds``, about that plan,
            if half of these are left. None for never.
        state_filter: Of a task with sensors, by which observations are states. Default: the one
            before there are data.

    Raises:
        TypeError: If the task or a planner is of another kind.
        ValueError: If a horizon is shorter than a step, or ``action_bounds`` are no bounds.

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
        state_filter: StateFilter | None = None,
    ) -> None:
        check_kind("task", task, Task, "a Task(dynamics, reward, ...)")
        for name, planner in (("each_step", each_step), ("first", first)):
            check_kind(name, planner, Planner | None, "a Planner(...)")
        if tolerance is not None:
            checked_number("tolerance", tolerance, above=0)
        length, spec = task.episode_length, task.dynamics.spec
        each_step = Planner() if each_step is None else each_step
        if each_step.horizon is None:
            steps = min(max((length or 0) // 3, _SHORTEST), _LONGEST)
            each_step = replace(each_step, horizon=steps * (spec.step or 1.0))
        if first is None:
            like = {name: getattr(each_step, name) for name in ("objective", "num_functions")}
            whole = each_step.horizon if length is None else None
            first = Planner(rounds=_FIRST_ROUNDS, **like, horizon=whole)
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
        """The task in what its dynamics have learnt, or in the physics before that."""
        dynamics = self.task.dynamics
        newest = dynamics.before_data() or dynamics
        return self.task if newest is dynamics else replace(self.task, dynamics=newest)

    # The loop of the user

    def reset(self) -> None:
        """Begin an episode: forget the plan, and go on with nothing but what was learnt."""
        self._plan: tuple[Plan, ...] | None = None
        self._last: tuple[Tensor, Tensor] | None = None  # measurement and action

    def step(self, measurement: ArrayLike) -> NDArray[np.float64]:
        """Choose the action after a measurement; both are recorded for :meth:`learn`.

        Args:
            measurement: ``observation_dim`` numbers of the task's spec, or of its sensors.

        Returns:
            The action, ``action_dim`` numbers within the bounds.

        Raises:
            ValueError: If the measurement has another shape, or numbers that are not finite. No
                transition goes across it; the plan stays.
            RuntimeError: If there is neither a physics nor anything learnt.
        """
        row = self._recorded(measurement)
        actions, self._plan = self._advance(row.unsqueeze(0), self._plan or [None], 0)
        self._last = row, actions[0]
        return actions[0].numpy().copy()

    def observe(self, measurement: ArrayLike) -> None:
        """Record the measurement with which an episode ends; a ValueError as of :meth:`step`."""
        self._recorded(measurement)

    def _recorded(self, measurement: ArrayLike) -> Tensor:
        """Return a measurement, checked; record the transition to it, if there is one."""
        last, self._last = self._last, None  # no transition goes across what fails from here on
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
        """Let the dynamics learn, and go on in the newest model.

        Args:
            data: Trajectories of states. Default: the transitions between measurements of
                :meth:`step` and :meth:`observe` that were not learnt yet. With sensors, the
                states behind all of them are estimated first.

        Raises:
            ValueError: If there is no new transition; or trajectories of a task with sensors.
            PhysicsError: If the physics fails at a transition.
        """
        hidden, number = self.filter is not None, self._num_learnt
        if data is not None:
            told = "Trajectories(states, actions, next_states, episode) of tensors"
            check_kind("data", data, Trajectories, told)
        if data is not None and hidden:
            raise ValueError(
                "The states behind trajectories of sensors are estimated from what `step` has "
                "recorded; call learn() without data."
            )
        if data is None:
            number = len(self._steps)
            if number == self._num_learnt:
                raise ValueError(
                    "There is no new transition to learn, which takes a measurement, an action and "
                    "the measurement after it: call `step` first, or pass trajectories."
                )
            # The states behind all measurements of sensors are known better by now.
            known = self._states_of(self._steps)
            data = known if hidden else known.subset(slice(self._num_learnt, None))
            warn_of_delay(self.task.dynamics, known, number - self._num_learnt)
        teach(self.task, data)
        self._num_learnt = number
        return self

    def _states_of(self, steps: Sequence[tuple[Tensor, Tensor, Tensor, int]]) -> Trajectories:
        """Return transitions of the states, which of sensors are estimated in the newest model."""
        *columns, run = zip(*steps, strict=True)
        before, actions, after = (torch.stack(column) for column in columns)
        seen = Trajectories(before, actions, after, torch.tensor(run))
        if self.filter is None:
            return decoded(self.task.dynamics.spec, seen)
        number = len(seen.episodes())  # a seed
        self.filter, states = smooth_episodes(self.model, self.filter, seen, number)
        return states

    def __repr__(self) -> str:
        """Name the dynamics, and how much they have learnt."""
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
        """Plan actions, as policies of Stable-Baselines3 do, whose ``evaluate_policy`` takes it.

        Arguments and result are those of :meth:`~gpadjust.control.Agent.predict`. The state is the
        plan of each episode. Without one all episodes begin. If ``deterministic``, the search is
        always the same. Nothing is recorded.
        """
        check_observation(observation)
        rows = torch.as_tensor(np.atleast_2d(observation), dtype=torch.float64)
        episodes = going_on(state, episode_start, len(rows))
        found, plans = self._advance(rows, episodes, 0 if deterministic else None)
        actions = found.numpy().astype(np.float32)
        return (actions if np.ndim(observation) > 1 else actions[0]), plans

    def _advance(
        self, rows: Tensor, episodes: Sequence[Plan | None], seed: int | None
    ) -> tuple[Tensor, tuple[Plan, ...]]:
        """Return the actions of episodes at observations, and their plans from there on."""
        task = self.model
        estimates: Sequence[Estimate | None] = [None] * len(rows)
        if self.filter is None:
            states = [*task.dynamics.spec.decode(rows)]
        else:
            before = [each and each.estimate for each in episodes]
            found = estimates = self.filter.follow(task, rows, before)
            states = [each.mean for each in found]
        plans = []
        for state, earlier, estimate in zip(states, episodes, estimates, strict=True):
            # The seed makes a plan the same whatever the other rows are.
            with seeded(seed), long_work("plan", "rounds"):
                plan = self._planned(state, earlier, estimate and estimate.covariance)
            plans.append(plan.taken(estimate))
        actions = [cast(Tensor, plan.moment.action) for plan in plans]
        return torch.stack(actions), tuple(plans)

    def _planned(self, state: Tensor, earlier: Plan | None, covariance: Tensor | None) -> Plan:
        """Return the steps ahead of an episode at a state, which has the covariance."""
        begun, task, seconds = time.perf_counter(), self.model, self.each_step.seconds
        moment = Moment() if earlier is None else earlier.moment
        left = None  # beyond the episode's length it looks as far ahead as ever
        if task.episode_length is not None and moment.steps_done < task.episode_length:
            left = task.episode_length - moment.steps_done
        at: Any = task, state, self.action_bounds, left
        how: dict[str, Any] = {"moment": moment, "covariance": covariance}
        if earlier is None or not len(earlier.actions):
            return self._promising(self._anew(*at, **how), earlier)
        if seconds is not None:
            how["deadline"] = begun + seconds
        plan = self.each_step.plan(*at, earlier=earlier, **how)
        k = len(plan.actions)
        merged = earlier._replace(
            actions=torch.cat([plan.actions, earlier.actions[k:]]),
            next_states=torch.cat([plan.next_states, earlier.next_states[k:]]),
            left_bounds=plan.left_bounds,
            violation=plan.violation,
        )
        if not self._disappoints(plan, earlier):
            return merged
        if seconds is None:
            return self._promising(self._anew(*at, **how), earlier)
        if begun + seconds - time.perf_counter() < seconds / 2:
            return merged
        plan = self.first.plan(*at, earlier=merged, **how)
        is_whole = len(plan.actions) >= len(merged.actions)
        return self._promising(plan, earlier) if is_whole else merged

    def _anew(self, task: Task, state: Tensor, bounds: Tensor, left: int | None, **at: Any) -> Plan:
        """Return a plan of the steps ahead without an earlier one: the better of two searches.

        One begins with random sequences. Of an unstable system those of a whole episode tell
        nothing; the other search begins with a plan that is made in the model part by part.
        """
        plan = self.first.plan(task, state, bounds, left, **at)
        horizon, is_limited = self.each_step.horizon, self.first.horizon or self.first.seconds
        if horizon is None or left is None or is_limited:
            return plan
        ahead = replace(self.first, horizon=_PART * horizon)
        moment, here, done = at["moment"], state, 0
        part: Plan | None = None
        if ahead.steps_ahead(task.dynamics.spec, left) >= left:
            return plan
        actions, states = bounds[:0], state.unsqueeze(0)[:0]
        while done < left:
            part = ahead.plan(task, here, bounds, left - done, earlier=part, moment=moment)
            k = len(part.actions)
            k = k if done + k == left else -(-k // 2)  # half of it is made
            made, here = part.actions[:k], part.next_states[k - 1]
            actions, states = torch.cat([actions, made]), torch.cat([states, part.next_states[:k]])
            part = part._replace(actions=part.actions[k:], next_states=part.next_states[k:])
            for action in made:
                moment = moment.after(action)
            done += k
        rough = plan._replace(actions=actions, next_states=states)
        other = self.first.plan(task, state, bounds, left, earlier=rough, **at)
        return max(plan, other, key=lambda each: each.value)

    @staticmethod
    def _promising(plan: Plan, earlier: Plan | None) -> Plan:
        """Return a plan of all steps ahead, with the rewards that it promises of the episode."""
        made = plan.rewards[:0] if earlier is None else earlier.promised[: plan.moment.steps_done]
        return plan._replace(promised=torch.cat([made, plan.rewards]))

    def _disappoints(self, plan: Plan, earlier: Plan) -> bool:
        """Return whether a plan is worth much less than its steps had promised."""
        if self.tolerance is None:
            return False
        if plan.left_bounds > earlier.left_bounds:
            return True  # its missing rewards would look like good ones
        promised = earlier.promised[earlier.moment.steps_done :][: len(plan.rewards)]
        if not len(promised):  # an episode may be longer than what was planned
            return False
        loss = (promised - plan.rewards[: len(promised)]).mean()
        return bool(loss > self.tolerance * (earlier.promised.max() - earlier.promised.min()))


Kept = TypeVar("Kept")


def going_on(state: Sequence[Kept] | None, episode_start: Any, n: int) -> list[Kept | None]:
    """Return what a policy kept of each of ``n`` episodes, its state; None of those that begin."""
    if state is None:
        return [None] * n
    begins = np.zeros(n, dtype=bool) if episode_start is None else np.atleast_1d(episode_start)
    return [None if new else kept for kept, new in zip(state, begins, strict=True)]
