"""The experiment on kinks without noise: its systems, tables, and a run of few transitions."""

import pytest
import torch
from paper.kinks import DATA, KINKS, SMOOTH, Kinks, Settings
from paper.kinks.run import _drawn
from paper.kinks.systems import SYSTEMS
from paper.kinks.tables import tables

from paper.common.runner import main


@pytest.mark.parametrize("name", [*KINKS, *SMOOTH])
def test_which_systems_have_kinks(name):
    """Second differences of a step, along a line of states, grow as the line gets finer, or not."""
    system, generator = SYSTEMS[name], torch.Generator().manual_seed(0)
    ends, actions = system.draw(60, generator)
    states = ends[:30].unsqueeze(1), ends[30:].unsqueeze(1)

    def roughest(points):
        way = torch.linspace(0, 1, points, dtype=torch.float64).reshape(1, -1, 1)
        line = states[0] + way * (states[1] - states[0])
        action = actions[:30].unsqueeze(1).expand(-1, points, -1)
        after = system.step(line.flatten(0, 1), action.flatten(0, 1)).unflatten(0, (30, points))
        second = after.diff(n=2, dim=1).abs().amax() * (points - 1) ** 2
        return float(second)

    growth = roughest(161) / roughest(41)
    assert growth > 2 if name in KINKS else growth < 1.2


def test_physics_is_crude_and_data_are_as_told():
    settings = Settings(held_out=10, steps=5)
    for system in SYSTEMS.values():
        for data in DATA:
            states, actions = _drawn(system, data, 23, settings, 3)
            assert states.shape == (23, system.spec.state_dim)
            assert actions.shape == (23, 1)
            after = system.step(states, actions)
            crude = system.physics(torch.cat([states, actions], dim=-1))
            assert 0 < (after - crude).abs().max() < 20


def record(system, seed, held, width):
    return {
        "system": system,
        "data": "scattered",
        "n": 100,
        "seed": seed,
        "seconds": 1.0,
        "error": [0.1, 0.1],
        **{"held": [held, held], "held_alone": [0.8, 0.8]},
        **{f"{name}{alone}": [1.0, 1.0] for name in ("score", "nlpd") for alone in ("", "_alone")},
        **{"width": [width, width], "width_alone": [1.0, 1.0]},
    }


def test_targets(tmp_path):
    records = [
        record(system, seed, 0.89 if system == "backlash" else 0.96, 1.2)
        for system in KINKS
        for seed in range(2)
    ]
    records += [record(system, seed, 1.0, 1.05) for system in SMOOTH for seed in range(2)]
    found = tables(records, Kinks(out=tmp_path))
    lines = found["targets"].text.splitlines()[2:]
    verdicts = {line.split(" | ")[0].strip("| "): line.split("**")[1] for line in lines}
    assert verdicts == {"K1": "missed", "K2": "met"}
    row = "| gear with backlash | scattered | 100 | 2 | 0.1 | 0.800 | 0.890 | 1.20 | 1.00 |"
    assert row in found["intervals"].text


def test_a_run_of_few_transitions(tmp_path):
    settings = Settings(held_out=20, steps=4)
    main(Kinks(out=tmp_path, runs=2, jobs=1, systems=("bouncing",), sizes=(8,), settings=settings))
    assert "bouncing ball" in (tmp_path / "tables.md").read_text()
    with pytest.raises(ValueError, match="Expected some of"):
        Kinks(systems=("other",)).check()
