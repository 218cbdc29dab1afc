"""Physics: the crude models f_p that a user brings, as torch modules."""

from gpadjust.physics.base import Physics
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError, PhysicsWarning
from gpadjust.physics.fmu_physics import FMUPhysics
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.function import FunctionPhysics, as_physics
from gpadjust.physics.mujoco import MujocoPhysics
from gpadjust.physics.ode import ODEPhysics
from gpadjust.physics.parameters import ParameterValues, PhysicsParameters
from gpadjust.physics.subprocess_physics import SubprocessPhysics
from gpadjust.physics.unknown import Unknown

__all__ = [
    "MujocoPhysics",
    "Physics",
]
