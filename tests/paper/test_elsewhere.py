"""The experiment on records beyond those learnt from: its systems, tables, and a tiny run."""

import pytest
import torch
from paper.elsewhere import HORIZONS, TRAININGS, Elsewhere, Settings
from paper.elsewhere.systems import SYSTEMS, design_c, loaded_pendulum
from paper.elsewhere.tables import tables
from paper.real.machines import PENDULUM

from paper.common.runner import rounded

TINY = Settings(n=20, windows=2)


def test_systems_have_their_records():
    assert SYSTEMS.keys() == TRAININGS.keys()
    for system in SYSTEMS.values():
        records = system.stretches(100, 0)
        assert len(records) == 10
        for name, test in system.tests.items():
            windows = system.windows(name, HORIZONS[-1], 3)
            assert windows.measured.shape == (3, HORIZONS[-1], system.machine.spec.state_dim)
            if system.has_load:
                assert (windows.actions[..., 1] == test.load).all()


def test_the_physics_of_another_mass_and_design():
    known = {name: torch.tensor(v).double() for name, v in PENDULUM.known["identified"].items()}
    state, action = torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[0.0, 0.68]]).double()
    heavy = loaded_pendulum(state, torch.tensor([[0.0, 1.36]]).double(), known)
    # Without torque and friction the mass is of no matter.
    torch.testing.assert_close(heavy, loaded_pendulum(state, action, known))
    machine = SYSTEMS["design-c0"].machine
    crude = {name: torch.tensor(v).double() for name, v in machine.known["crude"].items()}
    rest = design_c(torch.zeros(1, 4).double(), torch.zeros(1, 2).double(), crude)
    assert (rest == 0).all()


@pytest.mark.filterwarnings("ignore:The observations say next to nothing")
@pytest.mark.slow
def test_a_run_and_its_tables(tmp_path):
    experiment = Elsewhere(out=tmp_path, trainings=("pendulum",), settings=TINY)
    experiment.check()
    records = []
    for task in experiment.tasks()[:3]:
        found = rounded(experiment.run(*task, unfinished=tmp_path / "x"))
        records.append(dict(zip(experiment.key, task, strict=True)) | found)
    assert [*records[2]["tests"]["1kg"]] == ["none", "found"]
    assert len(records[2]["variation"]) == 4
    written = tables(records, experiment)
    assert written["scores"].text.count("\n") == 1 + 4 * 4
    assert "beyond the training range: 95 % hold at least 0.85" in written["targets"].text


def test_options_out_of_range():
    with pytest.raises(ValueError, match="found moon"):
        Elsewhere(trainings=("moon",)).check()
    with pytest.raises(ValueError, match="--n: expected"):
        Elsewhere(settings=Settings(n=15)).check()
