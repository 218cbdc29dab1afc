"""How dynamics learn real episodes, and how well they predicted them before."""

from __future__ import annotations

import math
import time
import warnings

from torch import Tensor

from gpadjust.control.recorded_episodes import RecordedEpisodes
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics
from gpadjust.dynamics.trajectory_scores import typical_change
from gpadjust.models import TermsModel
from gpadjust.physics import PhysicsError
from gpadjust.validation.trust import trust

_WINDOWS = 4  # of each horizon: some half second for a model of an episode


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
    new = new.learnable(task.dynamics)
    if task.dynamics.is_fitted:
        before = time.perf_counter()
        found = _scores(task, new, recorded, horizons)
        found["score_seconds"] = time.perf_counter() - before
    task.dynamics.update(new.states, new.actions, new.next_states)
    found["fit_seconds"] = time.perf_counter() - start - found.get("score_seconds", 0.0)
    return {name: value for name, value in found.items() if not math.isnan(value)}


def _scores(
    task: Task, new: RecordedEpisodes, recorded: RecordedEpisodes, horizons: tuple[int, ...]
) -> dict[str, float]:
    dynamics, spec = task.dynamics, task.dynamics.spec
    transitions = (new.states, new.actions, new.next_states)
    score = dynamics.score(*transitions)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [spec.states[i] for i in spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    found["overrides"] = _overrides(dynamics, new.states, new.actions)
    if not horizons:
        return found
    try:
        far = dynamics.score_trajectories(
            *transitions,
            horizons=horizons,
            max_windows=_WINDOWS,
            units=typical_change(spec, recorded.states, recorded.next_states),
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
    for i, horizon in enumerate(horizons):
        found |= {
            f"nlpd_{horizon}": float(far.nlpd[i].mean()),
            f"coverage_{horizon}": float(far.coverage[i].mean()),
            f"energy_{horizon}": float(far.energy[i]),
        }
    return found


def _overrides(dynamics: Dynamics, states: Tensor, actions: Tensor) -> float:
    """The share of predictions in which data override the physics; nan without one."""
    if not isinstance(dynamics, LearnedDynamics):
        return float("nan")
    model = dynamics.model
    if not isinstance(model, TermsModel) or not model.rho_names:
        return float("nan")
    return float(trust(model, dynamics.targets.inputs(states, actions)).data.mean())
