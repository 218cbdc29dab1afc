"""Dynamics by a Gaussian process."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any, Literal, get_args

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_choice, check_kind, checked_options, checked_whole
from gpadjust.core import CKA, GP, FitResult, Prediction, ZeroMeanGP, fit
from gpadjust.core.model import Predictive
from gpadjust.dynamics.base import Dynamics, Sampler, TransitionFunctions
from gpadjust.dynamics.physics_dynamics import (
    PhysicsDynamics,
    PhysicsProbes,
    check_next_values,
    checked_physics_error,
    named_physics,
    varying_parameters,
)
from gpadjust.dynamics.state import check_numbers, columns_of, fingerprint, loading
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.kinds.factory import ModelFactory, make_model
from gpadjust.physics import ParameterValues, Physics, PhysicsError
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import side_by_side, some_columns, with_sine_and_cosine

_NUM_FEATURES = 1024  # by default
_MEAN_ROWS = 200  # kernel rows of a mean: transitions times draws
_CLEAR = 3.5  # standard errors, below which a correlation of errors counts as none
_LEAST = 1e-6  # eigenvalue of a correlation matrix

Target = Literal["difference", "absolute"]


@dataclass(frozen=True, eq=False)
class Learnt:
    """Transitions and their model, in one object, which an update replaces after it succeeds."""

    data: Trajectories
    model: GP
    probes: list[PhysicsProbes]  # of each physics, at transitions of the first update

    @cached_property
    def with_few_draws(self) -> GP:
        """The model with two or more draws, so few that means are quick."""
        # Evenly spaced draws, so that a group of draws (a nested model) has its share.
        u = self.model.u
        number = min(len(u), max(2, _MEAN_ROWS // len(self.data)))
        return self.model.subset_draws(((torch.arange(number) + 0.5) * len(u) / number).long())

    @cached_property
    def noise_root(self) -> Tensor | None:
        """Lower triangular root of the noise correlation, or None."""
        correlation = error_correlation(self.model)
        return None if correlation is None else torch.linalg.cholesky(correlation)


class LearnedDynamics(Dynamics):
    r"""Dynamics by a Gaussian process, usually one that adjusts a physics of the system.

    One model has the change (or next value) of each state as an independent output, and the moving
    states and the action as inputs, such as :math:`f_a = \rho f_p + \delta` of
    :class:`~gpadjust.CKA`. Integrated states follow from their velocities, exogenous states do not
    change, and previous ones repeat the states and actions that they name. After an error, the
    dynamics are as before.

    Args:
        spec: Names and kinds of the entries of states and actions.
        physics: The next values of the states that are neither exogenous nor previous values, from
            these states and the actions or the ``physics_reads`` of the spec. Several: a list, or
            a dictionary with their names. Default: none.
        model: Makes the model from ``(X, Y, physics=...)``: a class of models such as
            :class:`~gpadjust.CKA` (without physics :class:`~gpadjust.ZeroMeanGP`), a
            ``functools.partial`` of it with further arguments, or a function, which also gets
            ``input_transform`` if the state has angles.
        target: Outputs of the model: the ``"difference"`` of next state and state, for an angle the
            shortest way round, or the next state (``"absolute"``). A scaling of an absolute
            position or angle depends on its origin; a scaling of a change does not.
        fit_options: Options of :func:`gpadjust.fit`: ``method``, ``num_draws`` and ``seed``.
        num_features: Number of random features of each kernel in sampled functions, even; 256 for
            a policy search, which needs many functions.
        physics_error: Standard deviations of the error of a step of the physics, by the name of the
            state, for margins of plans before the first transitions.

    Raises:
        TypeError, ValueError: If an argument has another type or is out of range, ``model`` does
            not take the arguments, or a physics returns the change of the state.
        RuntimeError: By methods that predict, before the first update.
        PhysicsError: By methods, if the physics fails.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import LearnedDynamics, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> dynamics = LearnedDynamics(spec, physics=lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> x, v = torch.rand(8, 1, dtype=torch.float64), torch.rand(8, 1, dtype=torch.float64)
        >>> dynamics.update(x, v, x + 0.12 * v)
        >>> mean, variance = dynamics.predict(x, v)
        >>> bool((mean - x - 0.12 * v).abs().max() < 1e-3)
        True
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: Any = None,
        *,
        model: ModelFactory = CKA,
        target: Target = "difference",
        fit_options: Mapping[str, Any] | None = None,
        num_features: int = _NUM_FEATURES,
        physics_error: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(spec)
        if checked_whole("num_features", num_features, 2) % 2:
            raise ValueError(f"Expected num_features to be even; found {num_features}.")
        options = checked_options("fit_options", fit_options, ("method", "num_draws", "seed"))
        self.fit_options = {name: value for name, value in options.items() if value is not None}
        check_choice("method", self.fit_options.get("method", "bayes"), ("bayes", "map"))
        self.targets = Targets(spec, target)
        self._parts: dict[str, Physics] = {}
        self._options: dict[str, Any] = {}  # of the model
        self.physics: Physics | None = None
        if physics is not None:
            self._parts = named_physics(physics, spec)
            parts = {name: TargetPhysics(part, self.targets) for name, part in self._parts.items()}
            self._options["physics"] = parts
            if len(parts) == 1:
                (self.physics,) = self._parts.values()
                (self._options["physics"],) = parts.values()
        if self.targets.angles:
            self._options["input_transform"] = AngleInput(self.targets.angles)
        check_factory(model, self._options)
        self.make_model = model
        self.num_features = num_features
        self.physics_error = checked_physics_error(spec, physics_error)
        self.fit_result: FitResult | None = None
        self._learnt: Learnt | None = None

    @property
    def is_fitted(self) -> bool:
        """True after the first update."""
        return self._learnt is not None

    @property
    def model(self) -> GP:
        """The model of the targets of the predicted states, see ``target``."""
        return self._last_learnt().model

    @property
    def num_transitions(self) -> int:
        """Number of transitions of all updates."""
        return 0 if self._learnt is None else len(self._learnt.data)

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit all unknown numbers again, to these and all earlier transitions.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured: the fit of each
                state uses the rows where it was measured.

        Raises:
            TypeError, ValueError: As :meth:`Trajectories.checked`; if there are fewer than 2 rows
                of a state in all, or transitions contradict the spec
                (:meth:`StateSpec.check_transitions`).
            PhysicsError: If the physics fails.
        """
        data = self._checked(states, actions, next_states)
        if self._learnt is None:
            parts = self._parts.values()
            probes = [PhysicsProbes.from_data(part, self.spec, data) for part in parts]
        else:
            data = self._learnt.data.append(data)
            probes = self._learnt.probes
        self._check_enough(data)
        with warnings.catch_warnings():
            if self._learnt is not None:
                warnings.simplefilter("ignore")  # the first update has issued them
            model = self._built(data)
        self.fit_result = fit(model, **self.fit_options)
        self._learnt = Learnt(data, model, probes)

    @torch.no_grad()
    def predict(
        self, states: Tensor, actions: Tensor, *, observation_noise: bool = True
    ) -> Prediction:
        """Return mean and variance of each entry of the next states, ``... x state_dim`` each.

        They have no gradients; :meth:`mean_function` does.

        Args:
            states: ``... x state_dim``; angles of states and means are not wrapped.
            actions: ``... x action_dim``.
            observation_noise: If True, the variance includes the estimated noise of next states.
        """
        following, variance = self._predict(states, actions, observation_noise)
        return Prediction(
            self.spec.complete(states, actions, following), self.spec.complete_variance(variance)
        )

    def physics_alone(self) -> Dynamics | None:
        """Return the physics with the guesses of unknown parameters; None unless there is one."""
        if self.physics is None:
            return None
        return PhysicsDynamics(self.spec, self.physics, physics_error=self.physics_error)

    @torch.no_grad()
    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states of each row, noise included, from PyTorch's generator."""
        mean, variance = self._predict(states, actions, True)
        z = torch.randn_like(mean)
        root = self.noise_root()
        if root is not None:  # correlation R = root root^T
            z = z @ root.mT
        return self.spec.complete(states, actions, mean + variance.sqrt() * z)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition functions from the posterior, without noise."""
        functions: Any = self.model.sample_functions(num_functions, seed, self.num_features)
        return self._step(functions.evaluate_each, num_functions)

    def mean_function(self) -> TransitionFunctions:
        """Return the mean of the predictions, as a function of any ``k`` blocks, with gradients.

        With many transitions it is the mean of fewer draws, two or more, for speed.
        """
        model = self._last_learnt().with_few_draws
        posterior = model.conditioning()
        has_scale = type(model).marginals_of is not Predictive.marginals_of  # a link has one

        def mean(inputs: Tensor) -> Tensor:
            X = inputs.flatten(0, -2)
            if has_scale:
                values = model.predict(X).mean
            else:  # no variances, which cost most
                means = posterior.mean_alone(model.evaluate(X, posterior.train.values))
                values = (means.mean(-3) * model.unit).mT
            return values.unflatten(0, inputs.shape[:-1])

        return self._step(mean)

    @torch.no_grad()
    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the variance of the estimated noise, ``N x state_dim``."""
        with_noise, without = (self._predict(states, actions, noise)[1] for noise in (True, False))
        return self.spec.complete_variance((with_noise - without).clamp_min(0.0))

    def noise_root(self) -> Tensor | None:
        """Return a root of the shrunk correlation of left-out errors, where it is clear."""
        return self._last_learnt().noise_root

    def describe(self) -> dict[str, str]:
        """Return each setting of these dynamics as a text; of objects, the class."""
        parts = self._parts.values()
        # States saved before an option existed have its default: leave defaults out.
        options = {
            "physics": [*self._parts] if len(parts) > 1 else None,
            "unknowns": {name: repr(u) for part in parts for name, u in part.unknowns.items()},
            "num_features": self.num_features if self.num_features != _NUM_FEATURES else None,
            "physics_error": self.physics_error,
        }
        return fingerprint(
            type(self),
            self.spec,
            model=getattr(self.make_model, "func", self.make_model),
            target=self.targets.target,
            model_options=getattr(self.make_model, "keywords", {}),
            **{"method": None, **self.fit_options},
            **{name: value for name, value in options.items() if value},
        )

    def state_dict(self) -> dict[str, Any]:
        """Return transitions, model and f_p at some rows, in tensors and plain values."""
        if self._learnt is None:
            return {}
        model = self._learnt.model
        settings = getattr(model.noise, "settings", {})
        state = {
            "fingerprint": self.describe(),
            "transitions": columns_of(self._learnt.data),
            "probes": [[*probe] for probe in self._learnt.probes],
            "model": dict(model.state_dict()),
            "draws": model.draws,
            # corrections of single observations, set by a fit
            "noise": {name: v for name, v in settings.items() if isinstance(v, Tensor)},
        }
        return deepcopy(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a result of :meth:`state_dict`; predictions and later fits are then the same.

        An empty state, that of dynamics before the first update, removes all transitions. The
        physics is compared at three of the transitions.

        Raises:
            TypeError: If the state is not a dictionary.
            RuntimeError: If the state belongs to dynamics with other settings or another physics,
                or is damaged.
        """
        if state == {}:
            self._learnt = self.fit_result = None
            return
        with loading(state, self.describe()) as copy, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the first update has issued them
            probes = [PhysicsProbes(*columns) for columns in copy["probes"]]
            for part, probe in zip(self._parts.values(), probes, strict=True):
                probe.check(part, self.spec)
            check_numbers({**copy["model"], **copy["noise"], "draws": copy["draws"]})
            data = Trajectories.checked(self.spec, **copy["transitions"])
            model = self._built(data)
            if copy["noise"]:  # a fit replaced the noise by one with corrections
                noise: Any = model.noise
                noise = type(noise)(**{**noise.settings, **copy["noise"]})
                model = model.with_noise(noise.of_data(model.data, model.term_sum))
            model.load_state_dict(copy["model"])
            draws = copy["draws"]
            number = len(model.u)
            if draws.shape[1:] != model.u.shape[1:] or len(draws) < number:
                raise ValueError(f"expected {number} or more draws, each like {model.u[0].shape}")
            model.set_draws(draws, number)
            learnt = Learnt(data, model.eval(), probes)
        self._learnt = learnt
        self.fit_result = None

    def _check_enough(self, data: Trajectories) -> None:
        """Raise a ValueError unless each predicted state was measured in two rows or more."""
        least, i = (~data.next_states[:, self.spec.predicted].isnan()).sum(0).min(0)
        if least < 2:
            rows = str(int(least))
            if len(data) >= 2:
                rows += f" with a measured {self.spec.states[self.spec.predicted[i]]!r}"
            raise ValueError(
                f"Expected at least 2 transitions to learn from, got {rows}: fewer have no scale. "
                "Collect more before the first update."
            )

    def _built(self, data: Trajectories) -> GP:
        """Return the model of some transitions."""
        targets = self.targets
        X = targets.inputs(data.states, data.actions)
        Y = targets.encode(data.states, data.next_states)
        # A model of tensors has no names: those of states and actions serve errors and summaries.
        model: GP = make_model(self.make_model, X, Y, kind=GP, **self._options)
        model.data = model.data._replace(
            input_names=targets.input_names, output_names=targets.output_names
        )
        return model

    def _varied(self, variation: Tensor | float) -> Sampler:
        """Return `sample_functions` with varying parameters of the physics."""
        learnt = self._last_learnt()
        if self.physics is None or not self.physics.unknowns:
            return super()._varied(variation)
        parameters, actions = learnt.model.physics_parameters, learnt.data.actions
        vary = varying_parameters(self.physics, self.spec, parameters, actions, variation)

        def sample_functions(num_functions: int, seed: int | None = None) -> TransitionFunctions:
            functions = self.sample_functions(num_functions, seed)
            change = vary(num_functions, seed)
            return lambda states, actions: functions(states, actions) + change(states, actions)

        return sample_functions

    def _last_learnt(self) -> Learnt:
        """Return the result of the last update."""
        if self._learnt is None:
            raise RuntimeError(
                f"{type(self).__name__} has not learnt from transitions yet; call `update`."
            )
        return self._learnt

    def _step(
        self, model: Callable[[Tensor], Tensor], num_functions: int | None = None
    ) -> TransitionFunctions:
        """Return the next state as a function of states and actions, by a function of inputs."""

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            targets = model(self.targets.inputs(states, actions))
            return self.spec.complete(states, actions, self.targets.decode(states, targets))

        return step

    def _predict(
        self, states: Tensor, actions: Tensor, observation_noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the predicted states, ``... x len(spec.predicted)``."""
        self._check_blocks(states, actions)
        X = self.targets.inputs(states, actions)
        rows = X.reshape(-1, X.shape[-1])
        moments = self.model.predict(rows, observation_noise=observation_noise)
        # Back to the shape of the states.
        mean, variance = (part.reshape(*X.shape[:-1], part.shape[-1]) for part in moments)
        return self.targets.decode(states, mean), variance


def error_correlation(model: Any) -> Tensor | None:
    r"""Return the correlation of outputs by left-out errors, ``m x m``; None if none is clear.

    A correlation r of n pairs has the standard error :math:`(1 - r^2) / \sqrt n`. It counts where
    :math:`|r| \sqrt n` is more than 3.5, and is shrunk by the share of its square that is chance
    (Schaefer and Strimmer 2005).
    """
    if model.num_outputs < 2 or not isinstance(model, GP):
        return None
    errors = model.data.Y - model.left_out().prediction.mean
    is_observed = (~errors.isnan()).double()
    errors = errors.nan_to_num(nan=0.0)
    number = (is_observed.mT @ is_observed).clamp_min(1.0)
    size = (errors.square().mT @ is_observed).clamp_min(torch.finfo(errors.dtype).tiny)
    # r_ij = sum_k e_ki e_kj / sqrt(sum_k e_ki^2 sum_k e_kj^2), over the rows k with both
    r = (errors.mT @ errors) / (size * size.mT).sqrt()
    clear = r.abs() * number.sqrt() > _CLEAR
    chance = (1 - r.square()).square() / (number * r.square().clamp_min(1e-12))
    r = torch.where(clear, r * (1 - chance).clamp_min(0.0), 0.0)
    r.fill_diagonal_(1.0)
    if not (r - torch.eye(len(r))).any():
        return None
    values, vectors = torch.linalg.eigh(r)
    if values[0] < _LEAST:  # pairs are observed together in different rows
        r = vectors * values.clamp_min(_LEAST) @ vectors.mT
        sd = r.diagonal().sqrt()
        r = r / sd / sd.unsqueeze(-1)
    return r


def check_factory(make: Any, options: Mapping[str, Any]) -> None:
    """Raise a TypeError unless a factory takes inputs, targets and these options."""
    keywords = getattr(make, "keywords", {})
    function = getattr(make, "func", make)
    twice = {"physics", "input_transform", "train_X", "train_Y", "train_Yvar"} & {*keywords}
    is_without = isinstance(function, type) and issubclass(function, ZeroMeanGP)
    try:
        if twice:
            raise TypeError(f"{min(twice)} comes from the dynamics; leave it out of the partial")
        if is_without and "physics" in options:
            raise TypeError("it takes no physics; leave the physics out, or take model=CKA")
        signature(make).bind(None, None, **options)
    except TypeError as error:
        arguments = ", ".join(["X", "Y", *(f"{option}=..." for option in options)])
        name = getattr(function, "__name__", repr(function))
        raise TypeError(
            f"Expected model as a factory of ({arguments}): a class of gpadjust, such as CKA or, "
            "without a physics, ZeroMeanGP, a functools.partial of it, or a function; found "
            f"{name}: {error}."
        ) from None


class Targets:
    r"""Targets of a model that stand for next states.

    They are the change of each predicted state, :math:`y = s' - s`, for an angle the shortest way
    round; or with ``"absolute"`` its next value :math:`s + (s' - s)`, which is continuous along a
    trajectory even if angles are wrapped.
    """

    def __init__(self, spec: StateSpec, target: Target) -> None:
        check_choice("target", target, get_args(Target))
        self.spec, self.target = spec, target
        columns = spec.model_columns  # the moving states come first
        self.predicted = [spec.moving.index(i) for i in spec.predicted]
        self.angles = [place for place, i in enumerate(columns) if i in spec.angle_columns]
        self.of_physics = [columns.index(i) for i in spec.physics_columns]
        names = (*spec.states, *spec.actions)
        self.input_names = tuple(names[i] for i in columns)
        change = "change of " if target == "difference" else ""
        self.output_names = tuple(change + names[i] for i in spec.predicted)

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return raw inputs of a model, ``... x d``; see :attr:`StateSpec.model_columns`."""
        return some_columns(side_by_side(states, actions), self.spec.model_columns)

    def encode(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Return targets ``... x m`` of transitions."""
        predicted = self.spec.predicted
        change = self.spec.change(states, next_states)[..., predicted]
        if self.target == "difference":
            return change
        return states[..., predicted] + change

    def decode(self, states: Tensor, targets: Tensor) -> Tensor:
        """Return next values of the predicted states, ``... x m``."""
        if self.target == "absolute":
            return targets
        return some_columns(states, self.spec.predicted) + targets


class TargetPhysics(Physics):
    r"""The physics of the targets, by an f_p that returns next states.

    Memory, batching and gradients are those of f_p.
    """

    def __init__(self, physics: Physics, targets: Targets) -> None:
        super().__init__(unknowns=physics.unknowns, name=physics.name)
        self.physics, self.targets = physics, targets
        self.num_outputs = len(targets.predicted)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the targets by the physics, ``N x m``."""
        inputs = some_columns(X, self.targets.of_physics)
        try:
            following = self.physics.of_rows(self.physics.read_rows(inputs, *parameters))
        except PhysicsError as error:
            if error.partial is not None:
                fails = ~error.partial.isfinite().all(-1, keepdim=True)
                error.partial = self._of_states(X, error.partial).masked_fill(fails, torch.nan)
            raise
        return self._of_states(X, following)

    def _of_states(self, X: Tensor, following: Tensor) -> Tensor:
        """Return the targets by next states."""
        targets = self.targets
        num_states = len(targets.spec.moving)
        check_next_values(self.physics, following, num_states)
        change = following - X[:, :num_states]
        columns = []
        for i in targets.predicted:
            column = change[:, i]
            if i in targets.angles:  # the shortest way round
                column = torch.atan2(column.sin(), column.cos())
            if targets.target == "absolute":
                column = X[:, i] + column
            columns.append(column)
        return torch.stack(columns, dim=-1)

    def forget(self) -> None:
        """Clear the memory of the physics."""
        self.physics.forget()

    def extra_repr(self) -> str:
        """Return the settings in ``repr``."""
        return f"target={self.targets.target!r}"


class AngleInput(InputTransform):
    r"""A transform of each angle :math:`\theta`, in its place, to :math:`\sin\theta, \cos\theta`.

    A stationary kernel on the result is continuous where the angle wraps.

    Args:
        columns: The columns of X that are angles in rad: one or more different numbers, from 0.

    Example:
        >>> import torch
        >>> AngleInput([0])(torch.tensor([[0.0, 7.0]]))
        tensor([[0., 1., 7.]])
    """

    is_one_to_many = False
    transform_on_train = True
    transform_on_eval = True
    transform_on_fantasize = True

    def __init__(self, columns: Sequence[int]) -> None:
        super().__init__()
        check_kind("columns", columns, Sequence, "a sequence of numbers, such as [0]")
        self.columns = tuple(checked_whole("Each of columns", i, 0) for i in columns)
        if not columns or len({*columns}) < len(columns):
            raise ValueError(f"Expected columns as one or more different numbers, got {columns}.")

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` to ``... x n x (d + k)``, for ``k`` angles."""
        if X.shape[-1] <= max(self.columns):
            raise ValueError(
                f"Expected X with an angle in column {max(self.columns)}, got {tuple(X.shape)}."
            )
        return with_sine_and_cosine(X, self.columns)

    def column_names(self, names: Sequence[str]) -> list[str]:
        """Return the names of the columns of :meth:`transform`, by the names of those of X."""
        columns: list[str] = []
        for i, name in enumerate(names):
            columns += [f"sin({name})", f"cos({name})"] if i in self.columns else [name]
        return columns

    @property
    def settings(self) -> dict[str, list[int]]:
        """The arguments."""
        return {"columns": [*self.columns]}

    def equals(self, other: InputTransform) -> bool:
        """Return whether ``other`` replaces the same columns."""
        return isinstance(other, AngleInput) and self.columns == other.columns
