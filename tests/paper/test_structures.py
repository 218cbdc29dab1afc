"""Structures: the problems, a smoke run, and the claim."""

import math

import pytest
import torch

from paper.structures import (
    CELLS,
    GROUPS,
    KINDS,
    MODELS,
    Settings,
    Structures,
    systems,
)
from paper.structures.problems import PROBLEMS
from paper.structures.structures import cells, judge_intervals

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


@pytest.mark.slow
def test_smoke(tmp_path):
    settings = Settings(num_test=20, num_transitions=20)
    experiment = Structures(out=tmp_path, settings=settings)
    kinds = [("forrester", 5, 0.0), ("pendulum", 5, 0.0)]
    records = [
        dict(zip(experiment.key, (*kind, model, 0), strict=True)) | experiment.run(*kind, model, 0)
        for kind in kinds
        for model in MODELS
    ]
    assert all(0 <= r["coverage"] <= 1 and r["nrmse"] > 0 for r in records)
    assert [len(r["each"]["nlpd"]) for r in records] == [1] * 4 + [2] * 4
    found = experiment.tables(records)
    assert "pendulum, N = 5" in found["nrmse"].text
    assert "| all |" in found["summary"].text
    assert "| U1 |" in found["claims"].text


def test_limits():
    """Both limits are against the better of the two, of each score by itself."""
    rmse = {
        "cka": [1.0, 1.3, 1.2],
        "phy": [2.0, 1.0, 9.0],
        "gp": [1.5, 2.0, 1.0],
        "rra": [3.0] * 3,
    }
    nlpd = {"cka": 0.1, "phy": 0.0, "gp": 1.0, "rra": 2.0}
    records = [
        {"problem": "booth", "size": 5, "noise": 0.0, "model": model, "seed": seed, "N": 10,
         "nrmse": values[seed], "nlpd": nlpd[model], "coverage": 0.9, "seconds": 1.0,
         "warned": False, "power": [], "each": {}}
        for model, values in rmse.items() for seed in range(3)
    ]  # fmt: skip
    found = cells(records).iloc[0]
    assert found["nrmse", "cka"] == pytest.approx(1.2 / 1.5)
    assert found["nlpd", "cka"] == pytest.approx(0.1)
    text = Structures().tables(records)["summary"].text
    assert "| all | 1 of 1 (100%) | 1 | 1 | 0.80 |" in text


def test_cells():
    assert len(CELLS) == len(set(CELLS)) == 16 + 1 + 4 * 3
    assert {name for name, *_ in CELLS} == set(GROUPS)
    assert len(Structures(runs=2, only=("cka",)).cases()) == 2 * len(CELLS)
    with pytest.raises(ValueError, match="no 'pendulums'"):
        Structures(only=("pendulums",)).check()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "cart-pole", "pendulum", "double-pendulum"])
def test_transitions(name):
    """Few are part of many; all go on from where the one before ended, or are of records."""
    few, many = (systems.system(name, n, 60, 3) for n in (10, 50))
    assert torch.equal(few.train.states, many.train.states[:10])
    assert len(many.train.states) == 50
    assert torch.equal(few.test.states, systems.system(name, 10, 60, 4).test.states)
    known = {tuple(row) for row in many.train.states.tolist()}
    assert not known & {tuple(row) for row in many.test.states.tolist()}


@pytest.mark.parametrize("name", ["pendulum", "double-pendulum"])
def test_the_physics_of_records_is_crude_but_right(name):
    """It leaves less than half of the change in the machines, but not as little as noise."""
    data = systems.system(name, 50, 0, 0)
    with torch.no_grad():
        following = data.physics(torch.cat([data.test.states, data.test.actions], dim=-1))
    left = data.spec.change(following, data.test.next_states).square().mean(0).sqrt()
    change = data.spec.change(data.test.states, data.test.next_states).square().mean(0).sqrt()
    share = left / change
    assert (share < 0.55).all()
    assert share.max() > 0.2


def test_too_few_transitions_in_the_records():
    with pytest.raises(ValueError, match="have 404 transitions, not 500"):
        systems.system("pendulum", 500, 0, 0)


def test_double_pendulum_keeps_its_energy():
    """Without torques a rigid body's kinetic and potential energy are constant."""
    physics, x = (
        systems.double_pendulum_physics(),
        torch.tensor([[0.5, -0.8, 1.0, 2.0]]).double(),
    )
    mass, centre, length, coupling = (0.608, 0.630), (0.275, 0.166), 0.3, 0.630 * 0.3 * 0.166

    def energy(x):
        q1, q2, dq1, dq2 = x[0].tolist()
        first = 0.0547 + mass[1] * length**2
        kinetic = 0.5 * first * dq1**2 + 0.5 * 0.0252 * (dq1 + dq2) ** 2
        kinetic += coupling * math.cos(q2) * dq1 * (dq1 + dq2)
        height = -(mass[0] * centre[0] + mass[1] * length) * math.cos(q1)
        return kinetic + 9.81 * (height - mass[1] * centre[1] * math.cos(q1 + q2))

    before = energy(x)
    with torch.no_grad():
        for _ in range(50):
            x = physics(torch.cat([x, torch.zeros(1, 2).double()], dim=-1))
    assert energy(x) == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize("name", KINDS)
def test_the_physics_tells_of_the_function(name):
    given = PROBLEMS[name]
    X = torch.rand(2000, given.num_inputs, dtype=torch.float64)
    both = torch.stack([given.truth(X), given.physics(X)])
    assert both.isfinite().all()
    assert torch.corrcoef(both)[0, 1].abs() > 0.3
    assert ("noise" in name) == bool(given.noise)


def test_intervals_are_judged_by_their_distance_from_95_and_by_density():
    runs = [
        {"problem": "booth", "size": seed, "noise": 0.0, "seed": 0, "model": name,
         "coverage": value + seed / 1000, "nlpd": density + seed / 1000}
        for seed in range(4)
        for name, value, density in (("cka", 0.94, -2.0), ("rra", 0.93, -1.5), ("gp", 0.6, 1.0))
    ]  # fmt: skip
    assert judge_intervals(runs).verdict == "reproduced"
    assert judge_intervals(runs[:2]).verdict == "not run"
    worse = judge_intervals([{**run, "nlpd": -run["nlpd"]} for run in runs])
    assert worse.verdict == "undetermined"
    assert "by coverage reproduced, by NLPD not reproduced" in worse.measured
