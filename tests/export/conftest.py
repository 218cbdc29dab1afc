"""Fitted models, and what a file of C says of them."""

import ctypes
import functools
import shutil
import subprocess
import warnings

import numpy as np
import pytest
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.transforms.input import ChainedInputTransform, InputStandardize, Normalize
from gpytorch.kernels import MaternKernel, ScaleKernel

from gpadjust import CKA, RRA, FunctionPhysics, ScaleGP, Unknown, VariationalCKA, ZeroMeanGP, fit
from gpadjust.models import BiasGP
from tests.systems import crude, normal, truth, uniform

X = uniform(30, 2)
Y = truth(X) + 0.1 * normal(30, 2)


def matern(nu):
    return lambda d, batch: ScaleKernel(
        MaternKernel(nu, ard_num_dims=d, batch_shape=batch), batch_shape=batch
    )


def scaled_inputs():
    second = InputStandardize(2, indices=[1])
    return ChainedInputTransform(first=Normalize(2), second=second)


def with_missing():
    some = Y.clone()
    some[4:9, 1] = torch.nan
    return torch.cat([some, some + 0.01])


def scaled(X, p):
    return p.factor[:, None] * crude(X)


def with_errors():
    """A model whose variances are larger near errors, and by recent ones."""
    model = CKA(X, Y, physics=crude)
    model.local_errors.learn(5 * uniform(2, 30), X, torch.full((2, 1, 2), 0.3).double())
    model.local_errors.observe(torch.full((2, 3), 4.0).double(), torch.inf)
    return model


def with_later_observations():
    return CKA(X[:20], Y[:20], physics=crude).eval().condition_on_observations(X[20:], Y[20:])


def sampled():
    model = CKA(X, Y, physics=crude)
    fit(model, num_samples=4)
    return model


MODELS = {
    "CKA": lambda: CKA(X, Y, physics=crude),
    "CKA, one output": lambda: CKA(X, Y[:, :1], physics=lambda X: crude(X)[..., :1]),
    "CKA, two physics": lambda: CKA(X, Y, physics={"crude": crude, "square": torch.square}),
    "CKA, missing and repeated": lambda: CKA(X.repeat(2, 1), with_missing(), physics=crude),
    "CKA, scaled inputs": lambda: CKA(X, Y, physics=crude, input_transform=scaled_inputs()),
    "CKA, Matern": lambda: CKA(
        X, Y, physics=crude, rho_covar_module=matern(0.5), delta_covar_module=matern(1.5)
    ),
    "CKA, unknown parameter": lambda: CKA(
        X, Y, physics=FunctionPhysics(scaled, unknowns={"factor": Unknown(1.0, sd=0.5)})
    ),
    "CKA, heavy tails": lambda: CKA(X, Y, physics=crude, likelihood="heavy-tailed"),
    "CKA, known noise": lambda: CKA(X, Y, 0.1 * Y, physics=crude),
    "CKA, noisy inputs": lambda: CKA(X, Y, train_Xvar=0.01 * X, physics=crude),
    "CKA, unknown mean": lambda: CKA(X, Y, physics=crude, delta_mean="learn"),
    "CKA, later observations": with_later_observations,
    "CKA, larger errors": with_errors,
    "CKA, samples": sampled,
    "BiasGP": lambda: BiasGP(X, Y, physics=crude, covar_module=matern(2.5), rho_mean="learn"),
    "ScaleGP": lambda: ScaleGP(X, Y, physics=crude),
    "ZeroMeanGP": lambda: ZeroMeanGP(X, Y),
    "RRA": lambda: RRA(X, Y, physics=crude, num_features=20),
    "RRA, one output": lambda: RRA(
        X, Y[:, :1], physics=lambda X: crude(X)[..., :1], num_features=20
    ),
    "RRA, unknown mean": lambda: RRA(X, Y, physics=crude, num_features=20, delta_mean="learn"),
    "VariationalCKA, one output": lambda: VariationalCKA(
        X, Y[:, :1], physics=lambda X: crude(X)[..., :1], num_inducing=8
    ),
    "VariationalCKA": lambda: VariationalCKA(X, Y, physics=crude, num_inducing=8),
}
FITTED_BEFORE = ("CKA, samples", "CKA, larger errors", "CKA, later observations")
CANCELS = (  # sums of terms that are much larger, in torch as well
    "CKA, missing and repeated",
    "CKA, samples",
    "CKA, Matern",
    "CKA, two physics",
    "CKA, unknown mean",
    "BiasGP",
)


@functools.cache
def fitted(name):
    model = MODELS[name]()
    if name not in FITTED_BEFORE:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizationWarning)
            fit(model, method="map", num_starts=1, num_screened=8, max_iterations=5)
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
