"""The physics as a mean function."""

from unittest import TestCase

import torch
from gpytorch.test.base_mean_test_case import BaseMeanTestCase

from gpadjust.gp import PhysicsMean


class TestAsGPyTorchsMeans(BaseMeanTestCase, TestCase):
    def create_mean(self):
        return PhysicsMean(lambda X: X.sum(-1))

    test_forward_vec = None  # f_p takes rows; a GPyTorch model passes n x d


def test_values(uniform):
    X = uniform(3, 4, 2)
    mean = PhysicsMean(lambda X: X.square(), output=1)
    torch.testing.assert_close(mean(X), X[..., 1].square())


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
