"""Smoke run of the experiment on nuclear masses, and its physics."""

import numpy as np
import pytest
import torch

from paper.published.masses import drop, left_out, nuclides, shell


class Textbook:
    """Coefficients in MeV."""

    volume, surface, coulomb, asymmetry, pairing = 15.8, 18.3, 0.714, 23.2, 12.0
    valence, promiscuity = -0.2, 0.1


def test_the_physics():
    lead, tin = torch.tensor([[82.0, 126.0], [50.0, 70.0]]).double()
    both = torch.stack([lead, tin])
    assert torch.allclose(shell(both, Textbook)[0], drop(both, Textbook)[0])  # doubly magic
    assert abs(drop(both, Textbook)[0] - 1636.4) < 15  # MeV, as measured
    assert shell(both, Textbook)[1] == drop(both, Textbook)[1] - 0.2 * 12


def test_the_data_and_what_is_left_out():
    table = nuclides()
    known = table[table.measured == 1].reset_index(drop=True)
    assert len(known) == 2457
    folds = np.stack([left_out(known, "fold", 0, seed) for seed in range(10)])
    assert (folds.sum(0) == 1).all()
    ends = left_out(known, "outer2", 0, 0)
    tin = known[known.Z == 50].N
    assert sorted(known[ends & (known.Z == 50)].N) == [
        *sorted(tin)[:2],
        *sorted(tin)[-2:],
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_it_runs(ran, tmp_path):
    runs, tables = ran("masses", "--stride", "15", "--num-rows", "60")
    assert len(runs) == 2 * 9 + 3 * 9
    assert all(name in tables for name in ("errors", "all", "parameters"))
    assert (tmp_path / "masses.png").exists()
