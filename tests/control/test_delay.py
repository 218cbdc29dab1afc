"""Delays that nobody told."""

import pytest
import torch

from gpadjust.control.delay import find_delay
from gpadjust.dynamics import PhysicsDynamics, StateSpec, Trajectories
from tests.control.conftest import full_step
from tests.point import POINT_SPEC

NOISES = 0.0, 0.3
PLAIN = StateSpec(["x", "v"], ["u"])
TOLD = StateSpec(["x", "v", "u_1"], ["u"], previous={"u_1": "u"}, physics_reads=["x", "v", "u_1"])


def motion(X):
    x, v, u = X.unbind(-1)
    return torch.stack([x + 0.1 * v, 0.9 * v + 0.1 * u], dim=-1)


def episodes(spec, delay, seed=0, friction=0.0, noise=0.0, steps=15):
    """Four episodes of random actions, held for two steps, of a cart with dry friction."""
    torch.manual_seed(seed)
    u = torch.randn(4, steps).double().repeat_interleave(2, 1)[:, :steps]
    late = torch.cat([torch.zeros(4, delay).double(), u], dim=1)
    parts = []
    for given, taken in zip(u, late, strict=False):
        states, state = [], torch.zeros(2).double()
        for t in range(steps + 1):
            previous = [given[t - 1] if t else torch.tensor(0.0).double()] * len(spec.previous)
            states.append(torch.stack([*state, *previous]))
            force = taken[min(t, steps - 1)] - friction * torch.sign(state[1])
            state = motion(torch.stack([*state, force])[None])[0]
        path = torch.stack(states)
        path[:, :2] += noise * torch.randn(steps + 1, 2).double()
        parts.append((path[:-1], given.unsqueeze(-1), path[1:]))
    columns = [torch.cat(column) for column in zip(*parts, strict=True)]
    return Trajectories(*columns, torch.arange(4).repeat_interleave(steps))


@pytest.mark.parametrize(("spec", "delay"), [(PLAIN, 1), (TOLD, 2)])
@pytest.mark.parametrize("seed", range(3))
def test_one_step_more_than_told_is_found(spec, delay, seed):
    data = episodes(spec, delay, seed, friction=0.1, noise=0.01)
    found = find_delay(PhysicsDynamics(spec, motion), data)
    assert f"follow 'u' {delay} step(s) late" in found
    assert "previous={'u_1': 'u'" in found
    assert f"steps={delay}" in found


@pytest.mark.parametrize(
    ("spec", "delay", "options"),
    [
        *((PLAIN, 0, {"seed": s, "friction": 0.5, "noise": n}) for s in range(5) for n in NOISES),
        *((TOLD, 1, {"seed": s, "friction": 0.5, "noise": n}) for s in range(5) for n in NOISES),
        (PLAIN, 1, {"steps": 6}),  # which tell nothing
    ],
)
def test_there_is_no_false_alarm(spec, delay, options):
    assert find_delay(PhysicsDynamics(spec, motion), episodes(spec, delay, **options)) is None


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_a_wrong_gain_under_a_feedback_is_no_delay(gain):
    torch.manual_seed(0)
    x = torch.linspace(-1, 1, 4).double().unsqueeze(-1)
    parts = []
    for _ in range(10):
        v = -0.3 * x + 0.01 * torch.randn(4, 1).double()
        parts.append((x, v, x + gain * v))
        x = parts[-1][-1]
    columns = [torch.stack(column, 1).flatten(0, 1) for column in zip(*parts, strict=True)]
    data = Trajectories(*columns, torch.arange(4).repeat_interleave(10))
    assert find_delay(PhysicsDynamics(POINT_SPEC, full_step), data) is None
