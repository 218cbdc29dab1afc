"""The structures that :func:`gpadjust.compare` fits, and the physics alone beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch.distributions import StudentT

from gpadjust.core import CKA, CalibratedPhysics, PhysicsMeanGP, ZeroMeanGP
from gpadjust.core.data import Data
from gpadjust.kinds.factory import ModelFactory
from gpadjust.physics import Physics, as_physics
from gpadjust.validation.leave_one_out import ROUNDING, LeaveOneOut

STACKED = "stacked"  # what a comparison calls the mixture of all structures
ALONE = "physics alone"  # and f_p as it is


class Structure(NamedTuple):
    """A way to adjust a physics, one of those that :func:`~gpadjust.compare` fits.

    Attributes:
        name: Its name.
        model: A callable that makes the model of ``X`` and ``Y``, of any number of outputs, each by
            itself: a class, or ``functools.partial`` of one. Its keywords are the ``physics``, if
            it uses that, ``train_Yvar``, if there is one, and the options of
            :func:`~gpadjust.compare`.
        uses_physics: Whether it reads the physics at all.
        adjusts: Whether it does more than to take the physics as a mean.
        joins: Whether it takes several physics at once.
        calibrates: Whether it is of a physics with unknown parameters only.
    """

    name: str
    model: ModelFactory
    uses_physics: bool = True
    adjusts: bool = True
    joins: bool = True
    calibrates: bool = False


STRUCTURES = (
    Structure("calibrated physics", CalibratedPhysics, adjusts=False, joins=False, calibrates=True),
    Structure("zero mean", ZeroMeanGP, uses_physics=False, adjusts=False, joins=False),
    Structure("physics mean", PhysicsMeanGP, adjusts=False),
    Structure("CKA", CKA),
)
"""The structures that :func:`gpadjust.compare` knows; add your own to them."""


def known_structures(
    structures: str | Structure | ModelFactory | Sequence[str | Structure | ModelFactory],
) -> list[Structure]:
    """Return the structures that are asked for, each once."""
    names = {structure.name: structure for structure in STRUCTURES}
    is_one = isinstance(structures, str | Structure) or callable(structures)
    asked: Any = [structures] if is_one else [*structures]  # type: ignore[misc]
    asked = [_of_factory(each) if callable(each) else each for each in asked]
    unknown = [s for s in asked if not isinstance(s, Structure) and s not in names]
    if unknown or not asked:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, names))}, or a "
            "Structure of your own, or what makes a model: a class, or functools.partial of one."
        )
    found = [s if isinstance(s, Structure) else names[s] for s in asked]
    named = {structure.name: structure for structure in found}
    differ = all(named[structure.name] == structure for structure in found)
    if not differ or {STACKED, ALONE} & named.keys():
        raise ValueError(
            f"Expected structures of different names, none of them {STACKED!r} (their mixture) or "
            f"{ALONE!r}; found {[structure.name for structure in found]}. Rename yours."
        )
    return list(named.values())


def _of_factory(factory: Any) -> Structure:
    """Return the structure of what makes a model, named by its class and arguments."""
    function = getattr(factory, "func", factory)
    arguments = [f"{name}={v!r}" for name, v in getattr(factory, "keywords", {}).items()]
    name = getattr(function, "__name__", type(function).__name__)
    known = [structure for structure in STRUCTURES if structure.model is function]
    like = known[0] if known else Structure(name, factory)
    called = f"{name}({', '.join(arguments)})" if arguments else name
    return like._replace(name=called, model=factory)


def by_name(physics: Any) -> dict[str, Physics]:
    """Return several physics by their names; a single one by an empty name."""
    if isinstance(physics, Mapping):
        return {str(name): as_physics(each) for name, each in physics.items()}
    if not isinstance(physics, list | tuple):
        return {"": as_physics(physics)}
    parts = [as_physics(each) for each in physics]
    names = [part.name for part in parts]
    names = [n if n.isidentifier() and names.count(n) == 1 else "" for n in names]
    return {
        name or f"f_{i + 1}": part for i, (name, part) in enumerate(zip(names, parts, strict=True))
    }


def candidates(
    structures: Sequence[Structure], physics: Mapping[str, Physics]
) -> list[tuple[Structure, Any]]:
    """Return the structures to be fitted: of one physics, or of each of several and of all."""
    found: list[tuple[Structure, Any]] = []
    for structure in structures:
        own = physics
        if structure.calibrates:
            own = {name: part for name, part in physics.items() if part.unknowns}
        if not structure.uses_physics or [*physics] == [""]:
            found += [(structure, part) for part in [*own.values()][:1]]
            continue
        for name, part in own.items():
            found.append((structure._replace(name=f"{structure.name} of {name}"), part))
        if structure.joins:
            found.append((structure._replace(name=f"{structure.name} of all"), {**physics}))
    if not found:
        raise ValueError(
            "Expected a physics with unknown parameters for 'calibrated physics'; found none: name "
            "them, unknowns={'mass': Unknown(1.0, factor=1.5)}."
        )
    return found


@torch.no_grad()
def physics_alone(physics: Mapping[str, Physics], data: Data) -> dict[str, LeaveOneOut]:
    r"""Return left-out predictions by each physics as it is, with noise of an unknown variance.

    Nothing is fitted, :math:`y_i = f_p(x_i) + \epsilon_i`. With a prior of the variance that does
    not depend on units, an observation that is left out has Student's distribution about f_p with
    the mean square error at the others and ``n - 1`` degrees of freedom (Gelman et al. 2013,
    section 3.2); with known variances it is Gaussian. Physics with unknown parameters are left out:
    alone, they are :class:`~gpadjust.CalibratedPhysics`.

    Returns:
        The predictions by ``"physics alone"``, of several physics ``"physics alone of coarse"`` and
        so on.
    """
    return {
        f"{ALONE} of {name}" if name else ALONE: _left_out(part, data)
        for name, part in physics.items()
        if not part.unknowns
    }


def _left_out(physics: Physics, data: Data) -> LeaveOneOut:
    X, Y = data.X, data.Y
    mean, least = physics(X), ROUNDING**2 * (Y - Y.nanmean(0)).square().nanmean(0)
    if data.Yvar is not None:
        variance = data.Yvar.maximum(least)
        density = torch.distributions.Normal(mean, variance.sqrt(), False).log_prob(Y)
    else:
        squares = (Y - mean).square()
        freedom = (~Y.isnan()).sum(0) - 1
        others = squares.nansum(0) - squares.nan_to_num(nan=0.0)
        scale = (others.clamp_min(0) / freedom).maximum(least).sqrt()
        student = StudentT(freedom.to(mean), mean, scale, validate_args=False)
        variance = student.variance.nan_to_num(nan=torch.inf)
        density = student.log_prob(Y)
    pit = torch.special.ndtr((Y - mean) / variance.sqrt())
    return LeaveOneOut(X, Y, mean, variance, density, pit, data.output_names)
