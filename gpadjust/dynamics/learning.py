"""Models of transitions: how they are made, and fitted again as transitions come."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from functools import partial
from inspect import signature
from typing import Any, NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor
from torch.nn import Module

from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.state import PhysicsProbes, copies, expect, loaded, saved
from gpadjust.dynamics.targets import TargetPhysics, Targets, parts_of, warn_of_differences
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.inference import FitOptions, FitResult, SampleResult, fit
from gpadjust.inference.fitting import check_options
from gpadjust.inference.warm_start import warm_start
from gpadjust.models import TermsModel, ZeroMeanGP
from gpadjust.models.factory import ModelFactory, make_model
from gpadjust.physics import Physics, as_physics
from gpadjust.states import StateSpec

_SEARCH = FitOptions(num_screened=64, num_starts=4, max_iterations=30)
_REFIT = FitOptions(num_screened=0, num_starts=1, max_iterations=15)


class DynamicsFitOptions(FitOptions, total=False):
    """The options of :func:`gpadjust.fit` for dynamics, the method among them."""

    method: str | None


class Learnt(NamedTuple):
    """Transitions, and the model of them; replaced as a whole, so that no error leaves half."""

    data: Trajectories
    known: Tensor | None  # what the physics says of the targets there
    chunks: tuple[int, ...]  # numbers of transitions: fitted, then conditioned on in turn
    searched_at: int  # number of transitions at the last search of the hyper-parameters
    fitted: TermsModel  # of the first chunk
    model: TermsModel  # of all

    def with_rows(self, data: Trajectories, known: Tensor | None) -> tuple[Trajectories, Any]:
        """All transitions, and what the physics says there, with those of further ones."""
        if self.known is not None and known is not None:
            known = torch.cat([self.known, known])
        return self.data.append(data), known

    def state_dict(self) -> dict[str, Any]:
        """All of it in tensors and plain values."""
        return {
            "transitions": saved(self.data),
            "physics": None if self.known is None else self.known.clone(),
            "chunks": [*self.chunks],
            "searched_at": self.searched_at,
            "model": {name: t.clone() for name, t in self.fitted.state_dict().items()},
        }

    @staticmethod
    def loaded(state: Mapping[str, Any], recipe: Recipe) -> Learnt:
        """Return a copy of a state's entries; a RuntimeError if one is missing or wrong."""
        for name in ("transitions", "physics", "chunks", "searched_at", "model"):
            if name not in state:
                raise RuntimeError(f"The state is damaged: it lacks {name!r}.")
        data, known = loaded(state["transitions"], recipe.targets.spec), state["physics"]
        n, num_known = len(data.states), len(recipe.parts) * len(recipe.targets.predicted)
        if (known is None) != (num_known == 0):
            there, here = ("out", "one") if known is None else ("", "none")
            raise RuntimeError(
                f"The state is of dynamics with{there} a physics, but there is {here} here. Load "
                "it into dynamics built as they were."
            )
        if known is not None:
            (known,) = copies([known], "physics", (n, num_known))
        chunks, searched_at, parameters = (state[k] for k in ("chunks", "searched_at", "model"))
        sizes: list[Any] = [*chunks] if isinstance(chunks, list | tuple) else [None]
        whole = all(isinstance(size, int) and 1 <= size <= n for size in sizes)
        expect(whole and sum(sizes) == n, "chunks", f"numbers of transitions, {n} in all")
        whole = isinstance(searched_at, int) and 1 <= searched_at <= n
        expect(whole, "searched_at", f"a number of transitions, at most {n}")
        whole = isinstance(parameters, Mapping) and all(map(torch.is_tensor, parameters.values()))
        whole = whole and not any(tensor.isnan().any() for tensor in parameters.values())
        expect(whole, "model", "a dictionary of tensors without NaN")
        parts = [data.some(rows) for rows in torch.arange(n).split(sizes)]
        with recipe.restored_on_error():
            recipe.tell_physics(data, known)
            fitted = recipe.build(parts[0], quiet=True)
            fitted.load_state_dict(dict(parameters))
            recipe.check_same_physics(data, known)
            model = fitted.eval()
            for part in parts[1:]:
                model = recipe.condition(model, part)
        return Learnt(data, known, tuple(sizes), searched_at, fitted, model)


