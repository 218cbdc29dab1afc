"""An agent's trials, and how well dynamics that learn them one by one predict the next."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from gpadjust.dynamics import LearnedDynamics, Trajectories
from gpadjust.inference import SamplingWarning
from gpadjust.states import StateSpec
from paper.cartpole.control import make_agent
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import claims_table, markdown
from paper.common.verdicts import FEWEST, Judged, counted, met
from paper.machines import METHODS, NOISES, SENSORS, Foresight, ForesightSettings

_LEARNER = "cka"


def run(experiment: Foresight, system: str, seed: int) -> Run:
    """Let an agent make trials; return the scores of each method with each noise."""
    warnings.simplefilter("ignore", SamplingWarning)
    control = experiment.control(system)
    agent = make_agent(control, _LEARNER, seed)
    known: Any = agent.ready_task().dynamics  # of the control experiment: at the most likely
    spec, physics = known.spec, known.physics
    agent.task = replace(agent.ready_task(), dynamics=_dynamics(spec, physics, "default"))
    length = control.settings.episode_length
    agent.gradient_steps = length
    start = time.process_time()
    agent.learn(experiment.settings.trials * length, log_interval=experiment.settings.trials + 1)
    seconds = time.process_time() - start
    made = agent.recorded_episodes()
    parts: Any = (part.split(length) for part in (made.states, made.actions, made.next_states))
    trials = [
        Trajectories(states, actions, following, episode=torch.zeros(length))
        for states, actions, following in zip(*parts, strict=True)
    ]
    rewards = [each.mean().item() for each in made.rewards.split(length)]
    found: dict[str, Any] = {"agent_seconds": seconds, "rewards": rewards}
    for noise in NOISES:
        seen = trials if noise == "none" else measured(spec, trials, seed)
        for method in METHODS:
            dynamics = _dynamics(spec, physics, method)
            found[f"{noise}-{method}"] = _replay(dynamics, seen, experiment.settings)
    return found


def measured(spec: StateSpec, trials: list[Trajectories], seed: int) -> list[Trajectories]:
    """The same trials as noisy sensors see them: each state once, whichever row it is in."""
    sd = torch.tensor([SENSORS.get(name, 0.0) for name in spec.states], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed + 1_000)
    found = []
    for states, actions, next_states in trials:
        every = torch.cat([states, next_states[-1:]])
        seen = every + sd * torch.randn(every.shape, generator=generator, dtype=torch.float64)
        found.append(Trajectories(seen[:-1], actions, seen[1:], torch.zeros(len(actions))))
    return found


def _dynamics(spec: StateSpec, physics: Any, method: str) -> LearnedDynamics:
    if method == "default":
        return LearnedDynamics(spec, physics)
    make = LEARNERS["literal"].make
    return LearnedDynamics(spec, physics, model=make, fit_options={"method": "map"})


def _replay(
    dynamics: LearnedDynamics, trials: list[Trajectories], settings: ForesightSettings
) -> dict[str, Any]:
    """Learn all trials but the last, one by one, each time judged by the next."""
    rows, third = [], max(1, (len(trials) - 1) // 3)
    conditioned: dict[str, Any] = {}
    for i, (learnt, unseen) in enumerate(pairwise(trials), 1):
        start = time.process_time()
        dynamics.update(*learnt)
        seconds = time.process_time() - start
        rows.append({**_scores(dynamics, unseen, settings), "fit_seconds": seconds})
        if i == third:
            state = dynamics.state_dict()
            dynamics.condition(*(torch.cat(c) for c in zip(*trials[third:-1], strict=True)))
            conditioned = _scores(dynamics, trials[-1], settings)
            dynamics.load_state_dict(state)
    return {**{name: [row[name] for row in rows] for name in rows[0]}, "conditioned": conditioned}


def _scores(
    dynamics: LearnedDynamics, unseen: Trajectories, settings: ForesightSettings
) -> dict[str, Any]:
    """Scores of next states, and of free runs by their number of steps; an entry for each state."""
    near = dynamics.score(*unseen)
    found: dict[str, Any] = {"coverage": near.coverage.tolist(), "nlpd": near.nlpd.tolist()}
    for steps in settings.horizons:
        windows = unseen.windows(steps, stride=1)
        last = len(windows.actions) - 1
        places = torch.linspace(0, last, min(last + 1, settings.max_windows)).round().long()
        windows = windows.some(places)
        free = dynamics.free_run(
            windows.initial_states, windows.actions, num_functions=settings.num_functions
        )
        far = free.score(windows.measured, horizons=[steps])
        moving = dynamics.spec.moving
        found[f"coverage_{steps}"] = far.coverage[0, moving].tolist()
        found[f"nlpd_{steps}"] = far.nlpd[0, moving].tolist()
    return found


def tables(runs: Sequence[Run], experiment: Foresight) -> dict[str, Table]:
    """All tables, by name."""
    settings, labels = experiment.settings, experiment.axes["system"]
    last, far = settings.trials, max(settings.horizons)
    start = ["system", "noise", "fit", "agents"]
    headers = {
        "coverage": [
            "next states: trial 2",
            f"trials 3-{last}",
            f"{far} steps: trials 2-{last}",
            f"NLPD, next states, 3-{last}",
            f"NLPD, {far} steps, 2-{last}",
        ],
        "trials": [*(f"trial {i}" for i in range(2, last + 1)), "last fit, s"],
        "conditioned": ["conditioned", "fitted again", "difference"],
    }
    rows: dict[str, list[list[str]]] = {name: [] for name in headers}
    for system, noise, method in ((s, n, m) for s in labels for n in NOISES for m in METHODS):
        own = [each[f"{noise}-{method}"] for each in runs if each["system"] == system]
        if not own:
            continue
        near = [_spread([_mean(r["coverage"][i]) for r in own]) for i in range(last - 1)]
        told = [_mean(r["conditioned"]["coverage"]) for r in own]
        gaps = [t - _mean(r["coverage"][-1]) for t, r in zip(told, own, strict=True)]
        spans = (("coverage", 3), (f"coverage_{far}", 2), ("nlpd", 3), (f"nlpd_{far}", 2))
        over = [_spread([_mean(r[name][first - 2 :]) for r in own]) for name, first in spans]
        seconds = np.median([r["fit_seconds"][-1] for r in own])
        label = [labels[system], NOISES[noise], METHODS[method], f"{len(own)}"]
        rows["coverage"].append([*label, near[0], *over])
        rows["trials"].append([*label, *near, f"{seconds:.1f}"])
        rows["conditioned"].append([*label, _spread(told), near[-1], _spread(gaps, "+.2f")])
    titles = {
        "coverage": "Shares in the intervals of 95 %, and NLPD in nats",
        "trials": "Shares of the next states in the intervals of 95 %, by trial",
        "conditioned": f"Shares of the next states of trial {last}, conditioned or fitted again",
    }
    judged = claims_table("target", verdicts(runs, experiment))
    return {
        "targets": Table("Targets of the default fit", judged),
        **{k: Table(titles[k], markdown([*start, *headers[k]], rows[k])) for k in headers},
    }


def verdicts(runs: Sequence[Run], experiment: Foresight) -> dict[str, list[Judged]]:
    """Those on the default fit, by system and noise; single trials are means over the agents."""
    last, far = experiment.settings.trials, max(experiment.settings.horizons)
    next_states = "intervals of 95 % hold of the next states of trial 2"
    ahead = f"{far} steps ahead, of trials 2-{last}, mean"
    aims = (
        ("K1", "coverage", 2, 2, (0.85, 0.99), next_states),
        ("K2", "coverage", 3, last, (0.90, 0.98), f"of those of trials 3-{last}, in the mean"),
        ("K3", f"coverage_{far}", 2, last, (0.85, 0.99), ahead),
    )
    found = {}
    for system, noise in ((s, n) for s in experiment.axes["system"] for n in NOISES):
        own = [each[f"{noise}-default"] for each in runs if each["system"] == system]
        if not own:
            continue
        judged = []
        for id, name, first, end, (low, high), text in aims:
            trials = {i: _mean([r[name][i - 2] for r in own]) for i in range(first, end + 1)}
            mean = _mean([*trials.values()])
            said = f"{mean:.3f}"
            for which, beyond in (
                ("below", {i: value for i, value in trials.items() if value < low}),
                ("above", {i: value for i, value in trials.items() if value > high}),
            ):
                if beyond and len(trials) > 1:
                    single = ", ".join(f"trial {i} {value:.3f}" for i, value in beyond.items())
                    said += f"; {which}: {single}"
            claim = f"{text}: {low:.2f} to {high:.2f}"
            judged.append(Judged(id, claim, met(low <= mean <= high), said))
        gaps = [_mean(r["conditioned"]["coverage"]) - _mean(r["coverage"][-1]) for r in own]
        text = "conditioned on three times the data, mean: within 0.1 of fitting again"
        said = f"{_mean(gaps):+.3f}; agents " + ", ".join(f"{gap:+.2f}" for gap in gaps)
        judged.append(Judged("K4", text, met(abs(_mean(gaps)) <= 0.1), said))
        heading = experiment.axes["system"][system]
        heading += f", {NOISES[noise]} noise" if noise != "none" else ""
        few = len(own) < FEWEST
        found[heading] = [
            replace(each, verdict="not run", measured="too few runs")
            if few
            else replace(each, measured=f"{counted(len(own))}: {each.measured}")
            for each in judged
        ]
    return found


def _mean(values: object) -> float:
    """Over states, trials or both, of what is known."""
    return float(np.nanmean(np.array(values, dtype=float)))


def _spread(values: Sequence[float], form: str = ".2f") -> str:
    """The mean and its standard error."""
    error = np.std(values, ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
    return f"{np.mean(values):{form}}" + ("" if np.isnan(error) else f" ± {error:.2f}")
