"""Names and kinds of the entries of state and action, and the measured outputs."""

from gpadjust.states.sensors import Sensors
from gpadjust.states.state_spec import StateSpec

__all__ = ["Sensors", "StateSpec"]
