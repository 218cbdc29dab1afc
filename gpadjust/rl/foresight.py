"""How well dynamics foresee a new episode, for the log."""

from __future__ import annotations

import warnings

from torch import Tensor

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics
from gpadjust.dynamics.trajectory_scores import typical_change
from gpadjust.models import TermsModel
from gpadjust.physics import PhysicsError
from gpadjust.rl.recorded_episodes import RecordedEpisodes
from gpadjust.validation.trust import trust

_WINDOWS = 4  # of each horizon: some half second for a model of an episode


def foresight(
    task: Task,
    transitions: tuple[Tensor, Tensor, Tensor],
    recorded: RecordedEpisodes,
    horizons: tuple[int, ...],
) -> dict[str, float]:
    """Scores of the next states, and of trajectories over each horizon, by the names in the log.

    Energies are in units of the typical changes in all that is recorded, so that those of different
    episodes can be compared. PyTorch's generator is left as it is.

    Args:
        task: The task, with bounds of the states; its dynamics are scored.
        transitions: States, actions and next states that they have not learnt from.
        recorded: All real episodes.
        horizons: Numbers of steps; none for the scores of next states, and how many of them data
            override the physics in, alone.
    """
    dynamics = task.dynamics
    score = dynamics.score(*transitions)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [dynamics.spec.states[i] for i in dynamics.spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    found["overrides"] = _overrides(dynamics, *transitions[:2])
    if not horizons:
        return found
    try:
        far = dynamics.score_trajectories(
            *transitions,
            horizons=horizons,
            max_windows=_WINDOWS,
            units=typical_change(dynamics.spec, recorded.states, recorded.next_states),
            state_bounds=task.widened(transitions[0]).state_bounds,
        )
    except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
        warnings.warn(
            f"There are no scores of trajectories, as their particles cannot move: {error} Pass "
            "options with score_horizons=() to do without.",
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
