"""A planar arm that reaches for targets, driven by muscles, or in the crude physics by torques."""
