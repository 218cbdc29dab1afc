"""ParameterPhysics: which parameters a function reads."""

from copy import deepcopy

import torch

from gpadjust import BlackBoxPhysics
from gpadjust.ax import ParameterPhysics
from tests.systems import refused

PARAMETERS = ["x1", "x2", "x3"]


class Network(torch.nn.Module):
    def forward(self, x1):
        return x1


def test_arguments_with_names_of_parameters_are_these():
    for physics, names in (
        (lambda x3, x1: x3, ("x3", "x1")),
        (lambda x2, *, x1: x2, ("x2", "x1")),
        (lambda x2, order=2: x2, ("x2",)),
        (lambda X, order=2: X, ("x1", "x2", "x3")),
        (torch.sin, ("x1", "x2", "x3")),
        (Network(), ("x1", "x2", "x3")),
        (BlackBoxPhysics(lambda x1: x1), ("x1", "x2", "x3")),
        ("torch:sin", ("x1", "x2", "x3")),
    ):
        assert ParameterPhysics(physics).read_names(PARAMETERS) == names
    for physics in (lambda x1, z: x1, lambda a, b: a, lambda x1, z, *, y=0: x1):
        words = r"not a parameter of the search space, which has x1, x2"
        refused(ValueError, words, ParameterPhysics(physics).read_names, PARAMETERS)
    refused(TypeError, "physics must be a Physics or a callable", ParameterPhysics, 3.0)


def test_it_is_given_values_by_name():
    physics = ParameterPhysics(lambda x3, x1: x3 - 10 * x1)
    rows = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    assert physics.take_rows(("x3", "x1"))(rows).flatten().tolist() == [-19.0, -37.0]


def test_what_it_remembers_outlives_models():
    calls = []

    def f_p(x1):
        calls.append(len(x1))
        return x1

    physics = ParameterPhysics(BlackBoxPhysics(f_p))
    rows = torch.rand(4, 1, dtype=torch.float64)
    for each in (physics, deepcopy(physics), physics):
        each.take_rows(("x1",))(rows)
    assert calls == [4]


def test_it_is_told_by_its_path():
    path = "gpadjust.physics:as_physics"
    assert repr(ParameterPhysics(path)) == f"ParameterPhysics('{path}')"
    assert ParameterPhysics("torch:sin") == ParameterPhysics(ParameterPhysics("torch:sin"))
    assert ParameterPhysics(torch.sin) != ParameterPhysics(torch.cos)
    assert ParameterPhysics(lambda x: x) != ParameterPhysics(lambda x: x)
