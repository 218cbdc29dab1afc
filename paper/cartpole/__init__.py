"""The cart-pole: learners with and without physics (the paper's sec. 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import LEARNERS, LITERAL, Learner

if TYPE_CHECKING:
    from paper.cartpole.control import Setup

NUM_STARTS = 20  # of the evaluation


@dataclass(frozen=True)
class Scenario(Learner):
    """A learner of a control task; its models are literal, of the most likely hyper-parameters."""

    # Settings that it has in place of the shared ones.
    changes: Mapping[str, Any] = field(default_factory=dict)
    # `"learnt"`, or `"physics"` for f_p alone, `"truth"` for the real system, `"none"` for
    # a model-free learner.
    kind: str = "learnt"


def scenario(name: str, label: str = "", **changes: Any) -> Scenario:
    """Return a scenario of a learner of the registry."""
    known = LEARNERS[name]
    kind = {"phy": "physics", "oracle": "truth", "mf": "none"}.get(name, "learnt")
    literal = LITERAL if name in ("cka", "rra") else {}
    label = label or f"Dyna-{known.label}"
    own: dict[str, Any] = {"changes": changes, "kind": kind}
    return Scenario(label, known.color, known.model, literal, known.adjusts, **own)


@dataclass(frozen=True, kw_only=True)
class Control(Experiment):
    """Learners of one task; settings are shared, unless a learner says otherwise.

    SAC's were tuned on the cart-pole with its true dynamics as the model.
    """

    runs: int = 5  # seeds of each learner
    episodes: int = 50
    """real episodes of a run"""
    episode_length: int = 25
    """steps of an episode"""
    model_episodes: int = 20  # episodes in the model after each of the first real ones
    last_model_episode: int = 25
    """real episodes after which the model is no longer used"""
    updates_per_model_step: float = 2  # gradient steps for each step in the model
    num_particles: int = 5  # model episodes side by side
    refresh_model_data: bool = True
    """whether each new model predicts the earlier ones' transitions again (the paper does not)"""
    updates: int | None = None
    """gradient steps after each episode of a model-free learner; default: as many as the others"""
    later_updates: int = 100
    """gradient steps after each episode without a model"""
    learning_rate: float = 3e-3  # of SAC
    gamma: float = 0.95  # of SAC
    tau: float = 0.02  # of SAC
    batch_size: int = 256  # of SAC
    net_arch: tuple[int, ...] = (128, 128)  # of SAC
    ent_coef: str = "auto_0.3"  # of SAC
    target_entropy: str | float = "auto"  # of SAC
    target: str = "difference"
    """the targets of dynamics: differences of states, or next states ("absolute")"""
    num_features: int = 128  # of RRA

    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.rl.Dyna",
        "gpadjust.rl.DynaOptions",
        "stable_baselines3.SAC",
    )
    cheap: ClassVar[Mapping[str, Any]] = {"episodes": 1}
    digits: ClassVar[int] = 5
    known: ClassVar[Mapping[str, Scenario]]
    """all learners"""
    rmses: ClassVar[Mapping[str, str]]
    """the states that models predict, and what they are called in tables, with units"""

    def setup(self, name: str, seed: int) -> Setup:
        """Return the real system, its task and the recorder of a run."""
        raise NotImplementedError

    def updates_after(self, episode: int, model_free: bool) -> int:
        """Return the gradient steps after a real episode (from 1), outside the model."""
        if model_free and self.updates is not None:
            return self.updates
        if episode > self.last_model_episode:
            return self.later_updates
        return self.episode_length + (self.updates_in_model() if model_free else 0)

    def updates_in_model(self) -> int:
        """Return the gradient steps within the model after a real episode."""
        return round(self.updates_per_model_step * self.model_episodes * self.episode_length)

    @property
    def labels(self) -> dict[str, str]:
        """The names of the learners in tables and figures."""
        return {name: scenario.label for name, scenario in self.known.items()}

    def settings_of(self, name: str) -> Any:
        """Return the experiment with the settings of a learner."""
        return self.changed(self.known[name].changes)

    def describe(self, *kind: Any) -> dict[str, Any]:
        """Return the settings of the learner, and the task with its dynamics, if it has a model."""
        name, settings = kind[0], self.settings_of(kind[0]).settings
        if self.known[name].kind == "none":
            return settings
        task = self.setup(name, 0).task.describe()
        task.pop("dynamics.model_options", None)  # recorded in addition to the task
        return {**settings, "task": task, "options": dict(self.known[name].options)}

    def run(self, *case: Any) -> dict[str, Any]:
        """Learn; warnings are shown, as runs are long."""
        from paper.cartpole.control import run

        return run(self, *case)


SCENARIOS = {
    "mf": scenario("mf", "model-free"),
    # Per episode, of all episodes; the best of 25, 50, 100, 200.
    "mf-best": scenario("mf", "model-free, fewer updates", updates=100),
    "phy": scenario("phy", "Dyna-Phy"),
    "gp": scenario("gp"),
    "gp-paper": scenario("gp", "Dyna-GP, paper", target="absolute", encode_angle=False),
    "cka": scenario("cka"),
    "rra": scenario("rra"),
    "rra-paper": scenario("rra-paper", "Dyna-RRA, paper", target="absolute"),
    "oracle": scenario("oracle", "oracle"),
}


@dataclass(frozen=True, kw_only=True)
class CartPole(Control):
    """Learners swing up and balance the pole of a cart-pole."""

    encode_angle: bool = True  # whether policy and model see sine and cosine of the angle

    axes: ClassVar[Axes] = {"scenario": {name: each.label for name, each in SCENARIOS.items()}}
    curves: ClassVar[tuple[str, ...]] = ("mf", "phy", "gp-paper", "cka", "rra-paper")
    quick: ClassVar[Mapping[str, Any]] = {"episodes": 25, "model_episodes": 10}
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = {
        "x": "x, m",
        "theta": "theta, rad",
        "x_dot": "x', m/s",
        "theta_dot": "theta', rad/s",
    }

    def setup(self, name: str, seed: int) -> Setup:
        """Return the cart-pole; all learners of a seed have the same f_p."""
        from paper.cartpole.system import setup

        return setup(self.known[name], self.settings_of(name), seed)
