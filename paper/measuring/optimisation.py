"""Trials of Bayesian optimisation in Ax until one is near to the best, with and without f_p."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from ax.api.client import Client
from ax.generation_strategy.generation_strategy import GenerationStrategy
from ax.utils.common.logger import set_ax_logger_levels
from botorch.utils.sampling import manual_seed
from matplotlib.axes import Axes

from gpadjust.ax import generation_strategy
from paper.common.experiment import Run, Table
from paper.common.figures import curves
from paper.common.tables import Cell, across, claims_table, groups, of, table
from paper.common.verdicts import FEWEST, Judged, counted, met
from paper.measuring import Optimisation, OptimisationSettings
from paper.measuring.searched import Problem, problem, scale

PROBLEMS, LABELS = Optimisation.axes["problem"], Optimisation.axes["learner"]
REFERENCE = "ax"
JUDGED = ("cka", "cka-few")
_COLORS = {"ax": "tab:red", "cka": "navy", "cka-few": "tab:cyan", "map": "tab:purple"}


def run(experiment: Optimisation, name: str, learner: str, seed: int) -> Run:
    """Optimise a problem by trials.

    Args:
        experiment: The experiment.
        name: The problem.
        learner: Who chooses the trials.
        seed: Of the initial design, and of what is random in Ax.

    Returns:
        The best regret after each trial, infinite before a feasible one, up to the first that is
        near enough; and the seconds that the choices took.
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
    client: Client, system: Problem, learner: str, settings: OptimisationSettings, seed: int
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
    strategy: GenerationStrategy = generation_strategy(
        system.physics,
        fit_options={"method": "map"} if learner == "map" else None,
        initialize_with_center=True,  # as Ax's default, with which it is compared
        **options,
    )
    client.set_generation_strategy(strategy)


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each run; the trials are infinite if it came to its end before it was near."""
    rows = [
        {
            **{name: r[name] for name in ("problem", "learner", "seed")},
            "trials": np.inf if r["trials"] is None else r["trials"],
            "seconds": r["seconds"] / len(r["regrets"]),
        }
        for r in runs
    ]
    return pd.DataFrame(rows).sort_values("seed", kind="stable")


def regrets(runs: Sequence[Run], trials: int) -> pd.DataFrame:
    """A row for each run and trial; a run that ended stays at the regret that it ended with."""
    rows = []
    for r in runs:
        found = [np.inf if each is None else each for each in r["regrets"]]
        found += [found[-1]] * (trials - len(found))
        key = {name: r[name] for name in ("problem", "learner", "seed")}
        rows += [{**key, "trial": i + 1, "regret": each} for i, each in enumerate(found)]
    return pd.DataFrame(rows)


def tables(runs: Sequence[Run], experiment: Optimisation) -> dict[str, Table]:
    """All tables, by name."""
    found, most = load(runs), experiment.settings.trials
    percent = f"{experiment.settings.regret:.0%}".replace("%", " %")
    judged = [each for learner in JUDGED for each in verdicts(found, most, learner)]
    names = {name: name for name in PROBLEMS}

    def by_learner(cell: Cell) -> str:
        return table(groups(found, "learner", LABELS), across(found, "problem", names, cell))

    return {
        "claims": Table("Targets", claims_table("target", {"": judged})),
        "trials": Table(
            f"Median of the trials to {percent} regret, the initial ones included; in brackets "
            f"the runs that came there within {most}, if not all did",
            by_learner(_count),
        ),
        "paired": Table(
            "Seeds with which a learner needs fewer trials than Ax's default / as many / more",
            by_learner(lambda part: _paired(found, part)),
        ),
        "seconds": Table(
            "Median seconds of a trial's choice, the initial ones included",
            by_learner(of("seconds", "median", ".2g")),
        ),
    }


def verdicts(runs: pd.DataFrame, most: int, learner: str = "cka") -> list[Judged]:
    """Whether a learner needs at most half the trials of Ax's default, in the median."""
    judged = []
    first = 1 + JUDGED.index(learner) * len(PROBLEMS)
    for number, name in enumerate(PROBLEMS, start=first):
        part = runs[runs["problem"] == name]
        if part.empty:
            continue
        text = f"{name}: {LABELS[learner]} needs at most half the trials of Ax's default"
        text += ", which has five (unequal designs)" if learner == "cka-few" else ""
        by_seed = part.pivot(index="seed", columns="learner", values="trials")
        both = by_seed.reindex(columns=[learner, REFERENCE]).dropna()
        if len(both) < FEWEST:
            judged.append(Judged(f"O{number}", text, "not run", "too few runs of both"))
            continue
        own, reference = (float(np.median(both[each])) for each in (learner, REFERENCE))
        said = [f"{x:g}" if np.isfinite(x) else f"more than {most}" for x in (own, reference)]
        measured = f"{counted(len(both))}: {said[0]}, Ax's default {said[1]} (medians)"
        # Of a median beyond the last trial nobody knows the half, only the least that it can be.
        half = min(reference, most + 1) / 2
        verdict = met(own <= half)
        if own > half and not np.isfinite(reference):
            verdict = "inconclusive"
        judged.append(Judged(f"O{number}", text, verdict, measured))
    return judged


def _count(part: pd.DataFrame) -> str:
    if part.empty:
        return ""
    middle, reached = float(np.median(part["trials"])), np.isfinite(part["trials"]).sum()
    text = f"{middle:g}" if np.isfinite(middle) else "never"
    return text if reached == len(part) else f"{text} ({reached} of {len(part)})"


def _paired(runs: pd.DataFrame, part: pd.DataFrame) -> str:
    if part.empty or part["learner"].iloc[0] == REFERENCE:
        return ""
    beside = runs[(runs["learner"] == REFERENCE) & (runs["problem"] == part["problem"].iloc[0])]
    reference, own = (each.set_index("seed")["trials"] for each in (beside, part))
    shared = own.index.intersection(reference.index)
    own, reference = own[shared], reference[shared]
    counts = [(own < reference).sum(), (own == reference).sum(), (own > reference).sum()]
    return " / ".join(map(str, counts)) if len(shared) else ""


def draw(runs: Sequence[Run], experiment: Optimisation) -> list[Path]:
    """Draw the median and the quartiles of the regret over the trials."""
    settings = experiment.settings
    shown = regrets(runs, settings.trials)
    # A regret is not followed below the threshold, at which a run ends.
    shown["regret"] = shown["regret"].clip(settings.regret, 2.0)
    parts = {
        f"{label} ({counted(part['seed'].nunique())})": part
        for label, part in groups(shown, "problem", PROBLEMS).items()
    }

    def finish(ax: Axes, title: str, part: pd.DataFrame) -> None:
        ax.axvline(settings.initial + 0.5, color="0.7", lw=1, ls="--", zorder=0)

    found = curves(
        experiment.out / "regrets.png",
        parts,
        "regret",
        {name: (LABELS[name], color) for name, color in _COLORS.items()},
        x="trial",
        labels=("trials; dashed: where Ax's initial design ends", "regret"),
        columns=3,
        size=(4, 3),
        share=False,
        logarithmic=True,
        finish=finish,
    )
    return [found]
