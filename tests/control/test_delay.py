"""Delays that nobody told."""

import pytest
import torch

from gpadjust.control.delay import find_delay
from gpadjust.dynamics import PhysicsDynamics, StateSpec, Trajectories
from tests.control.conftest import full_step
from tests.point import POINT_SPEC
from tests.systems import line, normal

NOISES = 0.0, 0.3
PLAIN = StateSpec(["x", "v"], ["u"])
TOLD = StateSpec(["x", "v", "u_1"], ["u"], previous={"u_1": "u"}, physics_reads=["x", "v", "u_1"])


def motion(X):
    x, v, u = X.unbind(-1)
    return torch.stack([x + 0.1 * v, 0.9 * v + 0.1 * u], dim=-1)


def episodes(spec, delay, seed=0, friction=0.0, noise=0.0, steps=15):
    """Four episodes of random actions, held for two steps, of a cart with dry friction."""
    u = normal(4, steps, seed=seed).repeat_interleave(2, 1)[:, :steps]
    late = torch.cat([torch.zeros(4, delay).double(), u], dim=1)
    path = [torch.zeros(4, 2).double()]
    for t in range(steps):
        force = late[:, t] - friction * torch.sign(path[-1][:, 1])
        path.append(motion(torch.cat([path[-1], force.unsqueeze(-1)], dim=-1)))
    states = torch.stack(path, 1) + noise * normal(4, steps + 1, 2, seed=seed + 100)
    before = torch.cat([torch.zeros(4, 1).double(), u], 1).unsqueeze(-1)
    states = torch.cat([states, *[before] * len(spec.previous)], -1)
    columns = [part.flatten(0, 1) for part in (states[:, :-1], u.unsqueeze(-1), states[:, 1:])]
    return Trajectories(*columns, torch.arange(4).repeat_interleave(steps))


@pytest.mark.parametrize(("spec", "delay"), [(PLAIN, 1), (TOLD, 2)])
def test_one_step_more_than_told_is_found(spec, delay):
    data = episodes(spec, delay, friction=0.1, noise=0.01)
    found = find_delay(PhysicsDynamics(spec, motion), data)
    assert f"follow 'u' {delay} step(s) late" in found
    assert "previous={'u_1': 'u'" in found
    assert f"steps={delay}" in found


@pytest.mark.parametrize(
    ("spec", "delay", "options"),
    [
        *((PLAIN, 0, {"seed": s, "friction": 0.5, "noise": n}) for s in range(3) for n in NOISES),
        *((TOLD, 1, {"seed": s, "friction": 0.5, "noise": n}) for s in range(3) for n in NOISES),
        (PLAIN, 1, {"steps": 6}),  # which tell nothing
    ],
)
def test_there_is_no_false_alarm(spec, delay, options):
    assert find_delay(PhysicsDynamics(spec, motion), episodes(spec, delay, **options)) is None


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_a_wrong_gain_under_a_feedback_is_no_delay(gain):
    parts, x = [], line(4, -1.0)
    for seed in range(10):
        v = -0.3 * x + 0.01 * normal(4, 1, seed=seed)
        parts.append((x, v, x + gain * v))
        x = parts[-1][-1]
    columns = [torch.stack(column, 1).flatten(0, 1) for column in zip(*parts, strict=True)]
    data = Trajectories(*columns, torch.arange(4).repeat_interleave(10))
    assert find_delay(PhysicsDynamics(POINT_SPEC, full_step), data) is None
