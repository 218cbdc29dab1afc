"""Learn from some records; compare free runs, and their intervals, with others."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch

from gpadjust.dynamics import FreeRun, Windows
from gpadjust.inference import ParameterWarning, SamplingWarning
from paper.common.experiment import Run, Table
from paper.common.tables import claims_table, markdown
from paper.common.verdicts import Judged, met
from paper.machines import ANOTHER, HORIZONS, TRAININGS, Elsewhere
from paper.machines.learners import train
from paper.machines.pendulums import STEP
from paper.machines.real import follow
from paper.machines.records import ELSEWHERE

_LEAST, _WIDEST = 0.85, 1.5
_VARIATIONS = {"none": "", "found": " + variation found", "another": " + variation 0.2"}


def run(experiment: Elsewhere, training: str, learner: str, seed: int) -> Run:
    """Learn, and return scores by test, by variation, by steps ahead, of each angle."""
    for category in (SamplingWarning, ParameterWarning):
        warnings.simplefilter("ignore", category)
    settings, known = experiment.settings, ELSEWHERE[training]
    records, smoothed = known.stretches(settings.n, seed), learner == "smoothed"
    begin = time.perf_counter()
    made = train("smoothed-cka" if smoothed else learner, known.machine, records, seed)
    seconds, tests = time.perf_counter() - begin, dict[str, Any]()
    given: dict[str, Any] = {"start_noise": "learnt"}
    variations: dict[str, Any] = {"none": None}
    if smoothed:
        given = {"start_noise": made.noise, "noise": made.noise, "process_noise": "learnt"}
        variations |= {"found": made.variation, "another": ANOTHER}
    for name, test in known.tests.items():
        windows = known.windows(name, HORIZONS[-1], settings.windows)
        tests[name] = {
            kind: _scores(follow(made.dynamics, windows, settings, **given, variation=v), windows)
            for kind, v in variations.items()
            if kind != "another" or test.kind == "another machine"
        }
    found = made.variation.tolist() if made.variation is not None else None
    return {"fit_seconds": seconds, "variation": found, "tests": tests}


def _scores(free: FreeRun, windows: Windows) -> dict[str, Any]:
    """Errors, shares held, and widths by what would have held 95 %: of each angle."""
    angles, rows = free.spec.angle_columns, [steps - 1 for steps in HORIZONS]
    error = free.spec.change(free.mean, windows.measured)[:, rows][..., angles]
    above, below = ((end - free.mean)[:, rows][..., angles] for end in (free.upper, free.lower))
    # How much wider, about the mean, an interval would have to be to reach what was measured.
    tiny = torch.finfo(error.dtype).tiny
    needed = torch.maximum(error / above.clamp_min(tiny), error / below.clamp_max(-tiny))
    found = {
        "rmse": error.square().mean(0).sqrt(),
        "held": ((error <= above) & (error >= below)).double().mean(0),
        "width": 1 / needed.quantile(0.95, dim=0),
    }
    return {
        name: dict(zip(map(str, HORIZONS), values.tolist(), strict=True))
        for name, values in found.items()
    }


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each angle and horizon of each test and variation of each run."""
    rows = [
        {
            **{key: each[key] for key in ("training", "learner", "seed")},
            **{"test": test, "variation": variation, "steps": steps, "angle": angle},
            **{name: scores[name][str(steps)][angle] for name in ("rmse", "held", "width")},
            "kind": ELSEWHERE[each["training"]].tests[test].kind,
        }
        for each in runs
        for test, of_test in each["tests"].items()
        for variation, scores in of_test.items()
        for steps in HORIZONS
        for angle in range(len(scores["rmse"][str(steps)]))
    ]
    return pd.DataFrame(rows)


def tables(runs: Sequence[Run], experiment: Elsewhere) -> dict[str, Table]:
    """All tables, by name."""
    by = ["training", "test", "learner", "variation", "steps", "angle", "kind"]
    means = load(runs).groupby(by)[["rmse", "held", "width"]].mean().reset_index()
    rows = []
    for training, label in TRAININGS.items():
        for test, given in ELSEWHERE[training].tests.items():
            for learner, name in experiment.axes["learner"].items():
                for variation, added in _VARIATIONS.items():
                    place = (training, test, learner, variation)
                    own = means[(means[by[:4]] == place).all(axis=1)]
                    if own.empty:
                        continue
                    cells = [
                        "/".join(f"{v:{form}}" for v in own.loc[own["steps"] == steps, column])
                        for column, form in (("rmse", ".3f"), ("held", ".2f"), ("width", ".2f"))
                        for steps in HORIZONS
                    ]
                    rows.append([label, given.what, f"{name}{added}", *cells])
    header = ["trained on", "tested at", ""]
    for what in ("RMSE", "held", "width"):
        header += [f"{what} {steps * STEP:g} s" for steps in HORIZONS]
    title = "RMSE in rad, share held of 95 %, width by what would have held 95 % (by angle)"
    return {
        "targets": Table("Targets", claims_table("target", {"": verdicts(means)})),
        "scores": Table(title, markdown(header, rows)),
    }


def verdicts(means: pd.DataFrame) -> list[Judged]:
    """Targets of smoothed CKA with variation: what was found, and 0.2 of another machine."""
    own = means[means["learner"] == "smoothed"]
    ours = (own["variation"] == "found") & (own["kind"] != "another machine")
    ours |= (own["variation"] == "another") & (own["kind"] == "another machine")
    found, count = [], 0
    for kind, claim in (
        ("beyond", "beyond the training range"),
        ("another machine", "on another machine, variation 0.2"),
        ("in range", "in range"),
    ):
        mine = own[(own["kind"] == kind) & ours]
        before = own[(own["kind"] == kind) & (own["variation"] == "none")]
        for column, text in (
            ("held", f"95 % hold at least {_LEAST}"),
            ("width", f"widths at most {_WIDEST} times what holds 0.95"),
        ):
            count += 1
            if mine.empty:
                continue
            kept, alone = (
                part[column] >= _LEAST if column == "held" else part[column] <= _WIDEST
                for part in (mine, before)
            )
            said = (
                f"in {kept.sum()} of {len(kept)} cells, from {mine[column].min():.2f} to "
                f"{mine[column].max():.2f} (without variation in {alone.sum()}, "
                f"{before[column].min():.2f} to {before[column].max():.2f})"
            )
            found.append(Judged(f"E{count}", f"{claim}: {text}", met(bool(kept.all())), said))
    return found
