"""Rows that stand in the data twice."""

import warnings

import pytest
import torch

from gpadjust import CKA, VariationalCKA
from tests.systems import ripple


@pytest.mark.parametrize("has_gap", [False, True], ids=["observed", "missing"])
def test_they_are_warned_of(uniform, has_gap):
    X = uniform(9, 2)
    Y = ripple(X)
    if has_gap:
        Y[1, 0] = torch.nan
    rows = torch.tensor([*range(9), 1, 1, 4])
    with pytest.warns(UserWarning, match="3 of 12 rows equal an earlier row"):
        CKA(X[rows], Y[rows], physics=ripple)


def test_repeats_that_differ_are_not(uniform):
    X = uniform(9, 2)
    X, Y = X.repeat(2, 1), ripple(X).repeat(2, 1)
    Y[9:, 1] += 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CKA(X, Y, physics=ripple)
        VariationalCKA(X, Y, physics=ripple, num_inducing=4)
