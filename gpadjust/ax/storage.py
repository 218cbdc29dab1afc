"""How Ax saves and loads what is of this room."""

from __future__ import annotations

from typing import Any

from ax.exceptions.storage import JSONEncodeError
from ax.storage.botorch_modular_registry import register_model
from ax.storage.json_store.registry import CORE_DECODER_REGISTRY, CORE_ENCODER_REGISTRY
from ax.storage.transform_registry import register_transform

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.physics_optimum_node import PhysicsOptimumNode
from gpadjust.ax.tell_physics import TellPhysics
from gpadjust.models import CKA, RRA, CalibratedPhysics, PhysicsMeanGP, ScaleGP, ZeroMeanGP


def register() -> None:
    """Enter models, transform, node and physics in Ax's registries."""
    for model in (CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP, CalibratedPhysics):
        register_model(model)
    register_transform(TellPhysics)
    CORE_ENCODER_REGISTRY[ParameterPhysics] = as_dict
    CORE_DECODER_REGISTRY[ParameterPhysics.__name__] = ParameterPhysics
    CORE_DECODER_REGISTRY[PhysicsOptimumNode.__name__] = PhysicsOptimumNode


def as_dict(physics: ParameterPhysics) -> dict[str, Any]:
    """A physics as Ax saves it: by its import path.

    Raises:
        JSONEncodeError: If it has none.
    """
    if physics.path is None:
        raise JSONEncodeError(
            f"Ax cannot save the physics {physics.name!r}: found a lambda or a function or object "
            "inside of another, expected one with a name in a module. Write `def f_p(...)`, or "
            "`f_p = BlackBoxPhysics(...)`, in a file that can be imported, and make the generation "
            "strategy of that."
        )
    return {"__type": ParameterPhysics.__name__, "physics": physics.path}
