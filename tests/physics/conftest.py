"""A module that several tests of the physics take."""

import torch


class Scale(torch.nn.Module):
    """`x_0 -> gain * x_0 + offset`, with a parameter and a buffer."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.register_buffer("offset", torch.tensor(0.0, dtype=torch.float64))
        self.calls = 0

    def forward(self, X):
        self.calls += 1
        return self.gain * X[:, 0] + self.offset
