"""Models of transitions: how they are made, and fitted again as transitions come."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from inspect import signature
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.checks import check_choice, checked_options
from gpadjust.core import GP, FitResult, ZeroMeanGP, fit
from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.state import PhysicsProbes, copies, expect, loaded, saved
from gpadjust.dynamics.targets import TargetPhysics, Targets, warn_of_differences
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.kinds.factory import ModelFactory, make_model
from gpadjust.physics import Physics
from gpadjust.states import StateSpec

_STATE = ("transitions", "physics", "chunks", "model", "draws", "noise")


class Learnt(NamedTuple):
    """Transitions, and the model of them; replaced as a whole, so that no error leaves half."""

    data: Trajectories
    known: Tensor | None  # what the physics says of the targets there
    chunks: tuple[int, ...]  # numbers of transitions: fitted, then conditioned on in turn
    fitted: GP  # of the first chunk
    model: GP  # of all

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
            "model": {name: t.clone() for name, t in self.fitted.state_dict().items()},
            "draws": self.fitted.draws.clone(),
            "noise": {name: t.clone() for name, t in _tensors_of(self.fitted.noise).items()},
        }

    @staticmethod
    def loaded(state: Mapping[str, Any], recipe: Recipe) -> Learnt:
        """Return a copy of a state's entries; a RuntimeError if one is missing or wrong."""
        for name in _STATE:
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
        chunks, parameters, draws, noise = (state[name] for name in _STATE[2:])
        sizes: list[Any] = [*chunks] if isinstance(chunks, list | tuple) else [None]
        whole = all(isinstance(size, int) and 1 <= size <= n for size in sizes)
        expect(whole and sum(sizes) == n, "chunks", f"numbers of transitions, {n} in all")
        for name, tensors in (("model", parameters), ("noise", noise), ("draws", {"": draws})):
            whole = isinstance(tensors, Mapping) and all(map(torch.is_tensor, tensors.values()))
            whole = whole and not any(tensor.isnan().any() for tensor in tensors.values())
            expect(whole, name, "tensors without NaN")
        parts = [data.some(rows) for rows in torch.arange(n).split(sizes)]
        with recipe.restored_on_error():
            recipe.tell_physics(data, known)
            fitted = recipe.build(parts[0], quiet=True)
            if noise:
                own: Any = fitted.noise
                own = type(own)(**{**own.settings, **noise}).of_terms(fitted.term_sum)
                fitted = fitted.with_noise(own)
            fitted.load_state_dict(dict(parameters))
            number, shape = len(fitted.u), fitted.u.shape[1:]
            whole = draws.shape[1:] == shape and len(draws) >= number
            expect(whole, "draws", f"{number} or more coordinates {tuple(shape)}")
            fitted.set_draws(draws.clone(), number)
            recipe.check_same_physics(data, known)
            model = fitted.eval()
            for part in parts[1:]:
                model = recipe.condition(model, part)
        return Learnt(data, known, tuple(sizes), fitted, model)


class Recipe:
    """Makes the models of dynamics, and asks their physics about transitions.

    Raises:
        TypeError: If ``make`` does not take the arguments of a model, or lacks one.
    """

    def __init__(
        self,
        targets: Targets,
        physics: Mapping[str, Physics],
        make: ModelFactory,
        encode_angles: bool,
    ) -> None:
        self.targets = targets
        self.parts = {name: TargetPhysics(part, targets) for name, part in physics.items()}
        self.options: dict[str, Any] = {}
        if self.parts:
            self.options["physics"] = self.parts
            if len(self.parts) == 1:
                (self.options["physics"],) = self.parts.values()
        if encode_angles and targets.angles:
            self.options["input_transform"] = AngleInput(targets.angles)
        check_factory(make, self.options)
        self.make = make

    def build(self, data: Trajectories, quiet: bool) -> GP:
        """The model of some transitions; quiet where the first one has given its warnings."""
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")
            model: GP = make_model(self.make, *self._rows(data), kind=GP, **self.options)
        names = {name: getattr(self.targets, name) for name in ("input_names", "output_names")}
        model.data = model.data._replace(**names)
        return model

    def condition(self, model: GP, data: Trajectories) -> GP:
        """The model with further transitions, its unknown numbers as they are."""
        with torch.no_grad():
            return model.condition_on_observations(*self._rows(data))

    def physics_at(self, states: Tensor, actions: Tensor) -> Tensor | None:
        """Targets by the physics, those of its parts side by side."""
        if not self.parts:
            return None
        inputs = self.targets.inputs(states, actions)
        with torch.no_grad():
            return torch.cat([part(inputs) for part in self.parts.values()], -1)

    def tell_physics(self, data: Trajectories, known: Tensor | None) -> None:
        """Give the physics its values at some transitions, so that it need not run there again."""
        inputs = self.targets.inputs(data.states, data.actions)
        for part, own in self._of_parts(known):
            part.know(inputs, own)

    def compare_physics(self, data: Trajectories, known: Tensor | None) -> None:
        """Warn of a physics that returns differences."""
        predicted = self.targets.spec.predicted
        for part, own in self._of_parts(known):
            change = self.targets.decode(data.states, own) - data.states[:, predicted]
            warn_of_differences(part.name, self.targets.spec, data, predicted, change)

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
        """Leave what the physics was told as it was if there is an error."""
        known = {part: part.known for part in self.parts.values()}
        try:
            yield
        except BaseException:
            for part, before in known.items():
                part.known = before
            raise

    def fit(
        self, data: Trajectories, is_first: bool, options: Mapping[str, Any]
    ) -> tuple[GP, FitResult]:
        """Fit a model of all transitions, and return it and what the fit has found."""
        model = self.build(data, quiet=not is_first)
        return model, fit(model, **options)

    def _of_parts(self, known: Tensor | None) -> Iterator[tuple[TargetPhysics, Tensor]]:
        if known is not None:
            values = known.split(len(self.targets.predicted), dim=-1)
            yield from zip(self.parts.values(), values, strict=True)

    def _rows(self, data: Trajectories) -> tuple[Tensor, Tensor]:
        inputs = self.targets.inputs(data.states, data.actions)
        return inputs, self.targets.encode(data.states, data.next_states)


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


def checked_fit_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the options of :func:`gpadjust.fit`, without those that are None."""
    checked = checked_options("fit_options", options, ("method", "num_draws", "seed"))
    checked = {name: value for name, value in checked.items() if value is not None}
    check_choice("method", checked.get("method", "bayes"), ("bayes", "map"))
    return checked


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
