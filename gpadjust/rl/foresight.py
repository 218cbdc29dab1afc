"""How well dynamics foresee a new episode, for the log."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, Trajectories
from gpadjust.dynamics.free_run import typical_change
from gpadjust.models import TermsModel
from gpadjust.physics import PhysicsError
from gpadjust.rl.recorded_episodes import RecordedEpisodes
from gpadjust.validation.trust import trust

_WINDOWS = 4  # some half second for a model of an episode
_FAR = ("nlpd", "coverage", "energy")


def foresight(
    task: Task,
    new: Trajectories,
    recorded: RecordedEpisodes,
    horizons: tuple[int, ...],
) -> dict[str, float]:
    """Scores of the next states, and of trajectories over each horizon, by the names in the log.

    Energies are in units of the typical changes in all that is recorded, so that those of different
    episodes can be compared. PyTorch's generator is left as it is.

    Args:
        task: The task, with bounds of the states; its dynamics are scored.
        new: What they have not learnt from.
        recorded: All real episodes.
        horizons: Numbers of steps; none for the scores of next states, and how many of them data
            override the physics in, alone.
    """
    dynamics = task.dynamics
    score = dynamics.score(*new)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [dynamics.spec.states[i] for i in dynamics.spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    found["overrides"] = _overrides(dynamics, new.states, new.actions)
    found |= {f"{name}_{k}": float("nan") for k in horizons for name in _FAR}
    possible = [k for k in horizons if k <= new.longest]
    if not possible:
        return found
    windows = new.windows(possible[-1], stride=1)
    last = len(windows.actions) - 1
    windows = windows.some(torch.linspace(0, last, min(last + 1, _WINDOWS)).round().long())
    try:
        run = dynamics.free_run(
            windows.initial_states,
            windows.actions,
            state_bounds=task.widened(new.states).state_bounds,
        )
    except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
        warnings.warn(
            f"There are no scores of trajectories, as their particles cannot move: {error} Pass "
            "options with score_horizons=() to do without.",
            UserWarning,
            stacklevel=4,
        )
        return found
    units = typical_change(dynamics.spec, recorded.states, recorded.next_states)
    far = run.score(windows.measured, horizons=possible, units=units)
    for i, horizon in enumerate(possible):
        for name in _FAR:
            values = getattr(far, name)[i]
            values = values if name == "energy" else values[dynamics.spec.moving]
            found[f"{name}_{horizon}"] = float(values.mean())
    return found


def _overrides(dynamics: Dynamics, states: Tensor, actions: Tensor) -> float:
    """The share of predictions in which data override the physics; nan without one."""
    if not isinstance(dynamics, LearnedDynamics):
        return float("nan")
    model = dynamics.model
    if not isinstance(model, TermsModel) or not model.rho_names:
        return float("nan")
    return float(trust(model, dynamics.targets.inputs(states, actions)).data.mean())
