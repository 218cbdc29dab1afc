"""Soft actor-critic that also trains inside a dynamics model."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    Schedule,
    TensorDict,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.sac.policies import SACPolicy
from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.rl.informative_trials import InformativeTrials
from gpadjust.rl.mixed_replay_buffer import MixedReplayBuffer
from gpadjust.rl.model_phase import ModelPhase
from gpadjust.rl.model_vec_env import (
    InitialStates,
    ModelVecEnv,
    Particles,
    Reward,
    Termination,
    check_spaces,
)
from gpadjust.rl.options import FUNCTIONS, check_options, time_limit
from gpadjust.rl.planned_trials import PlannedTrials
from gpadjust.rl.recorded_trials import RecordedTrials

if TYPE_CHECKING:
    from gpadjust.rl.callbacks import DynaCallback

_NOT_SAVED = ("dynamics", *FUNCTIONS, "model_hooks", "_random_state", "_unread_dynamics")


def _on_cpu(state: Any) -> Any:
    """A state of dynamics, which SB3 loads to the device of the networks, where they compute."""
    if isinstance(state, dict):
        return {name: _on_cpu(part) for name, part in state.items()}
    return state.cpu() if torch.is_tensor(state) else state


class DynaSAC(SAC):
    r"""Stable-Baselines3's SAC, trained on real trials and on trials inside a dynamics model.

    After each real trial it updates on what it has, as SAC does; teaches the real transitions to
    ``dynamics``; and runs ``model_trials`` trials of particles in the model, with
    ``model_updates`` gradient steps for each step of each particle. Real and model experience lie
    in one :class:`MixedReplayBuffer` (Sutton 1990; Wannawas and Faisal 2023, sec. 2.3). Model
    steps do not count as time steps. All else is SAC's: callbacks, ``VecNormalize``, schedules,
    ``predict``, and ``save`` and ``load``, which keep the data and parameters of the dynamics, but
    not physics, reward and the other functions: pass these to ``load``, or get an agent that can
    only predict.

    Args:
        policy: As in SAC.
        env: The real environment; observations are those of the spec of the dynamics.
        dynamics: The model of the real system.
        reward: The known rewards, see :class:`ModelVecEnv`; compared with those of each real trial
            before the agent learns from it.
        terminated: Which states end a trial, see :class:`ModelVecEnv`.
        initial_states: Draws the initial states of model trials, see :class:`ModelVecEnv`.
            Default: those at which real trials started.
        model_trials: Model trials for each real one.
        model_updates: Gradient steps for each model step; may be broken, such as 0.5.
        model_until: Number of real trials after which the model is neither fitted nor run, and its
            experience is kept out of the batches, unless ``keep_model_data``. Default: never.
        keep_model_data: Whether batches hold model experience after ``model_until``.
        refresh_model_data: Whether the transitions that earlier models made are made again by the
            newest one, from the same states and actions, as soon as it is fitted. What the first
            models got wrong would mislead the agent for long.
        real_fraction: Share of real transitions in a batch, see :class:`MixedReplayBuffer`.
        model_buffer_size: How many model transitions are kept. Default: as ``buffer_size``.
        reward_tolerance: How far the known rewards may be from the recorded ones, relative to the
            largest of a trial; None to check neither rewards nor terminations, as noisy sensors
            may need.
        state_bounds: Bounds beyond which particles are not followed, ``2 x state_dim``, see
            :class:`ModelVecEnv`. Default: far beyond all real states so far.
        trial_length: Steps of a trial. Default: the time limit of ``env``.
        num_particles: Model trials that run side by side. Default: all.
        particles: How they are sampled, see :class:`ModelVecEnv`.
        exploration: How to plan real trials by what they teach the dynamics. Default: the policy
            acts in all.
        explore_trials: How many trials after the first are planned, if ``exploration`` is given.
        learning_rate: As in SAC.
        buffer_size: Real transitions that are kept.
        learning_starts: As in SAC. Default: the untrained policy acts in the first trial.
        batch_size: As in SAC.
        tau: As in SAC.
        gamma: As in SAC.
        train_freq: As in SAC. Default: after each trial; with several environments give a number
            of steps. The model is fitted after updates at which a trial has ended.
        gradient_steps: As in SAC. Default: one for each real step.
        kwargs: Further arguments of SAC.

    Attributes:
        num_trials: Real trials that have ended and were learnt from.
        wall_time: Seconds spent on ``"fit"``, ``"rollout"`` and ``"sac"``; with ``exploration`` on
            ``"plan"``, too.
        planned: Of the real trials that are planned, ``planned.num_planned`` is the number so far.

    Raises:
        ValueError: If observations or actions are not boxes of the spec's entries, ``reward`` is
            missing, n-step returns are asked for, or a number is out of range; after a real trial
            if its rewards or terminations are not those of the functions given.
        TypeError: If dynamics or functions are of another kind, or ``exploration`` is given with
            dynamics that cannot tell what transitions teach.
        AssertionError: By Stable-Baselines3, if the actions are no box.

    Example:
        >>> import gymnasium, torch
        >>> from gpadjust.dynamics import CKADynamics
        >>> from gpadjust.envs import CART_POLE_SPEC, cart_pole_reward, random_cart_pole_physics
        >>> from gpadjust.rl import DynaSAC
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> dynamics = CKADynamics(CART_POLE_SPEC, physics=random_cart_pole_physics(0))
        >>> agent = DynaSAC(
        ...     "MlpPolicy", env, dynamics=dynamics, reward=cart_pole_reward, model_trials=2, seed=0
        ... )
        >>> agent.learn(total_timesteps=2 * 25).num_trials
        2
    """

    replay_buffer: MixedReplayBuffer
    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        dynamics: Dynamics | None = None,
        reward: Reward | None = None,
        *,
        terminated: Termination | None = None,
        initial_states: InitialStates | None = None,
        model_trials: int = 20,
        model_updates: float = 1.0,
        model_until: int | None = None,
        keep_model_data: bool = False,
        refresh_model_data: bool = True,
        real_fraction: float = 1 / 11,
        model_buffer_size: int | None = None,
        reward_tolerance: float | None = 1e-3,
        state_bounds: Tensor | None = None,
        trial_length: int | None = None,
        num_particles: int | None = None,
        particles: Particles = "independent",
        exploration: InformativeTrials | None = None,
        explore_trials: int = 3,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = (1, "episode"),
        gradient_steps: int = -1,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("n_steps", 1) != 1:
            raise ValueError(
                f"DynaSAC has no n-step returns; found n_steps={kwargs['n_steps']}: model "
                "transitions do not lie in the order of a trajectory."
            )
        if gradient_steps == 0:
            raise ValueError(
                "gradient_steps must not be 0: without updates on real trials Stable-Baselines3 "
                "does not call train(), and the model would never learn. Pass 1 or more, or -1."
            )
        buffer_class = kwargs.pop("replay_buffer_class", None) or MixedReplayBuffer
        if not issubclass(buffer_class, MixedReplayBuffer):
            raise ValueError(
                "replay_buffer_class must be MixedReplayBuffer or a subclass of it; found "
                f"{buffer_class.__name__}."
            )
        self.dynamics = dynamics
        self.reward = reward
        self.terminated = terminated
        self.initial_states = initial_states
        self.model_trials = model_trials
        self.model_updates = model_updates
        self.model_until = model_until
        self.keep_model_data = keep_model_data
        self.refresh_model_data = refresh_model_data
        self.real_fraction = real_fraction
        self.model_buffer_size = model_buffer_size
        self.reward_tolerance = reward_tolerance
        self.state_bounds = state_bounds
        self.trial_length = trial_length
        self.num_particles = num_particles
        self.particles = particles
        self.exploration = exploration
        self.explore_trials = explore_trials
        self.num_trials = 0
        self.wall_time = {"fit": 0.0, "rollout": 0.0, "sac": 0.0}
        if exploration is not None:
            self.wall_time["plan"] = 0.0
        self.planned = PlannedTrials()
        self._num_stored = 0  # of the time steps, how many came into the buffer
        self.owed_updates = 0.0
        self.model_hooks: list[DynaCallback] = []
        self._random_state: Any = None
        self._unread_dynamics: dict[str, Any] = {}  # of an agent that was loaded without dynamics
        self._needed = tuple(name for name in FUNCTIONS if getattr(self, name) is not None)
        if _init_setup_model:
            check_options(self, self._needed)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            replay_buffer_class=buffer_class,
            _init_setup_model=_init_setup_model,
            **kwargs,
        )

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update on real experience, then learn the model and train in it; SB3 calls this."""
        over = self.model_until is not None and self.num_trials >= self.model_until
        self.replay_buffer.mix = self.keep_model_data or not over
        with self.timed("sac"):
            super().train(gradient_steps, batch_size)
        if not self.replay_buffer.num_new:
            return
        new = self.recorded_trials(newest=self.replay_buffer.num_new)
        assert self.dynamics is not None
        if not new.num_ended or (new.num_transitions < 2 and not self.dynamics.is_fitted):
            return  # a first fit needs two
        self.replay_buffer.num_new = 0
        self.num_trials += new.num_ended
        if over:
            return
        phase = ModelPhase(self, lambda updates: super(DynaSAC, self).train(updates, batch_size))
        phase.learn(new)
        phase.train(self.model_trials * new.num_ended)
        total = sum(self.wall_time.values())
        for name, seconds in self.wall_time.items():
            self.logger.record(f"model/share_{name}", seconds / total)

    def model_env(self, num_envs: int) -> ModelVecEnv:
        """The dynamics, as they stand, as an environment of ``num_envs`` particles.

        Raises:
            ValueError: If there are no dynamics, or neither real trials nor ``initial_states``.
        """
        check_options(self, self._needed)
        assert self.dynamics is not None
        assert self.reward is not None
        trials = self.recorded_trials()
        if self.initial_states is None and not trials.num_transitions:
            raise ValueError(
                "There are no real trials yet that particles could start from; pass initial_states "
                "to DynaSAC, or call learn() first."
            )
        return ModelVecEnv(
            self.dynamics,
            self.reward,
            self.initial_states or trials.draw_starts,
            num_envs,
            self.real_trial_length(),
            self.observation_space,
            self.action_space,
            terminated=self.terminated,
            particles=self.particles,
            bounds=self.model_bounds(),
        )

    def model_bounds(self) -> Tensor | None:
        """Bounds ``2 x state_dim`` beyond which particles are not followed, as they stand."""
        if self.state_bounds is not None:
            return self.state_bounds
        trials = self.recorded_trials()
        return trials.bounds() if trials.num_transitions else None

    def recorded_trials(self, newest: int | None = None) -> RecordedTrials:
        """The real transitions in the buffer; or the newest steps of each environment only."""
        assert self.dynamics is not None, "checked when learning starts"
        return RecordedTrials(self.replay_buffer, self.policy, self.dynamics.spec, newest)

    def act_in_model(self, observations: np.ndarray) -> np.ndarray:
        """Sample the policy's actions at observations of model trials, which are not normalised."""
        self.policy.set_training_mode(False)
        normalizer = self._vec_normalize_env
        seen = observations if normalizer is None else normalizer.normalize_obs(observations)
        return self.predict(seen, deterministic=False)[0]

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """The actions of a real step, and as the buffer keeps them; SB3 calls this."""
        actions, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
        if self.exploration is None:
            return actions, scaled
        seen = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        assert isinstance(seen, np.ndarray), "observations are boxes"
        scaled = self.policy.scale_action(self.planned.act(self, seen, actions))
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """As in SB3; it also notices where trials end."""
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.planned.end(dones)

    def real_trial_length(self) -> int:
        """Steps of a trial: ``trial_length``, or else the time limit of the environment.

        Raises:
            ValueError: If there is neither.
        """
        if self.trial_length is not None:
            return self.trial_length
        assert self.env is not None
        return time_limit(self.env)

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add what is done inside to a part of ``wall_time``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.wall_time[part] = self.wall_time.get(part, 0.0) + spent

    def _setup_model(self) -> None:
        """Check the spaces before SB3 builds its networks on them."""
        if self.dynamics is not None:
            check_spaces(self.dynamics, self.observation_space, self.action_space)
        self.replay_buffer_kwargs |= {
            "real_fraction": self.real_fraction,
            "model_buffer_size": self.model_buffer_size,
        }
        super()._setup_model()

    def _on_step(self) -> None:
        """Remember that the step was stored; SB3 calls this."""
        super()._on_step()
        self._num_stored = self.num_timesteps

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """Refuse to spend a real trial on an agent that could not learn from it."""
        check_options(self, self._needed)
        if self.env is None:
            raise ValueError(
                "There is no environment to learn in; pass env to DynaSAC.load, or use set_env()."
            )
        assert isinstance(self.train_freq, TrainFreq), "converted when the agent was made"
        if self.n_envs > 1 and self.train_freq.unit is TrainFrequencyUnit.EPISODE:
            raise ValueError(
                f"With {self.n_envs} environments Stable-Baselines3 cannot train by episodes; pass "
                f"a number of steps as train_freq, such as ({self.real_trial_length()}, 'step')."
            )
        self.real_trial_length()
        self.model_hooks = []  # callbacks that have some add themselves
        if self._num_stored != self.num_timesteps:
            # A callback stopped the last call at a step that SB3 made, but did not store.
            self._last_obs = None
        if reset_num_timesteps or self._last_obs is None:
            self.planned.forget()  # the trials under way, which SB3 ends
        result = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self._num_stored = self.num_timesteps
        if self._random_state is not None:
            self._random_state.restore()
            self._random_state = None
        return result

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """As in SB3, with the state of the dynamics."""
        parameters = super().get_parameters()
        learnt = self._unread_dynamics if self.dynamics is None else self.dynamics.state_dict()
        return {**parameters, "dynamics": learnt}

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """As in SB3; without dynamics, their state is kept for the next ``save``."""
        if isinstance(load_path_or_dict, dict):
            parameters: dict[str, Any] = dict(load_path_or_dict)
        else:
            parameters = load_from_zip_file(load_path_or_dict, device=device, load_data=False)[1]
        state = _on_cpu(parameters.pop("dynamics", None))
        super().set_parameters(parameters, exact_match, device)
        if state is not None and self.dynamics is None:
            self._unread_dynamics = state
        elif state is not None and self.dynamics is not None:
            self.dynamics.load_state_dict(state)

    def load_replay_buffer(
        self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """As in SB3, for both buffers."""
        super().load_replay_buffer(path, truncate_last_traj)
        self.replay_buffer.model.device = self.device

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *_NOT_SAVED]
