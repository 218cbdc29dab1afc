"""Steps of many states, at some of which the physics fails."""

import pytest
import torch

from gpadjust.dynamics.particles import step_or_nan
from gpadjust.physics import PhysicsError


@pytest.mark.parametrize("num_states", [1, 3])
@pytest.mark.parametrize("bad", [[2], [0, 3]])
def test_rows_where_the_physics_fails_are_nan(num_states, bad):
    def move(states, actions):
        rows = (states[:, 0] < 0).nonzero().flatten().tolist()
        if rows:
            raise PhysicsError("It fails.", rows=rows)
        return states + actions[:, :1]

    states = torch.ones(4, num_states, dtype=torch.float64)
    actions = torch.full((4, 2), 0.5, dtype=torch.float64)
    states[bad] = -1.0
    before = states.clone()
    following = step_or_nan(move, states, actions)
    works = [i for i in range(4) if i not in bad]
    assert following[bad].isnan().all()
    assert (following[works] == 1.5).all()
    assert states.equal(before)
