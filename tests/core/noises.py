"""A noise that several tests use."""

import torch

from gpadjust.core import Noise


class Relative(Noise):
    """Noise of a constant standard deviation, and one that is a share of the physics."""

    def __init__(self):
        super().__init__(("constant", "relative"))

    def shares(self, places):
        f = places.f[0]
        return torch.stack([torch.ones_like(f), f.square()], -1)
