"""The physics as a mean function."""

from unittest import TestCase

import pytest
import torch
from gpytorch.test.base_mean_test_case import BaseMeanTestCase
from torch import Size

from gpadjust.gp import PhysicsColumn, PhysicsMean


class TestAsGPyTorchsMeans(BaseMeanTestCase, TestCase):
    def create_mean(self):
        return PhysicsMean(lambda X: X.sum(-1))

    @pytest.mark.skip(reason="f_p takes rows; a GPyTorch model passes n x d")
    def test_forward_vec(self):
        pass


def test_values(uniform):
    X = uniform(3, 4, 2)
    mean = PhysicsMean(lambda X: X.square(), output=1)
    torch.testing.assert_close(mean(X), X[..., 1].square())


def test_a_batch_reads_its_own_column(uniform):
    X = uniform(6, 4)
    column = PhysicsColumn(2, 2, Size([2]), scale=torch.tensor([[2.0], [3.0]], dtype=torch.float64))
    torch.testing.assert_close(PhysicsMean(column)(X), torch.stack([X[:, 2] / 2, X[:, 3] / 3]))


def test_parameters_of_the_physics_are_those_of_the_mean():
    class Gain(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(2.0))

        def forward(self, X):
            return self.gain * X[:, 0]

    mean = PhysicsMean(Gain())
    assert [p.item() for p in mean.parameters()] == [2.0]
    mean(torch.ones(3, 1)).sum().backward()
    assert next(mean.parameters()).grad.item() == 3.0
