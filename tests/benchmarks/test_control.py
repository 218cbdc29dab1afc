"""What a decision of the planner takes, and what of it is the model."""

import time

import pytest
import torch

from gpadjust.control import MPC, Planned, Task
from gpadjust.dynamics import LearnedDynamics
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import (
    CART_POLE_SPEC,
    REAL_CART_POLE,
    cart_pole_reward,
    cart_pole_start,
    equation_physics,
)


@pytest.fixture(scope="module")
def task():
    """The cart-pole, learnt from 100 transitions."""
    torch.manual_seed(0)
    truth, states = equation_physics(REAL_CART_POLE), cart_pole_start(4)
    rows = []
    for _ in range(25):
        actions = 20 * torch.rand(4, 1, dtype=torch.float64) - 10
        following = truth(torch.cat([states, actions], dim=-1))
        rows.append((states, actions, following))
        states = following
    dynamics = LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics)
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
    physics = task.dynamics.physics
    ratio = benchmark.stats["median"] / (16 * median_seconds(lambda: physics(rows)))
    benchmark.extra_info["decision / its evaluations of f_p"] = round(ratio, 2)
    print(f"{benchmark.stats['median']:.3f} s; {ratio:.2f} times its evaluations of f_p")
    assert ratio < 3


def test_mean_beside_its_matrix_products(benchmark, task):
    """What the mean adds to f_p, beside the kernels that it cannot do without, and their products.

    They are those of rho and delta, of four states, under two samples of the hyper-parameters.
    """
    benchmark.group = "the mean of the model at 128 states"
    mean, physics = task.dynamics.mean_function(), task.dynamics.physics
    states, actions = cart_pole_start(128), torch.zeros(128, 1, dtype=torch.float64)
    rows = torch.cat([states, actions], dim=-1)
    at, known = (torch.randn(16, n, 6, dtype=torch.float64) for n in (128, 100))
    weights = torch.randn(16, 100, 1, dtype=torch.float64)

    with torch.no_grad():
        benchmark(lambda: mean(states.unsqueeze(0), actions.unsqueeze(0)))
        of_physics = median_seconds(lambda: physics(rows))
        of_products = median_seconds(lambda: (at @ known.mT).exp_() @ weights)
    ratio = (benchmark.stats["median"] - of_physics) / of_products
    benchmark.extra_info["the mean without f_p / its products"] = round(ratio, 2)
    print(
        f"{1e3 * benchmark.stats['median']:.2f} ms, f_p {1e3 * of_physics:.2f}, products "
        f"{1e3 * of_products:.2f}: {ratio:.2f} times these"
    )
    assert ratio < 12


def median_seconds(call):
    """The time of a call, the median of 100."""
    spent = []
    for _ in range(100):
        start = time.perf_counter()
        call()
        spent.append(time.perf_counter() - start)
    return sorted(spent)[50]
