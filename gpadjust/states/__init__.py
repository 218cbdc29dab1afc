"""Names and kinds of the entries of state and action, for dynamics and systems."""

from gpadjust.states.state_spec import StateSpec

__all__ = ["StateSpec"]
