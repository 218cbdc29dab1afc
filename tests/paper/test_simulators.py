"""Simulators: logs of the machines, and a run of each method."""

import pytest
import torch

from paper.simulators import Simulators

pytest.importorskip("mujoco", "3.5")


@pytest.mark.parametrize("name", ["pendulum", "arm"])
def test_logs_are_of_the_model_and_of_its_friction(name):
    from paper.simulators.machines import MACHINES, log_of

    machine = MACHINES[name]
    right, lacking = (log_of(machine, has_friction, 60, seed=1) for has_friction in (False, True))
    physics, true = machine.physics(), torch.tensor([*right.true.values()], dtype=torch.float64)
    for log, most in ((right, 1e-12), (lacking, 1.0)):
        rows = torch.cat([log.states, log.torques], -1)[:-1]
        error = (physics(rows, true) - log.states[1:]).abs().max()
        assert error <= most
    assert error > 1e-3
    assert right.true == lacking.true
    measured = right.records.records[0].states
    angles = len(machine.start)
    off = (measured - right.states)[:, :angles]
    assert off.std() == pytest.approx(machine.noise, rel=0.2)
    assert measured[:, angles:].isnan().all()


@pytest.mark.slow
def test_a_log_of_each_method(ran):
    pytest.importorskip("mujoco.sysid._src.optimize", reason="mujoco[sysid] is not installed")
    options = ["--seed", "1000", "--rows", "200", "--ahead", "20"]
    runs, tables = ran("simulators", "--only", "pendulum", "right", *options)
    assert len(runs) == 2 * len(Simulators.axes["method"])
    assert "| mujoco.sysid | link.mass | 2 |" in tables
    for run in runs:
        assert run["free_run"] < run["free_run_guesses"]
        for name, true in run["true"].items():
            assert run["estimates"][name][0] == pytest.approx(true, rel=0.1)
