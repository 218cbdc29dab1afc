"""Model predictive control: plans of actions, and a controller that plans at every step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import reduce
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole, seeded
from gpadjust.control.constraints import margins
from gpadjust.control.episodes import decoded, teach
from gpadjust.control.faults import check_observation
from gpadjust.control.reach import random_sequences
from gpadjust.control.rollouts import Objective, Return, Rollout, Rollouts
from gpadjust.control.state_filter import Estimate, StateFilter, smooth_episodes
from gpadjust.control.task import Task
from gpadjust.dynamics import Trajectories
from gpadjust.states import StateSpec

_SHORTEST, _LONGEST = 8, 30  # steps ahead
_SEGMENT = 1.5  # horizons of a step


@dataclass(frozen=True)
class CrossEntropy:
    """The cross-entropy method (Rubinstein 1999).

    Each round draws as many sequences as the first ones from a normal distribution with mean and
    standard deviation of the best so far, step by step, clipped to the bounds. The best stay.

    Args:
        rounds: Rounds after the first sequences; 0 takes the best of these.
        num_elites: How many are the best.
        correlation: Of the deviations from the mean of a step and the next one, in [0, 1): higher
            for smoother actions (Pinneri et al. 2020).

    Raises:
        TypeError: If a number is of another kind.
        ValueError: If it is out of range.
    """

    rounds: int = 2
    _: KW_ONLY
    num_elites: int = 8
    correlation: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        checked_whole("rounds", self.rounds, 0)
        checked_whole("num_elites", self.num_elites, 1)
        checked_number("correlation", self.correlation, least=0, below=1)

    def best(
        self, score: Callable[[Tensor], Tensor], first: Tensor, bounds: Tensor
    ) -> tuple[Tensor, float]:
        """Search, from PyTorch's generator.

        Args:
            score: Scores ``n`` of sequences ``n x T x action_dim``, higher is better; called once a
                round. When there is no time left, it raises an exception, which comes through.
            first: The sequences to begin with, ``n x T x action_dim``.
            bounds: Lower and upper bounds of the actions, ``2 x action_dim``.

        Returns:
            The sequence, ``T x action_dim``, one of those whose score was asked, and its score.
        """
        sequences, scores = first, score(first)
        for _ in range(self.rounds):
            elites = scores.topk(min(self.num_elites, len(scores))).indices
            sequences, scores = sequences[elites], scores[elites]
            mean, sd = sequences.mean(0), sequences.std(0, correction=0)
            noise = _correlated_noise(first.shape, self.correlation)
            drawn = torch.clamp(mean + sd * noise, bounds[0], bounds[1])
            sequences, scores = torch.cat([sequences, drawn]), torch.cat([scores, score(drawn)])
        best = int(scores.argmax())
        return sequences[best], float(scores[best])


def _correlated_noise(shape: torch.Size, correlation: float) -> Tensor:
    """Draw standard normal noise ``n x T x a`` whose steps are correlated."""
    noise = torch.randn(shape, dtype=torch.float64)
    if correlation:
        fresh = math.sqrt(1 - correlation**2)
        for t in range(1, shape[1]):
            noise[:, t] = correlation * noise[:, t - 1] + fresh * noise[:, t]
    return noise


class Plan(NamedTuple):
    """Actions for an episode, or for the rest of it.

    Args:
        actions: Those of the steps ahead, ``T x action_dim``.
        next_states: The states to which they lead, ``T x state_dim``, averaged over the functions.
        value: The score of the objective.
        rewards: Rewards of the steps by the model, ``T``, averaged over its functions; 0 after the
            end of the episode.
        made: The share of the functions in which each step is made, ``T``: 0 after the end.
        left_bounds: The share of the functions in which it leaves the bounds of the states, or
            meets a failure of the physics.
        violation: How far constraints with their margins are violated in the worst step; 0 if none.
        promised: Of an episode under way, the rewards of all its steps, those made included, as
            they were foreseen when it was last planned to its end.
        reward: What was promised then of a step that is made, on average.
        steps_done: The number of steps that were made.
        before: The last action that was made, ``action_dim``; None where an episode begins.
        estimate: The state as sensors have shown it, and the action that was taken there; None of a
            task without sensors.
    """

    actions: Tensor
    next_states: Tensor
    value: float
    rewards: Tensor
    made: Tensor
    left_bounds: float
    violation: float = 0.0
    promised: Tensor = torch.zeros(0)
    reward: float = math.nan
    steps_done: int = 0
    before: Tensor | None = None
    estimate: Estimate | None = None

    @classmethod
    def of(cls, rollout: Rollout, n: int, value: float) -> Plan:
        """Return the plan of the actions that were taken in the n-th episodes of a rollout."""
        made = rollout.made[:, n]
        return cls(
            rollout.actions[0, n],
            rollout.next_states[:, n].mean(0),
            value,
            rollout.rewards[:, n].masked_fill(~made, 0.0).mean(0),
            made.double().mean(0),
            float(rollout.left_bounds[:, n].double().mean()),
            float(rollout.violation[:, n].mean(0).max()),
        )

    def taken(self, estimate: Estimate | None) -> Plan:
        """Return the plan after its first action was made."""
        action = self.actions[0]
        if estimate is not None:
            estimate = estimate._replace(action=action)
        return self._replace(
            actions=self.actions[1:],
            next_states=self.next_states[1:],
            steps_done=self.steps_done + 1,
            before=action,
            estimate=estimate,
        )


PlanState = tuple[Plan, ...]
"""The plan of each episode."""


@dataclass(frozen=True)
class Planner:
    """Plans actions by an objective, such as the return, in a model of the system.

    Sequences of actions are proposed; each is followed through the model, along its mean or
    through functions drawn from its posterior; and a search improves them. At first they are random
    piecewise constant ones; where there is an earlier plan, they are drawn about it. :class:`MPC`
    plans again at every step.

    Args:
        objective: What to look for: :class:`Return`, or your own.
        search: How the sequences are improved.
        horizon: The most time to look ahead, in the time unit of ``spec.step``; in steps where the
            spec has none. Default: to the end of the episode.
        num_functions: How many functions of the posterior each sequence is followed through; None
            for the mean of the model alone, which takes least time. (Of a sampled model it is the
            mean of some samples, two or more, see
            :meth:`~gpadjust.dynamics.LearnedDynamics.mean_function`.)
        num_random: Number of random sequences, or of those drawn about an earlier plan.
        max_hold: The most steps that a random sequence holds an action.
        spread: Standard deviation of what is drawn about an earlier plan, as a share of the range
            of the actions.
        seconds: The most time that a plan takes. A round of the search that would take longer does
            not begin; if even the first one would, its sequences are followed, and compared, as far
            as there is time, one step of the model at least. Default: as long as it takes.
        segment: Without an earlier plan, one more search begins with a plan in segments of this
            duration (in the unit of ``horizon``): half of a segment is made in the model, where the
            next one is planned. Of an unstable system, random sequences of a whole episode tell
            nothing. Default: none.

    Raises:
        TypeError: If objective or search is none, or a number is of another kind.
        ValueError: If a number is out of range, or there is nothing to choose from.

    Example:
        >>> import torch
        >>> from gpadjust.control import Planner, Return, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(point, lambda states, actions, next_states: -next_states[:, 0].abs())
        >>> bounds = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
        >>> plan = Planner(Return()).plan(task, torch.ones(1).double(), bounds, 3)
        >>> plan.actions.shape, plan.value > -1
        (torch.Size([3, 1]), True)
    """

    objective: Objective = field(default_factory=Return)
    search: CrossEntropy = field(default_factory=CrossEntropy)
    _: KW_ONLY
    horizon: float | None = None
    num_functions: int | None = None
    num_random: int = 80
    max_hold: int = 5
    spread: float = 0.1
    seconds: float | None = None
    segment: float | None = None

    def __post_init__(self) -> None:
        """Check objective, search and numbers."""
        kind = "an object of an Objective, such as Return()"
        check_kind("objective", self.objective, Objective, kind)
        check_kind("search", self.search, CrossEntropy, "a CrossEntropy(...)")
        for name in ("num_random", "max_hold", "num_functions"):
            if getattr(self, name) is not None or name != "num_functions":
                checked_whole(name, getattr(self, name), 1)
        for name in ("horizon", "seconds", "segment"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), above=0)
        self.objective.check_functions(self.num_functions)
        checked_number("spread", self.spread, above=0, below=1)
        if None not in (self.seconds, self.segment):
            raise ValueError("A plan in segments has no time limit; leave out seconds or segment.")

    def steps_ahead(self, spec: StateSpec) -> int | None:
        """Return the horizon in steps; None to the end of the episode.

        Raises:
            ValueError: If it is shorter than a step.
        """
        return _in_steps("horizon", self.horizon, spec)

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        state: Tensor,
        action_bounds: ArrayLike,
        num_steps: int | None = None,
        *,
        known: Tensor | None = None,
        steps_done: int = 0,
        before: Tensor | None = None,
        margins: Tensor | None = None,
    ) -> Plan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Args:
            task: The task, whose dynamics have learnt from transitions. Steps beyond its bounds are
                not made.
            state: Where the episode is, ``state_dim``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``, finite.
            num_steps: How many steps are ahead; the plan is of these or of the horizon, ``T``.
                Default: the episode length of the task.
            known: An earlier plan, ``t x action_dim``; its last action is held where it is shorter.
            steps_done: How many steps the episode has made by then.
            before: The last action that was made, from which the next one may differ by the task's
                ``action_rate`` alone. Default: none, where an episode begins.
            margins: Those of the constraints, ``T x c``; see
                :func:`~gpadjust.control.constraints.margins`. Default: they hold in the mean.

        Raises:
            ValueError: If ``state`` or ``action_bounds`` have another shape, bounds are not finite,
                or nobody says how many steps there are.
            RuntimeError: If the dynamics have learnt nothing yet.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        deadline = math.inf if self.seconds is None else time.perf_counter() + self.seconds
        spec = task.dynamics.spec
        action_bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        num_steps = self._checked_steps(task, state, num_steps)
        score = self.objective.of(task)
        options: dict[str, Any] = {"margins": margins, "before": before, "deadline": deadline}
        rollouts = Rollouts(task, self.num_functions, **options)
        best: list[Plan] = []  # so far, the newest last

        def scored(sequences: Tensor) -> Tensor:
            if best and not rollouts.has_time(num_steps):
                raise _TimeIsUp
            rollout = rollouts.follow(state, sequences, steps_done)
            if best and rollout.made.shape[-1] < num_steps:
                raise _TimeIsUp
            scores = self._checked_scores(score(rollout), len(sequences))
            n = int(scores.argmax())
            if not best or scores[n] > best[-1].value:
                best.append(Plan.of(rollout, n, float(scores[n])))
            return scores

        segment = _in_steps("segment", self.segment, spec)
        known = None if known is None or not len(known) else known
        with suppress(_TimeIsUp):
            first = self._proposed(num_steps, action_bounds, known)
            self.search.best(scored, first, action_bounds)
            if known is None and segment is not None and segment < num_steps:
                where = task, state, action_bounds, num_steps
                parts = self._in_segments(*where, before, steps_done)
                first = self._proposed(num_steps, action_bounds, parts)
                self.search.best(scored, first, action_bounds)
        return best[-1]

    def _in_segments(
        self,
        task: Task,
        state: Tensor,
        action_bounds: Tensor,
        num_steps: int,
        before: Tensor | None,
        steps_done: int,
    ) -> Tensor:
        """Return actions ``num_steps x action_dim`` of segments that overlap by half."""
        ahead = replace(self, horizon=self.segment, segment=None)
        actions, known = action_bounds[:0], None
        while (left := num_steps - len(actions)) > 0:
            done = steps_done + len(actions)
            options: dict[str, Any] = {"known": known, "before": before, "steps_done": done}
            plan = ahead.plan(task, state, action_bounds, left, **options)
            k = left if len(plan.actions) == left else -(-len(plan.actions) // 2)
            actions, known = torch.cat([actions, plan.actions[:k]]), plan.actions[k:]
            state, before = plan.next_states[k - 1], plan.actions[k - 1]
        return actions

    def _proposed(self, num_steps: int, bounds: Tensor, known: Tensor | None) -> Tensor:
        """Return the sequences that a search begins with, ``n x num_steps x action_dim``."""
        if known is None:
            return random_sequences(self.num_random, num_steps, bounds, self.max_hold)
        if known.dim() != 2 or known.shape[-1] != bounds.shape[-1]:
            raise ValueError(
                f"Expected known of shape {num_steps} x {bounds.shape[-1]}, found "
                f"{tuple(known.shape)}."
            )
        known = known[torch.arange(num_steps).clamp_max(len(known) - 1)]
        noise = _correlated_noise(torch.Size((self.num_random, *known.shape)), 0.5)
        drawn = known + self.spread * (bounds[1] - bounds[0]) * noise
        return torch.cat([known.unsqueeze(0), torch.clamp(drawn, bounds[0], bounds[1])])

    def _checked_scores(self, scores: Tensor, n: int) -> Tensor:
        """Return the scores of ``n`` sequences by the objective, which may be -inf."""
        if scores.shape != (n,) or scores.isnan().any():
            name = type(self.objective).__name__
            found = "nan" if scores.shape == (n,) else f"shape {tuple(scores.shape)}"
            raise ValueError(
                f"{name} must return one score per sequence, shape ({n},), none of them nan; found "
                f"{found}."
            )
        return scores

    def _checked_steps(self, task: Task, state: Tensor, num_steps: int | None) -> int:
        """Check the arguments, and return the number of steps to plan."""
        spec = task.dynamics.spec
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        horizon = self.steps_ahead(spec)
        num_steps = task.episode_length if num_steps is None else num_steps
        num_steps = horizon if num_steps is None else num_steps
        if num_steps is None or num_steps < 1:
            raise ValueError(
                f"Expected num_steps as a number of steps >= 1, found {num_steps}; pass it, or "
                "give the task an episode_length, or the planner a horizon."
            )
        return num_steps if horizon is None else min(num_steps, horizon)


class _TimeIsUp(Exception):  # noqa: N818 - no error
    """Raised in a search whose next round would take too long."""


def _in_steps(name: str, duration: float | None, spec: StateSpec) -> int | None:
    """Return the number of steps nearest to a duration in the time unit of the spec.

    Raises:
        ValueError: If it is shorter than a step.
    """
    if duration is None:
        return None
    step = spec.step or 1.0
    if duration < step * (1 - 1e-9):
        raise ValueError(
            f"{name} must be one step at least, which takes {step:g} in the time unit of "
            f"StateSpec(step=...); found {duration:g}."
        )
    return round(duration / step)


EACH_STEP = Planner(
    search=CrossEntropy(1, num_elites=12, correlation=0.5), num_random=128, spread=0.15
)
"""The default plan of a step: two looks at 128 sequences, of eight to 30 steps."""

FIRST = replace(EACH_STEP, search=replace(EACH_STEP.search, rounds=5))
"""The default plan of an episode that begins: the whole of it, at once and in segments."""


class _Run(NamedTuple):
    """Measurements of steps that followed each other, and the actions taken there."""

    observations: list[Tensor]
    actions: list[Tensor]

    @property
    def num_transitions(self) -> int:
        return min(len(self.observations) - 1, len(self.actions)) if self.actions else 0

    def whole(self) -> Trajectories:
        """Return the whole transitions, measurements in the place of states."""
        n = self.num_transitions
        seen = torch.stack(self.observations[: n + 1])
        return Trajectories(seen[:-1], torch.stack(self.actions[:n]), seen[1:], torch.zeros(n))


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
        hidden, number = self.task.sensors is not None, self._num_learnt
        if data is not None and hidden:
            raise ValueError(
                "The states behind trajectories of sensors are estimated from what `step` has "
                "recorded; call learn() without data."
            )
        if data is None:
            runs = [run for run in self._runs if run.num_transitions]
            number = sum(run.num_transitions for run in runs)
            if number == self._num_learnt:
                raise ValueError(
                    "There is no new transition to learn, which takes a measurement, an action and "
                    "the measurement after it: call `step` first, or pass trajectories."
                )
            data = self._trajectories(runs).some(slice(0 if hidden else self._num_learnt, None))
        teach(self.task, data)
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
        data = reduce(Trajectories.append, [run.whole() for run in runs])
        if self.filter is None:
            return decoded(self.task.dynamics.spec, data)
        self.filter, states = smooth_episodes(self.model, self.filter, data, len(runs))
        return states

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
        self, rows: Tensor, episodes: Sequence[Plan | None], seed: int | None
    ) -> tuple[Tensor, PlanState]:
        """Return the actions of episodes at observations, and their plans from there on."""
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
                plans.append(self.plan(state, earlier, covariance).taken(estimate))
        return torch.stack([cast(Tensor, plan.before) for plan in plans]), tuple(plans)

    def plan(
        self, state: Tensor, earlier: Plan | None = None, covariance: Tensor | None = None
    ) -> Plan:
        """Plan the steps ahead of an episode that is at a state.

        Args:
            state: Where it is, ``state_dim``.
            earlier: The plan by then; None at the start.
            covariance: That of the state, ``state_dim x state_dim``, if it is estimated.
        """
        begun, task = time.perf_counter(), self.model
        steps_done = 0 if earlier is None else earlier.steps_done
        before = None if earlier is None else earlier.before
        left = None if task.episode_length is None else max(task.episode_length - steps_done, 1)

        def planned(planner: Planner, along: Plan | None, known: Tensor | None) -> Plan:
            how: dict[str, Any] = {"known": known, "before": before, "steps_done": steps_done}
            if along is not None and task.constraints is not None:
                states = torch.cat([state.unsqueeze(0), along.next_states])[: len(along.actions)]
                path = states, along.actions, self.action_bounds, covariance
                how["margins"] = margins(task, *path)
            return planner.plan(task, state, self.action_bounds, left, **how)

        if earlier is not None and len(earlier.actions):
            horizon = self.each_step.steps_ahead(task.dynamics.spec)
            near = earlier._replace(actions=earlier.actions[:horizon])
            plan = planned(self._in_time(self.each_step, begun), near, earlier.actions)
            k = len(plan.actions)
            merged = earlier._replace(
                actions=torch.cat([plan.actions, earlier.actions[k:]]),
                next_states=torch.cat([plan.next_states, earlier.next_states[k:]]),
                left_bounds=plan.left_bounds,
                violation=plan.violation,
            )
            if not self._disappoints(plan, earlier):
                return merged
            if self.each_step.seconds is not None:
                whole = self._in_time(self.first, begun)
                if (whole.seconds or 0.0) < self.each_step.seconds / 2:
                    return merged
                plan = planned(whole, near, merged.actions)
                is_whole = len(plan.actions) >= len(merged.actions)
                return self._begun(plan, earlier) if is_whole else merged
        plan = planned(self.first, None, None)
        if task.constraints is not None:  # the margins are those of a plan that has none yet
            plan = planned(self.first, plan, plan.actions)
        return self._begun(plan, earlier)

    def _in_time(self, planner: Planner, begun: float) -> Planner:
        """Return the planner, for what is left of the time of a step that has begun."""
        if self.each_step.seconds is None:
            return planner
        left = begun + self.each_step.seconds - time.perf_counter()
        return replace(planner, seconds=max(left, 1e-9), segment=None)

    @staticmethod
    def _begun(plan: Plan, earlier: Plan | None) -> Plan:
        """Return a plan of all steps ahead, with what it promises."""
        reward = float(plan.rewards.sum() / plan.made.sum().clamp_min(1e-12))
        if earlier is None:
            return plan._replace(promised=plan.rewards, reward=reward)
        return plan._replace(
            promised=torch.cat([earlier.promised[: earlier.steps_done], plan.rewards]),
            reward=reward,
            steps_done=earlier.steps_done,
            before=earlier.before,
        )

    def _disappoints(self, plan: Plan, earlier: Plan) -> bool:
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
    """Return what a policy kept of each of ``n`` episodes, its state; None of those that begin."""
    if state is None:
        return [None] * n
    begins = np.zeros(n, dtype=bool) if episode_start is None else np.atleast_1d(episode_start)
    return [None if new else kept for kept, new in zip(state, begins, strict=True)]
