"""Mistakes of a user, each with a message that says how to mend it."""

import numpy as np
import pytest
import torch
from botorch.models.transforms import Log
from botorch.models.transforms.input import AppendFeatures
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood

from gpadjust import AR1, CKA, BlackBoxPhysics, PhysicsError, ScaleGP


@pytest.fixture
def XY(data):
    return data()


class TestData:
    def test_numbers_of_points_disagree(self, build, kind, XY):
        X, Y = XY
        with pytest.raises(
            ValueError, match=r"to agree in all but the last.*\(9, 2\) and \(8, 1\)"
        ):
            build(kind, X, Y[:8], bounds=None) if kind == "AR1" else build(kind, X, Y[:8])

    def test_batches_disagree(self, build, kind, data):
        X, Y = data(batch_shape=(2,))
        with pytest.raises(ValueError, match="to agree in all but the last"):
            build(kind, X, Y[0])

    def test_a_vector_of_targets(self, build, kind, XY):
        X, Y = XY
        with pytest.raises(ValueError, match=r"train_Y with at least 2 dim.*reshape\(-1, 1\)"):
            build(kind, X, Y.squeeze(-1))

    def test_noise_of_another_shape(self, build, kind, XY):
        X, Y = XY
        with pytest.raises(ValueError, match=r"train_Yvar .* shape \(9, 1\), got \(9, 2\)"):
            build(kind, X, Y, Y.expand(9, 2))

    def test_negative_noise(self, build, kind, XY):
        for noise in (torch.full_like(XY[1], -0.1), -0.1, [-0.1]):
            with pytest.raises(ValueError, match=r"not to be negative, got -0\.1"):
                build(kind, *XY, noise)

    @pytest.mark.parametrize("kind", ["ZeroMeanGP", "CKA", "RRA"])
    def test_noise_and_a_likelihood(self, build, kind, XY):
        with pytest.raises(ValueError, match="train_Yvar or a likelihood, got both"):
            build(kind, *XY, 0.1, likelihood=GaussianLikelihood().double())

    @pytest.mark.parametrize("name", ["train_X", "train_Y", "train_Yvar"])
    def test_not_finite(self, build, kind, XY, name):
        tensors = {"train_X": XY[0], "train_Y": XY[1], "train_Yvar": torch.ones_like(XY[1])}
        for bad in (float("nan"), float("inf")):
            missing = name == "train_Y" and bad != bad
            found = "to hold an observation in each row" if missing else "to be finite"
            tensors[name][4, 0] = bad
            with pytest.raises(ValueError, match=rf"{name} {found}.* 1 of 9 rows \(row 4\)"):
                build(kind, *tensors.values())

    def test_an_output_that_is_hardly_observed(self, build, kind, data):
        X, Y = data(num_outputs=2)
        Y[1:, 1] = torch.nan
        with pytest.raises(ValueError, match=r"at least 2 observations .* column\(s\) \[1\]"):
            build(kind, X, Y)

    @pytest.mark.parametrize("n", [0, 1])
    def test_too_few_points(self, build, kind, XY, n):
        X, Y = XY
        with pytest.raises(ValueError, match=f"at least 2 points in train_X, got {n}"):
            build(kind, X[:n], Y[:n])

    @pytest.mark.parametrize("name", ["train_X", "train_Y"])
    def test_float32(self, build, kind, XY, name):
        tensors = {"train_X": XY[0], "train_Y": XY[1]}
        tensors[name] = tensors[name].float()
        with pytest.raises(TypeError, match=rf"{name} in float64, got torch.float32.*double\(\)"):
            build(kind, *tensors.values())

    @pytest.mark.parametrize("kind", ["ZeroMeanGP", "CKA", "RRA"])
    def test_what_is_no_data(self, build, kind, XY):
        X, Y = XY
        with pytest.raises(TypeError, match="train_X to be a torch tensor, a NumPy array"):
            build(kind, X.tolist(), Y)
        with pytest.raises(TypeError, match="train_X to hold numbers only"):
            build(kind, np.array([["a", "b"]] * 9), Y)

    def test_no_columns(self, build, kind, XY):
        X, Y = XY
        with pytest.raises(ValueError, match="at least one input column and one output column"):
            build(kind, X, Y[:, :0], physics=lambda X: X) if kind != "ZeroMeanGP" else build(
                kind, X, Y[:, :0]
            )


