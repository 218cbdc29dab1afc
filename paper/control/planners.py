"""Planners by the settings of an experiment."""

from __future__ import annotations

from functools import partial
from typing import TypedDict

from gpadjust.control import CrossEntropy, Planner
from paper.control import Planned


class Planners(TypedDict):
    """Arguments of an agent that plans."""

    each_step: Planner
    first: Planner


def planners(settings: Planned, horizon: float) -> Planners:
    """The planners of an agent, of which that of each step looks so far ahead, in s."""
    search = partial(CrossEntropy, num_elites=settings.elites, correlation=0.5)
    return {
        "each_step": Planner(
            search=search(settings.rounds),
            horizon=horizon,
            num_random=settings.sequences,
            spread=settings.spread,
        ),
        "first": Planner(search=search(settings.first_rounds), num_random=settings.first_sequences),
    }
