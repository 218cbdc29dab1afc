"""Controllers for systems that people know."""
