"""The first trial, where the physics has its optimum."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from logging import ERROR, Logger, getLogger
from math import exp, isfinite, log
from typing import Any

import torch
from ax.adapter import base
from ax.adapter.registry import Generators
from ax.core.arm import Arm
from ax.core.experiment import Experiment
from ax.core.generator_run import GeneratorRun
from ax.core.observation import ObservationFeatures
from ax.core.optimization_config import OptimizationConfig
from ax.core.parameter import (
    ChoiceParameter,
    DerivedParameter,
    ParameterType,
    RangeParameter,
)
from ax.core.search_space import SearchSpace
from ax.core.types import ComparisonOp, TParameterization, TParamValue
from ax.exceptions.core import SearchSpaceExhausted
from ax.generation_strategy.center_generation_node import CenterGenerationNode
from ax.generators.random import base as random_base
from ax.storage.json_store.decoder import object_from_json
from ax.utils.common.logger import get_logger
from torch import Generator, Tensor

from gpadjust.ax.parameter_physics import ParameterPhysics, parts_of
from gpadjust.ax.units import are_numbers, no_numbers, several_outputs
from gpadjust.physics import PhysicsError

logger: Logger = get_logger(__name__)

NUM_SOBOL = 1024
"""Points of the whole search space, Ax's Sobol points."""
STEPS = (1 / 4, 1 / 8, 1 / 16, 1 / 32)
"""Step of each refinement, in units of the differences of these points."""
NUM_REFINED = 64
"""Points of each refinement."""

_MOST_DRAWS = 100_000  # of Ax, to keep parameter constraints by rejection


@dataclass(init=False)
class PhysicsOptimumNode(CenterGenerationNode):
    """A node of one trial: at the optimum of what the physics says of the objective.

    It is Ax's center node with another point, and does as that one where a metric of the objective
    has no physics, where f_p fails (which is logged), and in hierarchical search spaces. A trial at
    the center has the generator key ``"CenterOfSearchSpace"``, as Ax's own.

    The center and Ax's Sobol points, 1,024 in all, are compared, and then four times 64 points
    around the best so far, at ever smaller steps, on the scales of the parameters and within their
    constraints. f_p is asked all 1,024 at once, and each 64; fewer if points are the same, or a
    step leaves the search space. It finds the same each time: the optimum of one or two parameters
    to about a hundredth of their ranges or better, of six to some hundredths.

    Several physics of a metric count by their mean, unknown parameters by their guesses. Points at
    which a physics fails are left out. Outcome constraints whose metrics all have a physics are
    kept, if a point is found that does, else broken as little as possible; those relative to a
    status quo are not looked at. Of several objectives (not a weighted sum of metrics, which counts
    as it is) the sum counts, each in units of its standard deviation over the 1,024 points. What no
    physics reads stays at the center, unless parameter constraints tie it to others.

    Args:
        physics: For each metric that has one, its physics, a :class:`ParameterPhysics`; several of
            one metric as a list or a dictionary.
        next_node_name: The node after it.
        use_existing_trials_for_initialization: Whether it is left out if the experiment has trials
            when Ax looks for the node to go on with.

    Example:
        >>> from ax.api.client import Client
        >>> from ax.api.configs import RangeParameterConfig
        >>> from gpadjust.ax import generation_strategy
        >>> client = Client()
        >>> x = RangeParameterConfig(name="x", parameter_type="float", bounds=(0, 10))
        >>> client.configure_experiment(parameters=[x])
        >>> client.configure_optimization(objective="-cost")
        >>> client.set_generation_strategy(generation_strategy({"cost": lambda x: (x - 7) ** 2}))
        >>> ((index, parameters),) = client.get_next_trials(max_trials=1).items()
        >>> round(parameters["x"], 2)
        7.0
    """

    physics: dict[str, Any]

    def __init__(
        self,
        physics: dict[str, Any],
        next_node_name: str,
        use_existing_trials_for_initialization: bool = False,
    ) -> None:
        super().__init__(
            next_node_name=next_node_name,
            use_existing_trials_for_initialization=use_existing_trials_for_initialization,
        )
        self.physics = physics
        self._center_name: str = self.name
        self._name: str = "PhysicsOptimum"
        self._at_center = False

    def gen(self, *, experiment: Experiment, **arguments: Any) -> GeneratorRun | None:
        """Generate a trial at the optimum of the physics.

        Raises:
            ValueError: If a physics that is asked reads what is no parameter, or text.
        """
        run = super().gen(experiment=experiment, **arguments)
        if run is not None and self._at_center and run._generator_key == self.name:
            run._generator_key = self._center_name
        return run

    def compute_center_params(self) -> TParameterization | None:
        """The optimum of the physics, or else the center, or None if there is none."""
        center = super().compute_center_params()
        try:
            found = physics_optimum(self.experiment, self.physics, center)
        except PhysicsError as error:
            logger.warning(f"The first trial is at the center of the search space: {error}")
            found = None
        self._at_center = found is None
        return center if found is None else found

    @classmethod
    def deserialize_init_args(
        cls, args: dict[str, Any], decoder_registry: Any = None, class_decoder_registry: Any = None
    ) -> dict[str, Any]:
        """The arguments as Ax saved them, the physics made of their import paths."""
        registries = {
            "decoder_registry": decoder_registry,
            "class_decoder_registry": class_decoder_registry,
        }
        given = {name: each for name, each in registries.items() if each is not None}
        physics = object_from_json(args["physics"], **given)
        return super().deserialize_init_args({**args, "physics": physics})


