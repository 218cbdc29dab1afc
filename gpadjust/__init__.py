"""Gaussian processes that adjust a physics model to data."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpadjust.emulation import EmulatedPhysics
    from gpadjust.inference import FitResult, SampleResult, fit
    from gpadjust.models import (
        AR1,
        CKA,
        RRA,
        BiasGP,
        CalibratedPhysics,
        ParallelPartialGP,
        PhysicsMeanGP,
        ScaleGP,
        StackedGP,
        VariationalCKA,
        ZeroMeanGP,
        load,
        save,
    )
    from gpadjust.physics import (
        BlackBoxPhysics,
        FormulaPhysics,
        FunctionPhysics,
        JoinedPhysics,
        ODEPhysics,
        Physics,
        PhysicsError,
        PhysicsWarning,
        SubprocessPhysics,
        Unknown,
    )
    from gpadjust.validation import Comparison, compare

__version__ = "0.2.0"

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "BiasGP",
    "BlackBoxPhysics",
    "CalibratedPhysics",
    "Comparison",
    "EmulatedPhysics",
    "FitResult",
    "FormulaPhysics",
    "FunctionPhysics",
    "JoinedPhysics",
    "ODEPhysics",
    "ParallelPartialGP",
    "Physics",
    "PhysicsError",
    "PhysicsMeanGP",
    "PhysicsWarning",
    "SampleResult",
    "ScaleGP",
    "StackedGP",
    "SubprocessPhysics",
    "Unknown",
    "VariationalCKA",
    "ZeroMeanGP",
    "compare",
    "fit",
    "load",
    "save",
]

# Rooms that need no extra, in the order in which a name of `__all__` is looked for.
_ROOMS = (
    "physics",
    "models",
    "inference",
    "validation",
    "emulation",
    "gp",
    "states",
    "files",
    "active",
    "dynamics",
)
# Rooms that are not searched for names; most need an extra.
_OTHER_ROOMS = ("ax", "control", "export", "records", "report", "rl", "sklearn", "systems")


def __getattr__(name: str) -> Any:
    """Import a name or a room at its first use: environments need no BoTorch, which is slow."""
    if name in (*_ROOMS, *_OTHER_ROOMS):
        try:
            return import_module(f"gpadjust.{name}")
        except ImportError as error:  # hasattr and help go on
            raise AttributeError(str(error)) from error
    if name in __all__:
        for room in _ROOMS:
            module = import_module(f"gpadjust.{room}")
            if name in module.__all__:
                globals()[name] = getattr(module, name)
                return globals()[name]
    raise AttributeError(f"module 'gpadjust' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_ROOMS, *_OTHER_ROOMS, "__version__"})
