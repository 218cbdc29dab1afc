"""What the entries of a system's state and action are, said once for dynamics and environments."""

from gpadjust.states.state_spec import StateSpec

__all__ = ["StateSpec"]