class TestPhysics:
    @pytest.fixture(autouse=True)
    def _only_models_with_physics(self, kind):
        if kind == "ZeroMeanGP":
            pytest.skip("has no physics")

    def test_none(self, build, kind, XY):
        if kind != "AR1":
            with pytest.raises(TypeError, match="Expected a physics, got None; ZeroMeanGP is"):
                build(kind, *XY, physics=None)

    def test_wrong_number_of_outputs(self, build, kind, XY, crude_physics):
        pattern = "outputs as the high one has, got 2 and 2" if kind == "AR1" else "returned 2 col"
        with pytest.raises(ValueError, match=pattern):
            build(kind, *XY, physics=crude_physics)

    def test_wrong_shape(self, build, kind, XY):
        with pytest.raises(PhysicsError, match="returned shape"):
            build(kind, *XY, physics=lambda X: X.sum())

    def test_nan(self, build, kind, XY):
        with pytest.raises(PhysicsError, match="returned NaN or inf"):
            build(kind, *XY, physics=lambda X: X.sum(-1) / 0)

    def test_an_exception(self, build, kind, XY):
        def simulator(X):
            raise RuntimeError("licence expired")

        with pytest.raises(PhysicsError, match="'simulator' raised RuntimeError: licence expired"):
            build(kind, *XY, physics=simulator)

    def test_numpy(self, build, kind, XY):
        with pytest.raises(PhysicsError, match=r"BlackBoxPhysics\(function\)"):
            build(kind, *XY, physics=lambda X: np.sin(X.numpy()).sum(-1))

    def test_not_callable(self, build, kind, XY):
        with pytest.raises(TypeError, match="physics must be a Physics or a callable"):
            build(kind, *XY, physics=3.0)


def test_a_physics_that_fails_at_a_prediction(XY):
    X, Y = XY
    physics = BlackBoxPhysics(lambda X: np.where(X[:, 0] < 5, X.sum(-1), np.nan))
    model = CKA(X, Y, physics=physics)
    with pytest.raises(PhysicsError, match="returned NaN or inf in 1 of 2"):
        model.posterior(torch.tensor([[0.0, 0.5], [9.0, 0.5]], dtype=torch.float64))


class TestScaleGP:
    def test_zero_physics(self, XY):
        with pytest.raises(ValueError, match=r"zero at all training inputs.*BiasGP or CKA"):
            ScaleGP(*XY, physics=lambda X: torch.zeros(len(X), dtype=X.dtype))

    def test_zero_in_one_output(self, data):
        X, Y = data(num_outputs=2)
        with pytest.raises(ValueError, match="zero at all training inputs"):
            ScaleGP(X, Y, physics=lambda X: X * torch.tensor([1.0, 0.0], dtype=X.dtype))

    def test_physics_near_zero(self, XY):
        X, Y = XY
        zero = X[3, 0].item()
        with pytest.warns(UserWarning, match="nearly zero at 1 of 9 training inputs"):
            ScaleGP(X, Y, physics=lambda X: X[:, 0] - zero)


class TestOptions:
    @pytest.mark.parametrize("kind", ["CKA", "RRA"])
    @pytest.mark.parametrize("center", ["median", float("nan"), torch.ones(3)])
    def test_center(self, build, kind, XY, center):
        with pytest.raises(ValueError, match=r"Expected center to be 'mean' \(.*, a finite number"):
            build(kind, *XY, center=center)

    @pytest.mark.parametrize("num_features", [0, -3, 10.5, 7])
    def test_num_features(self, build, XY, num_features):
        with pytest.raises(ValueError, match=f"an even whole number >= 2 .* got {num_features}"):
            build("RRA", *XY, num_features=num_features)

    @pytest.mark.parametrize("mean", ["learnt", [1.0, 2.0]])
    def test_rho_mean(self, build, XY, mean):
        with pytest.raises(ValueError, match="Expected rho_mean to be 'learn', a number, or 1 num"):
            build("CKA", *XY, rho_mean=mean)

    def test_too_few_points_for_unknown_means(self, build, XY):
        with pytest.raises(ValueError, match=r"at least 4 points to learn 2 constant means"):
            build("CKA", XY[0][:3], XY[1][:3], rho_mean="learn", delta_mean="learn")

    def test_kernel_class(self, build, XY):
        with pytest.raises(TypeError, match="the kernel of rho to be a GPyTorch kernel"):
            build("CKA", *XY, rho_covar_module=RBFKernel)

    def test_values_of_the_low_level_without_inputs(self, XY):
        with pytest.raises(ValueError, match="`low_Y` without `low_X`"):
            AR1(*XY, low_Y=XY[1])

    def test_outcome_transform_that_is_not_linear(self, build, kind, XY):
        if kind == "RRA-paper":
            pytest.skip("takes none")
        with pytest.raises(ValueError, match="The outcome transform Log is not supported"):
            build(kind, *XY, outcome_transform=Log())

    @pytest.mark.parametrize("kind", ["CKA", "RRA", "AR1"])
    def test_input_transform_that_is_one_to_many(self, build, kind, XY):
        several = AppendFeatures(torch.zeros(3, 1, dtype=torch.float64), transform_on_train=True)
        with pytest.raises(ValueError, match="AppendFeatures makes several points of one"):
            build(kind, *XY, input_transform=several)

    def test_kernel_that_is_none(self, XY, crude_physics):
        with pytest.raises(TypeError, match="the kernel of rho to be a GPyTorch kernel"):
            CKA(*XY, physics=lambda X: crude_physics(X)[:, :1], rho_covar_module=torch.nn.ReLU())

    @pytest.mark.parametrize("name", ["rho", "delta"])
    def test_batch_shape_of_a_kernel(self, build, data, name):
        X, Y = data(num_outputs=2)
        pattern = rf"the kernel of {name} with batch_shape \(2,\).*torch.Size\(\[2\]\)"
        with pytest.raises(ValueError, match=pattern):
            build("CKA", X, Y, **{f"{name}_covar_module": ScaleKernel(MaternKernel())})

    def test_batch_shape_of_a_plain_kernel(self, build, data):
        with pytest.raises(ValueError, match=r"the kernel of delta with batch_shape \(2,\)"):
            build("ZeroMeanGP", *data(num_outputs=2), covar_module=RBFKernel())


