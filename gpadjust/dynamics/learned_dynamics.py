"""Dynamics learnt by a Gaussian process."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_choice, checked_options, checked_tensor, checked_whole
from gpadjust.core import CKA, GP, FitResult, Prediction, ZeroMeanGP, fit
from gpadjust.core.model import Predictive
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.least_squares import even_normal
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.state import PhysicsProbes, check_numbers, columns_of, fingerprint, loading
from gpadjust.dynamics.targets import (
    AngleInput,
    Target,
    TargetPhysics,
    Targets,
    checked_physics_error,
    named_physics,
)
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.kinds.factory import ModelFactory, make_model
from gpadjust.physics import Physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.states import StateSpec
from gpadjust.validation.leave_one_out import error_correlation

_NUM_FEATURES = 1024  # by default
_MEAN_ROWS = 200  # kernel rows of a mean: transitions times draws
_BEYOND = 2.0  # times as much again, half a range of the actions beyond it
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # coordinate, beyond which there is nothing of a prior


@dataclass(frozen=True, eq=False)
class Learnt:
    """Transitions, and the model of them; replaced as a whole, so that no error leaves half."""

    data: Trajectories
    model: GP
    probes: list[PhysicsProbes]  # of each physics, by its first transitions

    @cached_property
    def with_few_draws(self) -> GP:
        """The model with as many draws as keep means quick, two or more."""
        u = self.model.u
        number = min(len(u), max(2, _MEAN_ROWS // len(self.data)))
        return self.model.subset_draws(((torch.arange(number) + 0.5) * len(u) / number).long())

    @cached_property
    def noise_root(self) -> Tensor | None:
        """See :meth:`LearnedDynamics.noise_root`."""
        correlation = error_correlation(self.model)
        return None if correlation is None else torch.linalg.cholesky(correlation)


class LearnedDynamics(Dynamics):
    r"""Dynamics that a Gaussian process learns, as a rule by adjusting a physics of the system.

    Each state's change (or next value) is an independent output of one model, of the states that
    move and the action, such as :math:`f_a = \rho f_p + \delta` of :class:`~gpadjust.CKA`.
    Integrated states follow from their velocities, exogenous ones stay, and previous ones are what
    they name: with earlier outputs and actions among the states that is an autoregressive model
    (NARX), which :meth:`free_run` feeds with its own predictions.

    Args:
        spec: What the entries of states and actions are.
        physics: The next values of the states that are neither exogenous nor previous values,
            from the columns ``physics_reads`` of the spec, by default these states and the actions;
            angles in rad, of which models read sine and cosine. Several: a list, or a dictionary
            with their names. Default: none.
        model: Makes the model from ``(X, Y, physics=...)``: a class of models such as
            :class:`~gpadjust.CKA` (without physics :class:`~gpadjust.ZeroMeanGP`), a
            ``functools.partial`` of it with further arguments, or a function, which gets
            ``input_transform``, too, where the state has angles.
        target: What the model learns: the ``"difference"`` of next state and state, of an angle
            the shortest way round, or the next state itself (``"absolute"``). A scaling of an
            absolute position or angle depends on where its origin is; one of a change does not.
        fit_options: Options of :func:`gpadjust.fit`: ``method``, ``num_draws`` and ``seed``. By
            default the hyper-parameters are drawn, and what is predicted has their uncertainty,
            too; ``"map"`` takes the most likely ones.
        num_features: Number of random features that stand for each kernel in sampled functions, an
            even one. Fewer are faster: 256 for a policy search, whose functions are many.
        physics_error: Standard deviations of the error of a step of the physics, by the name of the
            state, for which plans before the first transitions keep margins.

    Raises:
        TypeError: If an argument is of another type, or ``model`` needs a physics (or another
            argument) that is missing, or takes none that is given.
        ValueError: If ``target`` or an option is unknown, a number is none of those above, or a
            physics returns the change of the state.

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
        self._parts = {} if physics is None else named_physics(physics, spec)
        parts = {name: TargetPhysics(part, self.targets) for name, part in self._parts.items()}
        self.physics = next(iter(self._parts.values())) if len(parts) == 1 else None
        self._options: dict[str, Any] = {}  # of the model
        if parts:
            self._options["physics"] = parts if len(parts) > 1 else next(iter(parts.values()))
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
        """True once it has learnt from transitions."""
        return self._learnt is not None

    @property
    def model(self) -> GP:
        """The model, whose targets are what ``target`` says of the predicted states."""
        return self._known_so_far().model

    @property
    def num_transitions(self) -> int:
        """Number of transitions that it has learnt from."""
        return 0 if self._learnt is None else len(self._learnt.data)

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn from further transitions: fit all unknown numbers again to these and earlier ones.

        If this raises an error, what was learnt before stands; so it does in all methods below.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured: each state is
                learnt from its own rows.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, values are not finite, a row of next states is NaN in
                all that the model predicts, there are fewer than 2 rows of a state in all, or
                states are not what the spec says (:meth:`StateSpec.check_transitions`).
            PhysicsError: If the physics fails.
        """
        data, before = self._checked(states, actions, next_states), self._learnt
        if before is None:
            probes = [PhysicsProbes.of(part, self.spec, data) for part in self._parts.values()]
        else:
            data, probes = before.data.append(data), before.probes
        self._check_enough(data)
        with warnings.catch_warnings():
            if before is not None:
                warnings.simplefilter("ignore")  # the first update has given them
            model = self._built(data)
        self.fit_result = fit(model, **self.fit_options)
        self._learnt = Learnt(data, model, probes)

    def predict(
        self, states: Tensor, actions: Tensor, *, observation_noise: bool = True
    ) -> Prediction:
        """Return mean and variance of the next states, ``... x state_dim`` each, entry by entry.

        Args:
            states: ``... x state_dim``; angles of the mean are not wrapped, either.
            actions: ``... x action_dim``.
            observation_noise: Whether the variance includes the noise that was learnt, by which
                next states scatter about the mean.

        Raises:
            RuntimeError: If nothing was learnt yet.
            PhysicsError: If the physics fails.
        """
        following, variance = self._predict(states, actions, observation_noise)
        return Prediction(
            self.spec.complete(states, actions, following), self.spec.complete_variance(variance)
        )

    def physics_alone(self) -> Dynamics | None:
        """Return the physics, with the guesses of unknown parameters; None unless it is one."""
        if self.physics is None:
            return None
        return PhysicsDynamics(self.spec, self.physics, physics_error=self.physics_error)

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, noise included, row by row, from PyTorch's generator."""
        mean, variance = self._predict(states, actions, True)
        drawn, root = torch.randn_like(mean), self.noise_root()
        drawn = drawn if root is None else drawn @ root.mT
        return self.spec.complete(states, actions, mean + variance.sqrt() * drawn)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition functions from the posterior, without noise; see :class:`Dynamics`."""
        functions: Any = self.model.sample_functions(num_functions, seed, self.num_features)
        return self._step(functions.each, num_functions)

    def mean_function(self) -> TransitionFunctions:
        """Return the mean of the predictions, as a function of any ``k`` blocks, with gradients.

        Of many transitions it is that of two or more of the draws, as many as keep it quick, which
        differ less the more is known.
        """
        model = self._known_so_far().with_few_draws
        posterior = model.conditioning()
        has_scale = type(model).marginals_of is not Predictive.marginals_of  # as of a link

        def mean(inputs: Tensor) -> Tensor:
            X = inputs.flatten(0, -2)
            if has_scale:
                values = model.predict(X).mean
            else:  # without variances, which cost most
                means = posterior.mean_alone(model.at(X, posterior.train.values))
                values = (means.mean(-3) * model.unit).mT
            return values.unflatten(0, inputs.shape[:-1])

        return self._step(mean)

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the variance of the learnt noise, ``N x state_dim``."""
        noisy, without = (self._predict(states, actions, noise)[1] for noise in (True, False))
        return self.spec.complete_variance((noisy - without).clamp_min(0.0))

    def noise_root(self) -> Tensor | None:
        """Return a lower triangular root of the correlation of predicted states' noise, if any.

        It is that of left-out errors, shrunk, of states whose correlation these clearly show.
        """
        return self._known_so_far().noise_root

    def describe(self) -> dict[str, str]:
        """Return each setting of these dynamics as a text; of objects, the class."""
        parts = self._parts.values()
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
        """Return all that was learnt, in tensors and plain values, and f_p at some rows."""
        if self._learnt is None:
            return {}
        data, model = self._learnt.data, self._learnt.model
        settings = getattr(model.noise, "settings", {})
        return deepcopy(
            {
                "fingerprint": self.describe(),
                "transitions": columns_of(data),
                "probes": [[*each] for each in self._learnt.probes],
                "model": dict(model.state_dict()),
                "draws": model.draws,
                # what a fit has learnt of single observations
                "noise": {name: v for name, v in settings.items() if isinstance(v, Tensor)},
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same.

        An empty state, that of dynamics that have learnt nothing, lets them forget. The physics is
        compared at three of the transitions, and evaluated at all of them.

        Raises:
            TypeError: If it is not a dictionary.
            RuntimeError: If it is of dynamics of other settings or another physics, or damaged.
            PhysicsError: If the physics fails.
        """
        if state == {}:
            self._learnt = self.fit_result = None
            return
        with loading(state, self.describe()) as copy, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the first update has given them
            probes = [PhysicsProbes(*each) for each in copy["probes"]]
            for part, each in zip(self._parts.values(), probes, strict=True):
                each.check(part, self.spec)
            check_numbers({**copy["model"], **copy["noise"], "draws": copy["draws"]})
            data = Trajectories.checked(self.spec, **copy["transitions"])
            model = self._built(data)
            if copy["noise"]:
                noise: Any = model.noise
                noise = type(noise)(**{**noise.settings, **copy["noise"]})
                model = model.with_noise(noise.of_terms(model.term_sum))
            model.load_state_dict(copy["model"])
            number, draws = len(model.u), copy["draws"]
            if draws.shape[1:] != model.u.shape[1:] or len(draws) < number:
                raise ValueError(f"expected {number} or more draws, each like {model.u[0].shape}")
            model.set_draws(draws, number)
            learnt = Learnt(data, model.eval(), probes)
        self._learnt, self.fit_result = learnt, None

    def _check_enough(self, data: Trajectories) -> None:
        """Raise a ValueError unless each predicted state was measured in two rows or more."""
        least, i = (~data.next_states[:, self.spec.predicted].isnan()).sum(0).min(0)
        if least < 2:
            name = self.spec.states[self.spec.predicted[i]]
            of = "" if len(data) < 2 else f" with a measured {name!r}"
            raise ValueError(
                f"Expected at least 2 transitions to learn from, got {least}{of}: there is no "
                "scale in fewer. Collect more before the first update."
            )

    def _built(self, data: Trajectories) -> GP:
        """Return the model of some transitions."""
        targets = self.targets
        X = targets.inputs(data.states, data.actions)
        Y = targets.encode(data.states, data.next_states)
        model: GP = make_model(self.make_model, X, Y, kind=GP, **self._options)
        model.data = model.data._replace(
            input_names=targets.input_names, output_names=targets.output_names
        )
        return model

    def _varied(
        self, variation: Tensor | float
    ) -> Callable[[int, int | None], TransitionFunctions]:
        """Return `sample_functions`, each function with parameters of its own."""
        learnt = self._known_so_far()
        if self.physics is None or not self.physics.unknowns:
            return super()._varied(variation)
        drawn = learnt.model.physics_parameters
        vary = varying_parameters(self.physics, self.spec, drawn, learnt.data.actions, variation)

        def sample_functions(num_functions: int, seed: int | None = None) -> TransitionFunctions:
            functions = self.sample_functions(num_functions, seed)
            change = vary(num_functions, seed)
            return lambda states, actions: functions(states, actions) + change(states, actions)

        return sample_functions

    def _known_so_far(self) -> Learnt:
        if self._learnt is None:
            raise RuntimeError(
                f"{type(self).__name__} has not learnt from transitions yet; call `update`."
            )
        return self._learnt

    def _step(
        self, of_inputs: Callable[[Tensor], Tensor], num_functions: int | None = None
    ) -> TransitionFunctions:
        """Return a step by targets as a function of the model's inputs."""

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            targets = of_inputs(self.targets.inputs(states, actions))
            return self.spec.complete(states, actions, self.targets.decode(states, targets))

        return step

    def _predict(
        self, states: Tensor, actions: Tensor, observation_noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the predicted states, ``... x len(spec.predicted)``."""
        self._check_blocks(states, actions)
        X = self.targets.inputs(states, actions)
        with torch.no_grad():
            rows = X.reshape(-1, X.shape[-1])
            moments = self.model.predict(rows, observation_noise=observation_noise)
        mean, variance = (part.reshape(*X.shape[:-1], part.shape[-1]) for part in moments)
        return self.targets.decode(states, mean), variance


def check_factory(make: Any, options: Mapping[str, Any]) -> None:
    """Raise a TypeError unless a model can be made of inputs, targets and these options."""
    keywords, made = getattr(make, "keywords", {}), getattr(make, "func", make)
    own = {"physics", "input_transform", "train_X", "train_Y", "train_Yvar"} & {*keywords}
    is_without = isinstance(made, type) and issubclass(made, ZeroMeanGP)
    try:
        if own:
            raise TypeError(f"{min(own)} comes from the dynamics; leave it out of the partial")
        if is_without and "physics" in options:
            raise TypeError("it takes no physics; leave that out, or take model=CKA")
        signature(make).bind(None, None, **options)
    except TypeError as error:
        arguments = ", ".join(["X", "Y", *(f"{option}=..." for option in options)])
        raise TypeError(
            f"Expected model as what makes one of ({arguments}): a class of gpadjust, such as CKA "
            "or, without a physics, ZeroMeanGP, a functools.partial of it with further arguments, "
            f"or a function; found {getattr(made, '__name__', repr(made))}: {error}."
        ) from None


def varying_parameters(
    physics: Physics,
    spec: StateSpec,
    learnt: PhysicsParameters,
    actions: Tensor,
    variation: Tensor | float,
) -> Callable[[int, int | None], TransitionFunctions]:
    """Return changes of next states by parameters that differ, in each draw by numbers of its own.

    They vary by standard deviations of their coordinates about those that were learnt, by more
    beyond the actions that were learnt from, ``N x action_dim``. What is returned takes a number
    ``k`` of draws and a seed, and returns a function of states and actions: by how much next states
    ``k x N x state_dim`` are others than by what was learnt, NaN where the physics fails.
    """
    unknowns, p = physics.unknowns, len(physics.unknowns)
    sd = checked_tensor("variation", variation)
    if sd.shape not in ((), (p,)) or not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected variation as one number of 0 or more, or one for each of "
            f"{', '.join(unknowns)}, got {sd.tolist()}."
        )
    sd = sd.expand(p)
    center = unknowns.coordinates(learnt.draws).clamp(-_END, _END).mean(0)
    low, high = actions.amin(0), actions.amax(0)
    # Of an action that never varied, its own size.
    half = ((high - low) / 2).where(high > low, high.abs().where(high != 0, torch.ones_like(high)))

    def changes(number: int, seed: int | None) -> TransitionFunctions:
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        drawn = even_normal(number, p, seed).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            beyond = (low - actions).clamp_min(0) + (actions - high).clamp_min(0)
            growth = 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)
            away = torch.minimum(sd * growth, sd.clamp_min(_MOST)) * drawn
            rows = spec.physics_inputs(states, actions).flatten(0, -2).unsqueeze(1)
            ends = []
            for coordinates in (center, center + away):
                values = unknowns.at(coordinates.expand_as(away).flatten(0, -2))  # of each row
                end = states.clone()
                end[..., spec.moving] = physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return spec.change(*ends)

        return change

    return changes