def physics_optimum(
    experiment: Experiment, physics: Mapping[str, Any], center: TParameterization | None = None
) -> TParameterization | None:
    """The best point of the search space by the experiment's objective, if f_p were true.

    :class:`PhysicsOptimumNode` says how it is searched.

    Args:
        experiment: The experiment with the search space and the objective.
        physics: For each metric that has one, a :class:`ParameterPhysics`, or a list or a
            dictionary of them.
        center: A point to begin with; None if there is none.

    Returns:
        The parameters of the best point; None if a metric of the objective has no physics, if the
        search space is hierarchical, or if Ax finds no points in it.

    Raises:
        PhysicsError: If a physics fails everywhere, or has several outputs.
        ValueError: If one reads what is no parameter, or text.
    """
    config, space = experiment.optimization_config, experiment.search_space
    if config is None or space.is_hierarchical:
        return None
    wanted = _Wanted(config, physics)
    if not wanted.known:
        return None
    reads = wanted.reads([*space.parameters])
    try:
        points = _sobol_points(experiment, reads, center)
    except SearchSpaceExhausted:
        return None
    best, least = wanted.best(points)
    if not isfinite(least[0]):
        raise PhysicsError(
            f"The physics of {', '.join(wanted.physics)} fail at each of {len(points)} points of "
            "the search space, one or another; expected a point at which none does."
        )
    chance = Generator().manual_seed(0)
    for step in STEPS:
        moved = _around(best, points, step, space, chance)
        if moved:
            found, value = wanted.best(moved)
            best, least = (found, value) if value < least else (best, least)
    return best


class _Wanted:
    """Objective and outcome constraints by the physics."""

    def __init__(self, config: OptimizationConfig, physics: Mapping[str, Any]) -> None:
        objective = config.objective
        self.weights = dict(objective.metric_weights)
        self.several = objective.is_multi_objective
        self.known = self.weights.keys() <= physics.keys()
        self.limits = [
            (dict(each.metric_weights), 1.0 if each.op is ComparisonOp.LEQ else -1.0, each.bound)
            for each in config.outcome_constraints
            if not each.relative and physics.keys() >= set(each.metric_signatures)
        ]
        metrics = {*self.weights, *(metric for weights, *_ in self.limits for metric in weights)}
        self.physics = {name: parts_of(physics[name]) for name in sorted(metrics & physics.keys())}
        self.units: dict[str, float] = {}
        self.parameters: list[str] = []

    def reads(self, parameters: list[str]) -> set[str]:
        """Return the parameters of the search space that some physics reads."""
        self.parameters = parameters
        parts = [part for several in self.physics.values() for part in several]
        return {name for part in parts for name in part.names_of(parameters)}

    def best(self, points: Sequence[TParameterization]) -> tuple[TParameterization, list[float]]:
        """The best point; and how far it breaks constraints, and what is to be small."""
        f = {metric: self.mean(metric, points) for metric in self.physics}
        if not self.units:  # of the points of the whole search space, which are the first
            self.units = {metric: _deviation(values) for metric, values in f.items()}
        broken, lost = torch.zeros(2, len(points), dtype=torch.float64)
        for weights, sign, bound in self.limits:
            unit = sum(abs(weight) * self.units[metric] for metric, weight in weights.items())
            value = sum((weight * f[metric] for metric, weight in weights.items()), -bound)
            broken = broken + (sign * value).clamp(min=0) / unit
        for metric, weight in self.weights.items():
            lost = lost - weight * f[metric] / (self.units[metric] if self.several else 1)
        rank = torch.stack([broken, lost], dim=-1)
        rank = rank.where(rank.isfinite().all(-1, keepdim=True), torch.inf)
        least, index = min((row, i) for i, row in enumerate(rank.tolist()))
        return points[index], least

    def mean(self, metric: str, points: Sequence[TParameterization]) -> Tensor:
        """The mean of all physics of a metric, ``N``, NaN where one fails."""
        asked = [self.asked(physics, metric, points) for physics in self.physics[metric]]
        return torch.stack(asked).mean(0)

    def asked(
        self, physics: ParameterPhysics, metric: str, points: Sequence[TParameterization]
    ) -> Tensor:
        """The values of a physics, ``N``, NaN where it fails."""
        names = physics.names_of(self.parameters)
        lost = [name for name in names if not are_numbers([point[name] for point in points])]
        if lost:
            raise no_numbers(lost)
        rows = [[float(point[name]) for name in names] for point in points]
        Y = physics.of(names).or_nan(torch.tensor(rows, dtype=torch.float64))
        if Y.shape[-1] != 1:
            raise several_outputs(physics.name, metric, Y.shape[-1])
        return Y.squeeze(-1)


