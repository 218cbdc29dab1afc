"""Tables of the learners that swing up a cart-pole."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from paper.cartpole import CartPole, Control
from paper.cartpole.claims import CLAIMS, LAST
from paper.cartpole.control import foresight, load, trials_table
from paper.common.experiment import Run, Table
from paper.common.figures import curves
from paper.common.tables import claims_table
from paper.common.verdicts import Curves, judge

MEASURES = {"cost": "sampled", "evaluation": "deterministic"}


def tables(runs: Sequence[Run], experiment: Control) -> dict[str, Table]:
    """Return all tables, by name; claims are judged if runs are as long as the paper's."""
    episodes = load(runs, "episodes", experiment)
    last, found = experiment.episodes, {}
    if last >= LAST:
        judged = {
            f"{actions} actions": judge(CLAIMS, Curves(episodes, measure), last)
            for measure, actions in MEASURES.items()
        }
        found["claims"] = Table("Claims", claims_table(judged))
    for measure, actions in MEASURES.items():
        shown = [trial for trial in (1, 3, 6, 12, 25, 50) if trial <= last]
        text = trials_table(
            episodes, measure, experiment.labels, shown, (last - 9, last), (1, last // 2), ".2f"
        )
        found[actions] = Table(f"Cost, {actions} actions", text)
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    return found


def draw(runs: Sequence[Run], experiment: CartPole) -> list[Path]:
    """Draw the paper's figure 2: mean and standard deviation of five learners' costs."""
    episodes = load(runs, "episodes", experiment)
    known = {name: experiment.known[name] for name in experiment.curves}
    lines = {name: (of.label, of.color) for name, of in known.items()}
    parts = {f"{actions} actions": episodes.assign(value=episodes[measure])
             for measure, actions in MEASURES.items()}  # fmt: skip
    labels = ("trial", "cost, mean ± standard deviation over runs")
    return [curves(experiment.folder / "figure2.png", parts, lines, labels)]
