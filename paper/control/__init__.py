"""What the control experiments share: learners of one task, resumable runs, records, summaries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from paper.common.experiment import Experiment, Record, Task

if TYPE_CHECKING:
    from paper.control.learner import System


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers, for all learners, unless one says otherwise.

    SAC's were tuned on the cart-pole with its true dynamics as the model.
    """

    episodes: int
    """real episodes of a run"""
    episode_length: int
    """steps of an episode"""
    model_episodes: int = 20
    """episodes in the model after each of the first real ones"""
    last_model_episode: int
    """real episodes after which the model is no longer used"""
    updates_per_model_step: float = 2
    """gradient steps for each step in the model"""
    num_particles: int = 5
    """model episodes side by side"""
    refresh_model_data: bool = True
    """whether each new model predicts the earlier ones' transitions again (the paper does not)"""
    updates: int | None = None
    """gradient steps after each episode of a model-free learner; default: as many as the others"""
    later_updates: int
    """gradient steps after each episode without a model"""
    learning_rate: float = 3e-3
    """of SAC"""
    gamma: float = 0.95
    """of SAC"""
    tau: float = 0.02
    """of SAC"""
    batch_size: int = 256
    """of SAC"""
    net_arch: tuple[int, ...] = (128, 128)
    """of SAC"""
    ent_coef: str = "auto_0.3"
    """of SAC"""
    target_entropy: str | float = "auto"
    """of SAC"""
    target: str = "difference"
    """what dynamics learn: differences of states, or next states ("absolute")"""
    num_features: int = 128
    """of RRA"""

    def updates_after(self, episode: int, model_free: bool) -> int:
        """Gradient steps after a real episode (from 1), without those within the model."""
        if model_free and self.updates is not None:
            return self.updates
        if episode > self.last_model_episode:
            return self.later_updates
        return self.episode_length + (self.updates_in_model() if model_free else 0)

    def updates_in_model(self) -> int:
        """Gradient steps within the model after a real episode."""
        return round(self.updates_per_model_step * self.model_episodes * self.episode_length)


@dataclass(frozen=True)
class Scenario:
    """A learner.

    Args:
        label: Its name in tables and figures.
        model: A class of :mod:`gpadjust.models` that adjusts f_p; ``"physics"`` for f_p alone,
            ``"truth"`` for the real system; None for a model-free learner.
        changes: Settings that it has in place of the shared ones.
        max_runs: The most seeds that it is run with.
    """

    label: str
    model: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    max_runs: int | None = None


@dataclass(frozen=True, kw_only=True)
class Control(Experiment):
    """Learners of one task."""

    scenarios: tuple[str, ...] = ()
    """the learners, by name; all of them, unless some are given"""
    settings: Settings

    key: ClassVar[tuple[str, ...]] = ("scenario", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3")
    known: ClassVar[Mapping[str, Scenario]]
    """all learners"""
    rmses: ClassVar[Mapping[str, str]]
    """the states that models predict, and what they are called in tables, with units"""

    def system(self, name: str, seed: int) -> System:
        """The real system, what is known of it, and who writes down what happens, for a run."""
        raise NotImplementedError

    @property
    def labels(self) -> dict[str, str]:
        """The names of the learners in tables and figures."""
        return {name: scenario.label for name, scenario in self.known.items()}

    def settings_of(self, name: str) -> Any:
        """The settings of a learner."""
        return replace(self.settings, **self.known[name].changes)

    def check(self) -> None:
        """Whether there are the learners, each once."""
        unknown = [name for name in self.scenarios if name not in self.known]
        if unknown:
            raise ValueError(
                f"--scenarios: there is no {unknown[0]!r}, but there are {', '.join(self.known)}"
            )
        if len(set(self.scenarios)) < len(self.scenarios):
            raise ValueError("--scenarios: expected each once")

    def tasks(self) -> list[Task]:
        """Pairs of learner and seed, seed by seed, so that what is done first can be compared."""
        return [
            (name, seed)
            for i, seed in enumerate(self.seeds)
            for name in self.scenarios or self.known
            if i < (self.known[name].max_runs or self.runs)
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """Settings, all options of the learner in force, and what its dynamics are."""
        from paper.control.learner import described

        return described(self, kind[0])

    def run(self, *case: Any) -> Record:
        """Learn, or go on with it."""
        from paper.control.learner import run

        return run(self, *case, unfinished=self.unfinished(*case))
