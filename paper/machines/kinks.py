"""Transitions of a system, CKA dynamics by the default fit, and intervals of other transitions."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from paper.common.experiment import Run, Table
from paper.common.tables import claims_table, groups, markdown, of
from paper.common.verdicts import Judged, met
from paper.machines import KINKS, SMOOTH, Kinks, KinksSettings
from paper.machines.kinks_systems import SYSTEMS, System

_PENALTY = 40.0  # 2 / 0.05: of the interval score of 95 %


def run(experiment: Kinks, data: str, n: int, system: str, seed: int) -> Run:
    """Intervals of held-out transitions, means over the predicted states."""
    settings, given = experiment.settings, SYSTEMS[system]
    states, actions = drawn(given, data, n + settings.held_out, settings, seed)
    following = given.step(states, actions)
    dynamics = LearnedDynamics(given.spec, given.physics)
    begin = time.process_time()
    dynamics.update(states[:n], actions[:n], following[:n])
    seconds = time.process_time() - begin
    X = dynamics.targets.inputs(states[n:], actions[n:])
    Y = dynamics.targets.encode(states[n:], following[n:])
    model: Any = dynamics.model
    own = _scores(model, X, Y)
    model.local_errors.forget()
    alone = {f"{name}_alone": values for name, values in _scores(model, X, Y).items()}
    error = (model.predict(X).mean - Y).square().mean(0).sqrt() / Y.std(0)
    found = {"error": error, **own, **alone}
    return {"seconds": seconds, **{name: values.tolist() for name, values in found.items()}}


def drawn(
    system: System, data: str, number: int, settings: KinksSettings, seed: int
) -> tuple[Tensor, Tensor]:
    """So many states and actions, in any order."""
    generator = torch.Generator().manual_seed(seed)
    if data == "scattered":
        return system.draw(number, generator)
    episodes = -(-number // settings.steps)
    state, action = system.draw(episodes, generator)
    states, actions = [], []
    for step in range(settings.steps):
        if step and step % 4 == 0:
            action = system.draw(episodes, generator)[1]
        states.append(state)
        actions.append(action)
        state = system.step(state, action)
    order = torch.randperm(episodes * settings.steps, generator=generator)[:number]
    return torch.cat(states)[order], torch.cat(actions)[order]


def _scores(model: Any, X: Tensor, Y: Tensor) -> dict[str, Tensor]:
    """Shares held, mean widths, interval scores and log densities of each predicted state."""
    low, high = model.interval(X, observation_noise=True)
    beyond = (low - Y).clamp_min(0) + (Y - high).clamp_min(0)
    mean, variance = model.components(X, observation_noise=True)
    density = torch.distributions.Normal(mean, variance.sqrt()).log_prob(Y.unsqueeze(-3))
    log_mean = density.logsumexp(-3) - torch.tensor(float(density.shape[-3])).log()
    return {
        "held": (beyond == 0).to(Y).mean(0),
        "width": (high - low).mean(0),
        "score": (high - low + _PENALTY * beyond).mean(0),
        "nlpd": -log_mean.mean(0),
    }


def tables(runs: Sequence[Run], experiment: Kinks) -> dict[str, Table]:
    """All tables, by name."""
    found = pd.DataFrame(
        {
            **{name: each[name] for name in ("system", "data", "n", "seconds")},
            "held": np.mean(each["held"]),
            "held_alone": np.mean(each["held_alone"]),
            "width": np.mean(np.log(np.divide(each["width"], each["width_alone"]))),
            "score": np.mean(np.log(np.divide(each["score"], each["score_alone"]))),
            "nlpd": np.mean(np.subtract(each["nlpd"], each["nlpd_alone"])),
            "error": np.mean(each["error"]),
        }
        for each in runs
    )
    columns = {
        "runs": len,
        "error / sd": of("error", "median", ".2g"),
        "held, kernels alone": lambda own: f"{own['held_alone'].mean():.3f}",
        "held": lambda own: f"{own['held'].mean():.3f}",
        "width": lambda own: f"{np.exp(own['width'].mean()):.2f}",
        "interval score": lambda own: f"{np.exp(own['score'].mean()):.2f}",
        "NLPD": of("nlpd", "median", "+.2f"),
        "s": of("seconds", "median", ".2g"),
    }
    rows = [
        [label if i == 0 else "", *map(str, kind), *(str(cell(part)) for cell in columns.values())]
        for label, own in groups(found, "system", experiment.axes["system"]).items()
        for i, (kind, part) in enumerate(own.groupby(["data", "n"]))
    ]
    return {
        "targets": Table("Targets", claims_table("target", {"": verdicts(found)})),
        "intervals": Table("Intervals of 95 %", markdown(["", "data", "n", *columns], rows)),
    }


def verdicts(found: pd.DataFrame) -> list[Judged]:
    """Verdicts, each on the worst system."""
    means = found.groupby("system")[["held", "width"]].mean()
    means["width"] = np.exp(means["width"])
    judged = []
    for id, labels, column, text, kept in (
        ("K1", KINKS, "held", "each system with kinks: 95 % hold at least 0.90", means >= 0.9),
        (
            "K2",
            SMOOTH,
            "width",
            "each smooth system: intervals at most 1.1 times as wide as by kernels alone",
            means <= 1.1,
        ),
    ):
        present = [system for system in labels if system in means.index]
        if present:
            said = ", ".join(f"{labels[s]} {means.loc[s, column]:.2f}" for s in present)
            judged.append(Judged(id, text, met(bool(kept.loc[present, column].all())), said))
    return judged
