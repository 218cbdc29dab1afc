"""Rendering without a screen, and states of the cart-pole."""

import math

import pytest
import torch


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def states_and_forces(uniform):
    """Draws ``n`` states all round the circle, and a force for each."""

    def draw(n, seed=0):
        high = torch.tensor([1.0, 2 * math.pi, 2.0, 8.0, 10.0], dtype=torch.float64)
        rows = high * uniform(n, 5, low=-1.0, high=1.0, seed=seed)
        return rows[:, :4], rows[:, 4:]

    return draw
