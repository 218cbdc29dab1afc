"""Checkpoints from which a run goes on exactly as if nothing had happened."""

from __future__ import annotations

import io
import os
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any

import cloudpickle
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from gpadjust.dynamics import Dynamics
from gpadjust.rl.dyna_sac import DynaSAC
from gpadjust.rl.model_vec_env import InitialStates, Reward, Termination
from gpadjust.rl.random_state import RandomState

_OF_ALL = ("venv", "envs", "class_attributes", "observation_space", "action_space")


class TrialCheckpoint(BaseCallback):
    """Writes the whole state of a :class:`DynaSAC` run after each trial; :func:`resume` goes on.

    The file holds networks and optimisers, both buffers, what the dynamics learnt, the state of the
    environment, and all random generators, so that an interrupted run ends with the same weights,
    bit for bit, as one that was not (on the same machine and versions). It is replaced atomically:
    whenever the process dies, a whole checkpoint is on the disk.

    Callbacks keep their own state: it is not in the file. One that draws random numbers (an
    ``EvalCallback`` with ``deterministic=False``) or counts steps begins anew, and may so change
    what follows.

    The environment must be picklable for this; one that is not (a real robot) is reset when the
    run goes on, which is then another run, and a warning says so. Files are pickles: open only
    those you trust.

    Args:
        path: The file.
        every: Number of rollouts (trials, unless ``train_freq`` says otherwise) between two
            checkpoints.

    Raises:
        ValueError: If ``every`` is not positive.

    Example:
        >>> checkpoint = TrialCheckpoint("run.ckpt")  # agent.learn(1250, callback=checkpoint)
        >>> # after an interruption: agent = resume("run.ckpt", env, dynamics=..., reward=...)
        >>> # agent.learn(1250 - agent.num_timesteps, checkpoint, reset_num_timesteps=False)
    """

    model: DynaSAC

    def __init__(self, path: str | Path, every: int = 1) -> None:
        if every < 1:
            raise ValueError(f"every must be at least 1; found {every}.")
        super().__init__()
        self.path = Path(path)
        self.every = every
        self._rollouts = 0

    def _init_callback(self) -> None:
        if not isinstance(self.model, DynaSAC):
            raise TypeError(f"TrialCheckpoint is for DynaSAC; found {type(self.model).__name__}.")
        if self.model.use_sde:
            raise ValueError(
                "TrialCheckpoint cannot resume generalised state-dependent exploration exactly; "
                "use DynaSAC with use_sde=False."
            )

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # The updates of the last trial are done, and the next has not begun.
        if self._rollouts % self.every == 0:
            save_checkpoint(self.model, self.path)
        self._rollouts += 1

    def _on_training_end(self) -> None:
        if self.model.num_timesteps >= self.model._total_timesteps:
            save_checkpoint(self.model, self.path)
        # Otherwise a callback stopped the run within a trial.


def save_checkpoint(agent: DynaSAC, path: str | Path) -> None:
    """Write the state of a run between two trials to a file, atomically; see :func:`resume`."""
    path = Path(path)
    saved = io.BytesIO()
    agent.save(saved)
    random_state = (RandomState.capture(), agent.action_space.np_random.bit_generator.state)
    parts = {
        "agent.zip": saved.getvalue(),
        "replay_buffer.pkl": pickle.dumps(agent.replay_buffer),
        "environment.pkl": _environment_state(agent),
        "random.pkl": pickle.dumps(random_state),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")  # one of a killed process is overwritten
    try:
        with open(temporary, "wb") as file:
            with zipfile.ZipFile(file, "w") as archive:
                for name, content in parts.items():
                    archive.writestr(name, content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def resume(
    path: str | Path,
    env: GymEnv,
    *,
    dynamics: Dynamics,
    reward: Reward,
    terminated: Termination | None = None,
    initial_states: InitialStates | None = None,
) -> DynaSAC:
    """Read the agent of a run that :class:`TrialCheckpoint` wrote, ready to go on.

    Go on with ``agent.learn(total - agent.num_timesteps, reset_num_timesteps=False)``.

    Args:
        path: The checkpoint.
        env: The environment, made and wrapped as for the first part of the run.
        dynamics: Dynamics of the same class, spec, physics and options, fitted or not.
        reward: The reward of the run.
        terminated: The termination of the run, if it had one.
        initial_states: The initial states of its model trials, if they were given.

    Returns:
        The agent. ``learn`` restores the random generators; until then you may use them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is no checkpoint, or ``env`` does not fit it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            saved, buffer, environment, random_state = (
                archive.read(name)
                for name in ("agent.zip", "replay_buffer.pkl", "environment.pkl", "random.pkl")
            )
    except (zipfile.BadZipFile, KeyError) as error:
        raise ValueError(
            f"{path} is not a checkpoint of TrialCheckpoint ({error}). An agent that was saved by "
            "agent.save is read by DynaSAC.load."
        ) from error
    agent = DynaSAC.load(
        io.BytesIO(saved),
        env=env,
        dynamics=dynamics,
        reward=reward,
        force_reset=False,
        terminated=terminated,
        initial_states=initial_states,
    )
    agent.replay_buffer = pickle.loads(buffer)
    agent.replay_buffer.device = agent.replay_buffer.model.device = agent.device
    generators, action_space = pickle.loads(random_state)
    agent.action_space.np_random.bit_generator.state = action_space
    agent._random_state = generators
    vec_env = agent.get_env()
    assert vec_env is not None
    if environment:
        _restore_environment(vec_env, pickle.loads(environment))
    else:
        agent._last_obs = None  # the environment is reset
    return agent


def _layers(env: VecEnv) -> list[VecEnv]:
    """A vectorised environment and what it wraps, from the outside."""
    layers = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


def _names(layers: list[VecEnv]) -> str:
    return " of ".join(type(layer).__name__ for layer in layers)


def _environment_state(agent: DynaSAC) -> bytes:
    """The pickled state of the environment; empty if it has none that can be pickled."""
    vec_env = agent.get_env()
    assert vec_env is not None
    layers = _layers(vec_env)
    inner = layers[-1]
    problem = f"a {type(inner).__name__} keeps its environments elsewhere"
    if isinstance(inner, DummyVecEnv):
        kept = [
            {name: value for name, value in vars(layer).items() if name not in _OF_ALL}
            for layer in layers
        ]
        for state in kept:
            state.pop("metadata", None)
        try:
            return bytes(cloudpickle.dumps((_names(layers), kept, inner.envs)))
        except Exception as error:  # pickling runs the user's code
            problem = f"{type(error).__name__}: {error}"
    warnings.warn(
        f"The state of the environment cannot be saved ({problem}), so a resumed run resets it and "
        "will not be bit-identical. Make the environment picklable, in a DummyVecEnv.",
        UserWarning,
        stacklevel=4,
    )
    return b""


def _restore_environment(
    vec_env: VecEnv, state: tuple[str, list[dict[str, Any]], list[Any]]
) -> None:
    layers = _layers(vec_env)
    names, kept, envs = state
    if _names(layers) != names:
        raise ValueError(
            f"env is not wrapped as the one of the checkpoint, a {names}; found a {_names(layers)}."
        )
    if vec_env.num_envs != len(envs):
        raise ValueError(
            f"The checkpoint had {len(envs)} environments; found {vec_env.num_envs} in env."
        )
    assert isinstance(layers[-1], DummyVecEnv), "as saved"
    for layer, attributes in zip(layers, kept, strict=True):
        vars(layer).update(attributes)
    layers[-1].envs = envs
