"""Physics by name."""

import sys
from operator import attrgetter

import numpy as np
import pytest
import torch

from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, Physics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path
from tests.systems import refused

PLANT = sys.modules[__name__]


def double(X):
    return 2 * X


class Formula:
    @staticmethod
    def triple(X):
        return 3 * X


class Drag(Physics):
    def evaluate(self, X):
        return -X


class Net(torch.nn.Identity):
    pass


drag, net = Drag(), Net()
mill, ghost = BlackBoxPhysics(double), FunctionPhysics(lambda X: X)
number = 3


@pytest.mark.parametrize("name", ["double", "Formula.triple", "drag", "net", "mill", "ghost"])
def test_what_a_module_names_comes_back(name):
    thing = attrgetter(name)(PLANT)
    assert import_path(thing) == f"{__name__}:{name}"
    loaded, X = physics_from_path(f"{__name__}:{name}"), torch.ones(2, 2)
    assert torch.equal(loaded(X), as_physics(thing)(X))
    assert loaded is thing or not isinstance(thing, Physics)
    if name in ("double", "net"):
        assert import_path(FunctionPhysics(thing)) == f"{__name__}:{name}"


def test_what_has_no_name(monkeypatch):
    local = FunctionPhysics(double, inputs=[0]), BlackBoxPhysics(double), Drag()
    for thing in (lambda X: X, *local, Drag().evaluate, np.vectorize(abs), torch.sin):
        assert import_path(thing) is None
    old = double
    monkeypatch.setattr(PLANT, "double", lambda X: X)
    assert import_path(old) is None  # another has replaced it


def test_wrong_path():
    for path, says in (
        ("plant", "Expected 'package.module:qualname'"),
        (":double", "Expected 'package.module:qualname'"),
        ("nowhere.at.all:f", r"cannot be imported \(ModuleNotFoundError: No module"),
        (".plant:f", r"cannot be imported \(TypeError"),
        (f"{__name__}:absent", r"cannot be imported \(AttributeError: .*absent"),
        (f"{__name__}:number", "found a int"),
        (f"{__name__}:Drag", "<class 'tests.*Drag"),
    ):
        refused(ValueError, says, physics_from_path, path)
