"""How well a policy reaches: the hand's distance from each of the 121 targets."""

from __future__ import annotations

import time
import warnings
from functools import lru_cache, partial
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.envs import REAL_ARM, arm_targets, hand_distance_cm
from gpadjust.envs.arm_simulation import ArmSimulation
from gpadjust.envs.arm_task import START_MEAN
from gpadjust.envs.opensim_model import MUSCLES, REST_ACTIVATION, build_muscle_arm
from gpadjust.rl import DynaSAC
from paper.arm.scenarios import MAP_TRIAL, ArmScenario, ArmSettings

NUM_LAST_STEPS = 5  # of the second score
ACCURACY = 1e-5  # the environment's
_LOG = "evaluation_log"


class Policy(Protocol):
    """What is evaluated."""

    def predict(
        self, observation: NDArray[np.float32], *, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for a batch of observations."""
        ...


def reach(policy: Policy, settings: ArmSettings, memory: bool) -> NDArray[np.float64]:
    """The distance of the hand, ``121 x trial_length`` in cm, by the deterministic policy.

    The real arm starts at rest at 35° and 65° for each target. All go a step at a time, so that the
    policy is asked once a step. No random number is drawn. An arm whose integration fails stays
    where it is for the rest of its trial, with a warning.

    Args:
        policy: The agent.
        settings: Length of a trial, and strength of the muscles.
        memory: Whether the policy sees the previous action.
    """
    simulation = _simulation(settings.strength)
    targets = arm_targets().numpy()
    rest = [*START_MEAN, 0.0, 0.0, *[REST_ACTIVATION] * len(MUSCLES)]
    arms = np.tile(np.array(rest), (len(targets), 1))
    actions = np.zeros((len(targets), 4))
    failed = np.zeros(len(targets), dtype=bool)
    distances = []
    for _ in range(settings.trial_length):
        seen = np.concatenate([arms[:, :4], targets, *([actions] if memory else [])], axis=1)
        chosen, _ = policy.predict(seen.astype(np.float32), deterministic=True)
        actions = np.asarray(chosen, dtype=np.float64).clip(0, 1)
        for i in np.flatnonzero(~failed):
            try:
                arms[i] = simulation.step(arms[i], actions[i])
            except RuntimeError as error:
                failed[i] = True
                warnings.warn(f"The arm of target {i} stays: {error}", UserWarning, stacklevel=2)
        reached = torch.from_numpy(np.concatenate([arms[:, :4], targets], axis=1))
        distances.append(hand_distance_cm(reached).numpy())
    return np.stack(distances, axis=1)


@lru_cache(maxsize=1)
def _simulation(strength: float) -> ArmSimulation:
    return ArmSimulation(partial(build_muscle_arm, REAL_ARM, strength), ACCURACY)


def score(distances: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Root mean squares of distances ``121 x steps``, for each target: over all and the last."""
    squares = np.square(distances)
    return {
        "all_steps": np.sqrt(squares.mean(1)),
        "last_five": np.sqrt(squares[:, -NUM_LAST_STEPS:].mean(1)),
    }


def hundred() -> NDArray[np.bool_]:
    """Which of the 121 targets are the paper's hundred, of 10, 20, ..., 100° each."""
    return (arm_targets() > 0.01).all(-1).numpy()


def evaluation_log(agent: DynaSAC) -> dict[str, Any]:
    """The evaluations of an agent so far; an attribute, so that checkpoints hold them."""
    log: dict[str, Any] = vars(agent).setdefault(_LOG, {"evaluations": {}, "maps": {}})
    return log


def evaluate(agent: DynaSAC, scenario: ArmScenario, settings: ArmSettings, trial: int) -> None:
    """Write the scores of an agent after a trial (0: before the first) into its log.

    ``"evaluations"`` has a list of numbers for each column: the root mean squares over steps and
    targets, with ``_100`` those over the paper's hundred targets, and the seconds it took.
    ``"maps"`` has the root mean squares over steps at each target after some trials.
    """
    start = time.perf_counter()
    by_target = score(reach(agent, settings, scenario.memory))
    log = evaluation_log(agent)
    row: dict[str, float] = {"trial": trial}
    for name, errors in by_target.items():
        row[name] = float(np.sqrt(np.square(errors).mean()))
        row[f"{name}_100"] = float(np.sqrt(np.square(errors[hundred()]).mean()))
    row["evaluation_seconds"] = time.perf_counter() - start
    for name, value in row.items():
        log["evaluations"].setdefault(name, []).append(value)
    if trial in (MAP_TRIAL, settings.num_trials):
        log["maps"][f"{trial}"] = {name: errors.tolist() for name, errors in by_target.items()}
