"""Trials until one is near to the best."""

from __future__ import annotations

import logging
import time
import warnings
from pathlib import Path
from typing import Any

from ax.api.client import Client
from ax.generation_strategy.generation_strategy import GenerationStrategy
from ax.utils.common.logger import set_ax_logger_levels
from botorch.utils.sampling import manual_seed

from gpadjust.ax import generation_strategy
from paper.common.experiment import Record
from paper.optimisation import LearnerName, Optimisation, Settings
from paper.optimisation.problems import Problem, problem, scale


def run(
    experiment: Optimisation, name: str, learner: LearnerName, seed: int, *, unfinished: Path
) -> Record:
    """Optimise a problem by trials.

    Args:
        experiment: The experiment.
        name: The problem.
        learner: Who chooses the trials.
        seed: Of the initial design, and of what is random in Ax.
        unfinished: Not used: a run takes minutes.

    Returns:
        The best regret after each trial, infinite before a feasible one, up to the first that is
        near enough; the seconds that the choices took; and the trials' parameters.
    """
    settings, system = experiment.settings, problem(name)
    best, distance = scale(name, settings.num_random)
    set_ax_logger_levels(logging.ERROR)
    client = Client()
    client.configure_experiment(parameters=[each.config() for each in system.ranges])
    client.configure_optimization(system.objective, outcome_constraints=system.constraints)
    regrets: list[float] = []
    seconds, least = 0.0, float("inf")
    with warnings.catch_warnings(), manual_seed(seed):
        # What an acquisition function's optimisation could not do is shown by the regret.
        warnings.simplefilter("ignore")
        choose(client, system, learner, settings, seed)
        while len(regrets) < settings.trials and least > settings.regret:
            start = time.process_time()
            ((index, parameters),) = client.get_next_trials(max_trials=1).items()
            seconds += time.process_time() - start
            metrics = system.measure(parameters)
            client.complete_trial(index, raw_data=metrics)
            least = min(least, (float(system.values(metrics)) - best) / distance)
            regrets.append(least)
    return {
        "trials": len(regrets) if least <= settings.regret else None,
        "seconds": seconds,
        "regrets": [None if r == float("inf") else r for r in regrets],
    }


def choose(
    client: Client, system: Problem, learner: LearnerName, settings: Settings, seed: int
) -> None:
    """Set the generation strategy of a client."""
    few = learner == "cka-few"
    options: dict[str, Any] = {
        "initialization_budget": settings.few if few else settings.initial,
        "initialization_random_seed": seed,
    }
    if learner == "ax":
        client.configure_generation_strategy(method="fast", **options)
        return
    fit_options = {"method": "map"} if learner == "map" else None
    strategy: GenerationStrategy = generation_strategy(
        system.physics,
        fit_options=fit_options,
        initialize_with_center=True,  # as Ax's default, with which it is compared
        **options,
    )
    client.set_generation_strategy(strategy)