class Recipe:
    """Makes the models of dynamics, and asks their physics about transitions.

    Raises:
        TypeError: If ``make`` does not take the arguments of a model, or lacks one.
    """

    def __init__(
        self, targets: Targets, physics: Physics | None, make: ModelFactory, encode_angles: bool
    ) -> None:
        self.targets = targets
        self.parts = {
            name: TargetPhysics(part, targets)
            for name, part in ({} if physics is None else parts_of(physics)).items()
        }
        self.physics = as_physics(self.parts) if self.parts else None
        self.options: dict[str, Any] = {} if self.physics is None else {"physics": self.physics}
        if encode_angles and targets.angles:
            self.options["input_transform"] = AngleInput(targets.angles)
        check_factory(make, self.options)
        self.make = make

    def build(self, data: Trajectories, quiet: bool) -> TermsModel:
        """The model of some transitions; quiet where the first one has given its warnings."""
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")
            given = {n: v if n == "physics" else deepcopy(v) for n, v in self.options.items()}
            model: TermsModel = make_model(self.make, *self._rows(data), kind=TermsModel, **given)
        model.input_names = self.targets.input_names
        model.output_names = self.targets.output_names
        return model

    def condition(self, model: TermsModel, data: Trajectories) -> TermsModel:
        """The model with further transitions, its hyper-parameters as they are."""
        with torch.no_grad():
            return model.condition_on_observations(*self._rows(data))

    def physics_at(self, states: Tensor, actions: Tensor) -> Tensor | None:
        """Targets by the physics, those of its parts side by side."""
        if self.physics is None:
            return None
        with torch.no_grad():
            return self.physics(self.targets.inputs(states, actions))

    def tell_physics(self, data: Trajectories, known: Tensor | None) -> None:
        """Give the physics its values at some transitions, so that it need not run there again."""
        inputs = self.targets.inputs(data.states, data.actions)
        for part, own in self._of_parts(known):
            part.know(inputs, own)

    def compare_physics(self, data: Trajectories, known: Tensor | None) -> None:
        """Warn of a physics that returns differences."""
        predicted = self.targets.spec.predicted
        for name, (_, own) in zip(self.parts, self._of_parts(known), strict=False):
            change = self.targets.decode(data.states, own) - data.states[:, predicted]
            warn_of_differences(name, self.targets.spec, data, predicted, change)

    def check_same_physics(self, data: Trajectories, known: Tensor | None) -> None:
        """Raise a RuntimeError if the physics says something else at 3 of the transitions."""
        spec, columns = self.targets.spec, self.targets.spec.predicted
        for part, own in self._of_parts(known):
            probes = PhysicsProbes.of(data.states, data.actions, own, columns)
            inputs = self.targets.inputs(probes.states, probes.actions)
            guess = part.unknowns.guess.expand(len(inputs), -1)
            with torch.no_grad():
                found = part.fresh_rows(torch.cat([inputs, guess], dim=-1))
            probes.check(found, part.name, spec, columns)

    @contextmanager
    def restored_on_error(self) -> Iterator[None]:
        """Leave the physics, and what it was told, as it was if there is an error."""
        with ExitStack() as stack:
            for part in self.parts.values():
                stack.enter_context(part.restored_on_error())
            yield

    @property
    def physics_learns(self) -> bool:
        """True if the physics has parameters to learn, so that its values change with a fit."""
        return any(p.requires_grad for part in self.parts.values() for p in part.parameters())

    def fit(
        self, data: Trajectories, previous: Learnt | None, options: DynamicsFitOptions
    ) -> tuple[TermsModel, FitResult | SampleResult, int]:
        """Fit a model of all transitions, from where the one of earlier ones was, if there is one.

        Returns:
            The model, what the fit has reached, and the number of transitions at the last search
            of the hyper-parameters.
        """
        n, given = len(data.states), dict[str, Any](options)
        model = self.build(data, quiet=previous is not None)
        if previous is None:
            return model, fit(model, **given), n
        warm_start(model, previous.model)
        searches = n >= 2 * previous.searched_at
        with warnings.catch_warnings():
            # The next update goes on from where this one stops.
            warnings.simplefilter("ignore", OptimizationWarning)
            result = fit(model, **kept(given), **(_SEARCH if searches else _REFIT))
        return model, result, n if searches else previous.searched_at

    def _of_parts(self, known: Tensor | None) -> Iterator[tuple[TargetPhysics, Tensor]]:
        if known is not None:
            values = known.split(len(self.targets.predicted), dim=-1)
            yield from zip(self.parts.values(), values, strict=True)

    def _rows(self, data: Trajectories) -> tuple[Tensor, Tensor]:
        inputs = self.targets.inputs(data.states, data.actions)
        return inputs, self.targets.encode(data.states, data.next_states)


def check_factory(make: Any, options: Mapping[str, Any]) -> None:
    """Raise a TypeError unless a model can be made of inputs, targets and these options."""
    if isinstance(make, Module) or not callable(make):
        is_module = isinstance(make, Module)
        found = f"an instance of {type(make).__name__}" if is_module else repr(make)
        raise TypeError(
            "Expected model as what makes one of (X, Y, physics=...): a class of gpadjust.models, "
            "such as CKA, PhysicsMeanGP or ZeroMeanGP, a functools.partial of it with further "
            f"arguments, or a function; found {found}."
        )
    taken = {"train_X", "train_Y", "train_Yvar", "physics", "input_transform"}
    if isinstance(make, partial) and (own := sorted(taken & {*make.keywords})):
        raise TypeError(
            f"Expected a model whose data and physics come from the dynamics; found {own[0]} in "
            "the functools.partial: leave it out, and give the physics to the dynamics."
        )
    inner, has_physics = made_by(make), "physics" in options
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


def checked_fit_options(options: DynamicsFitOptions | None, make: Any) -> DynamicsFitOptions:
    """The options of the first fit, once they are found to be right."""
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(
            f"Expected fit_options as a dictionary of options of gpadjust.fit, found {options!r}."
        )
    own: Any = {**(options or {})}
    method = own.pop("method", None)
    if why := getattr(made_by(make), "not_sampled", ""):
        if method == "bayes":
            raise ValueError(why)
        method = method or "map"
    check_options("bayes" if method is None else method, own)
    return {**(options or {})}


def kept(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that later fits have, too: all but those of the first search."""
    return {name: value for name, value in options.items() if name not in _REFIT}


def check_enough_observed(spec: StateSpec, data: Trajectories) -> None:
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


def made_by(make: Any) -> Any:
    """The function or class that a partial is of."""
    return made_by(make.func) if isinstance(make, partial) else make
