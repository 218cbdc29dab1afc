"""Kinds of data: noises, kernels, inputs and models that the core does not name."""
