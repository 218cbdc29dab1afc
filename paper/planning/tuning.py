"""How the settings of the planner were found: on the true system, with seeds that no run has."""

from __future__ import annotations

import argparse
import time

import torch

from gpadjust.control import CrossEntropy, PathIntegral, Planner, Task
from gpadjust.control.search import Search
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.systems.cart_pole import (
    CART_POLE_SPEC,
    REAL_CART_POLE,
    cart_pole_reward,
    cart_pole_start,
    equation_physics,
)
from gpadjust.systems.swing_up import MAX_FORCE
from paper.planning import Settings
from paper.planning.run import planners

SEEDS = range(100, 112)


def main() -> None:
    """Print the cost of a trial by horizon, sequences and search; the first plans are shared."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many")
    seeds = SEEDS[: parser.parse_args().seeds]
    known = PhysicsDynamics(CART_POLE_SPEC, equation_physics(REAL_CART_POLE))
    task = Task(known, cart_pole_reward, episode_length=Settings().episode_length)
    bounds = torch.tensor([[-MAX_FORCE], [MAX_FORCE]], dtype=torch.float64)
    _, first = planners(Settings())
    begun = {}
    for seed in seeds:
        torch.manual_seed(seed)
        start = cart_pole_start(1)[0]
        begun[seed] = start, first.plan(task, start, bounds).actions
    two = CrossEntropy(1, num_elites=12, correlation=0.5)
    one = CrossEntropy(0, num_elites=12, correlation=0.5)
    tried: list[tuple[int, int, float, str, Search]] = [
        (8, 96, 0.15, "2", two),
        (8, 128, 0.1, "2", two),
        (8, 128, 0.15, "2", two),
        (8, 128, 0.2, "2", two),
        (10, 64, 0.1, "2", CrossEntropy(1, num_elites=6, correlation=0.5)),
        (10, 128, 0.1, "2", two),
        (10, 128, 0.15, "2", two),
        (10, 128, 0.2, "2", two),
        (10, 256, 0.1, "2", two),
        (10, 256, 0.1, "1", one),
        (10, 256, 0.1, "1, path integral", PathIntegral(0)),
        (12, 128, 0.15, "2", two),
    ]
    for horizon, number, spread, name, search in tried:
        each = Planner(search=search, horizon=horizon, num_random=number, spread=spread)
        costs, begin = [], time.perf_counter()
        for seed in seeds:
            torch.manual_seed(seed)
            costs.append(_trial(task, each, bounds, *begun[seed]))
        spent = (time.perf_counter() - begin) / len(seeds) / Settings().episode_length
        mean, worst = sum(costs) / len(costs), max(costs)
        print(f"| {horizon}, {number}, {spread}, {name} | {mean:.3f} | {worst:.3f} | {spent:.3f} |")


def _trial(
    task: Task, planner: Planner, bounds: torch.Tensor, state: torch.Tensor, plan: torch.Tensor
) -> float:
    length, cost = Settings().episode_length, 0.0
    for t in range(length):
        if t:
            plan = planner.plan(task, state, bounds, length - t, known=plan[1:]).actions
        following = task.dynamics.sample(state.unsqueeze(0), plan[:1])
        cost -= task.rewards(state.unsqueeze(0), plan[:1], following).item()
        state = following[0]
    return cost / length


if __name__ == "__main__":
    main()
