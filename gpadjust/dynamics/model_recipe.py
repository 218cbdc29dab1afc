"""How the model of some transitions is built."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.next_state_physics import parts_of, warn_of_differences
from gpadjust.dynamics.physics_probes import PhysicsProbes
from gpadjust.dynamics.transition_physics import TransitionPhysics, TransitionTargets
from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import TermsModel
from gpadjust.models.terms_gp import arguments_of
from gpadjust.physics import Physics, as_physics

_OWN = ("train_X", "train_Y", "train_Yvar", "physics", "input_transform")


class ModelRecipe:
    """Builds the models of dynamics, and asks their physics about transitions.

    Args:
        targets: What the models learn.
        physics: The physics of next states, or None.
        model: The class of the models.
        options: Further arguments of the class.
        encode_angles: Whether the models read the sine and cosine of angles.

    Raises:
        TypeError: If ``model`` is no class of models, needs a physics that is missing or takes none
            that is given, or ``options`` is no mapping.
        ValueError: If the class does not take an option, or needs one.
    """

    def __init__(
        self,
        targets: TransitionTargets,
        physics: Physics | None,
        model: type[TermsModel],
        options: Mapping[str, Any] | None,
        encode_angles: bool,
    ) -> None:
        self.targets = targets
        self.model_class = model
        self.options = checked_options(model, physics is not None, options)
        self.parts = {
            name: TransitionPhysics(part, targets)
            for name, part in ({} if physics is None else parts_of(physics)).items()
        }
        self.physics = as_physics(self.parts) if self.parts else None
        self.columns = targets.angles if encode_angles else []

    def build(self, data: Transitions, quiet: bool) -> TermsModel:
        """The model of some transitions; quiet where the first one has given its warnings."""
        options = {
            name: deepcopy(value) if isinstance(value, Module) else value
            for name, value in self.options.items()
        }
        if self.physics is not None:
            options["physics"] = self.physics
        if self.columns:
            options["input_transform"] = AngleInput(self.columns)
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")
            make: Callable[..., TermsModel] = self.model_class
            model = make(*self._rows(data), **options)
        model.input_names = self.targets.input_names
        model.output_names = self.targets.output_names
        return model

    def condition(self, model: TermsModel, data: Transitions) -> TermsModel:
        """The model with further transitions, its hyper-parameters as they are."""
        with torch.no_grad():
            return model.condition_on_observations(*self._rows(data))

    def physics_at(self, data: Transitions) -> Tensor | None:
        """What the physics says of the targets, those of its parts side by side."""
        if self.physics is None:
            return None
        with torch.no_grad():
            return self.physics(self.targets.inputs(data.states, data.actions))

    def tell_physics(self, data: Transitions, known: Tensor | None) -> None:
        """Give the physics its values at some transitions, so that it need not run there again."""
        inputs = self.targets.inputs(data.states, data.actions)
        for part, own in self._of_parts(known):
            part.know(inputs, own)

    def compare_physics(self, data: Transitions, known: Tensor | None) -> None:
        """Warn of a physics that returns differences."""
        predicted = self.targets.spec.predicted
        for part, own in self._of_parts(known):
            change = self.targets.decode(data.states, own) - data.states[:, predicted]
            name = next(name for name, each in self.parts.items() if each is part)
            warn_of_differences(name, self.targets.spec, data, predicted, change)

    def check_same_physics(self, data: Transitions, known: Tensor | None) -> None:
        """Raise a RuntimeError if the physics says something else at 3 of the transitions."""
        spec, columns = self.targets.spec, self.targets.spec.predicted
        for part, own in self._of_parts(known):
            probes = PhysicsProbes.of(data.states, data.actions, own, columns)
            with torch.no_grad():
                found = part.anew(self.targets.inputs(probes.states, probes.actions))
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
        """Whether the physics has parameters to learn, so that what it says changes with a fit."""
        return any(p.requires_grad for part in self.parts.values() for p in part.parameters())

    def _of_parts(self, known: Tensor | None) -> Iterator[tuple[TransitionPhysics, Tensor]]:
        if known is not None:
            values = known.split(len(self.targets.predicted), dim=-1)
            yield from zip(self.parts.values(), values, strict=True)

    def _rows(self, data: Transitions) -> tuple[Tensor, Tensor]:
        inputs = self.targets.inputs(data.states, data.actions)
        return inputs, self.targets.encode(data.states, data.next_states)


def checked_options(
    model: type[TermsModel], has_physics: bool, options: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The further arguments of a class of models, once they and the class are found to be right."""
    if not isinstance(model, type) or not issubclass(model, TermsModel):
        is_module = isinstance(model, Module)
        found = f"an instance of {type(model).__name__}" if is_module else repr(model)
        raise TypeError(
            "Expected model as a class of gpadjust.models, such as CKA, PhysicsMeanGP or "
            f"ZeroMeanGP, or one of your own on TermsGP; found {found}. Its arguments go into "
            "model_options."
        )
    name, takes = model.__name__, arguments_of(model)
    if takes.get("physics") and not has_physics:
        raise TypeError(
            f"{name} adjusts a physics, but none was given: pass `physics`, or take "
            "model=ZeroMeanGP, which learns without one."
        )
    if has_physics and "physics" not in takes:
        raise TypeError(
            f"{name} takes no physics, but one was given: leave it out, or take model=CKA, which "
            "adjusts it."
        )
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(
            f"Expected model_options as a dictionary of arguments of {name}, found {options!r}."
        )
    options = dict(options or {})
    for option in options:
        if option in _OWN:
            raise ValueError(f"model_options may not hold {option!r}, which dynamics set.")
        if option not in takes:
            known = ", ".join(each for each in takes if each not in _OWN)
            raise ValueError(f"{name} does not take {option!r} of model_options; it takes {known}.")
    missing = [each for each, needed in takes.items() if needed and each not in (*_OWN, *options)]
    if missing:
        raise ValueError(
            f"{name} needs {', '.join(missing)} besides: give them in model_options, or take a "
            "class that sets them itself."
        )
    return options
