"""Dynamics learnt by a Gaussian process."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.transforms.input import InputTransform
from torch import Tensor
from torch.nn import Module

from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.physics_dynamics import check_physics
from gpadjust.dynamics.state_spec import StateSpec, check_columns
from gpadjust.dynamics.transition_physics import Target, TransitionPhysics, TransitionTargets
from gpadjust.dynamics.transitions import Transitions
from gpadjust.gp import AngleInput
from gpadjust.inference import FitResult, fit
from gpadjust.inference.fitting import FitOptions
from gpadjust.inference.objective import Objective
from gpadjust.inference.warm_start import warm_start
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.prediction import Prediction
from gpadjust.physics import Physics
from gpadjust.validation import coverage, nlpd, rmse

_SEARCHED = 128  # points that a search is made on; more would tell the same, and take longer
_SEARCH = FitOptions(num_screened=64, num_starts=4, max_iterations=30)
_REFIT = FitOptions(num_screened=0, num_starts=1, max_iterations=8)


class TransitionScores(NamedTuple):
    """How well transitions were predicted, for each predicted state: ``len(spec.predicted)``.

    Args:
        nlpd: Mean negative log predictive density, in nats.
        coverage: Share of the next states in the central 95 % interval.
        rmse: Root mean square error, in the state's units.
    """

    nlpd: Tensor
    coverage: Tensor
    rmse: Tensor


class LearnedDynamics(Dynamics):
    """The base of dynamics that a Gaussian process of this library learns.

    The states' targets are independent outputs of one model; users build
    :class:`~gpadjust.dynamics.CKADynamics` and so on. The arguments are its own, except that
    ``physics`` may be None.
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics | Any | None,
        *,
        target: Target = "difference",
        encode_angles: bool = True,
        model_options: Mapping[str, Any] | None = None,
        fit_options: FitOptions | None = None,
    ) -> None:
        super().__init__(spec)
        self.targets = TransitionTargets(spec, target)
        self.physics = None if physics is None else check_physics(physics)
        self.encode_angles = encode_angles
        self.model_options = dict(model_options or {})
        self.fit_options: FitOptions = {**(fit_options or {})}
        own = {"physics", "input_transform", "train_Yvar"} & {*self.model_options}
        if own:
            raise ValueError(f"model_options may not hold {own.pop()!r}, which dynamics set.")
        self.fit_result: FitResult | None = None
        self._forget_data()
        self._physics = (
            None if self.physics is None else TransitionPhysics(self.physics, self.targets)
        )

    @abstractmethod
    def _make_model(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        physics: TransitionPhysics | None,
        **options: Any,
    ) -> MultiOutputGP:
        """Build the model, from its options and an input transform."""

    def _forget_data(self) -> None:
        self._model: MultiOutputGP | None = None
        self._data: Transitions | None = None
        self._known: Tensor | None = None  # f_p at the data
        self._chunks: list[int] = []  # numbers of points: fitted, then conditioned on
        self._searched_at = 0

    @property
    def is_fitted(self) -> bool:
        """Whether it has learnt from any transitions."""
        return self._model is not None

    @property
    def model(self) -> MultiOutputGP:
        """The model, whose targets are what ``target`` says of the predicted states."""
        if self._model is None:
            raise RuntimeError(
                f"{type(self).__name__} has not learnt from transitions yet; call `update`."
            )
        return self._model

    @property
    def num_transitions(self) -> int:
        """Number of transitions that it has learnt from."""
        return 0 if self._data is None else len(self._data.states)

    def fit(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn from these transitions only, by a full search of the hyper-parameters.

        Args:
            states: ``N x state_dim``, with ``N >= 2``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, values are not finite, or there are fewer than 2 rows.
            PhysicsError: If the physics fails.
        """
        data = Transitions.checked(self.spec, states, actions, next_states)
        self._learn(data, self._physics_at(data), None)

    def update(
        self, states: Tensor, actions: Tensor, next_states: Tensor, *, refit: bool = True
    ) -> None:
        """Learn from further transitions, beside the earlier ones.

        The hyper-parameters are fitted again from where they were, and searched for anew whenever
        the number of transitions has doubled since the last search. If this raises an error, what
        was learnt before stands.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``.
            refit: Whether to fit the hyper-parameters again; if not, the model is conditioned on
                the new transitions with those that it has (:meth:`condition`).

        Raises:
            TypeError: As :meth:`fit`.
            ValueError: As :meth:`fit`; two rows in all will do.
            PhysicsError: As :meth:`fit`.
        """
        if not refit and self.is_fitted:
            self.condition(states, actions, next_states)
            return
        data = Transitions.checked(self.spec, states, actions, next_states)
        known = self._physics_at(data)
        if self._data is not None:
            data = self._data.append(data)
            if known is not None and self._known is not None:
                known = torch.cat([self._known, known])
        self._learn(data, known, self._model)

    def condition(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Condition on further transitions with the hyper-parameters as they are.

        In :math:`O(n^2 N)` for ``N`` new transitions beside ``n``; the arguments and errors are
        those of :meth:`update`.

        Raises:
            RuntimeError: If nothing was learnt yet.
        """
        model = self.model
        assert self._data is not None, "there is a model"
        data = Transitions.checked(self.spec, states, actions, next_states)
        known = self._physics_at(data)
        self._model = self._condition(model, data)
        self._data = self._data.append(data)
        if known is not None and self._known is not None:
            self._known = torch.cat([self._known, known])
        self._chunks = [*self._chunks, len(data.states)]

    def predict(
        self, states: Tensor, actions: Tensor, *, observation_noise: bool = True
    ) -> Prediction:
        """Mean and variance of the next states, entry by entry.

        Args:
            states: ``... x state_dim``.
            actions: ``... x action_dim``.
            observation_noise: Whether the variance includes the noise that was learnt, by which
                next states scatter about the mean.

        Returns:
            ``... x state_dim`` each; of an angle, not wrapped.

        Raises:
            RuntimeError: If nothing was learnt yet.
            PhysicsError: If the physics fails.
        """
        following, variance = self._predict(states, actions, observation_noise)
        return Prediction(
            self.spec.complete(states, following), self.spec.complete_variance(variance)
        )

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, noise included, row by row, from PyTorch's generator."""
        mean, variance = self._predict(states, actions, True)
        return self.spec.complete(states, mean + variance.sqrt() * torch.randn_like(mean))

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition functions from the posterior; without noise.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.

        Returns:
            A function of states ``k x N x state_dim`` and actions ``k x N x action_dim`` to next
            states. Later updates leave it as it is.

        Raises:
            RuntimeError: If nothing was learnt yet.
        """
        functions: Any = self.model.sample_functions(num_functions, seed)

        @torch.no_grad()
        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_pair(states, actions)
            if states.dim() != 3 or len(states) != num_functions:
                raise ValueError(
                    f"Expected states of shape {num_functions} x N x {self.spec.state_dim}, a "
                    f"block for each function, got {tuple(states.shape)}."
                )
            values = functions.each(self.targets.inputs(states, actions))
            return self.spec.complete(states, self.targets.decode(states, values))

        return step

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> TransitionScores:
        """Judge the predictions by transitions that were not learnt from.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: As :meth:`fit`.
            ValueError: As :meth:`fit`; one row will do.
        """
        data = Transitions.checked(self.spec, states, actions, next_states)
        mean, variance = self._predict(data.states, data.actions, True)
        following = data.states.clone()
        following[..., self.spec.predicted] = mean
        found = mean + self.spec.change(following, data.next_states)[..., self.spec.predicted]
        return TransitionScores(
            nlpd=nlpd(mean, variance, found),
            coverage=coverage(mean, variance, found),
            rmse=rmse(mean, found),
        )

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values: data, f_p there, hyper-parameters."""
        if self._model is None or self._data is None:
            return {}
        return {
            "transitions": {name: t.clone() for name, t in self._data._asdict().items()},
            "physics": None if self._known is None else self._known.clone(),
            "chunks": [*self._chunks],
            "searched_at": self._searched_at,
            "model": {name: t.clone() for name, t in self._fitted.state_dict().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same.

        Args:
            state: Of dynamics of the same class, options, spec and physics.
        """
        self._forget_data()
        self.fit_result = None
        if not state:
            return
        data = Transitions(**state["transitions"])
        self._data, self._known = data, state["physics"]
        self._chunks, self._searched_at = [*state["chunks"]], state["searched_at"]
        start = self._chunks[0]
        self._tell_physics(data, self._known)
        model = self._build(data.rows(0, start), quiet=True)
        model.load_state_dict(state["model"])
        self._fitted = self._model = model.eval()
        for size in self._chunks[1:]:
            self._model = self._condition(self._model, data.rows(start, start + size))
            start += size

    def _learn(
        self, data: Transitions, known: Tensor | None, previous: MultiOutputGP | None
    ) -> None:
        n = len(data.states)
        if n < 2:
            raise ValueError(
                f"Expected at least 2 transitions to learn from, got {n}: there is no scale in "
                "fewer. Collect more before the first update."
            )
        self._tell_physics(data, known)
        model = self._build(data, quiet=previous is not None)
        searches = previous is None or n >= 2 * self._searched_at
        if previous is None:
            result = fit(model, **self.fit_options)
        else:
            warm_start(model, previous)
            with warnings.catch_warnings():
                # The next update goes on from where this one stops.
                warnings.simplefilter("ignore", OptimizationWarning)
                if searches:
                    self._search(model, data)
                result = fit(model, "map", **_REFIT)
        self.fit_result = result
        self._searched_at = n if searches else self._searched_at
        self._data, self._known, self._chunks = data, known, [n]
        self._model = self._fitted = model

    def _search(self, model: MultiOutputGP, data: Transitions) -> None:
        """Give a model the best hyper-parameters of its own and those of a new search."""
        n = len(data.states)
        if n <= _SEARCHED:
            fit(model, "map", **_SEARCH)
            return
        generator = torch.Generator().manual_seed(n)
        rows = torch.randperm(n, generator=generator)[:_SEARCHED]
        part = self._build(Transitions(*(tensor[rows] for tensor in data)), quiet=True)
        warm_start(part, model)
        fit(part, "map", **_SEARCH)
        objective = Objective(model)
        before = objective.current()
        warm_start(model, part)
        after = objective.current()
        better = objective(after) < objective(before)
        objective.assign(torch.where(better.unsqueeze(-1), after, before)[0])

    def _build(self, data: Transitions, quiet: bool) -> MultiOutputGP:
        """The model of some transitions; quiet where the first one has given its warnings."""
        options = {
            name: deepcopy(value) if isinstance(value, Module) else value
            for name, value in self.model_options.items()
        }
        transform: InputTransform | None = None
        if self.encode_angles and self.targets.angles:
            transform = AngleInput(self.targets.angles)
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")
            return self._make_model(
                self.targets.inputs(data.states, data.actions),
                self.targets.encode(data.states, data.next_states),
                self._physics,
                input_transform=transform,
                **options,
            )

    def _condition(self, model: MultiOutputGP, data: Transitions) -> MultiOutputGP:
        with torch.no_grad():
            return model.condition_on_observations(
                self.targets.inputs(data.states, data.actions),
                self.targets.encode(data.states, data.next_states),
            )

    def _physics_at(self, data: Transitions) -> Tensor | None:
        if self._physics is None:
            return None
        with torch.no_grad():
            return self._physics(self.targets.inputs(data.states, data.actions))

    def _tell_physics(self, data: Transitions, known: Tensor | None) -> None:
        if self._physics is not None and known is not None:
            self._physics.know(self.targets.inputs(data.states, data.actions), known)

    def _predict(
        self, states: Tensor, actions: Tensor, observation_noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance of the predicted states, ``... x len(spec.predicted)``."""
        self._check_pair(states, actions)
        X = self.targets.inputs(states, actions)
        with torch.no_grad():
            flat = X.reshape(-1, X.shape[-1])
            mean, variance = self.model.predict(flat, observation_noise=observation_noise)
        mean, variance = (t.reshape(*X.shape[:-1], -1) for t in (mean, variance))
        return self.targets.decode(states, mean), variance

    def _check_pair(self, states: Tensor, actions: Tensor) -> None:
        check_columns(states, self.spec.state_dim, "states")
        check_columns(actions, self.spec.action_dim, "actions")
