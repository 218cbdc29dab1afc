"""Mistakes of a user, each with a message that says how to mend it."""

import numpy as np
import pytest
import torch
from botorch.models.transforms import Normalize, Power, Standardize
from botorch.models.transforms.input import AppendFeatures
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import BernoulliLikelihood, GaussianLikelihood

from gpadjust import AR1, PhysicsError, ScaleGP
from tests.systems import crude, refused


@pytest.fixture
def XY(data):
    return data()


NAN, INF = float("nan"), float("inf")
# What is done to inputs, targets and variances of nine points; the error, and what it says.
BAD_DATA = [
    (lambda X, Y: (X, Y[:8]), ValueError, r"agree in all but the last.*\(9, 2\).*\(8, 1\)"),
    (lambda X, Y: (X.expand(2, 9, 2), Y), ValueError, "to agree in all but the last"),
    (lambda X, Y: (X, Y[:, 0]), ValueError, r"train_Y with at least 2 dim.*reshape\(-1, 1\)"),
    (lambda X, Y: (X, Y[:, :0]), ValueError, "one input column and one output column"),
    (lambda X, Y: (X[:0], Y[:0]), ValueError, "at least 2 points in train_X, got 0"),
    (lambda X, Y: (X[:1], Y[:1]), ValueError, "at least 2 points in train_X, got 1"),
    (lambda X, Y: (X.float(), Y), TypeError, r"train_X in float64, got torch.float32.*double\("),
    (lambda X, Y: (X, Y.float()), TypeError, r"train_Y in float64, got torch.float32.*double\("),
    (lambda X, Y: (X.tolist(), Y), TypeError, "train_X to be a torch tensor, a NumPy array"),
    (lambda X, Y: (np.array([["a", "b"]] * 9), Y), TypeError, "train_X to hold numbers only"),
    (lambda X, Y: (X, Y, Y.expand(9, 2)), ValueError, r"Yvar .* shape \(9, 1\), got \(9, 2\)"),
    (lambda X, Y: (X, Y, 0 * Y - 0.1), ValueError, r"not to be negative, got -0\.1"),
    (lambda X, Y: (X, Y, -0.1), ValueError, r"not to be negative, got -0\.1"),
    (lambda X, Y: (X, Y, [-0.1]), ValueError, r"not to be negative, got -0\.1"),
    (lambda X, Y: (spoilt(X, NAN), Y), ValueError, r"train_X to be finite.* 1 of 9 .*\(row 4\)"),
    (lambda X, Y: (spoilt(X, INF), Y), ValueError, r"train_X to be finite.* 1 of 9 .*\(row 4\)"),
    (lambda X, Y: (X, spoilt(Y, INF)), ValueError, r"train_Y to be finite.* 1 of 9 .*\(row 4\)"),
    (lambda X, Y: (X, spoilt(Y, NAN)), ValueError, r"train_Y to hold an observation.*\(row 4\)"),
    (lambda X, Y: (X, Y, spoilt(Y, NAN)), ValueError, r"train_Yvar to be finite.*\(row 4\)"),
    (lambda X, Y: (X, Y, spoilt(Y, INF)), ValueError, r"train_Yvar to be finite.*\(row 4\)"),
    (lambda X, Y: (X, Y, lambda X: X.sum(-1)), TypeError, r"train_Yvar.*physics="),
]


def spoilt(tensor, value):
    tensor = tensor.clone()
    tensor[4, 0] = value
    return tensor


@pytest.mark.parametrize("kind", ["ZeroMeanGP", "CKA", "AR1"])
def test_data(build, kind, XY):
    cls, options = type(build(kind, *XY)), {"physics": lambda X: X.sum(-1)}
    options |= {"bounds": torch.tensor([[0.0] * 2, [2.0] * 2])} if kind == "AR1" else {}
    for change, error, says in BAD_DATA:
        refused(error, says, cls, *change(*XY), **(options if kind != "ZeroMeanGP" else {}))
    with pytest.raises(TypeError, match=r"train_Yvar.*physics="):
        cls(*XY, lambda X: X.sum(-1))  # by position alone


def test_data_of_two_outputs(build, data):
    X, Y = data(num_outputs=2)
    refused(ValueError, r"batch_shape \(2,\)", build, "CKA", X, Y, likelihood=GaussianLikelihood())
    for kind, option, name in (
        ("CKA", "rho_covar_module", "rho"),
        ("CKA", "delta_covar_module", "delta"),
        ("ZeroMeanGP", "covar_module", "delta"),
    ):
        says = rf"the kernel of {name} with batch_shape \(2,\).*torch.Size\(\[2\]\)"
        refused(ValueError, says, build, kind, X, Y, **{option: ScaleKernel(MaternKernel())})
    half = {"physics": lambda X: X * torch.tensor([1.0, 0.0], dtype=X.dtype)}
    refused(ValueError, "zero at all training inputs", ScaleGP, X, Y, **half)
    Y[1:, 1] = torch.nan
    refused(ValueError, r"2 observations.*\[1\]", build, "CKA", X, Y)


def expired(X):
    raise RuntimeError("licence expired")


@pytest.mark.parametrize("kind", ["CKA", "AR1"])
def test_physics(build, kind, XY):
    wrong = "outputs as the high one has, got 2 and 2" if kind == "AR1" else "returned 2 col"
    for physics, error, says in (
        (crude, ValueError, wrong),
        (lambda X: X.sum(), PhysicsError, "returned shape"),
        (lambda X: X.sum(-1) / 0, PhysicsError, "returned NaN or inf"),
        (expired, PhysicsError, "'expired' raised RuntimeError: licence expired"),
        (lambda X: np.sin(X.numpy()).sum(-1), PhysicsError, r"BlackBoxPhysics\(function\)"),
        (3.0, TypeError, "physics must be a Physics or a callable"),
    ):
        refused(error, says, build, kind, *XY, physics=physics)


