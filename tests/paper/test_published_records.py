"""Smoke runs of the experiments on published records, and what they read."""

import pytest
import torch
from torch.testing import assert_close

from gpadjust.dynamics import PhysicsDynamics
from paper.published import RECORDS, EmpsSettings
from paper.published.emps import measured, physics
from paper.published.freeruns_systems import SYSTEMS, narx_spec, records


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_emps(ran, tmp_path):
    runs, tables = ran("emps", "--rows", "600", "--every", "20", "--rounds", "5")
    assert len(runs) == 9
    assert all(0 < run["rmse"] < 1000 for run in runs)
    assert all(word in tables for word in ("dynoNet", "Fv, N s/m"))
    assert (tmp_path / "emps.png").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_freeruns(ran):
    options = ["--only", "furnace", "--transitions", "20", "--rounds", "5", "--starts", "1"]
    runs, tables = ran("freeruns", *options)
    assert len(runs) == 7
    assert all(run["rmse"] > 0 and 0 <= run["coverage"] <= 1 for run in runs)
    assert all(word in tables for word in ("PR-SSM, published", "lag, delay 2"))


def test_the_servo_is_in_metres_and_newtons():
    part = measured("estimation", EmpsSettings())
    assert (part.q.min(), part.q.max()) == pytest.approx((0.0, 0.25), abs=0.005)
    assert part.step == 0.025
    assert len(part.q) == 993


def test_dry_friction_holds_the_servo():
    rest = torch.tensor([[0.1, 0.0, 15.0], [0.1, 0.0, 40.0]], dtype=torch.float64)
    following = physics(0.025, [95.0, 200.0, 20.0, 0.0])(rest)
    assert_close(following[0], rest[0, :2])
    assert following[1, 1] > 0


@pytest.mark.parametrize("record", RECORDS)
def test_candidates_return_next_states(record):
    system = SYSTEMS[record]
    actions = system.column(system.action)
    for structure in system.structures.values():
        values = [unknown.guess for unknown in structure.unknowns.values()]
        spec = structure.spec(5)
        states = torch.zeros(3, spec.state_dim, dtype=torch.float64)
        step = PhysicsDynamics(spec, structure.physics(values)).mean_function()
        assert step(states[None], actions[:3].view(1, 3, 1)).isfinite().all()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_record_fills_in_what_was_before():
    system = SYSTEMS["furnace"]
    output, actions = system.column("co2")[:10], system.column("gas_rate")[:10]
    data = records(output[:, None], actions, narx_spec(2, 3)).trajectories()
    assert_close(data.states[0], torch.stack([output[2], output[1], actions[1], actions[0]]))
