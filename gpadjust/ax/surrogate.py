"""Registration in Ax: building, fitting, saving and loading of this room's models."""

from __future__ import annotations

from typing import Any

from ax.core.search_space import SearchSpaceDigest
from ax.exceptions.storage import JSONEncodeError
from ax.generators.torch.botorch_modular.surrogate import Surrogate, submodel_input_constructor
from ax.generators.torch.botorch_modular.utils import ModelConfig, fit_botorch_model
from ax.storage.botorch_modular_registry import register_model
from ax.storage.json_store.registry import CORE_DECODER_REGISTRY, CORE_ENCODER_REGISTRY
from ax.storage.transform_registry import register_transform
from botorch.utils.datasets import SupervisedDataset
from botorch.utils.types import DEFAULT

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.tell_physics import TellPhysics
from gpadjust.ax.units import PhysicsInUnits
from gpadjust.core import CKA, GP, RRA, CalibratedPhysics, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit
from gpadjust.kinds.factory import map_parts

_TRANSFORMS = ("outcome_transform_classes", "input_transform_classes")
_PARTS = ("covar_module_class", "likelihood_class", *_TRANSFORMS)


def register() -> None:
    """Enter functions, models, transform and physics into Ax's registries."""
    # Dispatch on the class of a model.
    submodel_input_constructor.register(GP)(model_inputs)
    fit_botorch_model.register(GP)(fit_model)
    for model in (CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP, CalibratedPhysics):
        register_model(model)
    register_transform(TellPhysics)
    # Ax saves a ModelConfig as JSON.
    CORE_ENCODER_REGISTRY[ParameterPhysics] = as_dict
    CORE_DECODER_REGISTRY[ParameterPhysics.__name__] = ParameterPhysics


def model_inputs(
    botorch_model_class: type[GP],
    model_config: ModelConfig,
    dataset: SupervisedDataset,
    search_space_digest: SearchSpaceDigest,
    surrogate: Surrogate,
) -> dict[str, Any]:
    """Return the arguments of a model: the data after Ax's transforms, and ``model_options``.

    Raise a ValueError if a physics is not behind ``TellPhysics``, or the config has classes of
    parts: the models scale inputs and targets themselves.
    """
    name = botorch_model_class.__name__
    parts = [part for part in _PARTS if getattr(model_config, part) not in (None, [], DEFAULT)]
    if parts:
        raise ValueError(
            f"{name} makes its own parts; found {', '.join(parts)} in ModelConfig. Put arguments "
            "of the model in model_options, such as {'delta_covar_module': ...}."
        )
    # Columns that stand for a task or a fidelity need a kernel of their own.
    kinds = ("task", "fidelity", "categorical")
    special = [kind for kind in kinds if getattr(search_space_digest, f"{kind}_features")]
    if special:
        raise ValueError(
            f"{name} has no kernel for {' and '.join(special)} parameters. Leave categories to "
            "OneHot (transforms=gpadjust.ax.TRANSFORMS); give each task or fidelity its own model."
        )

    def check_units(part: Any) -> None:
        # Without TellPhysics f_p would get the inputs of the model, such as logarithms.
        if not isinstance(part, PhysicsInUnits) or part.units.names != tuple(dataset.feature_names):
            raise ValueError(
                f"The physics of {', '.join(dataset.outcome_names)} would get inputs after Ax's "
                "transforms, in other units than the search space. Make TellPhysics the last "
                "transform, generator_kwargs={'surrogate_spec': ..., 'transforms': "
                "gpadjust.ax.TRANSFORMS}, or use gpadjust.ax.generation_strategy."
            )

    if (physics := model_config.model_options.get("physics")) is not None:
        map_parts(check_units, physics)
    return {**botorch_model_class.construct_inputs(dataset), **model_config.model_options}


def fit_model(model: GP, mll_class: Any, mll_options: dict[str, Any] | None = None) -> None:
    """Fit a model by :func:`gpadjust.fit` with ``mll_options``."""
    fit(model, **(mll_options or {}))


def as_dict(physics: ParameterPhysics) -> dict[str, Any]:
    """Return a physics in Ax's format, or raise a JSONEncodeError if it has no import path."""
    if physics.path is None:
        raise JSONEncodeError(
            f"Ax cannot save the physics {physics.name!r}: expected a name in a module, no lambda. "
            "Write `def f_p(...)`, or `f_p = BlackBoxPhysics(...)`, in a file to import."
        )
    return {"__type": ParameterPhysics.__name__, "physics": physics.path}
