"""The arm, the errors of a policy that reaches with it, and the records of episodes."""

from __future__ import annotations

import warnings
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from paper.arm import Arm
from paper.arm.system import arm, hand_distance_cm
from paper.arm.system.opensim import MUSCLES, REST_ACTIVATION, ArmSimulation, build_muscle_arm
from paper.arm.system.reaching import START_MEAN, arm_targets
from paper.arm.system.torque_arm import REAL_ARM
from paper.cartpole import Scenario
from paper.cartpole.control import Recorder, Setup, dynamics

NUM_LAST_STEPS = 5  # of the second score
ACCURACY = 1e-5  # the environment's


def setup(scenario: Scenario, settings: Arm) -> Setup:
    """Return the arm, the task and the recorder of a run."""
    system = arm(
        strength=settings.strength,
        episode_length=settings.episode_length,
    )
    physics: Any = system.physics
    model = dynamics(scenario, settings, system.spec, physics, physics)
    recorder = ArmRecorder(settings, scenario.kind == "none")
    return Setup(system.make(), system.task(model), recorder)


def reach(policy: Any, settings: Arm) -> NDArray[np.float64]:
    """Return the distance of the hand, ``121 x episode_length`` in cm, by the deterministic policy.

    The real arm starts at rest at 35° and 65° for each target. All go a step at a time, so that the
    policy is asked once a step. No random number is drawn. An arm whose integration fails stays
    where it is for the rest of its episode, with a warning.

    A policy has ``predict(observations, deterministic=True)``, as an agent.
    """
    simulation = _simulation(settings.strength)
    targets = arm_targets().numpy()
    rest = [*START_MEAN, 0.0, 0.0, *[REST_ACTIVATION] * len(MUSCLES)]
    arms = np.tile(np.array(rest), (len(targets), 1))
    failed = np.zeros(len(targets), dtype=bool)
    distances = []
    for _ in range(settings.episode_length):
        seen = np.concatenate([arms[:, :4], targets], axis=1)
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
    """Return root mean squares of ``121 x steps`` distances, by target: over all and the last."""
    squares = np.square(distances)
    return {
        "all_steps": np.sqrt(squares.mean(1)),
        "last_five": np.sqrt(squares[:, -NUM_LAST_STEPS:].mean(1)),
    }


class ArmRecorder(Recorder):
    """Evaluates the policy before the first episode and after some.

    ``"evaluations"`` of what it found has a list of numbers for each column: the root mean squares
    over steps and targets. ``"maps"`` has those over steps at each target after an episode.
    """

    def __init__(self, settings: Arm, model_free: bool) -> None:
        super().__init__(settings, model_free)
        self.evaluations: dict[str, list[float]] = {}
        self.maps: dict[str, Any] = {}

    def of_policy(self, episode: int) -> dict[str, Any]:
        """Evaluate the policy after some episodes; the record has lists of their own for these."""
        if episode % self.settings.evaluate_every == 0:
            self.evaluate(episode)
        return {}

    def found(self) -> dict[str, Any]:
        """Return evaluations, the errors at each target after an episode, and the records."""
        return {"evaluations": self.evaluations, "maps": self.maps, **super().found()}

    def evaluate(self, episode: int) -> None:
        """Write down the scores of the agent after an episode (0: before the first)."""
        by_target = score(reach(self.model, self.settings))
        row = {name: float(np.sqrt(np.square(each).mean())) for name, each in by_target.items()}
        for name, value in {"episode": episode, **row}.items():
            self.evaluations.setdefault(name, []).append(value)
        if episode == self.settings.map_after:
            maps = {name: errors.round(2).tolist() for name, errors in by_target.items()}
            self.maps[f"{episode}"] = maps

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if not self.evaluations:
            self.evaluate(0)
