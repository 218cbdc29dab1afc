"""A physics of parameters, as a model in Ax asks it."""

from __future__ import annotations

from torch import Tensor

from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.units import Units
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.unknown import ParameterValues


class PhysicsInUnits(Physics):
    """A physics behind Ax's transforms: of what a model sees, in the units of what it learns.

    Args:
        origin: The user's physics.
        metric: What it is of.
        units: What the transforms did.
        parameters: The parameters of the search space, in its order.
    """

    def __init__(
        self, origin: ParameterPhysics, metric: str, units: Units, parameters: list[str]
    ) -> None:
        reads = origin.names_of(parameters)
        inner = origin.of(reads)
        super().__init__(unknowns=dict(inner.unknowns.items()), name=inner.name)
        self.origin, self.metric, self.units, self.reads = origin, metric, units, reads
        self.inner = inner

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The physics in the search space's units, and what the transforms make of it.

        Args:
            X: ``N x d'``, as the model sees it.
            parameters: Those that are unknown, if there are any.

        Returns:
            ``N x 1``.

        Raises:
            PhysicsError: If the physics fails, or has several outputs.
        """
        raw = self.units.raw(X, self.reads)
        Y = self.inner.of_rows(self.inner.read_rows(raw, *parameters))
        if Y.shape[-1] != 1:
            raise several_outputs(self.name, self.metric, Y.shape[-1])
        return self.units.metric(Y, self.metric)

    def in_user_units(self, values: Tensor) -> Tensor:
        """As the metric is."""
        return self.units.of_metric(values, self.metric)


def several_outputs(name: str, metric: str, count: int) -> PhysicsError:
    """The error of a physics with several outputs."""
    return PhysicsError(
        f"The physics {name!r} returned {count} columns for the metric {metric!r}, expected one; "
        "give each metric a physics of its own."
    )
