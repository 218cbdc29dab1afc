"""Physics by name."""

import sys
from operator import attrgetter
from types import ModuleType

import numpy as np
import pytest
import torch

from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, Physics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path
from tests.systems import refused

SOURCE = """
import torch
from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, Physics

def double(X):
    return 2 * X

def local():
    return lambda X: X

class Formula:
    @staticmethod
    def triple(X):
        return 3 * X

class Drag(Physics):
    def evaluate(self, X):
        return -X

class Net(torch.nn.Module):
    def forward(self, X):
        return X

drag = Drag()
net = Net()
mill = BlackBoxPhysics(double)
ghost = FunctionPhysics(lambda X: X)
number = 3
"""


@pytest.fixture
def plant():
    """A module `plant` with physics in it."""
    module = ModuleType("plant")
    sys.modules["plant"] = module
    exec(SOURCE, vars(module))
    yield module
    del sys.modules["plant"]


def test_what_a_module_names_comes_back(plant):
    for name in ("double", "Formula.triple", "drag", "net", "mill", "ghost"):
        thing = attrgetter(name)(plant)
        assert import_path(thing) == f"plant:{name}"
        loaded, X = physics_from_path(f"plant:{name}"), torch.ones(2, 2)
        assert torch.equal(loaded(X), as_physics(thing)(X))
        assert loaded is thing or not isinstance(thing, Physics)
    assert import_path(FunctionPhysics(plant.double)) == "plant:double"
    assert import_path(FunctionPhysics(plant.net)) == "plant:net"


def test_what_has_no_name(plant):
    for thing in (
        lambda X: X,
        plant.local(),
        FunctionPhysics(plant.double, inputs=[0]),
        BlackBoxPhysics(plant.double),
        plant.Drag(),
        plant.Drag().evaluate,
        np.vectorize(abs),
        torch.sin,
    ):
        assert import_path(thing) is None
    old, plant.double = plant.double, lambda X: X
    assert import_path(old) is None  # another has replaced it


def test_wrong_path(plant):
    for path, says in (
        ("plant", "Expected 'package.module:qualname'"),
        (":double", "Expected 'package.module:qualname'"),
        ("nowhere.at.all:f", r"cannot be imported \(ModuleNotFoundError: No module"),
        (".plant:f", r"cannot be imported \(TypeError"),
        ("plant:absent", r"cannot be imported \(AttributeError: .*absent"),
        ("plant:number", "found a int"),
        ("plant:Drag", "<class 'plant.Drag"),
    ):
        refused(ValueError, says, physics_from_path, path)
