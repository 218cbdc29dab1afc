"""Tables of the learners that swing up a cart-pole."""

from __future__ import annotations

from collections.abc import Sequence

from paper.cartpole import Control
from paper.cartpole.claims import CLAIMS
from paper.cartpole.control import foresight, load
from paper.cartpole.planning import trials_table
from paper.common.experiment import Run, Table
from paper.common.tables import claims_table
from paper.common.verdicts import Curves, judge

MEASURES = {"cost": "sampled", "evaluation": "deterministic"}


def tables(runs: Sequence[Run], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes = load(runs, "episodes", experiment)
    last = experiment.settings.episodes
    of = {measure: Curves(episodes, measure) for measure in MEASURES}
    judged = {f"{MEASURES[m]} actions": judge(CLAIMS, of[m], last) for m in MEASURES}
    found = {"claims": Table("Claims", claims_table("claim", judged))}
    for measure, actions in MEASURES.items():
        shown = [trial for trial in (1, 3, 6, 12, 25, 50) if trial <= last]
        text = trials_table(
            episodes, measure, experiment.labels, shown, (last - 9, last), (1, last // 2), ".2f"
        )
        found[actions] = Table(f"Cost, {actions} actions", text)
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    return found
