"""Systems near walls."""

import pytest
import torch

from gpadjust.dynamics import PhysicsDynamics
from paper.control import Walls, WallsSettings
from paper.control.walls import SYSTEMS, draw, run, tables

TINY = WallsSettings(trials=2, sequences=8, rounds=0, first_sequences=8, first_rounds=0, elites=2)


@pytest.mark.parametrize("name", SYSTEMS)
def test_physics_errors_are_those_of_a_step_of_each_system(name):
    """As stated, within a factor of three of the true ones at random actions."""
    walled = SYSTEMS[name](100)
    system, (env, spec) = walled.system, (walled.system.make(), walled.system.spec)
    seen, errors = env.reset(seed=0)[0], []
    env.action_space.seed(0)
    for _ in range(system.episode_length):
        action = env.action_space.sample()
        row = spec.decode(torch.as_tensor(seen).double()).unsqueeze(0)
        taken = torch.as_tensor(action).double().unsqueeze(0)
        ends = [
            PhysicsDynamics(spec, physics).predict(row, taken).mean
            for physics in (system.physics, walled.truth)
        ]
        errors.append(spec.change(*ends)[0])
        seen = env.step(action)[0]
    found = torch.stack(errors).square().mean(0).sqrt()
    for state, sd in system.physics_error.items():
        assert found[spec.states.index(state)] < 3 * sd


@pytest.mark.slow
def test_walls_make_a_table_and_a_figure(tmp_path):
    walls, runs = Walls(settings=TINY, out=tmp_path), []
    for controller in ("margin", "truth"):
        found = run(walls, "cart", controller, 100)
        assert {len(values) for values in found["trials"].values()} == {2}
        runs.append({"system": "cart", "controller": controller, "seed": 100, **found})
    text = tables(runs, walls)["walls"].text
    assert "| cart in gusts: true model, no margin | " in text
    assert text.splitlines()[3].endswith("| 1.00 | 1.00 |")
    assert "all: CKA, probability 0.95" in text
    assert draw(runs, walls)[0].exists()
