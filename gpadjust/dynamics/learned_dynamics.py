"""Dynamics learnt by a Gaussian process."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.checks import check_choice, check_switch, checked_options, checked_whole
from gpadjust.core import CKA, GP, FitResult, Prediction, ZeroMeanGP, fit
from gpadjust.core.model import Predictive
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics, varying_parameters
from gpadjust.dynamics.state import (
    PhysicsProbes,
    check_fingerprint,
    expect,
    fingerprint,
    loaded,
    saved,
)
from gpadjust.dynamics.targets import (
    AngleInput,
    Target,
    TargetPhysics,
    Targets,
    checked_physics_error,
    named_physics,
    warn_of_differences,
)
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.kinds.factory import ModelFactory, make_model
from gpadjust.states import StateSpec
from gpadjust.validation.leave_one_out import error_correlation

_STATE = ("transitions", "probes", "chunks", "model", "draws", "noise")
_NUM_FEATURES = 1024  # by default
_MEAN_ROWS = 200  # kernel rows of a mean: transitions times draws


class Learnt(NamedTuple):
    """Transitions, and the model of them; replaced as a whole, so that no error leaves half."""

    data: Trajectories
    chunks: tuple[int, ...]  # numbers of transitions: fitted, then conditioned on in turn
    fitted: GP  # of the first chunk
    model: GP  # of all


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
            from the columns that the spec says (``physics_reads``), by default these states and
            the actions; angles in rad. Several: a list, or a dictionary with their names, as of
            :class:`~gpadjust.CKA`. None for a model without physics.
        model: Makes the model from ``(X, Y, physics=...)``: :class:`~gpadjust.CKA`, another class
            of models (:class:`~gpadjust.ZeroMeanGP` is the one without physics), your own, or a
            function. Further arguments by ``functools.partial``, such as
            ``partial(RRA, num_features=128)``. A function gets ``input_transform``, too, where the
            state has angles.
        target: What the model learns: the ``"difference"`` of next state and state, of an angle
            the shortest way round, or the next state itself (``"absolute"``). A scaling of an
            absolute position or angle depends on where its origin is; one of a change does not.
        encode_angles: Whether the model reads the sine and cosine of angles; the physics always
            reads the angles.
        fit_options: Options of :func:`gpadjust.fit`: ``method``, ``num_draws`` and ``seed``. By
            default the hyper-parameters are drawn, and what is predicted has their uncertainty,
            too; ``"map"`` takes the most likely ones.
        num_features: Number of random features that stand for each kernel in sampled functions, an
            even one. Fewer are faster: 256 for a policy search, whose functions are many.
        physics_error: Standard deviations of the error of a step of the physics, by the name of the
            state, for which plans before the first transitions keep margins; see
            :class:`PhysicsDynamics`.

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
        encode_angles: bool = True,
        fit_options: Mapping[str, Any] | None = None,
        num_features: int = _NUM_FEATURES,
        physics_error: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(spec)
        if checked_whole("num_features", num_features, 2) % 2:
            raise ValueError(f"Expected num_features to be even; found {num_features}.")
        check_switch("encode_angles", encode_angles)
        self.targets = Targets(spec, target)
        parts = {} if physics is None else named_physics(physics, spec)
        self.physics = next(iter(parts.values())) if len(parts) == 1 else None  # if it is one
        self.encode_angles = encode_angles
        self.fit_result: FitResult | None = None
        self.make_model = model
        self._parts = {name: TargetPhysics(part, self.targets) for name, part in parts.items()}
        self._options: dict[str, Any] = {}  # of the model
        if self._parts:
            one = next(iter(self._parts.values()))
            self._options["physics"] = one if len(self._parts) == 1 else self._parts
        if encode_angles and self.targets.angles:
            self._options["input_transform"] = AngleInput(self.targets.angles)
        check_factory(model, self._options)
        self.fit_options = checked_fit_options(fit_options)
        self.num_features = num_features
        self.physics_error = checked_physics_error(spec, physics_error)
        self._learnt: Learnt | None = None
        self._probes: list[PhysicsProbes] = []  # of each physics, by its first transitions
        self._means: tuple[GP, GP] | None = None  # of a model: with few draws
        self._root: tuple[GP, Tensor | None] | None = None  # likewise

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
        return 0 if self._learnt is None else len(self._learnt.data.states)

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn from further transitions, beside the earlier ones.

        All unknown numbers are fitted again to all transitions. If this raises an error, what was
        learnt before stands; so it does in all methods below.

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
        values = self._physics_at(data.states, data.actions)
        if before is not None:
            data = before.data.append(data)
        _check_enough_observed(self.spec, data)
        probes = self._probes or self._compared(data, values)
        model = self._built(data, quiet=before is not None)
        self.fit_result = fit(model, **self.fit_options)
        self._probes, self._learnt = probes, Learnt(data, (len(data),), model, model)

    def try_physics(self, states: Tensor, actions: Tensor) -> None:
        """Call the physics once, to find what is wrong with it before there are transitions."""
        self._physics_at(states, actions)

    def condition(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Condition on further transitions with the unknown numbers as they are.

        In :math:`O(n^2 N)` for ``N`` new transitions beside ``n``; the arguments and errors are
        those of :meth:`update`, and a RuntimeError if nothing was learnt yet.
        """
        before = self._known_so_far()
        new = self._checked(states, actions, next_states)
        chunks, model = (*before.chunks, len(new)), self._conditioned(before.model, new)
        self._learnt = before._replace(data=before.data.append(new), chunks=chunks, model=model)

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
            self.spec.complete(states, actions, following), self.spec.complete_variance(variance)
        )

    def before_data(self) -> Dynamics | None:
        """Itself, once it has learnt; before that its physics, if that is a single one."""
        return self if self.is_fitted else self.physics_alone()

    def physics_alone(self) -> Dynamics | None:
        """The physics, with the guesses of unknown parameters; None unless it is a single one."""
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
        """Draw transition functions from the posterior, without noise; see :class:`Dynamics`.

        Raises:
            ValueError: If ``num_functions`` is no positive whole number.
            RuntimeError: If nothing was learnt yet.
        """
        functions: Any = self.model.sample_functions(num_functions, seed, self.num_features)

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            return self._following(states, actions, functions.each)

        return step

    def mean_function(self) -> TransitionFunctions:
        """The mean of the predictions, as a function of any ``k`` blocks, with gradients.

        Of many transitions it is that of two or more of the draws, as many as keep it quick, which
        differ less the more is known.

        Raises:
            RuntimeError: If nothing was learnt yet.
        """
        model = self.model
        if self._means is None or self._means[0] is not model:
            number = min(len(model.u), max(2, _MEAN_ROWS // self.num_transitions))
            rows = ((torch.arange(number) + 0.5) * len(model.u) / number).long()
            self._means = model, model.subset_draws(rows)
        few, posterior = self._means[1], self._means[1].conditioning()
        has_scale = type(few).marginals_of is not Predictive.marginals_of  # as of a link

        def mean(inputs: Tensor) -> Tensor:
            X = inputs.flatten(0, -2)
            if has_scale:
                values = few.predict(X).mean
            else:  # without variances, which cost most
                means = posterior.mean_alone(few.at(X, posterior.train.values))
                values = (means.mean(-3) * few.unit).mT
            return values.unflatten(0, inputs.shape[:-1])

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_pair(states, actions)
            return self._following(states, actions, mean)

        return step

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """The variance of the noise that was learnt, ``N x state_dim``; errors as `predict`."""
        noisy, without = (self._predict(states, actions, noise)[1] for noise in (True, False))
        return self.spec.complete_variance((noisy - without).clamp_min(0.0))

    def noise_root(self) -> Tensor | None:
        """Lower triangular root of the correlation of predicted states' noise; None for none.

        That of their left-out errors, shrunk, of states whose correlation these clearly show.
        """
        model = self.model
        if self._root is None or self._root[0] is not model:
            found = error_correlation(model)
            self._root = model, None if found is None else torch.linalg.cholesky(found)
        return self._root[1]

    def describe(self) -> dict[str, str]:
        """Each setting of these dynamics as a text; of objects, the class."""
        parts = [*self._parts]
        several: dict[str, Any] = {"physics": parts} if len(parts) > 1 else {}
        unknowns: dict[str, str] = {}
        for part in self._parts.values():
            unknowns |= {name: repr(unknown) for name, unknown in part.unknowns.items()}
        if unknowns:
            several["unknowns"] = unknowns
        if self.num_features != _NUM_FEATURES:
            several["num_features"] = self.num_features
        if self.physics_error:
            several["physics_error"] = self.physics_error
        return fingerprint(
            type(self),
            self.spec,
            model=_made_by(self.make_model),
            **several,
            target=self.targets.target,
            encode_angles=self.encode_angles,
            model_options=getattr(self.make_model, "keywords", {}),
            **{"method": None, **self.fit_options},
        )

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values: data, draws, f_p at some rows."""
        if self._learnt is None:
            return {}
        data, chunks, fitted, _ = self._learnt

        def copied(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: tensor.clone() for name, tensor in tensors.items()}

        return {
            "fingerprint": self.describe(),
            "transitions": saved(data),
            "probes": [[tensor.clone() for tensor in each] for each in self._probes],
            "chunks": [*chunks],
            "model": copied(fitted.state_dict()),
            "draws": fitted.draws.clone(),
            "noise": copied(_tensors_of(fitted.noise)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same.

        An empty state, that of dynamics that have learnt nothing, lets them forget. The physics is
        compared at three of the transitions, and evaluated at all of them.

        Raises:
            TypeError: If it is no dictionary.
            RuntimeError: If it is of dynamics of another class, spec, target, model, options or
                physics, or damaged.
            PhysicsError: If the physics fails.
        """
        check_fingerprint(state, self.describe())
        if not state:
            self._learnt = self.fit_result = None
            return
        for name in _STATE:
            if name not in state:
                raise RuntimeError(f"The state is damaged: it lacks {name!r}.")
        data = loaded(state["transitions"], self.spec)
        probes, whole = self._checked_probes(state["probes"]), self._restored(state, data)
        self._probes, self._learnt, self.fit_result = probes, whole, None

    def _checked_probes(self, given: Any) -> list[PhysicsProbes]:
        """Take the probes of a state; a RuntimeError unless the physics is the same there."""
        parts, columns = [*self._parts.values()], self.spec.predicted
        is_list = isinstance(given, list | tuple) and len(given) == len(parts)
        expect(is_list, "probes", f"a list of {len(parts)}, one for each physics")
        probes = [PhysicsProbes.checked(each, self.spec, len(columns)) for each in given]
        for part, each in zip(parts, probes, strict=True):
            part.forget()  # a file of another day: it may have changed
            with torch.no_grad():
                values = part(self.targets.inputs(each.states, each.actions))
            each.check(values, part.name, self.spec, columns)
        return probes

    def _restored(self, state: Mapping[str, Any], data: Trajectories) -> Learnt:
        """Return what a state has learnt from its transitions; a RuntimeError if it is damaged."""
        chunks, parameters, draws, noise = (state[name] for name in _STATE[2:])
        n = len(data)
        sizes: list[Any] = [*chunks] if isinstance(chunks, list | tuple) else [None]
        whole = all(isinstance(size, int) and 1 <= size <= n for size in sizes)
        expect(whole and sum(sizes) == n, "chunks", f"numbers of transitions, {n} in all")
        for name, tensors in (("model", parameters), ("noise", noise), ("draws", {"": draws})):
            whole = isinstance(tensors, Mapping) and all(map(torch.is_tensor, tensors.values()))
            whole = whole and not any(tensor.isnan().any() for tensor in tensors.values())
            expect(whole, name, "tensors without NaN")
        parts = [data.some(rows) for rows in torch.arange(n).split(sizes)]
        fitted = self._built(parts[0], quiet=True)
        if noise:
            own: Any = fitted.noise
            own = type(own)(**{**own.settings, **noise}).of_terms(fitted.term_sum)
            fitted = fitted.with_noise(own)
        fitted.load_state_dict(dict(parameters))
        number, shape = len(fitted.u), fitted.u.shape[1:]
        whole = draws.shape[1:] == shape and len(draws) >= number
        expect(whole, "draws", f"{number} or more coordinates {tuple(shape)}")
        fitted.set_draws(draws.clone(), number)
        model = fitted.eval()
        for part in parts[1:]:
            model = self._conditioned(model, part)
        return Learnt(data, tuple(sizes), fitted, model)

    def _built(self, data: Trajectories, quiet: bool) -> GP:
        """Return the model of some transitions; quiet if an earlier one has given its warnings."""
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")
            model: GP = make_model(self.make_model, *self._rows(data), kind=GP, **self._options)
        names = {name: getattr(self.targets, name) for name in ("input_names", "output_names")}
        model.data = model.data._replace(**names)
        return model

    def _conditioned(self, model: GP, data: Trajectories) -> GP:
        """Return the model with further transitions, its unknown numbers as they are."""
        with torch.no_grad():
            return model.condition_on_observations(*self._rows(data))

    def _rows(self, data: Trajectories) -> tuple[Tensor, Tensor]:
        inputs = self.targets.inputs(data.states, data.actions)
        return inputs, self.targets.encode(data.states, data.next_states)

    def _physics_at(self, states: Tensor, actions: Tensor) -> list[Tensor]:
        """Return the targets by each physics, ``N x m``, with the guesses of parameters."""
        inputs = self.targets.inputs(states, actions)
        with torch.no_grad():
            return [part(inputs) for part in self._parts.values()]

    def _compared(self, data: Trajectories, values: list[Tensor]) -> list[PhysicsProbes]:
        """Warn of a physics that returns differences, and return what each says of some rows."""
        columns = self.spec.predicted
        for part, own in zip(self._parts.values(), values, strict=True):
            change = self.targets.decode(data.states, own) - data.states[:, columns]
            warn_of_differences(part.name, self.spec, data, columns, change)
        return [PhysicsProbes.of(data.states, data.actions, own, columns) for own in values]

    def _varied(
        self, variation: Tensor | float
    ) -> Callable[[int, int | None], TransitionFunctions]:
        """Like `sample_functions`, each function with parameters of its own."""
        learnt = self._known_so_far()
        if self.physics is None or not self.physics.unknowns:
            return super()._varied(variation)
        drawn = learnt.model.physics_parameters
        vary = varying_parameters(self.physics, self.spec, drawn, learnt.data.actions, variation)

        def sample_functions(num_functions: int, seed: int | None = None) -> TransitionFunctions:
            functions = self.sample_functions(num_functions, seed)
            change = vary(num_functions, seed)

            def step(states: Tensor, actions: Tensor) -> Tensor:
                return functions(states, actions) + change(states, actions)

            return step

        return sample_functions

    def _known_so_far(self) -> Learnt:
        if self._learnt is None:
            raise RuntimeError(
                f"{type(self).__name__} has not learnt from transitions yet; call `update`."
            )
        return self._learnt

    def _following(
        self, states: Tensor, actions: Tensor, learnt: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """The next states by what was learnt of their inputs."""
        values = learnt(self.targets.inputs(states, actions))
        return self.spec.complete(states, actions, self.targets.decode(states, values))

    def _predict(
        self, states: Tensor, actions: Tensor, observation_noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance of the predicted states, ``... x len(spec.predicted)``."""
        self._check_pair(states, actions)
        X = self.targets.inputs(states, actions)
        with torch.no_grad():
            flat = X.reshape(-1, X.shape[-1])
            mean, variance = self.model.predict(flat, observation_noise=observation_noise)
        mean, variance = (t.reshape(*X.shape[:-1], t.shape[-1]) for t in (mean, variance))
        return self.targets.decode(states, mean), variance


def _tensors_of(noise: Any) -> dict[str, Tensor]:
    """Return what a fit has learnt of single observations."""
    settings = getattr(noise, "settings", {})
    return {name: value for name, value in settings.items() if isinstance(value, Tensor)}


def check_factory(make: Any, options: Mapping[str, Any]) -> None:
    """Raise a TypeError unless a model can be made of inputs, targets and these options."""
    if isinstance(make, Module) or not callable(make):
        is_module = isinstance(make, Module)
        found = f"an instance of {type(make).__name__}" if is_module else repr(make)
        raise TypeError(
            "Expected model as what makes one of (X, Y, physics=...): a class of gpadjust, such "
            "as CKA, PhysicsMeanGP or ZeroMeanGP, a functools.partial of it with further "
            f"arguments, or a function; found {found}."
        )
    taken = {"train_X", "train_Y", "train_Yvar", "physics", "input_transform"}
    if isinstance(make, partial) and (own := sorted(taken & {*make.keywords})):
        raise TypeError(
            f"Expected a model whose data and physics come from the dynamics; found {own[0]} in "
            "the functools.partial: leave it out, and give the physics to the dynamics."
        )
    inner, has_physics = _made_by(make), "physics" in options
    name = getattr(inner, "__name__", repr(inner))
    if has_physics and isinstance(inner, type) and issubclass(inner, ZeroMeanGP):
        raise TypeError(
            f"{name} takes no physics, but one was given: leave it out, or take model=CKA, which "
            "adjusts it."
        )
    try:
        signature(make).bind(None, None, **options)
    except TypeError as error:
        hint = "; pass `physics`, or take model=ZeroMeanGP, which learns without one"
        raise TypeError(
            f"{name} cannot make the model from (X, Y, {', '.join(f'{o}=...' for o in options)}): "
            f"{error}{'' if has_physics else hint}."
        ) from None


def checked_fit_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the options of :func:`gpadjust.fit`, without those that are None."""
    checked = checked_options("fit_options", options, ("method", "num_draws", "seed"))
    checked = {name: value for name, value in checked.items() if value is not None}
    check_choice("method", checked.get("method", "bayes"), ("bayes", "map"))
    return checked


def _check_enough_observed(spec: StateSpec, data: Trajectories) -> None:
    """Raise a ValueError unless each predicted state was measured in two transitions or more."""
    observed = ~data.next_states[:, spec.predicted].isnan()
    least, i = observed.sum(0).min(0)
    if least < 2:
        name = spec.states[spec.predicted[i]]
        of = "" if len(observed) < 2 else f" with a measured {name!r}"
        raise ValueError(
            f"Expected at least 2 transitions to learn from, got {least}{of}: there is no scale in "
            "fewer. Collect more before the first update."
        )


def _made_by(make: Any) -> Any:
    """The function or class that a partial is of."""
    return _made_by(make.func) if isinstance(make, partial) else make
