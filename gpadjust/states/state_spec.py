"""Names and kinds of the entries of a system's state."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from gpadjust.checks import check_columns, check_kind, checked_number

_OFF_CIRCLE = 0.3  # largest distance from the circle by noisy sensors
_PREDICTS = "so that the model predicts it"
_EXOGENOUS_ADVICE = (
    "If a set-point moves, give the task its `reference`; else take it out of `exogenous`, "
    f"{_PREDICTS}, or leave out transitions from one episode into the next."
)


@dataclass(frozen=True)
class StateSpec:
    r"""Names and kinds of the entries of a system's state and action.

    A *state* is a row of physical quantities. An *observation* is the input of a policy: the state
    with each angle :math:`\theta` replaced, in its place, by :math:`\sin\theta, \cos\theta`.

    Args:
        states: The names of the state's entries.
        actions: The names of the action's entries.
        angles: The states that are angles in rad; changes are the shortest way round the circle.
        exogenous: The states that are constant during an episode, such as a target, or follow the
            ``reference`` of a task. Policies get them; models and physics only if
            ``physics_reads`` names them.
        integrated: The velocities of states that follow from them without a prediction, by the
            names of these states: :math:`q' = q + h (v + v') / 2`.
        step: The time step :math:`h`, in the time unit of the velocities; needed by ``integrated``.
        previous: The origins of states that repeat another entry a step later, an action or a
            state, by the names of these states: ``{"last_force": "force"}``, or
            ``{"x_1": "x", "x_2": "x_1"}`` for two steps, as in an autoregressive model (NARX).
            Policy and models get them without predicting them. A repeated angle is an angle.
        physics_reads: The inputs of the physics: names of states and actions in its order, such
            as ``["x", "v", "last_force"]`` for a system that follows its force a step later. Models
            get them, too. Default: the states that are neither exogenous nor ``previous``, then
            the actions.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a name is unknown, repeated or has two roles that exclude each other,
            ``previous`` is circular, no state is left to predict, or ``step`` is missing or not
            positive.

    Example:
        >>> import torch
        >>> from gpadjust.states import StateSpec
        >>> spec = StateSpec(["theta", "theta_dot"], ["torque"], angles=["theta"])
        >>> spec.observe(torch.tensor([[0.0, 2.0]]))
        tensor([[0., 1., 2.]])
        >>> spec = StateSpec(["level", "last"], ["pump"], previous={"last": "level"})
        >>> state, action = torch.tensor([3.0, 2.0]), torch.tensor([0.7])
        >>> spec.complete(state, action, predicted=torch.tensor([4.0]))
        tensor([4., 3.])
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
        for argument in ("states", "actions", "angles", "exogenous", "physics_reads"):
            names = checked_names(argument, getattr(self, argument))
            object.__setattr__(self, argument, names)
        for argument in ("integrated", "previous"):
            mapping = getattr(self, argument)
            expected = "a dictionary of names, such as {'x': 'x_dot'}"
            check_kind(argument, mapping, Mapping, expected)
            for pair in mapping.items():
                checked_names(argument, [*dict.fromkeys(pair)])
            object.__setattr__(self, argument, dict(mapping))
        if self.step is not None:
            object.__setattr__(self, "step", checked_number("step", self.step, above=0))
        for mistake in self._mistakes():  # the first one
            raise ValueError(mistake)

    def _mistakes(self) -> Iterator[str]:
        """Yield messages of contradictions between the names."""
        states, actions, angles, previous = self.states, self.actions, self.angles, self.previous
        for argument in ("states", "actions"):
            if not getattr(self, argument):
                yield f"{argument} must be one or more different names; found none."
        fixed = [*self.exogenous, *self.integrated, *previous]
        for name in (*angles, *fixed, *self.integrated.values()):
            if name not in states:
                yield f"There is no state {name!r}; the states are {states}."
        # A name of a state and an action, or of neither, is ambiguous.
        entries = [("previous", name) for name in previous.values()]
        entries += [("physics_reads", name) for name in self.physics_reads]
        for argument, name in entries:
            if (name in states) == (name in actions):
                count = "both" if name in states else "neither"
                yield (
                    f"{argument} must name states or actions; found {name!r}, which is {count}: "
                    f"the states are {states}, the actions are {actions}."
                )
        for name, other in previous.items():
            if (name in angles) != (other in angles and other in states):
                angle, number = (name, other) if name in angles else (other, name)
                yield (
                    f"State {name!r} repeats {other!r}, but {angle!r} is one of the angles and "
                    f"{number!r} is not; put both into `angles`, or neither."
                )
            # Follow the origins until the first that is not a previous value.
            chain = [name, other]
            while chain[-1] in previous and chain[-1] not in chain[:-1]:
                chain.append(previous[chain[-1]])
            if chain[-1] in chain[:-1]:
                yield (
                    f"previous is circular, {' -> '.join(chain)}; let it end at an action, or at "
                    "a state that is not in `previous`."
                )
        # A velocity is predicted, so that it has no other role.
        twice = [name for name in fixed if fixed.count(name) > 1]
        for name in (*twice, *(v for v in self.integrated.values() if v in fixed)):
            yield (
                f"State {name!r} has two roles: exogenous, integrated, a velocity and a previous "
                "value exclude each other."
            )
        if {*fixed} == {*states}:
            yield "No state is left to predict; all are exogenous, integrated or previous values."
        if self.integrated and self.step is None:
            yield "step must be the duration of a step, as some states are integrated."

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
    def angle_columns(self) -> list[int]:
        """The states that are angles."""
        return [i for i, name in enumerate(self.states) if name in self.angles]

    @cached_property
    def exogenous_columns(self) -> list[int]:
        """The states that are exogenous."""
        return [i for i, name in enumerate(self.states) if name in self.exogenous]

    @cached_property
    def previous_columns(self) -> list[int]:
        """The states that hold previous values."""
        return [i for i, name in enumerate(self.states) if name in self.previous]

    @cached_property
    def moving(self) -> list[int]:
        """The states that the physics changes, neither exogenous nor previous values."""
        still = {*self.exogenous, *self.previous}
        return [i for i, name in enumerate(self.states) if name not in still]

    @cached_property
    def predicted(self) -> list[int]:
        """The states that a model predicts: moving, but not integrated."""
        return [i for i in self.moving if self.states[i] not in self.integrated]

    @cached_property
    def physics_columns(self) -> list[int]:
        """The inputs of the physics, as columns of states and actions side by side."""
        names = (*self.states, *self.actions)
        columns = [names.index(name) for name in self.physics_reads]
        return columns or [*self.moving, *range(self.state_dim, len(names))]

    @cached_property
    def model_columns(self) -> list[int]:
        """The inputs of models: moving states, actions, previous values, and others of f_p."""
        actions = range(self.state_dim, self.state_dim + self.action_dim)
        columns = (*self.moving, *actions, *self.previous_columns, *self.physics_columns)
        return [*dict.fromkeys(columns)]  # without repetitions, in order

    def physics_inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the inputs of the physics at states ``... x state_dim``: ``... x d``."""
        return some_columns(side_by_side(states, actions), self.physics_columns)

    def observe(self, states: Tensor) -> Tensor:
        """Return observations ``... x observation_dim`` of states ``... x state_dim``."""
        check_columns("states", states, self.state_dim)
        return with_sine_and_cosine(states, self.angle_columns)

    def decode(self, observations: Tensor) -> Tensor:
        r"""Return states ``... x state_dim`` of observations; angles in :math:`(-\pi, \pi]`."""
        check_columns("observations", observations, self.observation_dim)
        entries = iter(observations.unbind(-1))
        columns = []
        for name in self.states:
            column = next(entries)
            if name in self.angles:  # theta = atan2(sin theta, cos theta)
                column = torch.atan2(column, next(entries))
            columns.append(column)
        return torch.stack(columns, dim=-1)

    @property
    def observations(self) -> list[str]:
        """Names of the entries of an observation."""
        entries: list[str] = []
        for name in self.states:
            entries += [f"sin {name}", f"cos {name}"] if name in self.angles else [name]
        return entries

    def check_observations(self, observations: Tensor) -> None:
        """Raise a ValueError if observations have other entries, or pairs far from the circle."""
        entries = self.observations
        try:
            check_columns("observations", observations, len(entries))
        except ValueError as error:
            raise ValueError(f"{error} The entries are {', '.join(entries)}.") from None
        for name in self.angles:
            first = entries.index(f"sin {name}")
            pairs = observations[..., first : first + 2].reshape(-1, 2)
            distance = (pairs.norm(dim=-1) - 1).abs()  # sin^2 + cos^2 = 1
            if len(distance) and distance.max() > _OFF_CIRCLE:
                pair = ", ".join(f"{value:.3g}" for value in pairs[int(distance.argmax())])
                raise ValueError(
                    f"Entries {first} and {first + 1} of an observation must be sine and cosine of "
                    f"the angle {name!r}, found {pair}. Correct states (their order) or angles of "
                    "the StateSpec, or wrap the environment."
                )

    def change(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Return the change ``... x state_dim``, for angles the shortest way round."""
        change = next_states - states
        for i in self.angle_columns:
            angle = change[..., i].clone()  # autograd needs the value before the change in place
            change[..., i] = torch.atan2(angle.sin(), angle.cos())
        return change

    def check_transitions(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        r"""Raise a ValueError if transitions contradict the roles of states.

        An exogenous state may change, and a previous state differ from its origin, by no more than
        the rounding of single precision; a previous action from its origin by a thousandth of the
        largest one. An integrated state follows its velocity as :math:`q' - q = b\, h (v + v') / 2`
        on a path of length :math:`w`, the larger of :math:`\sum h (|v| + |v'|) / 2` and
        :math:`\sum |q' - q|`. It is an error if the least squares estimate of :math:`b` differs
        from 1 by more than three standard errors and :math:`0.1\, w`, as with a wrong ``step``,
        and a warning if the sum of discrepancies exceeds :math:`0.5\, w`, as with another state's
        velocity or noisy sensors at rest. Entries that are NaN are not checked.
        """
        # Environments report states in single precision.
        size = torch.maximum(states.abs(), next_states.abs())
        size[:, self.angle_columns] = size[:, self.angle_columns].clamp_min(1)
        rounding = 4 * torch.finfo(torch.float32).eps * size
        expected = self.remember(states.clone(), states, actions)
        gap = self.change(expected, next_states).abs()
        for name in (*self.exogenous, *self.previous):
            i = self.states.index(name)
            other = self.previous.get(name)
            limit = rounding[:, i]
            role = "exogenous, which is constant during an episode"
            advice = _EXOGENOUS_ADVICE
            if other is not None:
                role = f"the previous state {other!r}"
                advice = (
                    f"Correct `previous`, or take {name!r} out of it, {_PREDICTS}; or leave out "
                    "transitions from one episode into the next (reset() where one begins)."
                )
            if other in self.actions:  # an environment may clip or round an action
                limit = 1e-3 * expected[:, i].abs().amax()
                role = f"the previous action {other!r}"
            rows = (gap[:, i] > limit).nonzero()
            if len(rows):
                row = int(rows[0])
                raise ValueError(
                    f"State {name!r} is declared as {role}, but is "
                    f"{float(next_states[row, i]):.6g} where {float(expected[row, i]):.6g} was "
                    f"expected in row {row}. {advice}"
                )
        for name in self.integrated:
            self._check_integrated(name, states, next_states, rounding)

    def _check_integrated(
        self, name: str, states: Tensor, next_states: Tensor, rounding: Tensor
    ) -> None:
        """Raise an error if a state follows its velocity at another rate; warn of noise."""
        i = self.states.index(name)
        velocity = self.integrated[name]
        trapezoid = self._trapezoid(name, states, next_states)
        moved = states.clone()
        moved[:, i] += trapezoid
        discrepancy = self.change(moved, next_states)[:, i]  # q' - q - h (v + v') / 2
        is_measured = ~discrepancy.isnan()
        trapezoid, discrepancy = trapezoid[is_measured], discrepancy[is_measured]
        # w = max(sum h (|v| + |v'|) / 2, sum |q' - q|)
        path = self._trapezoid(name, states.abs(), next_states.abs())[is_measured].sum()
        path = torch.maximum(path, (trapezoid + discrepancy).abs().sum())
        # Least squares of discrepancy = (b - 1) trapezoid: NaN for one row or without movement,
        # so that the comparison below is false.
        square = trapezoid.square().sum()
        excess = (trapezoid * discrepancy).sum() / square
        scatter = (discrepancy - excess * trapezoid).square().sum() / (len(discrepancy) - 1)
        systematic = (excess.abs() - 3 * (scatter / square).sqrt()) * trapezoid.abs().sum()
        total = discrepancy.abs().sum()
        tolerance = rounding[is_measured, i].sum()
        rate = f" but moves {1 + float(excess):.3g} times as far" if square > 0 else ""
        message = (
            f"State {name!r} is declared as integrated, {name}' = {name} + step ({velocity} + "
            f"{velocity}') / 2 with step={self.step:g},{rate} and differs by {total:.3g} in all, "
            f"on a path of {path:.3g}. Correct `step` or `integrated`, or take {name!r} out of "
            f"`integrated`, {_PREDICTS}."
        )
        if systematic > 0.1 * path + tolerance:
            raise ValueError(message)
        if total > 0.5 * path + tolerance:
            text = f"{message} Noisy sensors have the same effect."
            warnings.warn(text, UserWarning, stacklevel=5)

    def _trapezoid(self, name: str, states: Tensor, next_states: Tensor) -> Tensor:
        """Return the change of an integrated state, by the trapezoid rule."""
        v = self.states.index(self.integrated[name])
        return (self.step or 0.0) * (states[..., v] + next_states[..., v]) / 2  # h (v + v') / 2

    def remember(self, next_states: Tensor, states: Tensor, actions: Tensor) -> Tensor:
        """Write states and actions, ``... x dim``, into the next states as previous values."""
        for name, other in self.previous.items():
            if other in self.states:
                origin = states[..., self.states.index(other)]
            else:
                origin = actions[..., self.actions.index(other)]
            next_states[..., self.states.index(name)] = origin
        return next_states

    def complete(self, states: Tensor, actions: Tensor, predicted: Tensor) -> Tensor:
        """Return next states with the predicted ones ``... x len(predicted)`` of a model."""
        if len(self.predicted) == self.state_dim:
            return predicted
        # Exogenous states do not change here; a task may set them afterwards.
        following = states.expand(*predicted.shape[:-1], self.state_dim).clone()
        following[..., self.predicted] = predicted
        self.remember(following, states, actions)
        for name in self.integrated:
            following[..., self.states.index(name)] += self._trapezoid(name, states, following)
        return following

    def complete_variance(self, variance: Tensor) -> Tensor:
        """Return the variance of all states by the variance of the predicted ones."""
        full = variance.new_zeros(*variance.shape[:-1], self.state_dim)
        full[..., self.predicted] = variance
        # q' = q + h (v + v') / 2: Var q' = (h / 2)^2 Var v'
        share = ((self.step or 0.0) / 2) ** 2
        for name, velocity in self.integrated.items():
            full[..., self.states.index(name)] = share * full[..., self.states.index(velocity)]
        return full


def checked_names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return different names as a tuple."""
    # A string is a sequence of letters.
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise TypeError(f"{argument} must be a sequence of names; found {names!r}.")
    for name in names:
        check_kind(f"Each name of {argument}", name, str, "a string")
    if len({*names}) < len(names):
        raise ValueError(f"{argument} must be different names; found {tuple(names)}.")
    return tuple(names)


def with_sine_and_cosine(rows: Tensor, angles: Sequence[int]) -> Tensor:
    """Return rows ``... x d`` with each angle replaced by its sine and cosine."""
    columns: list[Tensor] = []
    for i, column in enumerate(rows.unbind(-1)):
        if i in angles:
            columns += [column.sin(), column.cos()]
        else:
            columns.append(column)
    return torch.stack(columns, dim=-1)


def side_by_side(states: Tensor, actions: Tensor) -> Tensor:
    """Return states ``... x state_dim`` and actions in one row; one action may serve all."""
    return torch.cat([states, actions.expand(*states.shape[:-1], -1)], dim=-1)


def some_columns(rows: Tensor, columns: list[int]) -> Tensor:
    """Return some columns of rows ``... x d``."""
    if columns == [*range(rows.shape[-1])]:
        return rows  # all of them: no copy
    return rows[..., columns]
