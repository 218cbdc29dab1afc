"""The first trial, where the physics has its optimum."""

from __future__ import annotations

from dataclasses import dataclass
from logging import Logger
from typing import Any

from ax.core.experiment import Experiment
from ax.core.generator_run import GeneratorRun
from ax.core.types import TParameterization
from ax.generation_strategy.center_generation_node import CenterGenerationNode
from ax.storage.json_store.decoder import object_from_json
from ax.utils.common.logger import get_logger

from gpadjust.ax.physics_optimum import physics_optimum
from gpadjust.physics import PhysicsError

logger: Logger = get_logger(__name__)


@dataclass(init=False)
class PhysicsOptimumNode(CenterGenerationNode):
    """A node of one trial: at the optimum of what the physics says of the objective.

    It is Ax's centre node with another point, and does as that one where a metric of the objective
    has no physics, where f_p fails (which is logged), and in hierarchical search spaces. A trial at
    the centre has the generator key ``"CenterOfSearchSpace"``, as Ax's own.

    The centre and Ax's Sobol points, 1,024 in all, are compared, and then four times 64 points
    around the best so far, at ever smaller steps, on the scales of the parameters and within their
    constraints. f_p is asked all 1,024 at once, and each 64; fewer if points are the same, or a
    step leaves the search space. It finds the same each time: the optimum of one or two parameters
    to about a hundredth of their ranges or better, of six to some hundredths.

    Several physics of a metric count by their mean, unknown parameters by their guesses. Points at
    which a physics fails are left out. Outcome constraints whose metrics all have a physics are
    kept, if a point is found that does, else broken as little as possible; those relative to a
    status quo are not looked at. Of several objectives (not a weighted sum of metrics, which counts
    as it is) the sum counts, each in units of its standard deviation over the 1,024 points. What no
    physics reads stays at the centre, unless parameter constraints tie it to others.

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
        """As Ax's centre node, at the optimum of the physics.

        Raises:
            ValueError: If a physics that is asked reads what is no parameter, or text.
        """
        run = super().gen(experiment=experiment, **arguments)
        if run is not None and self._at_center and run._generator_key == self.name:
            run._generator_key = self._center_name
        return run

    def compute_center_params(self) -> TParameterization | None:
        """The optimum of the physics, or else the centre, or None if there is none."""
        center = super().compute_center_params()
        try:
            found = physics_optimum(self.experiment, self.physics, center)
        except PhysicsError as error:
            logger.warning(f"The first trial is at the centre of the search space: {error}")
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
