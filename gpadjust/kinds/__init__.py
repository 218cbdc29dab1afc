"""Kinds of data: noises, kernels, inputs, scales and physics that the core does not name."""

from gpadjust.kinds.ar1 import AR1
from gpadjust.kinds.categories import Categories, levels_of, on_levels
from gpadjust.kinds.emulated import EmulatedPhysics
from gpadjust.kinds.factory import ModelFactory, make_model, with_options
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.links import (
    Linked,
    LinkedCalibratedPhysics,
    LinkedCKA,
    LinkedPhysicsMeanGP,
    LinkedRRA,
    LinkedScaleGP,
    LinkedZeroMeanGP,
    linked,
)
from gpadjust.kinds.local_errors import LocalErrors
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.kinds.pyro_model import pyro_model
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.kinds.updates import Kalman, Window
from gpadjust.kinds.vanishing import Vanishing

__all__ = [
    "Categories", "HeavyTails", "Kalman", "LinkedCKA", "LocalErrors", "NoisyInputs",
    "RelativeNoise", "Vanishing", "Window", "levels_of", "linked", "pyro_model", "with_options",
]  # fmt: skip
