"""What a decision of the planner takes, and what of it is the model."""

import time

import pytest
import torch

from gpadjust.control import MPC, Planned, Task
from gpadjust.dynamics import LearnedDynamics
from gpadjust.envs import (
    CART_POLE_SPEC,
    cart_pole_physics,
    cart_pole_reward,
    cart_pole_start,
    random_cart_pole_physics,
)


@pytest.fixture(scope="module")
def task():
    """The cart-pole, learnt from 100 transitions."""
    torch.manual_seed(0)
    truth, states = cart_pole_physics(0.5, 0.5, 0.6, 0.1), cart_pole_start(4)
    rows = []
    for _ in range(25):
        actions = 20 * torch.rand(4, 1, dtype=torch.float64) - 10
        following = truth(torch.cat([states, actions], dim=-1))
        rows.append((states, actions, following))
        states = following
    dynamics = LearnedDynamics(CART_POLE_SPEC, random_cart_pole_physics(0))
    dynamics.update(*(torch.cat(column) for column in zip(*rows, strict=True)))
    return Task(dynamics, cart_pole_reward, episode_length=25)


def test_decision_beside_the_physics(benchmark, task):
    """A decision is two looks at 128 sequences of 8 steps; the physics alone is most of it."""
    benchmark.group = "a decision on the cart-pole"
    mpc = MPC(task, torch.tensor([[-10.0], [10.0]]))
    state = cart_pole_start(1)[0]
    earlier = Planned(torch.zeros(20, 1, dtype=torch.float64), torch.empty(0), 5)
    benchmark(lambda: mpc.plan(state, earlier))
    states = cart_pole_start(128)
    rows = torch.cat([states, torch.zeros(128, 1, dtype=torch.float64)], dim=-1)
    physics, spent = task.dynamics.physics, []
    for _ in range(10):
        start = time.perf_counter()
        for _ in range(16):
            physics(rows)
        spent.append(time.perf_counter() - start)
    ratio = benchmark.stats["median"] / sorted(spent)[5]
    benchmark.extra_info["decision / its evaluations of f_p"] = round(ratio, 2)
    print(f"{benchmark.stats['median']:.3f} s; {ratio:.2f} times its evaluations of f_p")
    assert ratio < 3
