"""Mistakes of a user, each with a message that says how to mend it."""

import numpy as np
import pytest
import torch
from botorch.models.transforms import Normalize, Power, Standardize
from botorch.models.transforms.input import AppendFeatures
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import BernoulliLikelihood, GaussianLikelihood

from gpadjust import AR1, CKA, BlackBoxPhysics, PhysicsError, ScaleGP
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
]


def spoilt(tensor, value):
    tensor = tensor.clone()
    tensor[4, 0] = value
    return tensor


def test_data(build, kind, XY):
    cls, options = type(build(kind, *XY)), {"physics": lambda X: X.sum(-1)}
    options |= {"bounds": torch.tensor([[0.0] * 2, [2.0] * 2])} if kind == "AR1" else {}
    for change, error, says in BAD_DATA:
        refused(error, says, cls, *change(*XY), **(options if kind != "ZeroMeanGP" else {}))


def test_a_function_in_the_place_of_variances(build, kind, XY):
    for physics in ({}, {} if kind == "ZeroMeanGP" else {"physics": lambda X: X.sum(-1)}):
        with pytest.raises(TypeError, match=r"train_Yvar.*physics="):
            type(build(kind, *XY))(*XY, lambda X: X.sum(-1), **physics)


def test_an_output_that_is_hardly_observed(build, kind, data):
    X, Y = data(num_outputs=2)
    Y[1:, 1] = torch.nan
    refused(ValueError, r"2 observations.*\[1\]", build, kind, X, Y)


def test_a_likelihood_of_one_output_for_two(data):
    X, Y = data(num_outputs=2)
    with pytest.raises(ValueError, match=r"batch_shape \(2,\)"):
        CKA(X, Y, physics=lambda X: X, likelihood=GaussianLikelihood().double())


@pytest.mark.parametrize("kind", ["ZeroMeanGP", "CKA", "RRA"])
def test_noise_and_a_likelihood(build, kind, XY):
    with pytest.raises(ValueError, match="train_Yvar or a likelihood"):
        build(kind, *XY, 0.1, likelihood=GaussianLikelihood().double())


def expired(X):
    raise RuntimeError("licence expired")


@pytest.mark.parametrize("kind", ["PhysicsMeanGP", "ScaleGP", "CKA", "AR1", "RRA", "RRA-paper"])
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
    if kind != "AR1":
        refused(TypeError, r"None.*ZeroMeanGP", build, kind, *XY, physics=None)


def test_a_physics_that_fails_at_a_prediction(XY):
    X, Y = XY
    physics = BlackBoxPhysics(lambda X: np.where(X[:, 0] < 5, X.sum(-1), np.nan))
    model = CKA(X, Y, physics=physics)
    with pytest.raises(PhysicsError, match="returned NaN or inf in 1 of 2"):
        model.posterior(torch.tensor([[0.0, 0.5], [9.0, 0.5]], dtype=torch.float64))


class TestScaleGP:
    def test_zero_physics(self, XY):
        with pytest.raises(ValueError, match=r"zero at all.*BiasGP or CKA"):
            ScaleGP(*XY, physics=lambda X: torch.zeros(len(X), dtype=X.dtype))

    def test_zero_in_one_output(self, data):
        X, Y = data(num_outputs=2)
        with pytest.raises(ValueError, match="zero at all training inputs"):
            ScaleGP(X, Y, physics=lambda X: X * torch.tensor([1.0, 0.0], dtype=X.dtype))

    def test_physics_near_zero(self, XY):
        X, Y = XY
        zero = X[3, 0].item()
        with pytest.warns(UserWarning, match="zero at 1 of 9"):
            ScaleGP(X, Y, physics=lambda X: X[:, 0] - zero)


