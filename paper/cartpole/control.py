"""Learners of a control task: a run, its records, and the tables of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import Physics
from gpadjust.rl import DynaOptions, DynaSAC
from gpadjust.states import StateSpec
from paper.cartpole import Control, Scenario
from paper.common.experiment import Run
from paper.common.tables import groups, number, of, table
from paper.common.verdicts import Curves


class Setup(NamedTuple):
    """The parts of a run."""

    env: gym.Env[Any, Any]  # the real system; an environment that can be pickled
    task: Task  # what is known of it
    recorder: Recorder  # writes down what happens


def dynamics(
    scenario: Scenario, settings: Control, spec: StateSpec, physics: Physics, truth: Physics
) -> Dynamics:
    """Return the model of a learner; a model-free one does not use it."""
    if scenario.kind != "learnt":
        return PhysicsDynamics(spec, truth if scenario.kind == "truth" else physics)
    options = {"num_features": settings.num_features} if "RRA" in str(scenario.model) else {}
    target: Any = settings.target
    return LearnedDynamics(
        spec,
        physics if scenario.adjusts else None,
        model=partial(scenario.make, **options),
        target=target,
        fit_options={"method": "map"},
    )


def run(experiment: Control, name: str, seed: int) -> Run:
    """Learn."""
    settings, setup = experiment.settings_of(name), experiment.setup(name, seed)
    shared = (
        *("model_episodes", "updates_per_model_step", "last_model_episode"),
        *("refresh_model_data", "num_particles"),
    )
    options = DynaOptions(**{key: getattr(settings, key) for key in shared}, score_horizons=())
    if experiment.known[name].kind == "none":
        options = replace(options, last_model_episode=0)
    of_sac = ("learning_rate", "gamma", "tau", "batch_size", "ent_coef", "target_entropy")
    arguments: dict[str, Any] = {key: getattr(settings, key) for key in of_sac}
    policy = {"net_arch": list(settings.net_arch), "optimizer_kwargs": {"fused": True}}
    arguments |= {"policy_kwargs": policy, "device": "cpu", "seed": seed}
    agent = DynaSAC("MlpPolicy", setup.env, setup.task, options, **arguments)
    agent.learn(
        settings.episodes * settings.episode_length,
        callback=[setup.recorder, setup.recorder.record_fit],
        log_interval=settings.episodes + 1,  # nothing is shown
    )
    return setup.recorder.found()


class Recorder(BaseCallback):
    """Records each episode, and sets the number of updates that follows it.

    A record is begun when the episode ends, and finished after the updates, before the next one. An
    experiment says in a subclass what it writes down of an episode, and of the policy after it.

    Args:
        settings: Of the learner.
        model_free: Whether it has no model.
    """

    model: DynaSAC

    def __init__(self, settings: Control, model_free: bool) -> None:
        super().__init__()
        self.settings: Any = settings
        self.model_free = model_free
        self.records: list[dict[str, Any]] = []
        self._record: dict[str, Any] | None = None
        self._steps = 0  # of the earlier episodes

    def of_episode(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """Return entries of the record by an episode's transitions."""
        return {}

    def of_policy(self, episode: int) -> dict[str, Any]:
        """Return entries by the policy after the updates that follow an episode (from 1)."""
        return {}

    def found(self) -> dict[str, Any]:
        """Return the records of a run, a list for each column that has a number."""
        columns = {name: [r[name] for r in self.records] for name in self.records[0]}
        shown = {n: column for n, column in columns.items() if any(v is not None for v in column)}
        return {"episodes": shown}

    def _on_step(self) -> bool:
        return True

    def record_fit(self, agent: DynaSAC, event: str, metrics: dict[str, float]) -> None:
        """Record the scores of the model on the episode, once it can predict."""
        errors = [value for name, value in metrics.items() if name.startswith("rmse/")]
        if self._record is not None and event == "fit" and errors:
            # f_p alone has no variance, so that it has errors only.
            self._record |= {name: metrics.get(name) for name in ("nlpd", "coverage")}
            self._record["rmse"] = errors

    def _on_rollout_start(self) -> None:
        self._finish()
        episode = len(self.records) + 1
        self.model.gradient_steps = self.settings.updates_after(episode, self.model_free)

    def _on_rollout_end(self) -> None:
        episode = self.model.recorded_episodes(newest=self.num_timesteps - self._steps)
        self._steps = self.num_timesteps
        own = self.of_episode(episode.states, episode.actions, episode.next_states)
        self._record = {**own, **dict.fromkeys(("nlpd", "coverage", "rmse"))}

    def _on_training_end(self) -> None:
        self._finish()

    def _finish(self) -> None:
        """Complete the record of the episode whose updates are done, if there is one."""
        if self._record is not None:
            self.records.append(self._record | self.of_policy(len(self.records) + 1))
            self._record = None


