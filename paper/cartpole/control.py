"""Learners of a control task: a run, its records, and the tables of all."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from torch import Tensor

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import Physics
from gpadjust.rl import DynaCallback, DynaOptions, DynaSAC
from gpadjust.states import StateSpec
from paper.cartpole import Control, Scenario
from paper.common.experiment import Run
from paper.common.tables import groups, number, numbers, table
from paper.common.verdicts import Curves


class Setup(NamedTuple):
    """The parts of a run.

    Args:
        env: The real system; an environment that can be pickled.
        task: What is known of it.
        recorder: Writes down what happens.
    """

    env: gym.Env[Any, Any]
    task: Task
    recorder: Recorder


def dynamics(
    scenario: Scenario, settings: Control, spec: StateSpec, physics: Physics, truth: Physics
) -> Dynamics:
    """The model of a learner; a model-free one does not use it."""
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
    options, arguments = _options(experiment, name), _arguments(experiment, name)
    agent = DynaSAC("MlpPolicy", setup.env, setup.task, options, **arguments, seed=seed)
    agent.learn(
        settings.episodes * settings.episode_length,
        callback=setup.recorder,
        log_interval=settings.episodes + 1,  # nothing is shown
    )
    return setup.recorder.found()


def _options(experiment: Control, name: str) -> DynaOptions:
    settings: Control = experiment.settings_of(name)
    model_free = experiment.known[name].kind == "none"
    return DynaOptions(
        model_episodes=settings.model_episodes,
        updates_per_model_step=settings.updates_per_model_step,
        last_model_episode=0 if model_free else settings.last_model_episode,
        refresh_model_data=settings.refresh_model_data,
        num_particles=settings.num_particles,
        score_horizons=(),
    )


def _arguments(experiment: Control, name: str) -> dict[str, Any]:
    """The arguments of SAC that the settings decide."""
    settings: Control = experiment.settings_of(name)
    named = ("learning_rate", "gamma", "tau", "batch_size", "ent_coef", "target_entropy")
    policy = {"net_arch": list(settings.net_arch), "optimizer_kwargs": {"fused": True}}
    return {
        **{key: getattr(settings, key) for key in named},
        "policy_kwargs": policy,
        "device": "cpu",
    }


class Recorder(DynaCallback):
    """Records each episode, and sets the number of updates that follows it.

    A record is begun when the episode ends, and finished after the updates, before the next one.
    Records are notes of the agent, so that checkpoints hold them: one belongs after this callback
    in the list. Seconds of the parts are of wall time, ``"cpu_seconds"`` what this process took for
    all of it, on its one core. An experiment says in a subclass what it writes down of an episode,
    and of the policy after it.

    Args:
        settings: Of the learner.
        model_free: Whether it has no model.
    """

    model: DynaSAC

    def __init__(self, settings: Control, model_free: bool) -> None:
        super().__init__()
        self.settings: Any = settings
        self.model_free = model_free
        self._record: dict[str, Any] | None = None
        self._begun = 0.0  # of this process's time

    def of_episode(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """Entries of the record by an episode's transitions."""
        return {}

    def of_policy(self, episode: int) -> dict[str, Any]:
        """Entries by the policy after the updates that follow an episode (from 1)."""
        return {}

    def found(self) -> dict[str, Any]:
        """The records of a run, a list for each column."""
        return {"episodes": {name: [r[name] for r in self.records] for name in self.records[0]}}

    @property
    def records(self) -> list[dict[str, Any]]:
        """Those of the finished episodes."""
        records: list[dict[str, Any]] = self.model.notes.setdefault("episodes", [])
        return records

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """Record the scores of the model on the episode, once it can predict."""
        if self._record is not None and "nlpd" in metrics:
            errors = [value for name, value in metrics.items() if name.startswith("rmse/")]
            self._record |= {name: metrics[name] for name in ("nlpd", "coverage")}
            self._record["rmse"] = errors

    def _on_rollout_start(self) -> None:
        self._finish()
        self._begun = time.process_time()
        episode = len(self.records) + 1
        self.model.gradient_steps = self.settings.updates_after(episode, self.model_free)

    def _on_rollout_end(self) -> None:
        steps = self.num_timesteps - sum(past["steps"] for past in self.records)
        episode = self.model.recorded_episodes(newest=steps)
        own = self.of_episode(episode.states, episode.actions, episode.next_states)
        self._record = {"steps": steps, **own, **dict.fromkeys(("nlpd", "coverage", "rmse"))}

    def _on_training_end(self) -> None:
        self._finish()

    def _finish(self) -> None:
        """Complete the record of the episode whose updates are done, if there is one."""
        if self._record is None:
            return
        agent, log = self.model, self.records
        has_model = not self.model_free and len(log) < self.settings.last_model_episode
        left = agent.logger.name_to_value.get("model/left_bounds", 0) if has_model else 0
        record = {
            **self._record,
            **self.of_policy(len(log) + 1),
            "left_bounds": int(left),
            "updates": agent._n_updates - sum(past["updates"] for past in log),
        }
        for part, seconds in agent.wall_time.items():
            record[f"{part}_seconds"] = seconds - sum(past[f"{part}_seconds"] for past in log)
        record["cpu_seconds"] = time.process_time() - self._begun
        log.append(record)
        self._record = None


def load(runs: Sequence[Run], entry: str, experiment: Control) -> pd.DataFrame:
    """A row for each learner, seed and element of an entry that has lists by name.

    Of ``"episodes"`` there is a column for the error of each state; episodes count from 1.
    """
    errors = [f"rmse_{state}" for state in experiment.rmses]
    frames = []
    for name in experiment.known:
        for each in sorted(
            (r for r in runs if r["scenario"] == name), key=lambda r: int(r["seed"])
        ):
            own = pd.DataFrame(each[entry])
            if "rmse" in own:
                of_states = [found or [np.nan] * len(errors) for found in own.pop("rmse")]
                own[errors] = np.array(of_states, dtype=float)
                own = own.astype({"nlpd": float, "coverage": float})
            if "episode" not in own:
                own.insert(0, "episode", np.arange(len(own)) + 1)
            own.insert(0, "learner", name)
            own.insert(1, "seed", each["seed"])
            frames.append(own)
    return pd.concat(frames, ignore_index=True)


def foresight(episodes: pd.DataFrame, experiment: Control) -> str:
    """Scores of the models on episodes before they had them, from the second on."""
    errors = [f"rmse_{state}" for state in experiment.rmses]
    scored = episodes[episodes["episode"] > 1].groupby("learner", sort=False)
    table = scored[["nlpd", *errors]].median()
    table.insert(1, "coverage", scored["coverage"].mean())
    table = table[table[errors[0]].notna()].rename(index=experiment.labels)
    headings = [f"RMSE of {what}" for what in experiment.rmses.values()]
    return numbers(table, ["", "NLPD", "coverage of 95 %", *headings], ".2g")


def trials_table(
    own: pd.DataFrame, measure: str, labels: Mapping[Any, str], shown: Sequence[int],
    late: tuple[int, int], compared: tuple[int, int], form: str,
) -> str:  # fmt: skip
    """Means of some trials, the worst of later ones, differences from CKA by the same seeds."""
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
    return table(groups(own, "learner", labels), {**columns, "less CKA's": gap})
