"""The random generators that a run draws from."""

import pickle
import random

import numpy as np
import torch

from gpadjust.rl.random_state import RandomState


def draw():
    return random.random(), np.random.random(), torch.rand(1).item()  # noqa: NPY002


def test_draws_are_repeated_after_restoring():
    state = pickle.loads(pickle.dumps(RandomState.capture()))
    first, second = draw(), draw()
    assert first != second
    state.restore()
    assert (draw(), draw()) == (first, second)
