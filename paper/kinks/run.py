"""Transitions of a system, CKA dynamics by the default fit, and intervals of other transitions."""

from __future__ import annotations

import time
from typing import cast

import torch
from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from gpadjust.models import TermsGP
from paper.common.experiment import Record
from paper.kinks import Kinks, Settings
from paper.kinks.systems import SYSTEMS, System

_PENALTY = 40.0  # 2 / .05: of the interval score of 95 %


def run(
    experiment: Kinks, system: str, data: str, n: int, seed: int, *, unfinished: object
) -> Record:
    """Intervals of held-out transitions, means over the predicted states."""
    settings, given = experiment.settings, SYSTEMS[system]
    states, actions = _drawn(given, data, n + settings.held_out, settings, seed)
    following = given.step(states, actions)
    dynamics = LearnedDynamics(given.spec, given.physics)
    begin = time.process_time()
    dynamics.update(states[:n], actions[:n], following[:n])
    seconds = time.process_time() - begin
    X = dynamics.targets.inputs(states[n:], actions[n:])
    Y = dynamics.targets.encode(states[n:], following[n:])
    model = cast("TermsGP", dynamics.model)
    own = _scores(model, X, Y)
    model.local_errors.forget()
    alone = _scores(model, X, Y)
    error = (model.predict(X).mean - Y).square().mean(0).sqrt() / Y.std(0)
    return {
        "seconds": seconds,
        "error": [float(each) for each in error],
        **{name: [float(each) for each in values] for name, values in own.items()},
        **{f"{name}_alone": [float(e) for e in values] for name, values in alone.items()},
    }


def _drawn(
    system: System, data: str, number: int, settings: Settings, seed: int
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


def _scores(model: TermsGP, X: Tensor, Y: Tensor) -> dict[str, Tensor]:
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
