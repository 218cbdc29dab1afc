"""Tables and curves of learners that reach with an arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from paper.arm import Arm
from paper.arm.claims import LAST, claims
from paper.cartpole import Control
from paper.cartpole.control import foresight, load, trials_table
from paper.common.experiment import Run, Table
from paper.common.figures import curves as draw_curves
from paper.common.tables import claims_table
from paper.common.verdicts import Curves, judge

MEASURES = {"all_steps": "all steps", "last_five": "last five steps"}
_SHOWN = (3, 6, 9, 12, 18, 24, 30)  # episodes


def load_maps(runs: Sequence[Run], experiment: Control) -> pd.DataFrame:
    """Return errors in cm: a row for each learner, seed, mapped episode and target."""
    frames = [
        pd.DataFrame(
            {
                **{"learner": each["scenario"], "seed": each["seed"], "episode": int(episode)},
                **{"target": range(len(errors["all_steps"])), **errors},
            }
        )
        for name in experiment.known
        for each in runs
        if each["scenario"] == name
        for episode, errors in each["maps"].items()
    ]
    columns = ["learner", "seed", "episode", "target", *MEASURES]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def tables(runs: Sequence[Run], experiment: Control) -> dict[str, Table]:
    """Return all tables, by name."""
    episodes, maps = load(runs, "episodes", experiment), load_maps(runs, experiment)
    evaluations = load(runs, "evaluations", experiment)
    of = {measure: Curves(evaluations, measure) for measure in MEASURES}
    found = {}
    if experiment.episodes >= LAST:
        about = claims(episodes, maps)
        judged = {MEASURES[m]: judge(about, of[m], LAST) for m in MEASURES}
        found["claims"] = Table("Claims", claims_table(judged))
    for name, measure in (("all", "all_steps"), ("last", "last_five")):
        text = trials_table(
            evaluations, measure, experiment.labels, _SHOWN, (24, LAST), (24, LAST), ".1f"
        )
        found[name] = Table(f"Hand's error in cm, {MEASURES[measure]}", text)
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    return found


BOUND = 4.1  # cm, all steps, of SAC after 1,000 trials


def draw(runs: Sequence[Run], experiment: Arm) -> list[Path]:
    """Draw the paper's figure 3: mean and standard deviation of five learners' errors."""
    errors = load(runs, "evaluations", experiment)
    lines = {n: (experiment.known[n].label, experiment.known[n].color) for n in experiment.curves}

    def finish(ax: Axes) -> None:
        ax.axhline(34, color="0.5", lw=0.8, ls=":", label="start pose held, all steps")
        ax.axhline(BOUND, color="black", lw=1, ls="--", label="1,000 trials of SAC, all steps")
        ax.set_ylim(0, 70)

    parts = {what: errors.assign(value=errors[measure]) for measure, what in MEASURES.items()}
    labels = ("trial", "hand's RMSE over targets, cm, mean ± sd")
    path = experiment.folder / "figure3.png"
    return [draw_curves(path, parts, lines, labels, finish)]
