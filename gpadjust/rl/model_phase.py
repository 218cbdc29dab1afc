"""What happens between two real trials."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from gpadjust.dynamics import LearnedDynamics
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.recorded_trials import RecordedTrials

if TYPE_CHECKING:
    from gpadjust.rl.dyna_sac import DynaSAC


class ModelPhase:
    """Teaches new real trials to an agent's dynamics, and trains the agent inside them.

    Args:
        agent: The agent.
        update: Makes a number of gradient steps on its replay buffer.
    """

    def __init__(self, agent: DynaSAC, update: Callable[[int], None]) -> None:
        self.agent = agent
        self.update = update

    def learn(self, new: RecordedTrials) -> None:
        """Score the dynamics on new transitions, and teach them these."""
        agent = self.agent
        assert agent.dynamics is not None
        assert agent.reward is not None
        if agent.reward_tolerance is not None:
            new.check(agent.reward, agent.terminated, agent.reward_tolerance)
        transitions = (new.states, new.actions, new.next_states)
        metrics: dict[str, float] = {}
        before = agent.wall_time["fit"]
        with agent.timed("fit"):
            if isinstance(agent.dynamics, LearnedDynamics) and agent.dynamics.is_fitted:
                score = agent.dynamics.score(*transitions)
                metrics = {
                    "nlpd": float(score.nlpd.mean()),
                    "coverage": float(score.coverage.mean()),
                }
                names = [agent.dynamics.spec.states[i] for i in agent.dynamics.spec.moving]
                metrics |= {f"rmse/{n}": float(e) for n, e in zip(names, score.rmse, strict=True)}
            agent.dynamics.update(*transitions)
        metrics["fit_seconds"] = agent.wall_time["fit"] - before
        for name, value in metrics.items():
            agent.logger.record(f"model/{name}", value)
        for hook in agent.model_hooks:
            hook.on_model_fit(metrics)

    def train(self, num_trials: int) -> None:
        """Run model trials, with updates at each step."""
        agent = self.agent
        returns = []
        num_left_bounds = 0
        for start in range(0, num_trials, agent.num_particles or max(num_trials, 1)):
            env = agent.model_env(min(num_trials - start, agent.num_particles or num_trials))
            with agent.timed("rollout"):
                if start == 0 and agent.refresh_model_data:
                    env.refresh(agent.replay_buffer.model)
                obs = env.reset()
            trial_returns, num_left = self._run(env, obs)
            returns.append(trial_returns)
            num_left_bounds += num_left
            for hook in agent.model_hooks:
                hook.on_model_trials(trial_returns)
        if num_left_bounds == num_trials > 0 and not agent.replay_buffer.model.size():
            warnings.warn(
                "All model trials left the bounds of the states at once, so the agent has learnt "
                "nothing from the model. Check initial_states, or pass state_bounds.",
                UserWarning,
                stacklevel=2,
            )
        if returns:
            agent.logger.record("model/ep_rew_mean", float(np.concatenate(returns).mean()))
            agent.logger.record("model/left_bounds", num_left_bounds)

    def _run(self, env: ModelVecEnv, obs: np.ndarray) -> tuple[np.ndarray, int]:
        """One trial of each particle, with updates at each step.

        Returns:
            The returns, and the number of particles that left the bounds.
        """
        agent = self.agent
        returns = np.zeros(env.num_envs)
        num_left_bounds = 0
        running = np.ones(env.num_envs, dtype=bool)
        while running.any():
            with agent.timed("rollout"):
                actions = agent.act_in_model(obs)
                step = env.transition(actions)
                kept = running & ~step.left_bounds
                rows = (obs, step.observations, agent.policy.scale_action(actions), step.rewards)
                ends = (step.terminated | step.truncated, step.truncated)
                agent.replay_buffer.model.extend(*(values[kept] for values in (*rows, *ends)))
                returns += step.rewards * running
                num_left_bounds += int((step.left_bounds & running).sum())
                num_steps = int(running.sum())
                running &= ~ends[0]
                obs = step.observations
            with agent.timed("sac"):
                agent.owed_updates += agent.model_updates * num_steps
                updates = int(agent.owed_updates + 1e-9)  # ten times 0.3 are three
                agent.owed_updates -= updates
                if updates:
                    self.update(updates)
        return returns, num_left_bounds
