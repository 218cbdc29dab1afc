"""The models in Ax, with a physics of the parameters of a search space (the extra ``ax``)."""

try:
    import ax as _
except ImportError as error:
    raise ImportError('gpadjust.ax needs Ax; run `pip install "gpadjust[ax]"`.') from error

from gpadjust.ax import surrogate
from gpadjust.ax.parameter_physics import ParameterPhysics
from gpadjust.ax.strategy import TRANSFORMS, generation_strategy, generator_kwargs
from gpadjust.ax.tell_physics import TellPhysics

__all__ = [
    "TRANSFORMS",
    "TellPhysics",
    "generation_strategy",
    "generator_kwargs",
]

surrogate.register()  # Ax finds models, transforms and classes by registries
