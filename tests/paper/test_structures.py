"""Structures and choice: the problems, smoke runs, and the targets."""

import math

import pytest
import torch

from paper.common.runner import main
from paper.structures import (
    CELLS,
    GROUPS,
    KINDS,
    MODELS,
    OF_NO_USE,
    Choice,
    ChoiceSettings,
    Settings,
    Structures,
    systems,
)
from paper.structures.choice import tables
from paper.structures.problems import PROBLEMS
from paper.structures.structures import cells

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
    assert "| S1 |" in found["targets"].text


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


UNRELATED = (*OF_NO_USE, "unrelated, noise", "unrelated")


@pytest.mark.parametrize("name", OF_NO_USE + KINDS)
def test_whether_the_physics_tells_of_the_function(name):
    """Its correlation is small, or not; that of the other kinds is of f_p as it is."""
    given = PROBLEMS[name]
    X = torch.rand(2000, given.num_inputs, dtype=torch.float64)
    both = torch.stack([given.truth(X), given.physics(X)])
    assert both.isfinite().all()
    correlation = torch.corrcoef(both)[0, 1].abs()
    assert correlation < 0.8 if name in UNRELATED else correlation > 0.3
    assert ("noise" in name) == bool(given.noise)


def record(problem, per_input, method, **found):
    scores = {"rmse": 0.1, "coverage": 0.95, "measured": 0.95, "half": 0.5, "nlpd": 0.0}
    scores |= {"noise": PROBLEMS[problem].noise, "relevance": 0.5, "seconds": 1.0}
    scores |= {"chosen": "CKA", "shown": 0, "single": {"zero mean": 0.1, "CKA": 0.1}}
    return (
        {"problem": problem, "per_input": per_input, "method": method, "seed": 0} | scores | found
    )


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({("cka", 5): {"rmse": 0.2}}, {"N1"}),
        ({("cka", 10): {"noise": 2.0}}, {"N3"}),
        ({("cka", 5): {"measured": 0.85}, ("cka", 10): {"measured": 0.85}}, {"N4"}),
        ({("compare", 5): {"rmse": 0.12, "coverage": 0.9}}, {"C1", "C2", "C3"}),
        ({("compare", 5): {"shown": 1, "single": {"zero mean": 0.1, "CKA": 0.11}}}, {"C4"}),
        ({("compare", 5): {"chosen": "physics mean", "single": {
            "zero mean": 0.1, "CKA": 0.1, "physics mean": 0.12}}}, {"C4"}),
        ({("compare", 5): {"seconds": 9.0}, ("compare", 10): {"seconds": 9.0}}, {"C5"}),
    ],
)  # fmt: skip
def test_targets(tmp_path, changes, missed):
    records = [
        record(problem, per_input, method, **changes.get((method, per_input), {}))
        for problem in OF_NO_USE + KINDS
        for per_input in ((5, 10) if problem in OF_NO_USE else (5,))
        for method in ("zero", "cka", "compare")
    ]
    found = tables(records, Choice(out=tmp_path))["targets"].text.splitlines()[2:]
    verdicts = {line.split(" | ")[0].strip("| "): line.split("**")[1] for line in found}
    assert len(verdicts) == 9
    assert {name for name, verdict in verdicts.items() if verdict == "missed"} == missed


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
def test_a_small_run(tmp_path):
    few = {"runs": 2, "seed": 0, "only": ("decay",)}
    main(Choice(out=tmp_path, jobs=1, settings=ChoiceSettings(num_test=8), **few))
    text = (tmp_path / "tables.md").read_text()
    assert "| decay | 1 | 5 |" in text
