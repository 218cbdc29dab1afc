"""Ax's generation strategy, with a physics."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from ax.adapter.registry import MBM_X_trans
from ax.adapter.transforms.base import Transform
from ax.adapter.transforms.derelativize import Derelativize
from ax.adapter.transforms.standardize_y import StandardizeY
from ax.api.utils.generation_strategy_dispatch import choose_generation_strategy
from ax.api.utils.structs import GenerationStrategyDispatchStruct
from ax.generation_strategy.generation_strategy import GenerationStrategy
from ax.generators.torch.botorch_modular.surrogate import SurrogateSpec
from ax.generators.torch.botorch_modular.utils import ModelConfig

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.tell_physics import TellPhysics
from gpadjust.core import CKA, GP, ZeroMeanGP
from gpadjust.kinds.factory import map_parts

TRANSFORMS: list[type[Transform]] = [*MBM_X_trans, Derelativize, StandardizeY, TellPhysics]
"""Ax's transforms of parameters; of metrics shift and scale alone; and ``TellPhysics``."""


def generator_kwargs(
    physics: Mapping[str, Any],
    *,
    model: type[GP] | partial[GP] = CKA,
    fit_options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return ``surrogate_spec`` and ``transforms`` of Ax's ``BOTORCH_MODULAR`` generator.

    Args:
        physics: The physics of metrics by the metrics' names, see :class:`ParameterPhysics`;
            several for one metric as a list, or a dictionary with their names.
        model: The model of these metrics: a class, or ``functools.partial`` of one with further
            arguments, whose units are those after Ax's transforms. The other metrics have a
            :class:`~gpadjust.ZeroMeanGP`.
        fit_options: Arguments of :func:`gpadjust.fit`, such as ``{"method": "map"}``.

    Raises:
        TypeError: If ``physics`` is not a mapping, or ``model`` is not such a class.
    """
    if not isinstance(physics, Mapping) or not physics:
        message = "Expected the physics of at least one metric by its name, {'cost': f_p}, found "
        raise TypeError(f"{message}{physics!r}.")
    mll_options = dict(fit_options or {})
    model_class, options = _class_of(model)
    # One config for each metric with a physics, and one for all others.
    configs = {
        metric: ModelConfig(
            botorch_model_class=model_class,
            model_options={**options, "physics": map_parts(ParameterPhysics, part)},
            name=f"{model_class.__name__} of {metric}",
            mll_options=mll_options,
        )
        for metric, part in physics.items()
    }
    other = ModelConfig(botorch_model_class=ZeroMeanGP, name="ZeroMeanGP", mll_options=mll_options)
    spec = SurrogateSpec(
        model_configs=[other],
        metric_to_model_configs={metric: [config] for metric, config in configs.items()},
    )
    return {"surrogate_spec": spec, "transforms": TRANSFORMS}


def generation_strategy(
    physics: Mapping[str, Any],
    *,
    model: type[GP] | partial[GP] = CKA,
    fit_options: Mapping[str, Any] | None = None,
    **options: Any,
) -> GenerationStrategy:
    """Return Ax's default strategy, with models that adjust a physics in place of Ax's models.

    The first trials are those of Ax, the center of the search space and Sobol points. Arguments and
    errors are those of :func:`generator_kwargs`; at the first trial of a model, a physics that
    reads an unknown parameter, or text, is a ValueError.

    Args:
        physics: The physics of metrics.
        model: The model of these metrics.
        fit_options: Arguments of :func:`gpadjust.fit`.
        options: Options of ``Client.configure_generation_strategy`` except ``method``, such as
            ``initialization_budget`` and ``initialization_random_seed``.

    Example:
        >>> from ax.api.client import Client
        >>> from ax.api.configs import RangeParameterConfig
        >>> from gpadjust.ax import generation_strategy
        >>> client = Client()
        >>> time = RangeParameterConfig(name="time", parameter_type="float", bounds=(0, 10))
        >>> client.configure_experiment(parameters=[time])
        >>> client.configure_optimization(objective="conversion")
        >>> strategy = generation_strategy({"conversion": lambda time: 1 - (-time).exp()})
        >>> client.set_generation_strategy(strategy)
        >>> strategy.name
        'Center+Sobol+MBM:CKA'
    """
    kwargs = generator_kwargs(physics, model=model, fit_options=fit_options)
    struct = GenerationStrategyDispatchStruct(method="custom", **options)
    # The config gives the strategy its name; its generator then gets ours.
    strategy = choose_generation_strategy(
        struct, model_config=ModelConfig(name=_class_of(model)[0].__name__)
    )
    strategy.nodes_by_name["MBM"].generator_specs[0].generator_kwargs.update(kwargs)
    return strategy


def _class_of(model: Any) -> tuple[type[GP], dict[str, Any]]:
    """Return the class of a model factory and its further arguments."""
    factory = partial(model) if callable(model) else partial(CKA, model)
    structure: Any = factory.func
    # Ax makes a model by a class and keyword arguments.
    if factory.args or not isinstance(structure, type) or not issubclass(structure, GP):
        raise TypeError(
            "Expected model as a class of models, such as CKA, or functools.partial of one with "
            f"keyword arguments, as Ax needs a class, got {model!r}."
        )
    return structure, dict(factory.keywords)
