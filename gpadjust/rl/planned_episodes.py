"""Real episodes that go by plans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from gpadjust.control.mpc import Planned


@dataclass
class PlannedEpisode:
    """An episode under way.

    Args:
        ahead: The actions that are planned, ``T x action_dim``.
        environment: The number of its environment.
        steps_done: How many it has made.
        planned: What a planner keeps of it from step to step; None where actions are random.
        promise: The reward of a step that was promised of it when it began, if one was.
    """

    ahead: Tensor
    environment: int
    steps_done: int = 0
    planned: Planned | None = None
    promise: float | None = None


class PlannedEpisodes:
    """Which of an agent's episodes go by plans, and how far they are.

    It holds plain values, which are saved with the agent, so that a run that is resumed within an
    episode follows its plan.
    """

    def __init__(self) -> None:
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
    ) -> Tensor:
        """The action of an environment: that of a plan, if its episode has one.

        Args:
            environment: Its number.
            state: Where it is, ``state_dim``.
            action: The policy's, ``action_dim``.
            begins: Whether an episode that begins is to be planned.
            plan: The actions ahead, ``T x action_dim``, of an episode that is at a state, as they
                are to be taken; it is asked at each step.
        """
        if environment not in self.under_way:
            begun = PlannedEpisode(state.new_empty(0, len(action)), environment)
            self.under_way[environment] = begun if begins() else None
        episode = self.under_way[environment]
        if episode is None:
            return action
        ahead = plan(episode, state)
        episode.ahead, episode.steps_done = ahead[1:], episode.steps_done + 1
        return ahead[0].to(action)
