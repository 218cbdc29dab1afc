"""Logs of machines whose equations are known."""

import numpy as np

from gpadjust.records import Record, Records


def held(rng, low, high, rows, length=8):
    """Actions that are held for some rows, uniform on [low, high]."""
    return np.repeat(rng.uniform(low, high, rows // length + 1), length)[:rows]


def simulated(rates, state, actions, step, fine=20):
    """States at each action, by the midpoint rule in `fine` parts of a step."""
    state, states, h = np.array(state), [], step / fine
    for u in actions:
        states.append(state)
        for _ in range(fine):
            middle = state + h / 2 * np.array(rates(*state, u))
            state = state + h * np.array(rates(*middle, u))
    return np.array(states)


def log_of(spec, step, states, actions, noise, rng):
    """Records of the states of a spec with noise, which is NaN of hidden ones."""
    states = states[:, : spec.state_dim]
    noisy = states + np.array(noise) * rng.normal(size=states.shape)
    return Records(Record(step * np.arange(len(actions)), noisy, actions[:, None]), spec)
