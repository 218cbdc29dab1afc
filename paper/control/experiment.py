"""What an experiment must say so that its learners can be run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from gpadjust.dynamics import Dynamics
from gpadjust.rl import DynaSAC
from paper.control.recorder import Recorder
from paper.control.scenario import Scenario, Settings, agent_options

Env = gym.Env[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Experiment:
    """Learners of one task; :mod:`paper.control.runs` runs them.

    Args:
        name: On the command line, and of the folder of its results.
        scenarios: The learners, by name.
        settings: The default of what they share.
        make_env: The real system of a scenario with some settings; it can be pickled.
        make_dynamics: The model of a scenario with a seed, and some settings. A model-free one does
            not use it.
        functions: The known functions of a scenario, which checkpoints do not hold.
        make_recorder: Writes down the trials of a scenario with some settings.
        details: What a result says beside its trials, of the agent at the end and its seed.
        check: Raises an ImportError if something that it needs is not installed.
    """

    name: str
    scenarios: Mapping[str, Scenario]
    settings: Settings
    make_env: Callable[[Any, Any], Env]
    make_dynamics: Callable[[Any, int, Any], Dynamics]
    functions: Callable[[Any], dict[str, Any]]
    make_recorder: Callable[[Any, Any], Recorder]
    details: Callable[[DynaSAC, int], dict[str, Any]]
    check: Callable[[], object] = lambda: None

    @property
    def labels(self) -> dict[str, str]:
        """The names of the scenarios in tables and figures."""
        return {name: scenario.label for name, scenario in self.scenarios.items()}

    def known(self, scenario: Scenario, seed: int, settings: Settings) -> dict[str, Any]:
        """Dynamics and functions, as DynaSAC and ``resume`` take them."""
        dynamics = self.make_dynamics(scenario, seed, settings)
        return {"dynamics": dynamics, **self.functions(scenario)}

    def make_agent(self, scenario: Scenario, seed: int, settings: Settings) -> DynaSAC:
        """The learner, at its start."""
        return DynaSAC(
            "MlpPolicy",
            self.make_env(scenario, settings),
            **self.known(scenario, seed, settings),
            **agent_options(scenario, settings),
            seed=seed,
        )