def _sobol_points(
    experiment: Experiment, reads: set[str], center: TParameterization | None
) -> list[TParameterization]:
    """The center, if there is one, and Ax's Sobol points, each once."""
    space = experiment.search_space
    tied = {name for each in space.parameter_constraints for name in each.constraint_dict}
    stay = {
        name: value
        for name, value in (center or {}).items()
        if name not in reads | tied
        and isinstance(space.parameters[name], RangeParameter | ChoiceParameter)
    }
    with _without_warnings():
        run = Generators.SOBOL(experiment=experiment, seed=0, deduplicate=False).gen(
            n=NUM_SOBOL - (center is not None),
            fixed_features=ObservationFeatures(parameters=stay),
            model_gen_options={"max_rs_draws": _MOST_DRAWS},
        )
    first = [] if center is None else [center]
    return _each_once([*first, *(arm.parameters for arm in run.arms)])


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Ax logs that choices repeat, all their counts, and that constraints are hard to keep."""
    loggers = [getLogger(module.__name__) for module in (base, random_base)]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(ERROR)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _around(
    best: TParameterization,
    points: Sequence[TParameterization],
    step: float,
    space: SearchSpace,
    chance: Generator,
) -> list[TParameterization]:
    """Points of the search space near to ``best``, each once, and not itself.

    Numbers go a step by the difference of two points, which keeps what is linear in them. A choice
    is now and then that of the first of these.
    """
    pairs = torch.randint(len(points), (NUM_REFINED, 2), generator=chance).tolist()
    found = [best]
    for first, second in pairs:
        moved = dict(best)
        for name, parameter in space.parameters.items():
            a, b = points[first][name], points[second][name]
            if isinstance(parameter, RangeParameter):
                moved[name] = _moved(parameter, best[name], a, b, step)
            elif isinstance(parameter, ChoiceParameter):
                if torch.rand((), generator=chance) < step:
                    moved[name] = a
            elif isinstance(parameter, DerivedParameter):
                moved[name] = parameter.compute(parameters=moved)
        if space.check_membership(moved):
            found.append(moved)
    return _each_once(found)[1:]


def _moved(parameter: RangeParameter, value: Any, a: Any, b: Any, step: float) -> TParamValue:
    """``value + step (a - b)`` on the parameter's scale, and within its range."""
    to, back = _scale(parameter)
    moved = back(to(value) + step * (to(a) - to(b)))
    if parameter.parameter_type is ParameterType.INT:
        moved = round(moved)
    return parameter.cast(min(max(moved, parameter.lower), parameter.upper))


def _scale(parameter: RangeParameter) -> tuple[Callable[[float], float], Callable[[float], float]]:
    if parameter.log_scale:
        return log, exp
    if parameter.logit_scale:
        return (lambda x: log(x / (1 - x))), (lambda z: 1 / (1 + exp(-z)))
    return float, float


def _deviation(values: Tensor) -> float:
    """Return the standard deviation of the known values, or 1 if there is none."""
    found = values[values.isfinite()]
    return (found.std(correction=0).item() if len(found) else 0.0) or 1.0


def _each_once(points: Sequence[TParameterization]) -> list[TParameterization]:
    """The points in their order, without repetitions."""
    found: dict[str, TParameterization] = {}
    for point in points:
        found.setdefault(Arm(parameters=point).signature, point)
    return [*found.values()]
