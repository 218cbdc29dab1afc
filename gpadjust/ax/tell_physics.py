"""The transform by which a physics learns what Ax's transforms did."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from ax.adapter.base import Adapter
from ax.adapter.data_utils import ExperimentData
from ax.adapter.transforms.base import Transform
from ax.core.parameter import ChoiceParameter, ParameterType, RangeParameter
from ax.core.search_space import SearchSpace
from ax.generators.torch.botorch_modular.generator import BoTorchGenerator
from ax.generators.torch.botorch_modular.surrogate import SurrogateSpec
from ax.generators.torch.botorch_modular.utils import ModelConfig

from gpadjust.ax.parameter_physics import ParameterPhysics, of_each
from gpadjust.ax.units import PhysicsInUnits, Units


class TellPhysics(Transform):
    """The last of the transforms: it changes nothing, and tells each physics of the others.

    Ax transforms parameters and metrics before a model sees them: logarithms, codes, fixed
    parameters that are left out, standardised metrics. A physics in a ``ModelConfig`` is then asked
    in the units of the search space all the same, and what it answers, in the units of its metric,
    goes through the same transforms as the metric's data.

    Raises:
        ValueError: If it is not the last of the transforms; if there is one that a physics cannot
            be asked behind; or if a physics is given for several metrics at once, or for none that
            the experiment has.
    """

    no_op_for_experiment_data = True

    def __init__(
        self,
        search_space: SearchSpace | None = None,
        experiment_data: ExperimentData | None = None,
        adapter: Adapter | None = None,
        config: Any = None,
    ) -> None:
        super().__init__(search_space, experiment_data, adapter, config)
        generator = getattr(adapter, "generator", None)
        if search_space is None or experiment_data is None or adapter is None:
            return
        if not isinstance(generator, BoTorchGenerator):
            return
        if adapter._raw_transforms[-1] is not TellPhysics:
            raise ValueError(
                "Expected TellPhysics as the last of the transforms, found "
                f"{adapter._raw_transforms[-1].__name__} after it."
            )
        before = [t for t in adapter.transforms.values() if not isinstance(t, TellPhysics)]
        given = adapter.transforms["Cast"].search_space
        if given.is_hierarchical:
            raise ValueError(
                "A physics cannot be asked in a hierarchical search space; make one of parameters "
                "that are always there."
            )
        ranges = {
            p.name: (float(p.lower), float(p.upper))
            for p in given.parameters.values()
            if isinstance(p, RangeParameter)
        }
        whole = [
            name for name in ranges if given.parameters[name].parameter_type is ParameterType.INT
        ]
        choices = {
            p.name: [float(value) for value in p.values]
            for p in given.parameters.values()
            if isinstance(p, ChoiceParameter) and p.is_numeric
        }
        units = Units(before, [*search_space.parameters], ranges, whole, choices)
        observed = set(experiment_data.metric_signatures)
        metrics = observed | {each.signature for each in adapter._experiment.metrics.values()}
        told = _Told(units, [*given.parameters], observed, metrics)
        # The generator's own specification: the user's may belong to several.
        if generator.surrogate_spec is not None:
            generator.surrogate_spec = told.spec(generator.surrogate_spec)
        if generator._surrogate is not None:
            generator._surrogate.surrogate_spec = told.spec(generator._surrogate.surrogate_spec)


class _Told:
    """Specifications of which each physics knows the units."""

    def __init__(
        self, units: Units, parameters: list[str], observed: set[str], metrics: set[str]
    ) -> None:
        self.units, self.parameters = units, parameters
        self.observed, self.metrics = observed, metrics

    def spec(self, spec: SurrogateSpec) -> SurrogateSpec:
        own = spec.metric_to_model_configs
        wrong = sorted(own.keys() - self.metrics)
        if wrong:
            raise ValueError(
                f"A model is given for {', '.join(wrong)}, which is no metric of the experiment; "
                f"expected some of {', '.join(sorted(self.metrics))}."
            )
        others = sorted(self.observed - own.keys())
        return replace(
            spec,
            model_configs=[self.config(each, others) for each in spec.model_configs],
            metric_to_model_configs={
                metric: [self.config(each, [metric]) for each in configs]
                for metric, configs in own.items()
            },
        )

    def config(self, config: ModelConfig, metrics: list[str]) -> ModelConfig:
        physics = config.model_options.get("physics")
        if physics is None or not metrics:
            return config
        if len(metrics) > 1:
            raise ValueError(
                f"Expected a physics for one metric, found one for {', '.join(metrics)}. Say which "
                "it is of: SurrogateSpec(metric_to_model_configs={'the metric': [ModelConfig(...)]"
                "}), or gpadjust.ax.generation_strategy({'the metric': f_p})."
            )
        told = of_each(partial(self.physics, metrics[0]), physics)
        return replace(config, model_options={**config.model_options, "physics": told})

    def physics(self, metric: str, physics: Any) -> PhysicsInUnits:
        origin = physics.origin if isinstance(physics, PhysicsInUnits) else physics
        return PhysicsInUnits(ParameterPhysics(origin), metric, self.units, self.parameters)
