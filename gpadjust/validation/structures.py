"""The structures that :func:`gpadjust.compare` fits, and the physics alone beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.distributions import StudentT

from gpadjust.models import CKA, CalibratedPhysics, PhysicsMeanGP, ZeroMeanGP
from gpadjust.models.factory import ModelFactory
from gpadjust.models.training_data import TrainingData
from gpadjust.physics import JoinedPhysics, Physics
from gpadjust.validation.leave_one_out import ROUNDING, LeaveOneOut, log_densities

STACKED = "stacked"  # what a comparison calls the mixture of all structures
ALONE = "physics alone"  # and f_p as it is


class Structure(NamedTuple):
    """A way to adjust a physics, one of those that :func:`~gpadjust.compare` fits.

    Attributes:
        name: Its name.
        model: A callable that makes the model of ``X`` and ``Y``, of any number of outputs, each by
            itself: a class, or ``functools.partial`` of one. It is given as keywords the
            ``physics``, if it uses that, ``train_Yvar``, if there is one, and the options that are
            given to :func:`~gpadjust.compare`.
        unknowns: Number of unknown constant means, for one physics.
        uses_physics: Whether it reads the physics at all.
        adjusts: Whether it does more than to take the physics as a mean.
        joins: Whether it takes several physics at once.
        calibrates: Whether it is of a physics with unknown parameters only.
        prior: Observations that its weight counts for beforehand, ``stacking_weights``; of several
            physics, that of all at once.
    """

    name: str
    model: ModelFactory
    unknowns: int = 0
    uses_physics: bool = True
    adjusts: bool = True
    joins: bool = True
    calibrates: bool = False
    prior: float = 0.0


STRUCTURES = (
    Structure("calibrated physics", CalibratedPhysics, adjusts=False, joins=False, calibrates=True),
    Structure("zero mean", ZeroMeanGP, uses_physics=False, adjusts=False, joins=False),
    Structure("physics mean", PhysicsMeanGP, adjusts=False),
    Structure(
        "constant rho", partial(PhysicsMeanGP, rho_mean="learn", delta_mean="learn"), unknowns=2
    ),
    Structure("CKA", CKA, prior=4.0),
)
"""The structures that :func:`gpadjust.compare` knows; add your own to them."""


def known_structures(
    structures: str | Structure | ModelFactory | Sequence[str | Structure | ModelFactory],
) -> list[Structure]:
    """The structures that are asked for, each once."""
    names = {structure.name: structure for structure in STRUCTURES}
    one = isinstance(structures, str | Structure) or callable(structures)
    asked: Any = [structures] if one else [*structures]  # type: ignore[misc]
    given = [_of_factory(each) if callable(each) else each for each in asked]
    unknown = [s for s in given if not isinstance(s, Structure) and s not in names]
    if unknown or not given:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, names))}, or a "
            "Structure of your own, or what makes a model: a class, or functools.partial of one."
        )
    found = [s if isinstance(s, Structure) else names[s] for s in given]
    named = {structure.name: structure for structure in found}
    differ = all(named[structure.name] == structure for structure in found)
    if not differ or {STACKED, ALONE} & named.keys():
        raise ValueError(
            f"Expected structures of different names, none of them {STACKED!r} (their mixture) or "
            f"{ALONE!r}, got {[structure.name for structure in found]}; give yours a name of its "
            "own."
        )
    return list(named.values())


def _of_factory(factory: Any) -> Structure:
    """The structure of what makes a model, named by its class and arguments.

    What it is is known if it is the class of a structure above.
    """
    function = getattr(factory, "func", factory)
    given = getattr(factory, "keywords", {})
    told = ", ".join(f"{name}={value!r}" for name, value in given.items())
    name = getattr(function, "__name__", type(function).__name__)
    known = [structure for structure in STRUCTURES if structure.model is function]
    like = known[0] if known else Structure(name, factory)
    unknowns = sum(value == "learn" for key, value in given.items() if key.endswith("_mean"))
    adjusts = like.adjusts or bool(given.keys() & {"rho_mean", "delta_mean"})
    called = f"{name}({told})" if told else name
    return like._replace(name=called, model=factory, unknowns=unknowns, adjusts=adjusts)


def candidates(
    structures: list[Structure], physics: Physics, num_points: int
) -> list[tuple[Structure, Physics]]:
    """The structures to be fitted: of one physics, or of each of several and of all.

    Those with too many unknown constants for the points are left out, if there are others.
    """
    found: list[tuple[Structure, Physics]] = []
    if not physics.unknowns:
        plain = [structure for structure in structures if not structure.calibrates]
        if not plain:
            raise ValueError(
                f"Physics {physics.name!r} has no unknown parameter for 'calibrated physics' to "
                "learn; say which it has with unknowns={'mass': Unknown(1.0, factor=1.5)}."
            )
        structures = plain
    for structure in structures:
        if not isinstance(physics, JoinedPhysics) or not structure.uses_physics:
            found.append((structure, physics))
            continue
        of = _parts(physics)
        for name, part in of:
            alone = 0.0 if structure.joins else structure.prior
            own = structure._replace(name=f"{structure.name} of {name}", prior=alone)
            found.append((own, part))
        if structure.joins:
            several = structure.unknowns + len(of) - 1
            joined = structure._replace(name=f"{structure.name} of all", unknowns=several)
            found.append((joined, physics))
    few = [pair for pair in found if pair[0].unknowns and num_points < 2 + pair[0].unknowns]
    return [pair for pair in found if pair not in few] or found


def _parts(physics: Physics) -> list[tuple[str, Physics]]:
    """The names and the physics that several are joined of; none of a single one."""
    if not isinstance(physics, JoinedPhysics):
        return []
    return [*zip(physics.names, cast(Iterable[Physics], physics.parts), strict=True)]


def physics_alone(physics: Physics, data: TrainingData) -> dict[str, LeaveOneOut]:
    r"""Each physics as it is, with noise whose variance the other observations tell.

    Nothing is fitted, :math:`y_i = f_p(x_i) + \epsilon_i`. With a prior of the variance that does
    not depend on units, an observation that is left out has Student's distribution about f_p with
    the mean square error at the others and ``n - 1`` degrees of freedom (Gelman et al. 2013,
    section 3.2); with known variances it is Gaussian.

    Physics with unknown parameters are left out: alone, they are
    :class:`~gpadjust.CalibratedPhysics`.

    Returns:
        The predictions by ``"physics alone"``, of several physics ``"physics alone of coarse"`` and
        so on.
    """
    named = {f"{ALONE} of {name}": part for name, part in _parts(physics)} or {ALONE: physics}
    return {name: _left_out(part, data) for name, part in named.items() if not part.unknowns}


@torch.no_grad()
def _left_out(physics: Physics, data: TrainingData) -> LeaveOneOut:
    mean: Tensor = physics(data.X)
    if data.Yvar is not None:
        variance = data.Yvar.expand_as(mean)
        density = log_densities(mean.unsqueeze(-3), variance.unsqueeze(-3), data.Y).squeeze(-3)
    else:
        squares = (data.Y - mean).square()
        freedom = (~data.Y.isnan()).sum(0) - 1
        others = squares.nansum(0) - squares.nan_to_num(nan=0.0)
        spread = (data.Y - data.Y.nanmean(0)).square().nanmean(0)
        scale = torch.maximum(others.clamp_min(0) / freedom, ROUNDING**2 * spread).sqrt()
        student = StudentT(freedom.to(mean), mean, scale, validate_args=False)
        variance = student.variance.nan_to_num(nan=torch.inf)
        density = student.log_prob(data.Y)
    return LeaveOneOut(data.X, data.Y, mean, variance, density, data.output_names)