def load(runs: Sequence[Run], entry: str, experiment: Control) -> pd.DataFrame:
    """Return a row for each learner, seed and element of an entry that has lists by name.

    Of ``"episodes"`` there is a column for the error of each state; episodes count from 1.
    """
    errors = [f"rmse_{state}" for state in experiment.rmses]
    place = {name: i for i, name in enumerate(experiment.known)}
    frames = []
    for each in sorted(runs, key=lambda run: (place[run["scenario"]], run["seed"])):
        lists = dict(each[entry])
        number = len(next(iter(lists.values()), []))
        lists.setdefault("episode", [i + 1 for i in range(number)])
        of_states = [row or [np.nan] * len(errors) for row in lists.pop("rmse", [])]
        own = pd.DataFrame({"learner": each["scenario"], "seed": each["seed"], **lists})
        if of_states:
            own[errors] = np.array(of_states, dtype=float)
        scores = {name: float for name in ("nlpd", "coverage") if name in own}
        frames.append(own.astype(scores))
    return pd.concat(frames, ignore_index=True)


def foresight(episodes: pd.DataFrame, experiment: Control) -> str:
    """Return scores of the models on episodes before they had them, from the second on."""
    scores = ["nlpd", "coverage", *(f"rmse_{state}" for state in experiment.rmses)]
    # Without models there are no such columns.
    episodes = episodes.reindex(columns=[*dict.fromkeys([*episodes.columns, *scores])])
    scored = episodes[(episodes["episode"] > 1)]
    first = f"rmse_{next(iter(experiment.rmses))}"
    with_models = {*episodes[episodes[first].notna()]["learner"]}
    scored = scored[scored["learner"].isin(with_models)]
    columns = {"NLPD": of("nlpd", "median", ".2g"), "coverage of 95 %": of("coverage", form=".2g")}
    columns |= {
        f"RMSE of {what}": of(f"rmse_{state}", "median", ".2g")
        for state, what in experiment.rmses.items()
    }
    return table(groups(scored, "learner", experiment.labels), columns)


def trials_table(
    own: pd.DataFrame, measure: str, labels: Mapping[Any, str], shown: Sequence[int],
    late: tuple[int, int], compared: tuple[int, int], form: str,
) -> str:  # fmt: skip
    """Return a measure at some trials, the worst later one, and paired differences from CKA."""
    curves = Curves(own, measure)

    def gap(part: pd.DataFrame) -> str:
        if "cka" not in curves.names:
            return ""
        return curves.paired_difference(part["learner"].iloc[0], *compared).text(form)

    def mean_at(trial: int, part: pd.DataFrame) -> str:
        return number(curves.mean_at(part["learner"].iloc[0], trial), form)

    columns: dict[str, Any] = {"runs": lambda part: part["seed"].nunique()}
    columns |= {f"trial {i}": partial(mean_at, i) for i in shown}
    columns["worst of {}-{}".format(*late)] = lambda part: number(
        part.loc[part["episode"].between(*late), measure].max(), form
    )
    columns["minus CKA's, {}-{}".format(*compared)] = gap
    return table(groups(own, "learner", labels), columns)
