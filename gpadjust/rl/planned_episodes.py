"""Real episodes that go by plans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gpadjust.control.mpc import Planned


@dataclass
class PlannedEpisode:
    """An episode under way.

    Args:
        ahead: The actions that are planned, ``T x action_dim``.
        states: What it has seen, ``t x state_dim``.
        actions: What it has done, ``t x action_dim``.
        environment: The number of its environment.
        planned: What a planner keeps of it from step to step; None where actions are random.
        promise: The reward of a step that was promised of it when it began, if one was.
    """

    ahead: Tensor
    states: Tensor
    actions: Tensor
    environment: int
    planned: Planned | None = None
    promise: float | None = None


class PlannedEpisodes:
    """Which of an agent's episodes go by plans, and how far they are.

    It holds plain values, which are saved with the agent, so that a run that is resumed within an
    episode follows its plan.

    Attributes:
        num_planned: How many episodes were begun with a plan.
    """

    def __init__(self) -> None:
        self.num_planned = 0
        self.under_way: dict[int, PlannedEpisode | None] = {}  # by environment; None: the policy's

    def forget(self) -> None:
        """All environments are reset."""
        self.under_way = {}

    def end(self, environment: int) -> None:
        """An environment begins another episode."""
        self.under_way.pop(environment, None)

    def is_planned(self, environment: int) -> bool:
        """Whether the episode of an environment goes by a plan."""
        return self.under_way.get(environment) is not None

    def act(
        self,
        environment: int,
        state: Tensor,
        action: Tensor,
        begins: Callable[[], bool],
        plan: Callable[[PlannedEpisode, Tensor], Tensor],
        replan_every: int | None,
    ) -> Tensor:
        """The action of an environment: that of a plan, if its episode has one.

        Args:
            environment: Its number.
            state: Where it is, ``state_dim``.
            action: The policy's, ``action_dim``.
            begins: Whether an episode that begins is to be planned.
            plan: The actions ahead, ``T x action_dim``, of an episode that is at a state, as they
                are to be taken.
            replan_every: Number of steps after which they are planned anew.
        """
        if environment not in self.under_way:
            nothing, unseen = state.new_empty(0, len(action)), state.new_empty(0, len(state))
            begun = PlannedEpisode(nothing, unseen, nothing, environment)
            self.under_way[environment] = begun if begins() else None
            self.num_planned += self.under_way[environment] is not None
        episode = self.under_way[environment]
        if episode is None:
            return action
        steps_done = len(episode.states)
        if not steps_done or (replan_every is not None and steps_done % replan_every == 0):
            episode.ahead = plan(episode, state)
        if len(episode.ahead):  # an episode may be longer than it was said to be
            action = episode.ahead[0].to(action)
        episode.ahead = episode.ahead[1:]
        episode.states = torch.cat([episode.states, state.unsqueeze(0)])
        episode.actions = torch.cat([episode.actions, action.to(state).unsqueeze(0)])
        return action
