"""The real trials of an agent that go by plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from gpadjust.rl.dyna_sac import DynaSAC


@dataclass
class _Trial:
    """A trial under way.

    Args:
        ahead: The actions that are planned, ``T x action_dim``.
        states: What it has seen, ``t x state_dim``.
        actions: What it has done, ``t x action_dim``.
    """

    ahead: Tensor
    states: Tensor
    actions: Tensor


class PlannedTrials:
    """Makes plans for an agent's trials as these begin, and remembers them until they end.

    It holds plain values, which are saved with the agent, so that a run that is resumed within a
    trial follows its plan.

    Attributes:
        num_planned: How many trials were begun with a plan.
    """

    def __init__(self) -> None:
        self.num_planned = 0
        self._trials: dict[int, _Trial | None] = {}  # by environment; None: the policy acts

    def forget(self) -> None:
        """All environments are reset."""
        self._trials = {}

    def end(self, dones: np.ndarray) -> None:
        """Some environments, of which ``dones`` is true, begin another trial."""
        for i in dones.nonzero()[0]:
            self._trials.pop(int(i), None)

    def act(self, agent: DynaSAC, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Put planned actions in the place of the policy's.

        Args:
            agent: The agent.
            observations: What the environments show, not normalised,
                ``n_envs x observation_dim``.
            actions: The policy's, ``n_envs x action_dim``.

        Returns:
            The actions, ``n_envs x action_dim``, within the bounds of the action space.
        """
        dynamics, options = agent.dynamics, agent.exploration
        assert dynamics is not None
        assert options is not None
        actions = actions.copy()
        for i, state in enumerate(dynamics.spec.decode(_doubles(observations))):
            if i not in self._trials:
                self._trials[i] = self._begin(agent)
            trial = self._trials[i]
            if trial is None:
                continue
            steps_done = len(trial.states)
            if not steps_done or (
                options.replan_every is not None and steps_done % options.replan_every == 0
            ):
                with agent.timed("plan"):
                    self._plan(agent, trial, state)
            if len(trial.ahead):  # a trial may be longer than it was said to be
                space = agent.action_space
                actions[i] = np.clip(trial.ahead[0].numpy(), space.low, space.high)
            trial.ahead = trial.ahead[1:]
            trial.states = torch.cat([trial.states, state.unsqueeze(0)])
            trial.actions = torch.cat([trial.actions, _doubles(actions[i : i + 1])])
        return actions

    def _begin(self, agent: DynaSAC) -> _Trial | None:
        """A trial without steps, if it is to be planned."""
        assert agent.dynamics is not None
        over = agent.model_until is not None and agent.num_trials >= agent.model_until
        # The first trial is the policy's, even of dynamics that have learnt from other data.
        ready = agent.num_trials > 0 and agent.dynamics.is_fitted
        if over or not ready or self.num_planned >= agent.explore_trials:
            return None
        self.num_planned += 1
        spec = agent.dynamics.spec
        nothing = torch.empty(0, spec.action_dim, dtype=torch.float64)
        return _Trial(nothing, torch.empty(0, spec.state_dim, dtype=torch.float64), nothing)

    def _plan(self, agent: DynaSAC, trial: _Trial, state: Tensor) -> None:
        """Plan the steps that are left of a trial, from where it is."""
        dynamics, options = agent.dynamics, agent.exploration
        assert dynamics is not None
        assert options is not None
        num_steps = agent.real_trial_length() - len(trial.states)
        if num_steps < 1:
            return
        space = agent.action_space
        plan = options.plan(
            dynamics,
            state,
            num_steps,
            _doubles(np.stack([space.low, space.high])),
            policy=lambda states: _doubles(agent.act_in_model(_observed(agent, states))),
            state_bounds=agent.model_bounds(),
            terminated=agent.terminated,
            past=(trial.states, trial.actions) if len(trial.states) else None,
            known=trial.ahead if len(trial.ahead) else None,
        )
        trial.ahead = plan.actions
        agent.logger.record("model/planned_information", plan.information)


def _doubles(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float64))


def _observed(agent: DynaSAC, states: Tensor) -> np.ndarray:
    assert agent.dynamics is not None
    seen: np.ndarray = agent.dynamics.spec.observe(states).numpy()
    return seen.astype(agent.observation_space.dtype)
