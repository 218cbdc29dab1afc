"""All learners with all seeds, in parallel processes, each resumable."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import joblib
import torch
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.rl import TrialCheckpoint, resume
from paper.control.experiment import Experiment
from paper.control.recorder import trial_log
from paper.control.scenario import Scenario, Settings
from paper.result_file import (
    check_settings,
    result_path,
    rounded,
    run_with_progress,
    versions,
    write_result,
)

Backend = Literal["loky", "ray"]


def run_one(
    experiment: Experiment,
    name: str,
    seed: int,
    out: Path,
    settings: Settings | None = None,
    callbacks: Sequence[BaseCallback] = (),
) -> Path:
    """Run a scenario with a seed, or go on with it, or do nothing if its result is there.

    Args:
        experiment: What it is a scenario of.
        name: The scenario.
        seed: Of f_p where that is random, the environment and the learner.
        out: Folder of the results. The state of an unfinished run lies in ``out/unfinished``.
        settings: The shared settings. Default: the experiment's.
        callbacks: Further callbacks.

    Returns:
        The path of the result, a JSON file.

    Raises:
        ValueError: If there is no such scenario, or what lies in ``out`` is of other settings.
    """
    if name not in experiment.scenarios:
        raise ValueError(
            f"There is no scenario {name!r}; there are {', '.join(experiment.scenarios)}."
        )
    torch.set_num_threads(1)
    settings = experiment.settings if settings is None else settings
    scenario = experiment.scenarios[name]
    path = result_path(out, name, seed)
    described = _described(experiment, scenario, settings)
    if path.exists():
        check_settings(path, json.loads(path.read_text())["settings"], described)
        return path
    unfinished = out / "unfinished" / f"{name}-{seed}.ckpt"
    if unfinished.exists():
        env = experiment.make_env(scenario, settings)
        agent = resume(unfinished, env, **experiment.known(scenario, seed, settings))
        check_settings(unfinished, vars(agent)["described"], described)
    else:
        agent = experiment.make_agent(scenario, seed, settings)
        vars(agent)["described"] = described
    steps = settings.num_trials * settings.trial_length - agent.num_timesteps
    recorder = experiment.make_recorder(scenario, settings)
    agent.learn(
        steps,
        callback=[recorder, *callbacks, TrialCheckpoint(unfinished)],
        log_interval=settings.num_trials + 1,  # nothing is shown
        reset_num_timesteps=False,
    )
    trials = trial_log(agent)
    result = {
        "scenario": name,
        "seed": seed,
        "settings": described,
        **{key: rounded(value) for key, value in experiment.details(agent, seed).items()},
        "versions": versions(),
        "trials": {key: [rounded(trial[key]) for trial in trials] for key in trials[0]},
    }
    write_result(path, result)
    unfinished.unlink()
    return path


def run_all(
    experiment: Experiment,
    tasks: Sequence[tuple[str, int]],
    out: Path,
    *,
    num_jobs: int,
    backend: Backend = "loky",
    settings: Settings | None = None,
) -> None:
    """Run the tasks, pairs of scenario and seed, that have no result yet."""
    missing = [task for task in tasks if not result_path(out, *task).exists()]
    for name, seed in (task for task in tasks if task not in missing):
        run_one(experiment, name, seed, out, settings)  # checks its settings
    calls = [
        joblib.delayed(run_one)(experiment, *task, out.absolute(), settings) for task in missing
    ]
    with _backend(backend):
        if backend == "ray":  # which cannot return results one by one
            joblib.Parallel(n_jobs=num_jobs, batch_size=1, verbose=10)(calls)
            return
        run_with_progress(calls, len(tasks) - len(missing), num_jobs)


def make_tasks(
    experiment: Experiment, names: Sequence[str], num_runs: int, first_seed: int
) -> list[tuple[str, int]]:
    """Pairs of scenario and seed, seed by seed, so that what is done first can be compared."""
    return [
        (name, first_seed + i)
        for i in range(num_runs)
        for name in names
        if i < (experiment.scenarios[name].max_runs or num_runs)
    ]


@contextmanager
def _backend(name: Backend) -> Iterator[None]:
    """Choose joblib's backend; Ray's uses the cluster that is running, or starts a local one."""
    if name == "ray":
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise SystemExit(
                "--backend ray needs Ray; install it with `pip install gpadjust[ray]`"
            ) from error
        register_ray()
    with joblib.parallel_config(backend=name):
        yield


def _described(experiment: Experiment, scenario: Scenario, settings: Settings) -> dict[str, Any]:
    """The settings of a run and what its model is, as JSON has them."""
    values = asdict(settings)
    if scenario.model_updates is not None:
        values["model_updates"] = scenario.model_updates
    if scenario.updates is not None:
        values["updates"] = scenario.updates
    if scenario.exploration is not None:
        planned = {"trials": scenario.explore_trials, **asdict(scenario.exploration)}
        values |= {f"exploration.{name}": value for name, value in planned.items()}
    if scenario.dynamics is not None:
        dynamics = experiment.make_dynamics(scenario, 0, settings)
        values |= {f"model.{name}": text for name, text in dynamics.describe().items()}
    described: dict[str, Any] = json.loads(json.dumps(values))
    return described
