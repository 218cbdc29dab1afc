"""How dynamics learn real episodes, and how well they predicted them before."""

from __future__ import annotations

import math
import time
import warnings

import torch
from torch import Tensor

from gpadjust.control.recorded_episodes import RecordedEpisodes
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, Trajectories
from gpadjust.dynamics.free_run import typical_change
from gpadjust.models import TermsModel
from gpadjust.physics import PhysicsError
from gpadjust.validation.trust import trust

_WINDOWS = 4  # some half second for a model of an episode
_FAR = ("nlpd", "coverage", "energy")


def learn_dynamics(
    task: Task, new: RecordedEpisodes, recorded: RecordedEpisodes, horizons: tuple[int, ...]
) -> dict[str, float]:
    """Score the dynamics of a task on new episodes, and update them with these.

    PyTorch's generator is left as it is by the scores. Scores that are not defined (densities of
    dynamics without variances, horizons longer than the episodes) are left out.

    Args:
        task: The task, with bounds of the states.
        new: Episodes that the dynamics have not learnt.
        recorded: All episodes; energy scores are in units of their typical changes, so that those
            of different episodes can be compared.
        horizons: Numbers of steps over which trajectories are scored; none for scores of single
            steps alone.

    Returns:
        ``nlpd`` and ``coverage`` of a step, ``rmse/<state>``; ``overrides``, the share of
        predictions in which data override the physics; ``nlpd_15``, ``coverage_15`` and
        ``energy_15`` of a horizon of 15; ``score_seconds``, ``fit_seconds``.
    """
    start, found = time.perf_counter(), {}
    learnable = new.learnable(task.dynamics)
    if task.dynamics.is_fitted:
        before = time.perf_counter()
        found = _scores(task, learnable, recorded, horizons)
        found["score_seconds"] = time.perf_counter() - before
    task.dynamics.update(*learnable)
    found["fit_seconds"] = time.perf_counter() - start - found.get("score_seconds", 0.0)
    return {name: value for name, value in found.items() if not math.isnan(value)}


def _scores(
    task: Task, new: Trajectories, recorded: RecordedEpisodes, horizons: tuple[int, ...]
) -> dict[str, float]:
    dynamics, spec = task.dynamics, task.dynamics.spec
    score = dynamics.score(*new)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [spec.states[i] for i in spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    found["overrides"] = _overrides(dynamics, new.states, new.actions)
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
            "score_horizons=() to do without.",
            UserWarning,
            stacklevel=4,
        )
        return found
    units = typical_change(spec, recorded.states, recorded.next_states)
    far = run.score(windows.measured, horizons=possible, units=units)
    for i, horizon in enumerate(possible):
        for name in _FAR:
            values = getattr(far, name)[i]
            values = values if name == "energy" else values[spec.moving]
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
