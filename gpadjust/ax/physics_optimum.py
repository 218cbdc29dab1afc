"""Where the physics says that the best trial is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from logging import ERROR, getLogger
from math import exp, isfinite, log
from typing import Any

import torch
from ax.adapter import base
from ax.adapter.registry import Generators
from ax.core.arm import Arm
from ax.core.experiment import Experiment
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
from ax.generators.random import base as random_base
from torch import Generator, Tensor

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.physics_in_units import several_outputs
from gpadjust.ax.units import are_numbers, no_numbers
from gpadjust.physics import PhysicsError

NUM_SOBOL = 1024
"""Points of the whole search space, Ax's Sobol points."""
STEPS = (1 / 4, 1 / 8, 1 / 16, 1 / 32)
"""How far each refinement goes, in units of the differences of these points."""
NUM_REFINED = 64
"""Points of each refinement."""

_MOST_DRAWS = 100_000  # of Ax, to keep parameter constraints by rejection


def physics_optimum(
    experiment: Experiment, physics: Mapping[str, Any], center: TParameterization | None = None
) -> TParameterization | None:
    """The best point of the search space by the experiment's objective, if f_p were true.

    :class:`gpadjust.ax.PhysicsOptimumNode` says how it is searched.

    Args:
        experiment: What has the search space and the objective.
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
    """What the physics says of objective and outcome constraints."""

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
        self.physics = {name: _parts(physics[name]) for name in sorted(metrics & physics.keys())}
        self.units: dict[str, float] = {}
        self.parameters: list[str] = []

    def reads(self, parameters: list[str]) -> set[str]:
        """Those of the search space's parameters that some physics reads."""
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
        """What a physics says, ``N``, NaN where it fails."""
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
    """The centre, if there is one, and Ax's Sobol points, each once."""
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


def _parts(physics: Any) -> list[ParameterPhysics]:
    if isinstance(physics, Mapping):
        return [*physics.values()]
    return [*physics] if isinstance(physics, list | tuple) else [physics]


def _deviation(values: Tensor) -> float:
    """Of the values that there are, or 1 if it is none."""
    found = values[values.isfinite()]
    return (found.std(correction=0).item() if len(found) else 0.0) or 1.0


def _each_once(points: Sequence[TParameterization]) -> list[TParameterization]:
    """The points in their order, without repetitions."""
    found: dict[str, TParameterization] = {}
    for point in points:
        found.setdefault(Arm(parameters=point).signature, point)
    return [*found.values()]