BAD_OPTIONS = [
    *(
        (kind, {"center": center}, ValueError, r"Expected center to be 'mean' \(.*, a finite num")
        for kind in ("CKA", "RRA")
        for center in ("median", NAN, torch.ones(3))
    ),
    *(
        ("RRA", {"num_features": n}, error, f"num_features .*{says}.*{n}")
        for n, error, says in (
            (0, ValueError, "at least 1"),
            (10.5, TypeError, "whole"),
            (7, ValueError, "even"),
        )
    ),
    ("CKA", {"rho_mean": "learnt"}, ValueError, "rho_mean to be 'learn', a number, or 1 num"),
    ("CKA", {"rho_mean": [1.0, 2.0]}, ValueError, "rho_mean to be 'learn', a number, or 1 num"),
    ("CKA", {"rho_covar_module": RBFKernel}, TypeError, "kernel of rho to be a GPyTorch kernel"),
    ("CKA", {"rho_covar_module": torch.nn.ReLU()}, TypeError, "of rho to be a GPyTorch kernel"),
    *(
        (
            kind,
            {"outcome_transform": Power(2)},
            ValueError,
            "transform Power.* is not supported",
        )
        for kind in ("ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA", "AR1", "RRA")
    ),
    *(
        (kind, {"input_transform": several}, ValueError, "AppendFeatures makes several points of")
        for several in [AppendFeatures(torch.zeros(3, 1).double(), transform_on_train=True)]
        for kind in ("CKA", "RRA", "AR1")
    ),
    ("AR1", {"bounds": None}, ValueError, r"in `bounds` \(2 x d\)"),
    ("AR1", {"bounds": torch.zeros(2, 1)}, ValueError, r"bounds of shape 2 x 2, .* got \(2, 1\)"),
    *(
        ("AR1", {"bounds": [[0.0, 0.0], upper]}, ValueError, "each lower one below its upper")
        for upper in ([1.0, -1.0], [1.0, INF], [1.0, NAN])
    ),
    ("AR1", {"num_low": 1}, ValueError, "num_low must be at least 2; found 1"),
    ("AR1", {"num_low": 2.5}, TypeError, r"num_low must be a whole number; found 2\.5"),
    *(
        (kind, {"seed": seed}, TypeError, f"seed must be a whole number; found {seed!r}")
        for kind in ("AR1", "RRA", "RRA-paper")
        for seed in ("a", 1.5)
    ),
    *(
        (kind, {"input_transform": "x"}, TypeError, "to be one of BoTorch's, got 'x'")
        for kind in ("CKA", "ZeroMeanGP", "RRA", "AR1")
    ),
    *(
        (kind, {"input_transform": Normalize(3)}, ValueError, "input transform does not fit inp")
        for kind in ("CKA", "ZeroMeanGP", "RRA", "AR1")
    ),
    *(
        (kind, {"outcome_transform": Standardize(3)}, ValueError, "outcome transform does not fit")
        for kind in ("CKA", "ZeroMeanGP", "RRA", "AR1")
    ),
    *(
        (kind, {"likelihood": likelihood}, error, "ikelihood of GPyTorch, got")
        for kind in ("CKA", "ZeroMeanGP", "RRA")
        for likelihood, error in (("x", ValueError), (BernoulliLikelihood(), TypeError))
    ),
]


@pytest.mark.parametrize(("kind", "option", "error", "says"), BAD_OPTIONS)
def test_options(build, XY, kind, option, error, says):
    refused(error, says, build, kind, *XY, **option)


def test_too_few_points_for_unknown_means(build, XY):
    with pytest.raises(ValueError, match=r"4 points.*2 constant means"):
        build("CKA", XY[0][:3], XY[1][:3], rho_mean="learn", delta_mean="learn")


def test_the_batch_shape_of_a_kernel(build, data):
    for kind, option, name in (
        ("CKA", "rho_covar_module", "rho"),
        ("CKA", "delta_covar_module", "delta"),
        ("ZeroMeanGP", "covar_module", "delta"),
    ):
        says = rf"the kernel of {name} with batch_shape \(2,\).*torch.Size\(\[2\]\)"
        with pytest.raises(ValueError, match=says):
            build(kind, *data(num_outputs=2), **{option: ScaleKernel(MaternKernel())})


def test_levels_of_ar1(XY):
    X, Y = XY
    for levels, says in (
        ({"low_Y": Y}, "`low_Y` without `low_X`"),
        ({"low_X": X}, "AR1 needs a low level"),
        ({"low_X": X[:, :1], "low_Y": Y}, "the low level with 2 inputs and 1 outputs"),
        ({"low_X": X, "low_Y": Y[:5]}, "to agree in all but the last"),
    ):
        refused(ValueError, says, AR1, X, Y, **levels)


@pytest.mark.parametrize("kind", ["CKA", "RRA", "AR1"])
def test_predictions(build, kind, XY, uniform):
    model, Z = build(kind, *XY), uniform(4, 2)
    methods = [model.posterior, model.predict]
    if kind != "AR1":
        methods += [model.rho, model.delta]
    for method in methods:
        refused(TypeError, r"in float64, got torch\.float32", method, Z.float())
        refused(TypeError, "DataFrame, got list", method, Z.tolist())
        refused(ValueError, r"2 columns.*\(4, 5\)", method, uniform(4, 5))
    if kind != "AR1":
        refused(ValueError, r"model.posterior\(X\)", model.eval(), Z)


def test_rra(build, data, XY):
    refused(ValueError, r"batch_shape \(2,\)", build("RRA", *data(batch_shape=(2,))).pyro_model)
    model = build("RRA", *XY)
    refused(ValueError, "`Y` without `X`", model.pyro_model, Y=XY[1])
    for shape in ((48,), (3, 47), (3, 1, 48)):
        with pytest.raises(ValueError, match=r"weights of shape k x 48, got"):
            model.functions(torch.zeros(*shape, dtype=torch.float64))


@pytest.mark.parametrize("kind", ["ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA", "RRA"])
def test_an_argument_that_there_is_none_of(build, kind, XY):
    """The constructor of the model is named, and what it takes."""
    refused(TypeError, rf"{kind}\(\).*'center_'.*likelihood", build, kind, *XY, center_=1.0)
