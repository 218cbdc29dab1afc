"""Parameters: cases of the laws, and a run of two cases."""

import pytest
import torch

from paper.common.runner import main
from paper.parameters import LAWS, Parameters
from paper.parameters.laws import PROBLEMS, case


def test_all_laws_are_named():
    assert PROBLEMS.keys() == {*LAWS}


@pytest.mark.parametrize("name", PROBLEMS)
def test_cases_are_of_their_law(name):
    known = case(name, 7)
    assert known.X.shape[0] == PROBLEMS[name].number
    true = torch.tensor([*known.true.values()], dtype=torch.float64)
    torch.testing.assert_close(known.system, known.physics(known.X, true))
    misfit = (known.Y - known.system).square().mean().sqrt()
    assert 0.4 < misfit / known.noise < 1.8


def test_a_run_of_a_textbook_case(tmp_path):
    main(Parameters(out=tmp_path, runs=2, jobs=1, only=("smooth", "physics")))
    assert "| calibrated physics | slope | 2 |" in (tmp_path / "tables.md").read_text()


@pytest.mark.slow
def test_nuts_and_the_default(ran, tmp_path):
    runs, tables = ran("nuts", "--only", "enzyme", "--num-draws", "32")
    assert len(runs) == 6
    assert "NUTS" in tables
    assert (tmp_path / "nuts.png").exists()
