"""Names and kinds of the entries of a system's state."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from gpadjust.checks import check_columns, check_kind, checked_number

_OFF_CIRCLE = 0.3  # of a sine and cosine that noisy sensors show
_PREDICTS = "so that the model predicts it"
_EXOGENOUS = (
    "be exogenous, which stays as it is during an episode",
    "Of a set-point that moves give the task its `reference`; else take it out of `exogenous`, "
    f"{_PREDICTS}, or leave out transitions from one episode into the next.",
)


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
            the ``reference`` of a task. Policies see them; models and physics only if
            ``physics_reads`` names them.
        integrated: For states that a model need not predict, the states that are their
            velocities: :math:`q' = q + h (v + v') / 2`.
        step: The time step :math:`h`, in the time unit of the velocities; needed by ``integrated``.
        previous: For states that hold what another entry was a step before, the name of that
            action or state: ``{"last_force": "force"}``, or ``{"x_1": "x", "x_2": "x_1"}`` for two
            steps back, as in an autoregressive model (NARX). Policy and models see them, and models
            need not predict them. What holds an angle is an angle.
        physics_reads: The columns of the physics: names of states and actions in its order, such
            as ``["x", "v", "last_force"]`` of a system that follows its force a step late. Models
            read them, too. Default: the states that are neither exogenous nor ``previous``, then
            the actions.

    Raises:
        TypeError: If names are not strings, ``integrated`` or ``previous`` is no mapping or
            ``step`` no number.
        ValueError: If a name is unknown, repeated or two things that exclude each other,
            ``previous`` goes round in a circle, no state is left to predict, or ``step`` is missing
            or not positive.

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
        for argument, example in (
            ("integrated", {"x": "x_dot"}),
            ("previous", {"last_force": "force"}),
        ):
            mapping = getattr(self, argument)
            expected = f"a dictionary of names, such as {example}"
            check_kind(argument, mapping, Mapping, expected)
            for pair in mapping.items():
                checked_names(argument, [*dict.fromkeys(pair)])
            object.__setattr__(self, argument, dict(mapping))
        if self.step is not None:
            object.__setattr__(self, "step", checked_number("step", self.step, above=0))
        mistake = next(self._mistakes(), None)
        if mistake is not None:
            raise ValueError(mistake)

    def _mistakes(self) -> Iterator[str]:
        """Yield contradictions between the names, each as a message."""
        states, actions, angles, previous = self.states, self.actions, self.angles, self.previous
        for argument in ("states", "actions"):
            if not getattr(self, argument):
                yield f"{argument} must be one or more different names; found none."
        fixed = [*self.exogenous, *self.integrated, *previous]
        for name in (*angles, *fixed, *self.integrated.values()):
            if name not in states:
                yield f"There is no state {name!r}; the states are {states}."
        entries = [("previous", name) for name in previous.values()]
        for argument, name in (*entries, *(("physics_reads", name) for name in self.physics_reads)):
            if (name in states) == (name in actions):
                yield (
                    f"{argument} must name states or actions; found {name!r}, which is "
                    f"{'both' if name in states else 'neither'}: the states are {states}, the "
                    f"actions are {actions}."
                )
        for name, other in previous.items():
            if (name in angles) != (other in angles and other in states):
                one, another = (name, other) if name in angles else (other, name)
                yield (
                    f"State {name!r} holds the earlier value of {other!r}, but {one!r} is one of "
                    f"the angles and {another!r} is not; put both into `angles`, or neither."
                )
            chain = [name, other]
            while chain[-1] in previous and chain[-1] not in chain[:-1]:
                chain.append(previous[chain[-1]])
            if chain[-1] in chain[:-1]:
                yield (
                    f"previous goes round in a circle, {' -> '.join(chain)}; let it end at an "
                    "action, or at a state that is not in `previous`."
                )
        twice = [name for name in fixed if fixed.count(name) > 1]
        for name in (*twice, *(v for v in self.integrated.values() if v in fixed)):
            yield (
                f"State {name!r} is said to be two things: exogenous, integrated, a velocity and a "
                "previous value exclude each other."
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

    def _columns(self, names: Iterable[str]) -> list[int]:
        return [i for i, name in enumerate(self.states) if name in names]

    @cached_property
    def angle_columns(self) -> list[int]:
        """The states that are angles."""
        return self._columns(self.angles)

    @cached_property
    def exogenous_columns(self) -> list[int]:
        """The states that are exogenous."""
        return self._columns(self.exogenous)

    @cached_property
    def previous_columns(self) -> list[int]:
        """The states that hold previous values."""
        return self._columns(self.previous)

    @cached_property
    def moving(self) -> list[int]:
        """The states that the physics moves, neither exogenous nor previous values."""
        still = {*self.exogenous_columns, *self.previous_columns}
        return [i for i in range(self.state_dim) if i not in still]

    @cached_property
    def predicted(self) -> list[int]:
        """The states that a model predicts, those that move and are not integrated."""
        return [i for i in self.moving if self.states[i] not in self.integrated]

    @cached_property
    def physics_columns(self) -> list[int]:
        """The columns that the physics reads, of states and actions side by side."""
        names = (*self.states, *self.actions)
        read = [names.index(name) for name in self.physics_reads]
        return read or [*self.moving, *range(self.state_dim, len(names))]

    @cached_property
    def model_columns(self) -> list[int]:
        """The columns that models read: moving, actions, previous, and what f_p reads besides."""
        actions = range(self.state_dim, self.state_dim + self.action_dim)
        read = (*self.moving, *actions, *self.previous_columns, *self.physics_columns)
        return [*dict.fromkeys(read)]

    def physics_inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the inputs of the physics at states ``... x state_dim``: ``... x d``."""
        return some_columns(side_by_side(states, actions), self.physics_columns)

    def observe(self, states: Tensor) -> Tensor:
        """Return observations ``... x observation_dim`` of states ``... x state_dim``."""
        check_columns("states", states, self.state_dim)
        columns = []
        for name, column in zip(self.states, states.unbind(-1), strict=True):
            columns += [column.sin(), column.cos()] if name in self.angles else [column]
        return torch.stack(columns, dim=-1)

    def decode(self, observations: Tensor) -> Tensor:
        r"""Return states ``... x state_dim`` of observations; angles in :math:`(-\pi, \pi]`."""
        check_columns("observations", observations, self.observation_dim)
        rest = iter(observations.unbind(-1))
        columns = [
            torch.atan2(next(rest), next(rest)) if name in self.angles else next(rest)
            for name in self.states
        ]
        return torch.stack(columns, dim=-1)

    @property
    def observations(self) -> list[str]:
        """Names of the entries of an observation."""
        entries: list[str] = []
        for name in self.states:
            entries += [f"sin {name}", f"cos {name}"] if name in self.angles else [name]
        return entries

    def check_observations(self, observations: Tensor) -> None:
        """Raise a ValueError if there are more or fewer entries, or pairs far from the circle.

        Observations ``... x observation_dim`` may be those of noisy sensors.
        """
        entries = self.observations
        try:
            check_columns("observations", observations, len(entries))
        except ValueError as error:
            raise ValueError(f"{error} The entries are {', '.join(entries)}.") from None
        for name in self.angles:
            first = entries.index(f"sin {name}")
            pairs = observations[..., first : first + 2].reshape(-1, 2)
            off = (pairs.norm(dim=-1) - 1).abs()
            if len(off) and off.max() > _OFF_CIRCLE:
                pair = ", ".join(f"{value:.3g}" for value in pairs[int(off.argmax())])
                raise ValueError(
                    f"Entries {first} and {first + 1} of an observation must be sine and cosine of "
                    f"the angle {name!r}, found {pair}. Correct the order of the states of the "
                    "StateSpec, or which of them are angles; or wrap the environment so that it "
                    "observes what the spec says."
                )

    def change(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Return the change ``... x state_dim``, of angles the shortest way round."""
        change = next_states - states
        for i in self.angle_columns:
            angle = change[..., i].clone()  # not a view of what is written, for autograd
            change[..., i] = torch.atan2(angle.sin(), angle.cos())
        return change

    def check_transitions(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        r"""Check what is declared against transitions of the system.

        An exogenous state may change, and a previous state differ from that state, by no more than
        the rounding of single precision; a previous action from that action by a thousandth of the
        largest one. An integrated state follows its velocity as :math:`q' - q = b\, h (v + v') / 2`
        on a way :math:`w`, the larger of :math:`\sum h (|v| + |v'|) / 2` and
        :math:`\sum |q' - q|`. It is an error if the least squares estimate of :math:`b` is so far
        from 1 that this makes up more than :math:`0.1\, w` beside three of its standard errors, as
        with a wrong ``step``, and a warning if the discrepancies sum up to more than
        :math:`0.5\, w`, as with another state's velocity or noisy sensors at rest. The trapezoid
        itself errs by less than a tenth if an oscillation is sampled six times a period.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; an entry that was not measured (NaN) is not checked.

        Raises:
            ValueError: If a state, which is named, is not what it is said to be.

        Warns:
            UserWarning: If an integrated state is far from what its velocity says.
        """
        size = torch.maximum(states.abs(), next_states.abs())
        size[:, self.angle_columns] = size[:, self.angle_columns].clamp_min(1)
        rounding = 4 * torch.finfo(torch.float32).eps * size
        expected = self.remember(states.clone(), states, actions)
        gap = self.change(expected, next_states).abs()
        for name in (*self.exogenous, *self.previous):
            i, other = self.states.index(name), self.previous.get(name)
            is_action = other in self.actions
            limit = 1e-3 * expected[:, i].abs().amax() if is_action else rounding[:, i]
            rows = (gap[:, i] > limit).nonzero()
            if len(rows):
                row, said, advice = int(rows[0]), *_EXOGENOUS
                if other is not None:
                    said = f"hold the previous {'action' if is_action else 'state'} {other!r}"
                    advice = (
                        f"Correct `previous`, or take {name!r} out of it, {_PREDICTS}; or leave "
                        "out transitions from one episode into the next (reset() where one begins)."
                    )
                raise ValueError(
                    f"State {name!r} is said to {said}, but is {float(next_states[row, i]):.6g} "
                    f"where {float(expected[row, i]):.6g} was expected in row {row}. {advice}"
                )
        for name in self.integrated:
            self._check_integrated(name, states, next_states, rounding)

    def _check_integrated(
        self, name: str, states: Tensor, next_states: Tensor, rounding: Tensor
    ) -> None:
        """Raise an error if a state follows its velocity at another rate; warn of noise."""
        i, velocity = self.states.index(name), self.integrated[name]
        trapezoid = self._trapezoid(name, states, next_states)
        moved = states.clone()
        moved[:, i] += trapezoid
        discrepancy = self.change(moved, next_states)[:, i]
        known = ~discrepancy.isnan()
        trapezoid, discrepancy = trapezoid[known], discrepancy[known]
        way = self._trapezoid(name, states.abs(), next_states.abs())[known].sum()
        way = torch.maximum(way, (trapezoid + discrepancy).abs().sum())
        square, length = trapezoid.square().sum(), trapezoid.abs().sum()
        excess = (trapezoid * discrepancy).sum() / square
        scatter = (discrepancy - excess * trapezoid).square().sum() / (len(discrepancy) - 1)
        # Both are nan, and the comparison false, of one row or without any movement.
        systematic = (excess.abs() - 3 * (scatter / square).sqrt()) * length
        unavoidable, total = rounding[known, i].sum(), discrepancy.abs().sum()
        rate = f" but moves {1 + float(excess):.3g} times as far" if square > 0 else ""
        message = (
            f"State {name!r} is said to be integrated, as {name}' = {name} + step ({velocity} + "
            f"{velocity}') / 2 with step={self.step:g},{rate} and differs by {total:.3g} in all, "
            f"on a way of {way:.3g}. Mend `step` or `integrated`, or take {name!r} out of "
            f"`integrated`, {_PREDICTS}."
        )
        if systematic > 0.1 * way + unavoidable:
            raise ValueError(message)
        if total > 0.5 * way + unavoidable:
            warnings.warn(f"{message} Noisy sensors look the same.", UserWarning, stacklevel=5)

    def _trapezoid(self, name: str, states: Tensor, next_states: Tensor) -> Tensor:
        """Return the change of an integrated state, by the trapezoid rule."""
        v = self.states.index(self.integrated[name])
        return (self.step or 0.0) * (states[..., v] + next_states[..., v]) / 2

    def remember(self, next_states: Tensor, states: Tensor, actions: Tensor) -> Tensor:
        """Write states and actions, ``... x dim``, into the next states as previous ones."""
        for name, other in self.previous.items():
            is_state = other in self.states
            names, values = (self.states, states) if is_state else (self.actions, actions)
            next_states[..., self.states.index(name)] = values[..., names.index(other)]
        return next_states

    def complete(self, states: Tensor, actions: Tensor, predicted: Tensor) -> Tensor:
        """Return next states, of which a model knows ``predicted``, ``... x len(predicted)``."""
        if len(self.predicted) == self.state_dim:
            return predicted
        following = states.expand(*predicted.shape[:-1], self.state_dim).clone()
        following[..., self.predicted] = predicted
        self.remember(following, states, actions)
        for name in self.integrated:
            following[..., self.states.index(name)] += self._trapezoid(name, states, following)
        return following

    def complete_variance(self, variance: Tensor) -> Tensor:
        """Return the variance of all states by that of the predicted ones; see `complete`."""
        full = variance.new_zeros(*variance.shape[:-1], self.state_dim)
        full[..., self.predicted] = variance
        for name, velocity in self.integrated.items():
            share = ((self.step or 0.0) / 2) ** 2
            full[..., self.states.index(name)] = share * full[..., self.states.index(velocity)]
        return full


def checked_names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return different names as a tuple."""
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise TypeError(f"{argument} must be a sequence of names; found {names!r}.")
    for name in names:
        check_kind(f"Each name of {argument}", name, str, "a string")
    if len({*names}) < len(names):
        raise ValueError(f"{argument} must be different names; found {tuple(names)}.")
    return tuple(names)


def side_by_side(states: Tensor, actions: Tensor) -> Tensor:
    """Return states ``... x state_dim`` and actions in one row; one action may be for all."""
    return torch.cat([states, actions.expand(*states.shape[:-1], -1)], dim=-1)


def some_columns(rows: Tensor, columns: list[int]) -> Tensor:
    """Return some columns of rows ``... x d``; the rows themselves if these are all, in order."""
    return rows if columns == [*range(rows.shape[-1])] else rows[..., columns]
