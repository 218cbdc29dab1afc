"""What the entries of a system's state are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class StateSpec:
    r"""What the entries of a system's state and action are, said once.

    A *state* is a row of physical quantities; an *observation* is what a policy sees: the state
    with each angle :math:`\theta` replaced, in its place, by :math:`\sin\theta, \cos\theta`.

    Args:
        states: The names of the state's entries.
        actions: The names of the action's entries.
        angles: The states that are angles in rad. Policy and model see their sine and cosine, and
            changes are the shortest way round the circle.
        exogenous: The states that stay as they are during a trial, such as a target. The policy
            sees them; models and physics do not.
        integrated: For states that a model need not predict, the states that are their
            velocities: :math:`q' = q + h (v + v') / 2`.
        step: The time step :math:`h`, in the time unit of the velocities; needed by ``integrated``.

    Raises:
        ValueError: If a name is unknown, repeated, or stands for two things that exclude each
            other, no state is left to predict, or ``step`` is missing or not positive.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import StateSpec
        >>> spec = StateSpec(["theta", "theta_dot"], ["torque"], angles=["theta"])
        >>> spec.observe(torch.tensor([[0.0, 2.0]]))
        tensor([[0., 1., 2.]])
    """

    states: Sequence[str]
    actions: Sequence[str]
    angles: Sequence[str] = ()
    exogenous: Sequence[str] = ()
    integrated: Mapping[str, str] = field(default_factory=dict)
    step: float | None = None

    def __post_init__(self) -> None:
        """Check the names."""
        for name in ("states", "actions", "angles", "exogenous"):
            value = getattr(self, name)
            if isinstance(value, str):
                raise ValueError(f"{name} must be a sequence of names; found {value!r}.")
            object.__setattr__(self, name, tuple(value))
        object.__setattr__(self, "integrated", dict(self.integrated))
        for name in ("states", "actions"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names):
                raise ValueError(f"{name} must be one or more different names; found {names}.")
        named = (*self.angles, *self.exogenous, *self.integrated, *self.integrated.values())
        unknown = [name for name in named if name not in self.states]
        if unknown:
            raise ValueError(f"There is no state {unknown[0]!r}; the states are {self.states}.")
        fixed = (*self.exogenous, *self.integrated)
        twice = [name for name in fixed if fixed.count(name) > 1]
        twice += [name for name in self.integrated.values() if name in fixed]
        if twice:
            raise ValueError(
                f"State {twice[0]!r} is said to be two things: exogenous, integrated and a "
                "velocity exclude each other."
            )
        if set(fixed) == set(self.states):
            raise ValueError("No state is left to predict; all are exogenous or integrated.")
        if self.integrated and not (self.step is not None and self.step > 0):
            raise ValueError(
                f"step must be the positive duration of a step, as some states are integrated; "
                f"found {self.step}."
            )

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

    @property
    def moving(self) -> list[int]:
        """The states that are not exogenous: what models and physics read, before the action."""
        return [i for i, name in enumerate(self.states) if name not in self.exogenous]

    @property
    def predicted(self) -> list[int]:
        """The states that a model predicts: neither exogenous nor integrated."""
        return [i for i in self.moving if self.states[i] not in self.integrated]

    @property
    def angle_columns(self) -> list[int]:
        """The states that are angles."""
        return [i for i, name in enumerate(self.states) if name in self.angles]

    def observe(self, states: Tensor) -> Tensor:
        """Observations ``... x observation_dim`` of states ``... x state_dim``."""
        check_columns(states, self.state_dim, "states")
        columns = []
        for name, column in zip(self.states, states.unbind(-1), strict=True):
            columns += [column.sin(), column.cos()] if name in self.angles else [column]
        return torch.stack(columns, dim=-1)

    def decode(self, observations: Tensor) -> Tensor:
        r"""States ``... x state_dim`` of observations; angles are in :math:`(-\pi, \pi]`."""
        check_columns(observations, self.observation_dim, "observations")
        rest = iter(observations.unbind(-1))
        columns = [
            torch.atan2(next(rest), next(rest)) if name in self.angles else next(rest)
            for name in self.states
        ]
        return torch.stack(columns, dim=-1)

    def change(self, states: Tensor, next_states: Tensor) -> Tensor:
        """The change ``... x state_dim``, of angles the shortest way round."""
        change = next_states - states
        for i in self.angle_columns:
            angle = change[..., i]
            change[..., i] = torch.atan2(angle.sin(), angle.cos())
        return change

    def complete(self, states: Tensor, predicted: Tensor) -> Tensor:
        """The next states, of which a model knows ``predicted``, ``... x len(spec.predicted)``."""
        following = states.expand(*predicted.shape[:-1], self.state_dim).clone()
        following[..., self.predicted] = predicted
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


def check_columns(tensor: Tensor, columns: int, name: str) -> None:
    """Raise an error unless a tensor is floating-point and has the last dimension expected."""
    if not torch.is_tensor(tensor) or not tensor.is_floating_point():
        found = tensor.dtype if torch.is_tensor(tensor) else type(tensor).__name__
        raise TypeError(f"Expected {name} as a floating-point tensor, got {found}.")
    if tensor.dim() < 1 or tensor.shape[-1] != columns:
        raise ValueError(
            f"Expected {name} of shape ... x {columns}, as the spec says, got "
            f"{tuple(tensor.shape)}."
        )
