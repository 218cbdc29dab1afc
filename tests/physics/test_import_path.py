"""Physics by name."""

import sys
from types import ModuleType

import numpy as np
import pytest
import torch

from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, JoinedPhysics, Physics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path
from tests.systems import refused

SOURCE = """
import torch
from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, JoinedPhysics, Physics

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
pair = JoinedPhysics([double, drag])
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


@pytest.mark.parametrize(
    "name", ["double", "Formula.triple", "drag", "net", "mill", "ghost", "pair"]
)
def test_what_a_module_names_comes_back(plant, name):
    thing = plant
    for part in name.split("."):
        thing = getattr(thing, part)
    assert import_path(thing) == f"plant:{name}"
    loaded = physics_from_path(f"plant:{name}")
    X = torch.ones(2, 2)
    assert torch.equal(loaded(X), as_physics(thing)(X))
    if isinstance(thing, Physics):
        assert loaded is thing


def test_wrapped_function_has_the_path_of_the_function(plant):
    assert import_path(FunctionPhysics(plant.double)) == "plant:double"
    assert import_path(FunctionPhysics(plant.net)) == "plant:net"


@pytest.mark.parametrize(
    "make",
    [
        lambda plant: lambda X: X,
        lambda plant: plant.local(),
        lambda plant: FunctionPhysics(plant.double, inputs=[0]),
        lambda plant: BlackBoxPhysics(plant.double),
        lambda plant: JoinedPhysics([plant.double, plant.drag]),
        lambda plant: plant.Drag(),
        lambda plant: plant.Drag().evaluate,
        lambda plant: np.vectorize(abs),
        lambda plant: torch.sin,
    ],
)
def test_what_has_no_name(plant, make):
    assert import_path(make(plant)) is None


def test_function_that_another_has_replaced(plant):
    old = plant.double
    plant.double = lambda X: X
    assert import_path(old) is None


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("plant", "expected 'package.module:qualname'"),
        (":double", "expected 'package.module:qualname'"),
        ("nowhere.at.all:f", r"cannot be imported \(ModuleNotFoundError: No module"),
        (".plant:f", r"cannot be imported \(TypeError"),
        ("plant:absent", r"cannot be imported \(AttributeError: .*absent"),
        ("plant:number", "does not name a physics: .*found a int"),
        ("plant:Drag", "does not name a physics: .*the class Drag"),
    ],
)
def test_wrong_path(plant, path, message):
    refused(ValueError, message, physics_from_path, path)
