"""Texts and tables that show an agent."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from gpadjust.display import html_table
from gpadjust.words import number


class EpisodeReward(NamedTuple):
    """Steps of a real episode, and the real and the promised reward of a step."""

    steps: int
    reward: float
    promised: float  # NaN without a promise


def episode_rewards(agent: Any) -> list[EpisodeReward]:
    """Return the rewards of each real episode of an agent."""
    data = agent.recorded_episodes()
    rewards = [data.rewards[data.episode == i] for i in data.episode.unique_consecutive()]
    promises = getattr(agent, "promises", None) or [None] * len(rewards)  # learners make none
    return [
        EpisodeReward(len(steps), float(steps.mean()), math.nan if promise is None else promise)
        for steps, promise in zip(rewards, promises, strict=False)
    ]


def layer_names(env: Any) -> list[str]:
    """Return the classes of an environment and of the ones inside, from the outside."""
    names = []
    while env is not None:
        names.append(type(env).__name__)
        envs = getattr(env, "envs", None) or [None]  # of a vectorised environment, all alike
        env = getattr(env, "venv", None) or getattr(env, "env", None) or envs[0]
    return names


def agent_text(agent: Any) -> str:
    """Name an agent, its environment and dynamics, its progress, and its last reward."""
    env = "no environment" if agent.env is None else layer_names(agent.env)[-1]
    if agent.task is None:
        return f"{type(agent).__name__}({env}, no task)"
    last = "".join(f", last reward {row.reward:.3g} a step" for row in episode_rewards(agent)[-1:])
    return (
        f"{type(agent).__name__}({env}, {type(agent.task.dynamics).__name__}, "
        f"{agent.num_episodes} episodes learnt, {agent.num_timesteps} steps{last})"
    )


def agent_table(agent: Any) -> str:
    """Return a table of the first, the best and the last episode of an agent, in HTML."""
    rows = episode_rewards(agent)
    places: dict[str, int] = {}
    if rows:
        best = max(range(len(rows)), key=lambda i: rows[i].reward)
        places = {"first": 0, "best": best, "last": len(rows) - 1}
    head = ["", "episode", "steps", "reward of a step", "promised"]
    cells = [
        [name, str(i + 1), str(rows[i].steps), number(rows[i].reward), number(rows[i].promised)]
        for name, i in places.items()
    ]
    return html_table(repr(agent), head, cells)
