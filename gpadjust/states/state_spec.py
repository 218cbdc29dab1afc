"""Names and kinds of the entries of a system's state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real

import torch
from torch import Tensor

from gpadjust.checks import check_columns, checked_number
from gpadjust.states.spec_checks import (
    check_exogenous,
    check_integrated,
    check_lags,
    check_previous,
    check_reads,
    checked_mapping,
    checked_names,
)

_OFF_CIRCLE = 0.3  # of a sine and cosine that noisy sensors show


@dataclass(frozen=True)
class StateSpec:
    r"""Names and kinds of the entries of a system's state and action.

    A *state* is a row of physical quantities; an *observation* is what a policy sees: the state
    with each angle :math:`\theta` replaced, in its place, by :math:`\sin\theta, \cos\theta`.

    Args:
        states: The names of the state's entries.
        actions: The names of the action's entries.
        angles: The states that are angles in rad. Policy and model see their sine and cosine, and
            changes are the shortest way round the circle.
        exogenous: The states that stay as they are during an episode, such as a target, or follow
            the ``reference`` of a task. The policy sees them; models and physics do not, unless
            ``physics_reads`` names them.
        integrated: For states that a model need not predict, the states that are their
            velocities: :math:`q' = q + h (v + v') / 2`.
        step: The time step :math:`h`, in the time unit of the velocities; needed by ``integrated``.
        previous: For states that hold what another entry was a step before, the name of that
            action or state: ``{"last_force": "force"}``, or ``{"x_1": "x", "x_2": "x_1"}`` for two
            steps back. These are the lagged outputs and inputs of an autoregressive model (NARX).
            What a system does may depend on them, as where it follows its actions with a delay, or
            where not all of its state is measured: policy and models see them, and models need not
            predict them. What holds an angle is an angle.
        physics_reads: The columns of the physics: names of states and actions in its order, such
            as ``["x", "v", "last_force"]`` of a system that follows its force a step late. What the
            physics reads, models read. Default: the states that are neither exogenous nor
            ``previous``, then the actions.

    Raises:
        TypeError: If names are not strings, ``integrated`` or ``previous`` is no mapping or
            ``step`` no number.
        ValueError: If a name is unknown, repeated, or stands for two things that exclude each
            other, ``previous`` goes round in a circle, no state is left to predict, or ``step`` is
            missing or not positive.

    Example:
        >>> import torch
        >>> from gpadjust.states import StateSpec
        >>> spec = StateSpec(["theta", "theta_dot"], ["torque"], angles=["theta"])
        >>> spec.observe(torch.tensor([[0.0, 2.0]]))
        tensor([[0., 1., 2.]])

        A tank of which the level alone is measured, with two earlier levels and a pump's action:

        >>> previous = {"level_1": "level", "level_2": "level_1", "pump_1": "pump"}
        >>> spec = StateSpec(["level", *previous], ["pump"], previous=previous)
        >>> state, action = torch.tensor([3.0, 2.0, 1.0, 0.5]), torch.tensor([0.7])
        >>> spec.complete(state, action, predicted=torch.tensor([4.0]))
        tensor([4.0000, 3.0000, 2.0000, 0.7000])
    """

    states: Sequence[str]
    actions: Sequence[str]
    angles: Sequence[str] = ()
    exogenous: Sequence[str] = ()
    integrated: Mapping[str, str] = field(default_factory=dict, hash=False)
    step: float | None = None
    previous: Mapping[str, str] = field(default_factory=dict, hash=False)
    physics_reads: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Check the names."""
        for name in ("states", "actions", "angles", "exogenous", "physics_reads"):
            object.__setattr__(self, name, checked_names(getattr(self, name), name))
        for name, other, example in (
            ("integrated", "its velocity", {"x": "x_dot"}),
            ("previous", "an action or another state", {"last_force": "force"}),
        ):
            mapping = checked_mapping(getattr(self, name), name, other, example)
            object.__setattr__(self, name, mapping)
        for name in ("states", "actions"):
            if not getattr(self, name):
                raise ValueError(f"{name} must be one or more different names; found none.")
        if isinstance(self.step, bool) or not isinstance(self.step, Real | None):
            raise TypeError(f"step must be a number or None; found {self.step!r}.")
        named = (*self.angles, *self.exogenous, *self.integrated, *self.integrated.values())
        named = (*named, *self.previous)
        unknown = [name for name in named if name not in self.states]
        if unknown:
            raise ValueError(f"There is no state {unknown[0]!r}; the states are {self.states}.")
        check_lags(self.previous, self.states, self.actions, self.angles)
        check_reads(self.physics_reads, self.states, self.actions)
        fixed = (*self.exogenous, *self.integrated, *self.previous)
        twice = [name for name in fixed if fixed.count(name) > 1]
        twice += [name for name in self.integrated.values() if name in fixed]
        if twice:
            raise ValueError(
                f"State {twice[0]!r} is said to be two things: exogenous, integrated, a velocity "
                "and a previous value exclude each other."
            )
        if set(fixed) == set(self.states):
            raise ValueError(
                "No state is left to predict; all are exogenous, integrated or previous values."
            )
        if self.integrated and self.step is None:
            raise ValueError("step must be the duration of a step, as some states are integrated.")
        if self.step is not None:
            object.__setattr__(self, "step", checked_number("step", self.step, above=0))

    @property
    def state_dim(self) -> int:
        """Number of entries of a state."""
        return len(self.states)

    @property
    def action_dim(self) -> int:
        """Number of entries of an action."""
        return len(self.actions)

    @property
    def observation_dim(self) -> int:
        """Number of entries of an observation."""
        return len(self.states) + len(self.angles)

    @cached_property
    def moving(self) -> list[int]:
        """The states that the physics moves, neither exogenous nor previous values."""
        still = (*self.exogenous, *self.previous)
        return [i for i, name in enumerate(self.states) if name not in still]

    @cached_property
    def predicted(self) -> list[int]:
        """The states that a model predicts, those that move and are not integrated."""
        return [i for i in self.moving if self.states[i] not in self.integrated]

    @cached_property
    def exogenous_columns(self) -> list[int]:
        """The states that are exogenous."""
        return [i for i, name in enumerate(self.states) if name in self.exogenous]

    @cached_property
    def previous_columns(self) -> list[int]:
        """The states that hold previous values, read by models beside moving ones and action."""
        return [i for i, name in enumerate(self.states) if name in self.previous]

    @cached_property
    def physics_columns(self) -> list[int]:
        """The columns that the physics reads, of states and actions side by side."""
        if not self.physics_reads:
            return [*self.moving, *range(self.state_dim, self.state_dim + self.action_dim)]
        return [(*self.states, *self.actions).index(name) for name in self.physics_reads]

    @cached_property
    def model_columns(self) -> list[int]:
        """The columns that models read, of states and actions side by side.

        They are moving states, actions, previous values, and what else the physics reads.
        """
        read = [*self.moving, *range(self.state_dim, self.state_dim + self.action_dim)]
        read += self.previous_columns
        return read + [i for i in self.physics_columns if i not in read]

    def physics_inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """The inputs of the physics at states ``... x state_dim``: ``... x d``."""
        return some_columns(side_by_side(states, actions), self.physics_columns)

    @cached_property
    def angle_columns(self) -> list[int]:
        """The states that are angles."""
        return [i for i, name in enumerate(self.states) if name in self.angles]

    def observe(self, states: Tensor) -> Tensor:
        """Observations ``... x observation_dim`` of states ``... x state_dim``."""
        check_columns("states", states, self.state_dim)
        columns = []
        for name, column in zip(self.states, states.unbind(-1), strict=True):
            columns += [column.sin(), column.cos()] if name in self.angles else [column]
        return torch.stack(columns, dim=-1)

    def decode(self, observations: Tensor) -> Tensor:
        r"""States ``... x state_dim`` of observations; angles are in :math:`(-\pi, \pi]`."""
        check_columns("observations", observations, self.observation_dim)
        rest = iter(observations.unbind(-1))
        columns = [
            torch.atan2(next(rest), next(rest)) if name in self.angles else next(rest)
            for name in self.states
        ]
        return torch.stack(columns, dim=-1)

    def check_observations(self, observations: Tensor) -> None:
        """Check observations ``... x observation_dim`` of sensors, which may be noisy.

        Raises:
            ValueError: If there are more or fewer entries, or the sine and cosine of an angle are
                far from the unit circle.
        """
        try:
            check_columns("observations", observations, self.observation_dim)
        except ValueError as error:
            each = [f"sin {n}, cos {n}" if n in self.angles else n for n in self.states]
            raise ValueError(f"{error} The entries are {', '.join(each)}.") from None
        first = 0
        for name in self.states:
            if name not in self.angles:
                first += 1
                continue
            pairs = observations[..., first : first + 2].reshape(-1, 2)
            off = (pairs.norm(dim=-1) - 1).abs()
            if len(off) and off.max() > _OFF_CIRCLE:
                found = ", ".join(f"{value:.3g}" for value in pairs[int(off.argmax())])
                raise ValueError(
                    f"Entries {first} and {first + 1} of an observation must be sine and cosine of "
                    f"the angle {name!r}, found {found}. Correct the order of the states of the "
                    "StateSpec, or which of them are angles; or wrap the environment so that it "
                    "observes what the spec says."
                )
            first += 2

    def change(self, states: Tensor, next_states: Tensor) -> Tensor:
        """The change ``... x state_dim``, of angles the shortest way round."""
        change = next_states - states
        for i in self.angle_columns:
            angle = change[..., i].clone()  # not a view of what is written, for autograd
            change[..., i] = torch.atan2(angle.sin(), angle.cos())
        return change

    def check_transitions(
        self, states: Tensor, next_states: Tensor, actions: Tensor | None = None
    ) -> None:
        r"""Check what is declared against transitions of the system.

        An exogenous state may change by no more than the rounding of single precision. An
        integrated one must follow its velocity as :math:`q' - q = b\, h (v + v') / 2` with
        :math:`b = 1`. With the way :math:`w = \sum h (|v| + |v'|) / 2`, or :math:`\sum |q' - q|`
        where that is more,

        - it does not, as with a wrong ``step``, if the least squares estimate of :math:`b` is so
          far from 1 that this makes up more than :math:`0.1\, w` beside three of its standard
          errors;
        - there is a warning if the discrepancies sum up to more than :math:`0.5\, w`, as those of
          another state's velocity do, or of noisy sensors while nothing moves.

        The trapezoid itself errs by :math:`h^3 |\ddot v| / 12` a step: of an oscillation by less
        than a tenth if it is sampled six times a period or more. A previous action must be the
        action to a thousandth of the largest of that action; a previous state must be that state to
        the rounding of single precision.

        Args:
            states: ``N x state_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured, which is not
                checked.
            actions: ``N x action_dim``; may be left out if no state is a previous action.

        Raises:
            ValueError: If a state, which is named, is not what it is said to be, or there are
                previous actions, but no ``actions``.

        Warns:
            UserWarning: If an integrated state is far from what its velocity says.
        """
        check_columns("states", states, self.state_dim)
        check_columns("next_states", next_states, self.state_dim)
        if states.shape != next_states.shape:
            raise ValueError(
                "Expected states and next_states with as many rows, got shapes "
                f"{tuple(states.shape)} and {tuple(next_states.shape)}."
            )
        change = self.change(states, next_states)
        size = torch.maximum(states.abs(), next_states.abs())
        size[..., self.angle_columns] = size[..., self.angle_columns].clamp_min(1)
        rounding = 4 * torch.finfo(torch.float32).eps * size
        for name in self.exogenous:
            i = self.states.index(name)
            check_exogenous(name, change[..., i], rounding[..., i])
        if self.previous:
            self._check_previous(states, next_states, actions, rounding)
        for name, velocity in self.integrated.items():
            i, v = self.states.index(name), self.states.index(velocity)
            assert self.step is not None, "checked at the start"
            discrepancy = change[..., i] - self.step * (states[..., v] + next_states[..., v]) / 2
            if name in self.angles:
                discrepancy = torch.atan2(discrepancy.sin(), discrepancy.cos())
            known = ~discrepancy.isnan()
            velocities = (states[..., v][known], next_states[..., v][known])
            found, unavoidable = discrepancy[known], rounding[..., i][known]
            check_integrated(name, velocity, self.step, velocities, found, unavoidable)

    def _check_previous(
        self, states: Tensor, next_states: Tensor, actions: Tensor | None, rounding: Tensor
    ) -> None:
        taken = [name for name, other in self.previous.items() if other in self.actions]
        if taken and actions is None:
            raise ValueError(
                f"States {tuple(taken)} are said to be previous actions, which cannot be checked "
                "without actions; pass `actions`."
            )
        if actions is None:
            actions = states.new_zeros(*states.shape[:-1], self.action_dim)
        check_columns("actions", actions, self.action_dim)
        expected = self.remember(next_states.clone(), states, actions)
        gap = self.change(expected, next_states).abs()
        for name, other in self.previous.items():
            i = self.states.index(name)
            found, before, tolerance = next_states[..., i], expected[..., i], rounding[..., i]
            held = f"state {other!r}"
            if name in taken:
                held, tolerance = f"action {other!r}", 1e-3 * before.abs().amax()
            check_previous(name, held, found, before, gap[..., i] > tolerance)

    def remember(self, next_states: Tensor, states: Tensor, actions: Tensor) -> Tensor:
        """Write states and actions, ``... x dim``, into the next states as previous ones."""
        for name, other in self.previous.items():
            is_state = other in self.states
            names, values = (self.states, states) if is_state else (self.actions, actions)
            next_states[..., self.states.index(name)] = values[..., names.index(other)]
        return next_states

    def complete(self, states: Tensor, actions: Tensor, predicted: Tensor) -> Tensor:
        """The next states, of which a model knows ``predicted``, ``... x len(spec.predicted)``."""
        if len(self.predicted) == self.state_dim:
            return predicted
        following = states.expand(*predicted.shape[:-1], self.state_dim).clone()
        following[..., self.predicted] = predicted
        self.remember(following, states, actions)
        for name, velocity in self.integrated.items():
            i, v = self.states.index(name), self.states.index(velocity)
            assert self.step is not None, "checked at the start"
            following[..., i] += self.step * (states[..., v] + following[..., v]) / 2
        return following

    def complete_variance(self, variance: Tensor) -> Tensor:
        """The variance of all states, from that of the predicted ones; see :meth:`complete`."""
        full = variance.new_zeros(*variance.shape[:-1], self.state_dim)
        full[..., self.predicted] = variance
        for name, velocity in self.integrated.items():
            i, v = self.states.index(name), self.states.index(velocity)
            assert self.step is not None, "checked at the start"
            full[..., i] = (self.step / 2) ** 2 * full[..., v]
        return full


def side_by_side(states: Tensor, actions: Tensor) -> Tensor:
    """States ``... x state_dim`` and their actions in one row; one action may be for all."""
    return torch.cat([states, actions.expand(*states.shape[:-1], -1)], dim=-1)


def some_columns(rows: Tensor, columns: list[int]) -> Tensor:
    """Some columns of rows ``... x d``; the rows themselves if these are all, in their order."""
    return rows if columns == [*range(rows.shape[-1])] else rows[..., columns]