class TestAR1:
    def test_no_low_level(self, XY):
        with pytest.raises(ValueError, match=r"in `bounds` \(2 x d\)"):
            AR1(*XY, physics=lambda X: X.sum(-1))

    def test_no_physics(self, XY):
        with pytest.raises(ValueError, match="AR1 needs a low level"):
            AR1(*XY, low_X=XY[0])

    def test_bounds_of_another_shape(self, build, XY):
        with pytest.raises(ValueError, match=r"bounds of shape \(2, 2\), got \(2, 1\)"):
            build("AR1", *XY, bounds=torch.tensor([[0.0], [1.0]]))

    @pytest.mark.parametrize("upper", [[1.0, -1.0], [1.0, float("inf")], [1.0, float("nan")]])
    def test_bounds_upside_down(self, build, XY, upper):
        with pytest.raises(ValueError, match=r"each lower one .* below the upper one"):
            build("AR1", *XY, bounds=torch.tensor([[0.0, 0.0], upper]))

    def test_num_low(self, build, XY):
        with pytest.raises(ValueError, match="num_low >= 2 samples of f_p, got 1"):
            build("AR1", *XY, num_low=1)

    def test_levels_disagree(self, XY):
        X, Y = XY
        with pytest.raises(ValueError, match="the low level with 2 inputs and 1 outputs"):
            AR1(X, Y, low_X=X[:, :1], low_Y=Y)

    def test_values_of_the_low_level_disagree(self, XY):
        X, Y = XY
        with pytest.raises(ValueError, match="to agree in all but the last"):
            AR1(X, Y, low_X=X, low_Y=Y[:5])


class TestPredictions:
    @pytest.mark.parametrize("method", ["posterior", "rho", "delta"])
    def test_inputs_of_another_type(self, build, XY, uniform, method):
        model = build("CKA", *XY)
        with pytest.raises(TypeError, match=r"in float64, got torch\.float32"):
            getattr(model, method)(uniform(4, 2).float())
        with pytest.raises(TypeError, match="a NumPy array or a DataFrame, got list"):
            getattr(model, method)(uniform(4, 2).tolist())

    @pytest.mark.parametrize("kind", ["CKA", "RRA", "AR1"])
    def test_wrong_number_of_columns(self, build, kind, XY, uniform):
        model = build(kind, *XY)
        with pytest.raises(ValueError, match=r"Expected X with 2 columns.*got shape \(4, 5\)"):
            model.posterior(uniform(4, 5))

    @pytest.mark.parametrize("name", ["rho", "delta"])
    def test_wrong_number_of_columns_in_a_part(self, build, XY, uniform, name):
        with pytest.raises(ValueError, match=r"Expected X with 2 columns.*got shape \(4, 3\)"):
            getattr(build("CKA", *XY), name)(uniform(4, 3))

    @pytest.mark.parametrize("kind", ["CKA", "RRA"])
    def test_raw_inputs_to_the_model_itself(self, build, kind, XY, uniform):
        model = build(kind, *XY).eval()
        with pytest.raises(ValueError, match=r"model.posterior\(X\)"):
            model(uniform(4, 2))


class TestRRA:
    def test_pyro_model_of_a_batch(self, build, data):
        model = build("RRA", *data(batch_shape=(2,)))
        with pytest.raises(ValueError, match=r"this model has batch_shape \(2,\)"):
            model.pyro_model()

    def test_pyro_model_of_targets_without_inputs(self, build, XY):
        with pytest.raises(ValueError, match="`Y` without `X`"):
            build("RRA", *XY).pyro_model(Y=XY[1])

    @pytest.mark.parametrize("shape", [(48,), (3, 47), (3, 1, 48)])
    def test_weights_of_another_shape(self, build, XY, shape):
        model = build("RRA", *XY)
        with pytest.raises(ValueError, match=r"weights of shape k x 48, got"):
            model.functions(torch.zeros(*shape, dtype=torch.float64))
