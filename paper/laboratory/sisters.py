"""A pump of which few points are measured, with and without what others taught.

Tried on other seeds, ratios of the error with one other pump, one that has nothing to
do with it and is rough, and one that is smooth:

| whether others help is decided by | one | rough | smooth |
|---|---|---|---|
| evidence, beside a default model of vague priors; prior probability 0.5 | 0.37 | 0.96 | 1.02 |
| left-out observations; 0.5 | 0.45 | 0.98 | 1.01 |
| evidence on equal terms; 0.5 | 0.37 | 0.98 | 1.01 |
| the same; 0.1, which was taken | 0.40 | 0.99 | 1.02 |

These are of seeds 520 to 539. On seeds 500 to 509 the three ways, with a prior probability of 0.7,
had 1.31, 1.26 and 1.27 where the machine was rough, so that others have to show that they help.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.ticker import NullFormatter

from gpadjust import CKA, fit
from gpadjust.validation import rmse
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import claims_table, frame, markdown, number
from paper.common.verdicts import Judged, met
from paper.laboratory import Sisters
from paper.laboratory.pumps import OtherMachine, Pump, catalogue, inputs, measured

_ROUGH, _SMOOTH = (0.4, 0.2), (1.3, 0.7)
_MOST = {"one": 0.6, "three": 0.6, "rough": 1.05, "smooth": 1.05}


def run(experiment: Sisters, prior: str, seed: int) -> Run:
    """Errors of pump B without and with a prior, on the function itself."""
    settings, generator = experiment.settings, torch.Generator().manual_seed(seed // 10)
    pumps = [Pump.drawn(generator) for _ in range(10)]
    generator.manual_seed(1_000 + seed)
    B, *others = ([*pumps, *pumps][seed % 10 + k] for k in range(4))
    X = inputs(settings.points, generator)
    Y, test = measured(B.head(X), generator), inputs(settings.tests, generator)
    teachers: dict[str, list[Any]] = {
        "one": others[:1],
        "three": others,
        "rough": [OtherMachine(generator, _ROUGH)],
        "smooth": [OtherMachine(generator, _SMOOTH)],
    }
    taught = []
    for machine in teachers[prior]:
        own = inputs(settings.known, generator)
        taught.append(CKA(own, measured(machine.head(own), generator), physics=catalogue))
        fit(taught[-1])
    found: Run = {}
    for name in ("without", "with"):
        model = CKA(X, Y, physics=catalogue)
        result: Any = fit(model, prior=taught if name == "with" else None)
        mean, _ = model.predict(test)
        low, high = model.interval(test)
        found[f"rmse_{name}"] = rmse(mean, B.head(test)).item()
        held = (low <= B.head(test)) & (B.head(test) <= high)
        found[f"coverage_{name}"] = held.double().mean().item()
        found[f"width_{name}"] = (high - low).mean().item()
    found["probability"] = float(result.sisters)
    found["rmse_physics"] = rmse(catalogue(test), B.head(test)).item()
    return found


def tables(runs: Sequence[Run], experiment: Sisters) -> dict[str, Table]:
    """All tables, by name."""
    rows, ratios = [], {}
    found = frame(runs)
    for prior, label in experiment.axes["prior"].items():
        own = found[found["prior"] == prior]
        if len(own):
            ratios[prior] = ratio(own)
            middle, low, high = ratios[prior]
            rows.append(
                [
                    *(label, f"{len(own)}", number(own["rmse_physics"].mean())),
                    *(number(own[f"rmse_{name}"].mean()) for name in ("without", "with")),
                    f"{middle:.2f} [{low:.2f}, {high:.2f}]",
                    *(number(own[f"coverage_{n}"].mean(), ".2f") for n in ("without", "with")),
                    *(number(own[f"width_{name}"].mean()) for name in ("without", "with")),
                    number(own["probability"].mean(), ".2f"),
                ]
            )
    header = ["prior of pump B", "cases", "RMSE of f_p [m]", "RMSE without [m]", "RMSE with [m]"]
    header += ["with over without, geometric mean [95 %]", "coverage without", "coverage with"]
    header += ["width without [m]", "width with [m]", "probability that it helps"]
    shown = {"errors": Table("Errors of pump B", markdown(header, rows))}
    if ratios:
        claims = [
            Judged(
                f"S{i}",
                f"{experiment.axes['prior'][name]}: at most {_MOST[name]} of the error without",
                met(value[0] <= _MOST[name]),
                f"{value[0]:.2f} [{value[1]:.2f}, {value[2]:.2f}]",
            )
            for i, (name, value) in enumerate(ratios.items(), 1)
        ]
        shown["targets"] = Table("Targets", claims_table("target", {"sisters": claims}))
    return shown


def ratio(runs: pd.DataFrame) -> tuple[float, float, float]:
    """The geometric mean of the error with over that without, and its interval of 95 %."""
    logs = np.log(runs["rmse_with"] / runs["rmse_without"]).to_numpy()
    error = logs.std(ddof=1) / np.sqrt(len(logs)) if len(logs) > 1 else 0.0
    return tuple(np.exp(logs.mean() + k * error) for k in (0, -1.96, 1.96))


def draw(runs: Sequence[Run], experiment: Sisters) -> list[Path]:
    """Draw the error with a prior beside that without, for each pump."""
    found = frame(runs)
    shown = {k: v for k, v in experiment.axes["prior"].items() if k in {*found["prior"]}}
    titles = [label.removeprefix("a machine that has ") for label in shown.values()]
    figure, axes = panels(titles, len(shown), (3.2, 3.2))
    for ax, prior in zip(axes, shown, strict=True):
        own = found[found["prior"] == prior]
        ax.loglog(own["rmse_without"], own["rmse_with"], "o", color="navy", alpha=0.7)
        ends = [0.15, 4.0]
        ax.plot(ends, ends, color="0.4", lw=1)
        ax.plot(ends, [0.6 * end for end in ends], color="0.4", lw=1, ls=":")
        ax.set(xlabel="RMSE without [m]")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_minor_formatter(NullFormatter())
    axes[0].set(ylabel="RMSE with the prior [m]")
    return [save(figure, experiment.out / "sisters.png")]
