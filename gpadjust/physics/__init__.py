"""Physics: the crude models f_p that a user brings, as torch modules."""

from gpadjust.physics.base import Physics
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.function import FunctionPhysics, JoinedPhysics, as_physics
from gpadjust.physics.ode import ODEPhysics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.physics.subprocess_physics import SubprocessPhysics
from gpadjust.physics.unknown import ParameterValues, Unknown
from gpadjust.physics.warning import PhysicsWarning

__all__ = [
    "BlackBoxPhysics",
    "FormulaPhysics",
    "FunctionPhysics",
    "JoinedPhysics",
    "ODEPhysics",
    "ParameterValues",
    "Physics",
    "PhysicsError",
    "PhysicsParameters",
    "PhysicsWarning",
    "SubprocessPhysics",
    "Unknown",
    "as_physics",
]
