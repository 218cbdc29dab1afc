"""Fitted models, and what a file of C says of them."""

import ctypes
import functools
import shutil
import subprocess

import numpy as np
import pytest
import torch
from botorch.models.transforms.input import ChainedInputTransform, InputStandardize, Normalize

from gpadjust import (
    CKA,
    RRA,
    FunctionPhysics,
    PhysicsMeanGP,
    ScaleGP,
    Unknown,
    VariationalCKA,
    ZeroMeanGP,
)
from gpadjust.core import MATERN12, MATERN32, MATERN52, Stationary
from tests.systems import crude, normal, truth, uniform

X = uniform(16, 2)
Y = truth(X) + 0.1 * normal(16, 2)


def scaled_inputs():
    second = InputStandardize(2, indices=[1])
    return ChainedInputTransform(first=Normalize(2), second=second)


def with_missing():
    some = Y.clone()
    some[4:9, 1] = torch.nan
    return torch.cat([some, some + 0.01])


def one(X):
    return crude(X)[..., :1]


LAW = FunctionPhysics(
    lambda X, p: p.factor[:, None] * crude(X), unknowns={"factor": Unknown(1.0, sd=0.5)}
)
KERNELS = {"rho_covar_module": Stationary(MATERN12), "delta_covar_module": Stationary(MATERN32)}
MODELS = {
    "CKA": lambda: CKA(X, Y, physics=crude),
    "CKA, one output": lambda: CKA(X, Y[:, :1], physics=one),
    "CKA, two physics": lambda: CKA(X, Y, physics={"crude": crude, "square": torch.square}),
    "CKA, missing": lambda: CKA(X.repeat(2, 1), with_missing(), physics=crude),
    "CKA, scaled inputs": lambda: CKA(X, Y, physics=crude, input_transform=scaled_inputs()),
    "CKA, Matern": lambda: CKA(X, Y, physics=crude, **KERNELS),
    "CKA, unknown parameter": lambda: CKA(X, Y, physics=LAW),
    "CKA, known noise": lambda: CKA(X, Y, 0.1 * Y, physics=crude),
    "CKA, center": lambda: CKA(X, Y, physics=crude, center=2.0, delta_mean=1.0, constants=False),
    "CKA, later observations": lambda: CKA(X, Y, physics=crude),
    "CKA, nested": lambda: CKA(X, Y, physics=crude),
    "PhysicsMeanGP": lambda: PhysicsMeanGP(X, Y, physics=crude, covar_module=Stationary(MATERN52)),
    "ScaleGP": lambda: ScaleGP(X, Y, physics=crude),
    "ZeroMeanGP": lambda: ZeroMeanGP(X, Y),
    "RRA": lambda: RRA(X, Y, physics=crude, num_features=20),
    "RRA, one output": lambda: RRA(X, Y[:, :1], physics=one, num_features=20, constants=False),
    "RRA, missing": lambda: RRA(X.repeat(2, 1), with_missing(), physics=crude, num_features=8),
    "VariationalCKA": lambda: VariationalCKA(X, Y, physics=crude, num_inducing=8),
}
OF_ONE_DRAW = ("CKA, unknown parameter", "CKA, one output")


@functools.cache
def fitted(name):
    """A model with some draws somewhere in its prior; of nested models, if it says so."""
    model = MODELS[name]()
    number = 1 if name in OF_ONE_DRAW else 3
    u = 0.5 * normal(number, *model.u.shape[1:], seed=1)
    if model.table.choices:
        last = len(model.table.choices) - 1
        choices = range(3) if "nested" in name else [0] * number
        choices = [last] * number if "Variational" in name else choices
        u = torch.cat([model.table.with_choice(u[[i]], k) for i, k in enumerate(choices)])
    model.set_draws(u)
    if "later" in name:
        model = model.condition_on_observations(X[:6] + 0.1, Y[:6])
    return model


def compiled(code, folder, name="program"):
    """A library of a file of C."""
    compiler = shutil.which("cc") or pytest.skip("there is no C compiler")
    source, made = folder / f"{name}.c", folder / f"{name}.so"
    source.write_text(code)
    options = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, "-o", made, source, "-lm"], check=True)
    return ctypes.CDLL(str(made))


def called(function, sizes, *given):
    """Outputs of these sizes that a function of C writes."""
    arrays = [np.array(each, dtype=float) for each in (*given, *map(np.zeros, sizes))]
    pointer = ctypes.POINTER(ctypes.c_double)
    function(*(array.ctypes.data_as(pointer) for array in arrays))
    return [torch.as_tensor(array) for array in arrays[len(given) :]]


def in_casadi(function, *given):
    """Outputs of a function of CasADi, the only one by itself."""
    outputs = function(*(each.numpy() for each in given))
    several = outputs if isinstance(outputs, tuple) else [outputs]
    return [torch.tensor(each.full()[:, 0]) for each in several]
