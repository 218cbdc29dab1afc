"""The figure of an agent; it needs matplotlib, ``pip install gpadjust[plot]``."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import torch

from gpadjust.control.summary import episode_rewards
from gpadjust.records.plots import plot_record
from gpadjust.records.records import Record
from gpadjust.validation.plots import BLUE, DOTS, RED, given_axes, legend, tidy

__all__ = ["plot_agent"]


def plot_agent(agent: Any, *, axes: Any = None) -> Any:
    """Draw the reward of each real episode, and states and actions of the last one.

    Dots are mean rewards of a step, hollow ones the promises of the model before the episode.

    Args:
        agent: An agent, such as :class:`MPCAgent`, or a learner of :mod:`gpadjust.rl`.
        axes: One for the rewards, and one for each state and action. Default: a new figure.

    Returns:
        An array of these axes; ``axes[0].figure`` is the figure.

    Raises:
        ValueError: If no episode has been recorded, or the number of ``axes`` is wrong.
    """
    data, spec = agent.recorded_episodes(), agent.task.dynamics.spec
    rows = episode_rewards(agent)
    if not rows:
        raise ValueError("Expected real episodes to draw, found none; call `learn` first.")
    n = spec.state_dim + spec.action_dim
    if axes is None:
        figure = plt.figure(figsize=(7, 2.2 + 1.4 * n), layout="constrained")
        axes = figure.subplots(n + 1, 1, height_ratios=[1.5, *[1] * n])
    axes = given_axes(axes, (n + 1,))
    # Rewards, and promises where there are any
    numbers = range(1, len(rows) + 1)
    rewards = [row.reward for row in rows]
    axes[0].plot(numbers, rewards, "-", color=BLUE, lw=1.1)
    axes[0].plot(numbers, rewards, color=BLUE, **DOTS, label="real")
    promised = [row.promised for row in rows]
    if not all(map(math.isnan, promised)):
        hollow = DOTS | {"mfc": "none", "mec": RED}
        axes[0].plot(numbers, promised, **hollow, label="promised by the model")
    axes[0].set(xlabel="episode", ylabel="reward of a step")
    axes[0].xaxis.get_major_locator().set_params(integer=True)
    legend(axes[0])
    # The last episode; its last action is held
    last = data.subset(data.episode == data.episode[-1])
    states = torch.cat([last.states, last.next_states[-1:]])
    actions = torch.cat([last.actions, last.actions[-1:]])
    times = (spec.step or 1.0) * torch.arange(len(states)).double()
    units = None if spec.step else {"time": "steps"}
    plot_record(Record(times, states, actions), spec, units=units, axes=axes[1:])
    axes[1].set_title(f"episode {len(rows)}", fontsize="medium")
    for ax in axes[1:]:
        tidy(ax)
    return axes
