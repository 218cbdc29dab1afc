"""The experiment on the cascaded tanks."""

import pytest
import torch
from paper.tanks import CANDIDATES, GPS, LEARNERS, NARX, STRUCTURES, TENTH, Settings, Tanks
from paper.tanks.figure import COLORS
from paper.tanks.run import Start, blocks, follow, without
from paper.tanks.systems import FIXED, UNKNOWNS, measured, narx_spec, physics, rates
from paper.tanks.tables import label_of
from torch.testing import assert_close

from paper.common.runner import rounded, runs_file

TINY = Settings(samples=64, head=40, blocks=2, starts=1, rounds=3, tenths=6, narx=30, sizes=(12,))
VALUES = {**{name: known.guess for name, known in UNKNOWNS.items()}, "power": 0.5}


@pytest.mark.slow
def test_runs_and_their_tables(tmp_path):
    experiment = Tanks(out=tmp_path, runs=1, settings=TINY)
    experiment.check()
    file, ran = runs_file(experiment), ("overflow-small", "sensor-middle", "narx-2")
    ran = (*ran, TENTH, "overflow-delta")
    for name in CANDIDATES:
        if name not in ran:
            kind = dict(zip(experiment.key, (name, 64, 0), strict=True))
            file.append({**kind, "versions": {}, "cv": 9.0, "rmse": 9.0})
    records = []
    for task in experiment.tasks():
        if task[0] in ran:
            found = rounded(experiment.run(*task, unfinished=tmp_path / "x"))
            assert 0 < found["rmse"] < 10
            assert 0 <= found["coverage"] <= 1
            assert ("cv" in found) == (task[0] in (*CANDIDATES, *NARX))
            records.append(dict(zip(experiment.key, task, strict=True)) | found)
            if task[0] in CANDIDATES:
                file.append({**records[-1], "settings": {}, "versions": {}})
    by = {record["learner"]: record.get("by") for record in records}
    errors = {record["learner"]: record["cv"] for record in records if "cv" in record}
    assert by[TENTH] == min(ran[:2], key=lambda name: errors[name])
    assert by["overflow-delta"] == "overflow-small"
    tables = experiment.tables(records)
    assert tables.keys() == {"targets", "candidates", "learners", "parameters"}
    assert tables["targets"].text.count("\n") == 4
    unsettled = [{**record, "settled": False} for record in records]
    assert "not settled" in experiment.tables(unsettled)["targets"].text
    assert label_of(by[TENTH], by[TENTH]) in tables["learners"].text
    assert [path.name for path in experiment.draw(records)] == ["tanks.png"]


def test_candidates_come_first():
    tasks = Tanks().tasks()
    assert len(tasks) == len({*tasks})
    assert [name for name, *_ in tasks[: len(CANDIDATES)]] == [*CANDIDATES]
    assert {name for name, *_ in tasks} == {*CANDIDATES, *LEARNERS}
    few = Tanks(learners=("cka",)).tasks()
    assert {name for name, *_ in few} == {*CANDIDATES, "cka"}
    assert all(label_of(name) for name in (*CANDIDATES, *LEARNERS))
    assert FIXED.keys() == STRUCTURES.keys()
    assert {*COLORS} == {*STRUCTURES, "narx"}
    assert {*GPS, *NARX, TENTH} == {*LEARNERS}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"learners": ("moon",)}, "--learners: there is no 'moon', but there are tenth"),
        ({"settings": Settings(samples=66)}, "--samples: expected at most 1024, and two for"),
        ({"settings": Settings(samples=2000)}, "--samples: expected at most 1024"),
    ],
)
def test_unknown_names_and_numbers_out_of_range_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        Tanks(**options).check()


def test_blocks_are_all_samples_but_the_head():
    settings = Settings()
    rows = [row for block in blocks(settings) for row in range(1024)[block]]
    assert rows == [*range(settings.head, 1024)]
    _, lower = measured("Est", 1024)
    left = without(lower, blocks(settings)[1])
    assert left.isnan().sum() == 241
    assert not lower.isnan().any()


def test_sensor_without_bend_is_torricelli():
    state, action = (
        torch.tensor([[4.0, 9.0], [12.0, 4.0]]).double(),
        torch.full((2, 1), 3.0).double(),
    )
    values = {**VALUES, **FIXED["overflow"]}
    found = rates(state, action, values)
    over = torch.tensor([0.0, 1.5 * 3.0]).double()
    inflow = torch.full((2,), 0.12).double()
    outflow = 0.04 * state.sqrt()
    assert_close(found[:, 0], inflow - outflow[:, 0] - over)
    assert_close(found[:, 1], outflow[:, 0] + 0.5 * over - outflow[:, 1])


def test_sensor_of_a_root_slows_where_it_is_flat():
    """The level that the sensor's rate implies changes as Torricelli says."""
    state, action = torch.tensor([[4.0, 7.0]]).double(), torch.zeros(1, 1).double()
    values = {**VALUES, **FIXED["sensor"]}
    state.requires_grad_(True)
    level = 5 * ((state[:, 1] - 2.2) / 2.8).sqrt()
    (slope,) = torch.autograd.grad(level.sum(), state)
    change = slope[:, 1] * rates(state, action, values)[:, 1]
    assert_close(change, 0.04 * (2.0 - level.sqrt()))


def test_free_run_ends_where_inflow_is_outflow():
    lower = torch.full((800,), 5.0).double()
    actions = torch.full((800,), 2.0).double()
    path = follow(physics("overflow", VALUES), Start(5.0, 1.0), actions, lower)
    assert path[0] == 5.0
    assert float(path[-1]) == pytest.approx(4.0, abs=0.01)  # 2 = sqrt(level)


def test_states_without_physics():
    spec = narx_spec(3)
    assert spec.states == ("lower", "lower_1", "lower_2", "pump_1", "pump_2")
    assert narx_spec(1).states == ("lower",)
