"""One run of a learner, resumable."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

import gpadjust.models
from gpadjust.control import Task as ControlTask
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import Physics
from gpadjust.rl import Dyna, DynaOptions, DynaSAC, EpisodeCheckpoint, resume
from gpadjust.states import StateSpec
from paper.common.experiment import Record
from paper.common.runner import Refused
from paper.common.runs import differences, versions
from paper.control import Control, Scenario, Settings
from paper.control.recorder import Recorder

_SAID = ("task", "options", "seed", "verbose", "tensorboard_log", "_init_setup_model")


class System(NamedTuple):
    """What a run is about.

    Args:
        env: The real system; an environment that can be pickled.
        task: What is known of it.
        recorder: Writes down what happens.
    """

    env: gym.Env[Any, Any]
    task: ControlTask
    recorder: Recorder


def dynamics(
    scenario: Scenario, settings: Settings, spec: StateSpec, physics: Physics, truth: Physics
) -> Dynamics:
    """The model of a learner; a model-free one does not use it."""
    if scenario.model is None or scenario.model == "physics":
        return PhysicsDynamics(spec, physics)
    if scenario.model == "truth":
        return PhysicsDynamics(spec, truth)
    model = getattr(gpadjust.models, scenario.model)
    # The literal model, at its most likely hyper-parameters.
    options: dict[str, Any] = {"center": 0.0} if scenario.model in ("CKA", "RRA") else {}
    options |= {"num_features": settings.num_features} if "RRA" in scenario.model else {}
    adjusted = None if model is gpadjust.models.ZeroMeanGP else physics
    target: Any = settings.target
    return LearnedDynamics(
        spec,
        adjusted,
        model=partial(model, **options),
        target=target,
        fit_options={"method": "map"},
    )


def make_agent(experiment: Control, name: str, seed: int) -> DynaSAC:
    """A learner, at its start."""
    system = experiment.system(name, seed)
    options, arguments = _options(experiment, name, system), _arguments(experiment, name)
    return DynaSAC("MlpPolicy", system.env, system.task, options, **arguments, seed=seed)


def described(experiment: Control, name: str) -> dict[str, Any]:
    """Settings, all options of the learner in force, and what its dynamics are."""
    system, settings = experiment.system(name, 0), asdict(experiment.settings_of(name))
    learner = {**_defaults(SAC), **_defaults(Dyna), **_arguments(experiment, name)}
    options = asdict(_options(experiment, name, system))
    found = {
        **settings,
        "learner": {key: learner[key] for key in learner if key not in {*settings, *_SAID}},
        "options": {key: options[key] for key in options if key not in settings},
        "task": system.task.describe(),
    }
    if experiment.known[name].model is None:
        del found["task"]
    described: dict[str, Any] = json.loads(json.dumps(found, default=repr))
    return described


def run(
    experiment: Control,
    name: str,
    seed: int,
    unfinished: Path,
    callbacks: Sequence[BaseCallback] = (),
) -> Record:
    """Learn, or go on with it.

    Args:
        experiment: What it is a learner of.
        name: The learner.
        seed: Of f_p where that is random, the environment and the learner.
        unfinished: Beside it lies the state of the run, until it is done.
        callbacks: Further callbacks.

    Raises:
        Refused: If an unfinished run is of other settings or versions.
    """
    checkpoint = Path(f"{unfinished}.ckpt")
    settings, system = experiment.settings_of(name), experiment.system(name, seed)
    now = {"settings": described(experiment, name), "versions": versions(experiment.packages)}
    if checkpoint.exists():
        agent: Any = resume(checkpoint, system.env, system.task)
        differ = differences(agent.notes["made"], now)
        if differ:
            raise Refused(
                f"{checkpoint} is of an unfinished run of others: {differ}. Remove it to begin "
                "that run anew, choose another --out, or go on as it was begun."
            )
    else:
        agent = make_agent(experiment, name, seed)
        agent.notes["made"] = now
    agent.learn(
        settings.episodes * settings.episode_length - agent.num_timesteps,
        callback=[system.recorder, *callbacks, EpisodeCheckpoint(checkpoint)],
        log_interval=settings.episodes + 1,  # nothing is shown
        reset_num_timesteps=False,
    )
    found = system.recorder.found()
    for path in (checkpoint, Path(f"{checkpoint}.lock")):
        path.unlink(missing_ok=True)
    return found


def _options(experiment: Control, name: str, system: System) -> DynaOptions:
    settings: Settings = experiment.settings_of(name)
    model_free = experiment.known[name].model is None
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
    settings: Settings = experiment.settings_of(name)
    named = ("learning_rate", "gamma", "tau", "batch_size", "ent_coef", "target_entropy")
    return {
        **{key: getattr(settings, key) for key in named},
        "policy_kwargs": {
            "net_arch": list(settings.net_arch),
            "optimizer_kwargs": {"fused": True},
        },
        "device": "cpu",
    }


def _defaults(kind: Any) -> dict[str, Any]:
    """The arguments of a learner that have a default."""
    parameters = inspect.signature(kind.__init__).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}
