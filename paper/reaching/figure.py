"""Curves and maps of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gpadjust.systems.reaching import arm_targets, hand_position
from paper.arm.figure import BOUND, draw_arm
from paper.common.curves import load_trials
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.reaching import LEARNERS, SYSTEMS, Reaching
from paper.reaching.run import MAPPED
from paper.reaching.tables import load_maps

COLORS = {
    "cka": "navy",
    "phymean": "tab:purple",
    "phy": "tab:orange",
    "fitted": "tab:brown",
    "gp": "tab:red",
    "ensemble": "tab:green",
}
_WORST = 30  # cm, the end of the colours


def draw(records: Sequence[Record], experiment: Reaching) -> list[Path]:
    """Draw curves and maps; return their files."""
    found = [_curves(records, experiment)]
    maps = [
        record for record in records if (record["system"], record["learner"]) == ("plain", "cka")
    ]
    return [*found, _maps(maps, experiment)] if maps else found


def _curves(records: Sequence[Record], experiment: Reaching) -> Path:
    """The hand's error over the trials, models over each other, a panel for each arm."""
    trials = load_trials(records)
    systems = [name for name in SYSTEMS if name in set(trials["system"])]
    figure, axes = panels([SYSTEMS[name] for name in systems], 2, (4.2, 3), width=8.4)
    for ax, system in zip(axes, systems, strict=True):
        for name, label in LEARNERS.items():
            own = trials[(trials["system"] == system) & (trials["scenario"] == name)]
            if len(own):
                draw_quartiles(ax, own, "all_steps", color=COLORS[name], label=label)
        ax.axhline(BOUND, color="0.5", lw=1, ls="--", label="true arm, 1,000 trials of SAC")
        ax.set_ylim(0, 40)
    figure.supxlabel("trial", fontsize="medium")
    figure.supylabel("hand's error, cm, median and quartiles", fontsize="medium")
    one_legend(figure, axes)
    return save(figure, experiment.out / "curves.png")


def _maps(records: Sequence[Record], experiment: Reaching) -> Path:
    """The error at each target after some trials, the mean over the runs of CKA."""
    maps = load_maps(records)
    shown = [trial for trial in MAPPED if trial in set(maps["episode"])]
    figure, axes = panels([f"after trial {trial}" for trial in shown], 3, (2.9, 2.3))
    targets = 100 * hand_position(arm_targets()).numpy()
    for trial, ax in zip(shown, axes, strict=True):
        mean = maps[maps["episode"] == trial].groupby("target")["all_steps"].mean()
        draw_arm(ax)
        dots = ax.scatter(
            targets[:, 0],
            targets[:, 1],
            c=mean.to_numpy(),
            s=18,
            cmap="viridis_r",
            vmin=0,
            vmax=_WORST,
            zorder=2,
        )
        ax.set_aspect("equal")
    figure.supxlabel("along the upper arm at 0°, cm", fontsize="medium")
    figure.supylabel("across, cm", fontsize="medium")
    figure.colorbar(dots, ax=axes, label="RMSE, cm", shrink=0.9, extend="max")
    return save(figure, experiment.out / "map.png")
