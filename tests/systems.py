"""Functions, data and models that the tests of several rooms take."""

import pytest
import torch


def uniform(*shape, low=0.0, high=1.0, seed=0):
    """Draws float64 numbers of a shape, uniform on [low, high], the same ones for a seed."""
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def normal(*shape, seed=0):
    """Draws standard normal float64 numbers of a shape, the same ones for a seed."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def slopes(function, u, step=3e-4):
    """Derivatives by coordinates ``... x P``, by differences of the fourth order."""
    found = []
    for i in range(u.shape[-1]):
        by = torch.zeros_like(u)
        by[..., i] = step
        far, low, high, further = (function(u + k * by) for k in (-2, -1, 1, 2))
        found.append((8 * (high - low) - (further - far)) / (12 * step))
    return torch.stack(found, -1)


def line(n, low=0.0, high=1.0):
    """Evenly spaced float64 numbers, ``n x 1``."""
    return torch.linspace(low, high, n, dtype=torch.float64).unsqueeze(-1)


def crude(X):
    """Two outputs of two inputs, neither of them near zero on [0, 2]^2."""
    return torch.stack([2 + (3 * X[..., 0]).sin() + X[..., 1], 4 + (2 * X[..., 1]).cos()], dim=-1)


def truth(X):
    """What a model of `crude` is to learn."""
    bias = torch.stack([X[..., 1].square(), X[..., 0].exp()], dim=-1) / 4
    return crude(X) * (1.2 + 0.2 * X[..., :1]) + bias


def measured(X):
    """One output of two inputs, of a laboratory."""
    return 1.4 * (2 + (2 * X[..., :1]).sin()) + X[..., 1:].square()


def ripple(X):
    """As many outputs as inputs, none of them near zero."""
    return 2 + (3 * X).sin()


def wave(X):
    """One output, of the first input."""
    return torch.sin(6 * X[..., :1])


def waves(X):
    """Two outputs, of the first input."""
    return torch.cat([wave(X), wave(X).square()], dim=-1)


class Sine(torch.nn.Module):
    """A physics that learns: sin(rate x) + offset, and cos(rate x) if wanted."""

    def __init__(self, rate, offset=0.0, num_outputs=1):
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor(rate, dtype=torch.float64))
        self.offset, self.num_outputs = offset, num_outputs

    def forward(self, X):
        angle = self.rate * X
        return torch.cat([angle.sin() + self.offset, angle.cos()], -1)[..., : self.num_outputs]


def drawn(model, number=2, seed=3):
    """The model with some draws near the middle of its prior, the second of a nested model."""
    u = 0.4 * normal(number, *model.u.shape[1:], seed=seed)
    u, nested = (model.table.with_choice(u, k) for k in (0, 1))
    model.set_draws(torch.cat([u[:1], nested[1:2], u[2:]]))
    return model.eval()


def same(ours, theirs, **tolerance):
    """Asserts that tensors are close, one by one: moments of two predictions, say."""
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, **tolerance)


def refused(error, words, call, *args, **options):
    """Asserts that a call is refused by an error with these words."""
    with pytest.raises(error, match=words):
        call(*args, **options)
