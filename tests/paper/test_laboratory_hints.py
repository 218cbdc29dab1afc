"""Hints: the data of each kind, and a run."""

import pytest
import torch

from paper.laboratory import Hints
from paper.laboratory.hints import POINTS, data_of, run, tables
from paper.pairs.functions import pair

CURRIN = pair("currin")


def test_data_differ_in_their_kind_alone():
    X, Y, bent = data_of(CURRIN, "noisy", 0)
    assert (X.shape, Y.shape, bent) == ((POINTS, 2), (POINTS, 1), False)
    off = data_of(CURRIN, "outliers", 0)[1] - Y
    assert (off != 0).sum() == POINTS // 20
    assert data_of(CURRIN, "rigs", 0)[0].shape == (POINTS, 3)
    exact, wide = data_of(CURRIN, "exact", 0)[1], data_of(CURRIN, "relative", 0)[1]
    assert torch.equal(exact, CURRIN.truth(data_of(CURRIN, "exact", 0)[0]))
    assert wide.max() / wide.min() > 20


@pytest.mark.slow
def test_a_run():
    experiment = Hints()
    found = {"data": "outliers", "problem": "currin", "seed": 7}
    found |= run(experiment, "outliers", "currin", 7)
    assert found["given"]["outliers"] == 1
    assert "1.00" in tables([found], experiment)["given"].text