def test_physics_near_zero(XY):
    zero = XY[0][3, 0].item()
    with pytest.warns(UserWarning, match="zero at 1 of 9"):
        ScaleGP(*XY, physics=lambda X: X[:, 0] - zero)


CENTER = r"Expected center to be 'mean' \(.*, a finite num"
APPEND = AppendFeatures(torch.zeros(3, 1).double(), transform_on_train=True)
BAD_OPTIONS = [
    ("CKA", {"physics": None}, TypeError, r"None.*ZeroMeanGP"),
    ("ScaleGP", {"physics": lambda X: 0 * X[:, 0]}, ValueError, r"zero at all.*BiasGP or CKA"),
    *(("CKA", {"center": c}, ValueError, CENTER) for c in ("median", NAN, torch.ones(3))),
    ("RRA", {"num_features": 10.5}, TypeError, "num_features .*whole.*10.5"),
    ("RRA", {"num_features": 7}, ValueError, "num_features .*even.*7"),
    ("CKA", {"rho_mean": "learnt"}, ValueError, "rho_mean to be 'learn', a number, or 1 num"),
    ("CKA", {"rho_covar_module": RBFKernel}, TypeError, "kernel of rho to be a GPyTorch kernel"),
    ("CKA", {"outcome_transform": Power(2)}, ValueError, "transform Power.* is not supported"),
    ("CKA", {"input_transform": APPEND}, ValueError, "AppendFeatures makes several points of"),
    ("AR1", {"input_transform": APPEND}, ValueError, "AppendFeatures makes several points of"),
    ("AR1", {"bounds": None}, ValueError, r"in `bounds` \(2 x d\)"),
    ("AR1", {"bounds": torch.zeros(2, 1)}, ValueError, r"bounds of shape 2 x 2, .* got \(2, 1\)"),
    *(
        ("AR1", {"bounds": [[0.0, 0.0], upper]}, ValueError, "each lower one below its upper")
        for upper in ([1.0, -1.0], [1.0, INF], [1.0, NAN])
    ),
    ("AR1", {"num_low": 1}, ValueError, "num_low must be at least 2; found 1"),
    ("AR1", {"seed": "a"}, TypeError, "seed must be a whole number; found 'a'"),
    *(
        (kind, option, error, says)
        for kind in ("CKA", "AR1")
        for option, error, says in (
            ({"input_transform": "x"}, TypeError, "to be one of BoTorch's, got 'x'"),
            ({"input_transform": Normalize(3)}, ValueError, "input transform does not fit inp"),
            ({"outcome_transform": Standardize(3)}, ValueError, "outcome transform does not fit"),
        )
    ),
    ("CKA", {"likelihood": BernoulliLikelihood()}, TypeError, "ikelihood of GPyTorch, got"),
    *(  # the constructor of the model is named, and what it takes
        (kind, {"center_": 1.0}, TypeError, rf"{kind}\(\).*'center_'.*likelihood")
        for kind in ("ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA", "RRA")
    ),
]


def test_options(build, XY):
    for kind, option, error, says in BAD_OPTIONS:
        refused(error, says, build, kind, *XY, **option)
    with_likelihood = {"likelihood": GaussianLikelihood().double()}
    for kind in ("CKA", "RRA"):
        refused(ValueError, "train_Yvar or a likelihood", build, kind, *XY, 0.1, **with_likelihood)
    means, few = {"rho_mean": "learn", "delta_mean": "learn"}, [each[:3] for each in XY]
    refused(ValueError, r"4 points.*2 constant means", build, "CKA", *few, **means)


def test_levels_of_ar1(XY):
    X, Y = XY
    for levels, says in (
        ({"low_Y": Y}, "`low_Y` without `low_X`"),
        ({"low_X": X}, "AR1 needs a low level"),
        ({"low_X": X[:, :1], "low_Y": Y}, "the low level with 2 inputs and 1 outputs"),
        ({"low_X": X, "low_Y": Y[:5]}, "to agree in all but the last"),
    ):
        refused(ValueError, says, AR1, X, Y, **levels)


@pytest.mark.parametrize("kind", ["CKA", "AR1"])
def test_predictions(build, kind, XY, uniform):
    model, Z = build(kind, *XY), uniform(4, 2)
    terms = [] if kind == "AR1" else [model.rho, model.delta]
    for method in (model.posterior, model.predict, *terms):
        refused(TypeError, r"in float64, got torch\.float32", method, Z.float())
        refused(TypeError, "DataFrame, got list", method, Z.tolist())
        refused(ValueError, r"2 columns.*\(4, 5\)", method, uniform(4, 5))
    if kind != "AR1":
        refused(ValueError, r"model.posterior\(X\)", model.eval(), Z)


def test_rra(build, data, XY):
    batch = build("RRA", *data(batch_shape=(2,)))
    refused(ValueError, r"batch_shape \(2,\)", batch.pyro_model)
    model = build("RRA", *XY)
    refused(ValueError, "`Y` without `X`", model.pyro_model, Y=XY[1])
    for shape in ((48,), (3, 47), (3, 1, 48)):
        weights = torch.zeros(*shape, dtype=torch.float64)
        refused(ValueError, r"weights of shape k x 48, got", model.functions, weights)
