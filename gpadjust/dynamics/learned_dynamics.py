"""Dynamics learnt by a Gaussian process."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor
from torch.nn import Module

from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.identity import check_identity, identity
from gpadjust.dynamics.model_dynamics import ModelDynamics
from gpadjust.dynamics.next_state_physics import check_physics, parts_of, warn_of_differences
from gpadjust.dynamics.refitting import refit, search_rows
from gpadjust.dynamics.state_spec import StateSpec
from gpadjust.dynamics.transition_physics import Target, TransitionPhysics
from gpadjust.dynamics.transitions import Transitions
from gpadjust.inference import FitResult, fit
from gpadjust.inference.fitting import FitOptions
from gpadjust.models import ExactGPBase
from gpadjust.models.adjusted_gp import PhysicsLike
from gpadjust.physics import Physics, as_physics


class LearnedDynamics(ModelDynamics):
    """The base of dynamics that a Gaussian process of this library learns.

    The states' targets are independent outputs of one model; users build
    :class:`~gpadjust.dynamics.CKADynamics` and so on. The arguments are its own, except that
    ``physics`` may be None.
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: PhysicsLike | None,
        *,
        target: Target = "difference",
        encode_angles: bool = True,
        model_options: Mapping[str, Any] | None = None,
        fit_options: FitOptions | None = None,
    ) -> None:
        super().__init__(spec, target)
        self.physics = None if physics is None else check_physics(physics)
        self.encode_angles = encode_angles
        self.model_options = dict(model_options or {})
        self.fit_options: FitOptions = {**(fit_options or {})}
        own = {"physics", "input_transform", "train_Yvar"} & {*self.model_options}
        if own:
            raise ValueError(f"model_options may not hold {own.pop()!r}, which dynamics set.")
        self.fit_result: FitResult | None = None
        self._compared = False  # the physics with transitions
        self._forget_data()
        self._parts = {
            name: TransitionPhysics(part, self.targets)
            for name, part in ({} if self.physics is None else parts_of(self.physics)).items()
        }
        self._physics = as_physics(self._parts) if self._parts else None

    @abstractmethod
    def _make_model(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        physics: Physics | None,
        **options: Any,
    ) -> ExactGPBase:
        """Build the model, from its options and an input transform."""

    def _forget_data(self) -> None:
        self._model: ExactGPBase | None = None
        self._data: Transitions | None = None
        self._known: Tensor | None = None  # f_p at the data
        self._chunks: list[int] = []  # numbers of points: fitted, then conditioned on
        self._searched_at = 0

    @property
    def is_fitted(self) -> bool:
        """Whether it has learnt from any transitions."""
        return self._model is not None

    @property
    def model(self) -> ExactGPBase:
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
            next_states: ``N x state_dim``; NaN where an entry was not measured: each state is
                learnt from its own rows.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, values are not finite, a row of next states is NaN in
                all that the model predicts, there are fewer than 2 rows of a state, or states are
                not what the spec says (:meth:`StateSpec.check_transitions`).
            PhysicsError: If the physics fails.
        """
        data = self._checked(states, actions, next_states)
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
            next_states: ``N x state_dim``; NaN as in :meth:`fit`.
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
        data = self._checked(states, actions, next_states)
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
        data = self._checked(states, actions, next_states)
        known = self._physics_at(data)
        self._model = self._condition(model, data)
        self._data = self._data.append(data)
        if known is not None and self._known is not None:
            self._known = torch.cat([self._known, known])
        self._chunks = [*self._chunks, len(data.states)]

    def describe(self) -> dict[str, str]:
        """What these dynamics are, each setting as a text; of objects, the class."""
        several: dict[str, Any] = {"physics": [*self._parts]} if len(self._parts) > 1 else {}
        return identity(
            self,
            **several,
            target=self.targets.target,
            encode_angles=self.encode_angles,
            model_options=self.model_options,
        )

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values: data, f_p there, hyper-parameters."""
        if self._model is None or self._data is None:
            return {}
        return {
            "identity": self.describe(),
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

        Raises:
            RuntimeError: If it is of dynamics of another class, spec, target or model options.
        """
        check_identity(state, self.describe())
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

    def _learn(self, data: Transitions, known: Tensor | None, previous: ExactGPBase | None) -> None:
        n = len(data.states)
        observed = ~data.next_states[:, self.spec.predicted].isnan()
        least, i = observed.sum(0).min(0)
        if least < 2:
            of = "" if n < 2 else f" with a measured {self.spec.states[self.spec.predicted[i]]!r}"
            raise ValueError(
                f"Expected at least 2 transitions to learn from, got {least}{of}: there is no "
                "scale in fewer. Collect more before the first update."
            )
        if previous is None and known is not None and not self._compared:
            self._compare(data, known)
        self._tell_physics(data, known)
        model = self._build(data, quiet=previous is not None)
        searches = previous is None or n >= 2 * self._searched_at
        if previous is None:
            result = fit(model, **self.fit_options)
        else:
            rows = search_rows(observed) if searches else None
            part = None if rows is None else self._build(data.some(rows), quiet=True)
            result = refit(model, previous, searches, part)
        self.fit_result = result
        self._searched_at = n if searches else self._searched_at
        self._data, self._known, self._chunks = data, known, [n]
        self._model = self._fitted = model

    def _compare(self, data: Transitions, known: Tensor) -> None:
        """Warn of a physics that returns differences."""
        predicted = self.spec.predicted
        for name, values in zip(self._parts, known.split(len(predicted), dim=-1), strict=True):
            change = self.targets.decode(data.states, values) - data.states[:, predicted]
            warn_of_differences(name, self.spec, data, predicted, change)
        self._compared = True

    def _build(self, data: Transitions, quiet: bool) -> ExactGPBase:
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

    def _condition(self, model: ExactGPBase, data: Transitions) -> ExactGPBase:
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
        if known is None:
            return
        inputs = self.targets.inputs(data.states, data.actions)
        values = known.split(len(self.spec.predicted), dim=-1)
        for part, own in zip(self._parts.values(), values, strict=True):
            part.know(inputs, own)
