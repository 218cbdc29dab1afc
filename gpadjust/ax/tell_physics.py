"""The transform that gives each physics the effect of Ax's transforms."""

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

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.units import PhysicsInUnits, Units
from gpadjust.kinds.factory import map_parts


class TellPhysics(Transform):
    """The last transform, which changes no data but gives each physics the effect of the others.

    Ax transforms parameters and metrics before a model: logarithms, codes, omitted fixed
    parameters, standardised metrics. A physics in a ``ModelConfig`` still gets inputs in the units
    of the search space, and its outputs, in the units of its metric, pass the same transforms as
    the data of the metric.

    A ValueError is raised if this is not the last transform, if a transform is not supported, or
    if a physics belongs to several metrics, or to none of the experiment.
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
        # Ax builds transforms in other places, too, without data or for other generators.
        generator = getattr(adapter, "generator", None)
        if search_space is None or experiment_data is None or adapter is None:
            return
        if not isinstance(generator, BoTorchGenerator):
            return
        # A later transform would change the columns of the model again.
        if adapter._raw_transforms[-1] is not TellPhysics:
            raise ValueError(
                "Expected TellPhysics as the last transform, found "
                f"{adapter._raw_transforms[-1].__name__} after it."
            )
        transforms = [t for t in adapter.transforms.values() if not isinstance(t, TellPhysics)]
        original = adapter.transforms["Cast"].search_space  # Cast is the first transform
        if original.is_hierarchical:
            raise ValueError(
                "A physics needs a search space of parameters that are always there, found a "
                "hierarchical one."
            )
        # Plain values of the parameters before all transforms.
        parameters = original.parameters.values()
        scales = [p for p in parameters if isinstance(p, RangeParameter)]
        ranges = {p.name: (float(p.lower), float(p.upper)) for p in scales}
        integers = [p.name for p in scales if p.parameter_type is ParameterType.INT]
        lists = [p for p in parameters if isinstance(p, ChoiceParameter) and p.is_numeric]
        choices = {p.name: [float(value) for value in p.values] for p in lists}
        units = Units(transforms, [*search_space.parameters], ranges, integers, choices)
        # Metrics may have no data yet, or data without being tracked.
        observed = set(experiment_data.metric_signatures)
        metrics = observed | {metric.signature for metric in adapter._experiment.metrics.values()}
        setter = _UnitsSetter(units, [*original.parameters], observed, metrics)
        # The generator has a copy of the specification; the user's may serve several generators.
        if generator.surrogate_spec is not None:
            generator.surrogate_spec = setter.spec(generator.surrogate_spec)
        if generator._surrogate is not None:
            generator._surrogate.surrogate_spec = setter.spec(generator._surrogate.surrogate_spec)


class _UnitsSetter:
    """Copies of specifications in which each physics has its units."""

    def __init__(
        self, units: Units, parameters: list[str], observed: set[str], metrics: set[str]
    ) -> None:
        self.units, self.parameters = units, parameters
        self.observed, self.metrics = observed, metrics

    def spec(self, spec: SurrogateSpec) -> SurrogateSpec:
        """Return a specification with units."""
        by_metric = spec.metric_to_model_configs
        unknown = sorted(by_metric.keys() - self.metrics)
        if unknown:
            raise ValueError(
                f"A model has the unknown metric {', '.join(unknown)}; expected some of "
                f"{', '.join(sorted(self.metrics))}."
            )
        # The general configs serve all metrics without one of their own.
        others = sorted(self.observed - by_metric.keys())
        return replace(
            spec,
            model_configs=[self.config(config, others) for config in spec.model_configs],
            metric_to_model_configs={
                metric: [self.config(config, [metric]) for config in configs]
                for metric, configs in by_metric.items()
            },
        )

    def config(self, config: ModelConfig, metrics: list[str]) -> ModelConfig:
        """Return the config of the model of some metrics, with units."""
        physics = config.model_options.get("physics")
        if physics is None or not metrics:
            return config
        if len(metrics) > 1:
            raise ValueError(
                f"Expected a physics for one metric, found one for {', '.join(metrics)}. Name its "
                "metric: SurrogateSpec(metric_to_model_configs={'the metric': [ModelConfig(...)]"
                "}), or gpadjust.ax.generation_strategy({'the metric': f_p})."
            )
        in_units = map_parts(partial(self.physics, metrics[0]), physics)
        return replace(config, model_options={**config.model_options, "physics": in_units})

    def physics(self, metric: str, physics: Any) -> PhysicsInUnits:
        """Return a physics of a metric with units, which replace those of an earlier fit."""
        if isinstance(physics, PhysicsInUnits):
            physics = physics.origin
        return PhysicsInUnits(ParameterPhysics(physics), metric, self.units, self.parameters)
