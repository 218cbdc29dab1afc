"""A cart-pole that is to be swung up: the system, the environment, and its picture."""
