"""Dynamics learnt by a Gaussian process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_switch, checked_whole
from gpadjust.core import CKA, GP, FitResult, Prediction
from gpadjust.core.model import Predictive
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.joint_errors import error_correlation
from gpadjust.dynamics.learning import (
    Learnt,
    Recipe,
    check_enough_observed,
    checked_fit_options,
    made_by,
)
from gpadjust.dynamics.particles import varying_parameters
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.state import check_fingerprint, fingerprint
from gpadjust.dynamics.targets import Target, Targets, checked_physics_error, named_physics
from gpadjust.kinds.factory import ModelFactory
from gpadjust.states import StateSpec

_NUM_FEATURES = 1024  # by default
_MEAN_ROWS = 200  # kernel rows of a mean: transitions times draws


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
        self._recipe = Recipe(self.targets, parts, model, encode_angles)
        self.fit_options = checked_fit_options(fit_options)
        self.num_features = num_features
        self.physics_error = checked_physics_error(spec, physics_error)
        self._learnt: Learnt | None = None
        self._compared = False  # the physics with transitions
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
        data = self._checked(states, actions, next_states)
        known, previous = self._recipe.physics_at(data.states, data.actions), self._learnt
        if previous is not None:
            data, known = previous.with_rows(data, known)
        check_enough_observed(self.spec, data)
        with self._recipe.restored_on_error():
            if previous is None and not self._compared:
                self._recipe.compare_physics(data, known)
            self._recipe.tell_physics(data, known)
            model, result = self._recipe.fit(data, previous is None, self.fit_options)
        self._compared = self._compared or previous is None
        self.fit_result = result
        self._learnt = Learnt(data, known, (len(data.states),), model, model)

    def try_physics(self, states: Tensor, actions: Tensor) -> None:
        """Call the physics once, to find what is wrong with it before there are transitions."""
        self._recipe.physics_at(states, actions)

    def condition(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Condition on further transitions with the unknown numbers as they are.

        In :math:`O(n^2 N)` for ``N`` new transitions beside ``n``; the arguments and errors are
        those of :meth:`update`, and a RuntimeError if nothing was learnt yet.
        """
        before = self._known_so_far()
        new = self._checked(states, actions, next_states)
        data, known = before.with_rows(new, self._recipe.physics_at(new.states, new.actions))
        self._learnt = before._replace(
            data=data,
            known=known,
            chunks=(*before.chunks, len(new.states)),
            model=self._recipe.condition(before.model, new),
        )

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
        parts = [*self._recipe.parts]
        several: dict[str, Any] = {"physics": parts} if len(parts) > 1 else {}
        unknowns: dict[str, str] = {}
        for part in self._recipe.parts.values():
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
            model=made_by(self.make_model),
            **several,
            target=self.targets.target,
            encode_angles=self.encode_angles,
            model_options=getattr(self.make_model, "keywords", {}),
            **{"method": None, **self.fit_options},
        )

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values: data, f_p there, draws."""
        if self._learnt is None:
            return {}
        return {"fingerprint": self.describe(), **self._learnt.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same.

        An empty state, that of dynamics that have learnt nothing, lets them forget. The physics is
        asked about at most three of the transitions, whether it is the one that they were learnt
        with; a physics that is costly runs for these.

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
        self._learnt, self.fit_result = Learnt.loaded(state, self._recipe), None

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
