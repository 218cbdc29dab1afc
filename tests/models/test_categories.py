"""Categories among the inputs, and batches of which each has an offset."""

import math

import pandas as pd
import pytest
import torch
from gpytorch.kernels import MaternKernel, ScaleKernel

from gpadjust import CKA, PhysicsMeanGP, StackedGP, ZeroMeanGP, compare, fit, load, save
from gpadjust.gp.categories import GroupedRBFKernel
from gpadjust.gp.gaussian import LikelihoodValue
from gpadjust.inference.distributions import ByModules, stationary_terms
from gpadjust.inference.vectors import Parameters
from gpadjust.models import Prediction
from gpadjust.sklearn import CKARegressor
from gpadjust.validation import leave_one_out, trust
from tests.systems import refused

GENERATOR = torch.Generator().manual_seed(0)
N = 30
FLOW = 2 * torch.rand(N, generator=GENERATOR, dtype=torch.float64)
MATERIAL, RIG = (torch.randint(k, (N,), generator=GENERATOR) for k in (3, 4))
OFFSETS = torch.tensor([0.5, -0.6, 0.1, 0.3], dtype=torch.float64)
HEAD = torch.tensor([1.0, 2.0, 1.4], dtype=torch.float64)
NAMES = ["brass", "iron", "steel"]
NOISE = 0.03 * torch.randn(N, generator=GENERATOR, dtype=torch.float64)
Y = (HEAD[MATERIAL] * (3 - FLOW.square()) + OFFSETS[RIG] + NOISE).unsqueeze(-1)
FRAME = pd.DataFrame(
    {
        "flow": FLOW.numpy(),
        "material": pd.Categorical([NAMES[i] for i in MATERIAL]),
        "rig": [f"R{i}" for i in RIG.tolist()],
    }
)
X = torch.stack([FLOW, MATERIAL.double(), RIG.double()], -1)
NEW = FRAME[:4].assign(rig="R9")


def head(X):
    return 0.9 * HEAD[X[:, 1].long()] * (3 - X[:, 0].square())


def predicted(model, frame):
    """Mean and variance as tensors, as the prediction of a frame is one."""
    return Prediction(*(torch.tensor(each.to_numpy()) for each in model.predict(frame)))


@pytest.fixture(scope="module")
def model():
    model = CKA(FRAME, Y, physics=head, batch="rig")
    fit(model, num_samples=8)
    return model


def test_the_covariance_is_exchangeable():
    model = ZeroMeanGP(X, Y, categorical=[1], batch=2)
    f, rig = model.terms
    f.kernel.base_kernel.lengthscale = torch.tensor([[0.7, 1.5]])
    variances = [f.kernel.outputscale, rig.kernel.outputscale]
    inputs = model.transform_inputs(X)
    found = model.covar_module.at(inputs).covariance()
    same = [(X[:, None, i] == X[:, i]).double() for i in (1, 2)]
    near = (-((FLOW[:, None] - FLOW) / 0.7).square() / 2 - (1 - same[0]) / (2 * 1.5**2)).exp()
    torch.testing.assert_close(found, variances[0] * near + variances[1] * same[1])
    plain = model.covar_module(inputs).to_dense()
    torch.testing.assert_close(plain, found)


def test_closed_form_and_autograd_agree():
    model = CKA(X, Y, physics=head, categorical=[1], batch=[2]).train()
    parameters = Parameters(model)
    inputs = model.transform_inputs(X)
    closed = stationary_terms(model, parameters, inputs, None, False)
    values = {row.name: row.value().unsqueeze(0) + 0.1 for row in parameters.rows}
    other = ByModules(model, parameters, inputs, None, False)
    found, expected = closed(values, True), other(values, True)
    torch.testing.assert_close(found.covariance.squeeze(0), expected.covariance.squeeze(0))
    lengthscales = [n for n in parameters.names if "raw_lengthscale" in n]
    assert [values[n].shape[-1] for n in lengthscales] == [2, 2]  # of rho and delta, none of rigs
    by = torch.rand(N, N, generator=GENERATOR, dtype=torch.float64)

    zero = torch.zeros(1, dtype=torch.float64)
    value = LikelihoodValue(zero, zero, torch.zeros(1, N).double(), (by + by.T).unsqueeze(0))
    ours, theirs = found.pull_back(value), expected.pull_back(value)
    for name in lengthscales:
        torch.testing.assert_close(ours[name].flatten(), theirs[name].flatten())


def test_frames_and_new_rigs(model):
    assert model.levels == {1: ("brass", "iron", "steel"), 2: ("R0", "R1", "R2", "R3")}
    torch.testing.assert_close(model.data()["train_X"], X)
    torch.testing.assert_close(predicted(model, FRAME).mean, model.predict(X).mean)
    assert (predicted(model, FRAME).mean - Y).std() < 0.05
    offsets = model.term("rig", FRAME)
    found = torch.stack([offsets.mean[i == RIG][0, 0] for i in range(4)])
    torch.testing.assert_close(found - found.mean(), OFFSETS - OFFSETS.mean(), rtol=0, atol=0.1)
    assert "lengthscale of material" in model.summary()
    assert "rig: mean 0" in model.summary()
    known, new = predicted(model, FRAME[:4]).variance, predicted(model, NEW).variance
    rig = model.terms[-1].kernel.outputscale.mean() * model.units()[1].square().mean()
    assert (new > 20 * known).all()
    torch.testing.assert_close(model.term("rig", NEW).variance.mean(), rig)
    functions = model.sample_functions(300, seed=0, num_features=256)
    functions = functions(torch.cat([X[:4, :2], torch.full((4, 1), 9.0)], -1))
    torch.testing.assert_close(functions.var(0), new, rtol=0.3, atol=0)
    conditioned = model.condition_on_observations(NEW[:1], Y[:1])
    assert (predicted(conditioned, NEW).variance < 0.1 * new).all()


def test_files_scores_and_stacking(model, tmp_path):
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", trusted=True)
    torch.testing.assert_close(predicted(again, NEW).mean, predicted(model, NEW).mean)
    assert (again.levels, again.batches) == (model.levels, (2,))
    stacked = StackedGP({"CKA": model}, [[1.0]], 4)
    assert predicted(stacked.condition_on_observations(NEW, Y[:4]), NEW).mean.shape == (4, 1)
    assert leave_one_out(model).score().coverage > 0.8
    assert trust(model).X[:, 1].unique().numel() == 3
    comparison = compare(
        FRAME, Y, head, structures=["physics mean", "zero mean"], batch="rig", num_starts=2
    )
    assert predicted(comparison.recommended, NEW).mean.isfinite().all()


def test_arrays_outputs_and_declared_levels():
    both = torch.cat([Y, -Y], -1)
    levels = {"material": ["steel", "iron", "brass", "zinc"]}
    model = ZeroMeanGP(FRAME, both, categorical=levels, batch="rig")
    torch.testing.assert_close(model.data()["train_X"][:, 1], 2 - MATERIAL.double())
    fit(model, "map", num_starts=2)
    zinc = predicted(model, FRAME[:4].assign(material="zinc"))
    assert (zinc.variance > predicted(model, FRAME[:4]).variance).all()
    assert predicted(model.subset_output([1]), NEW).mean.shape == (4, 1)
    numbers = X + torch.tensor([0.0, 10.0, 0.0])
    regressor = CKARegressor(model=lambda X, Y: ZeroMeanGP(X, Y, categorical=[1]), random_state=0)
    regressor.set_params(fit_method="map").fit(numbers.numpy(), Y.flatten().numpy())
    assert regressor.model_.levels == {1: (10.0, 11.0, 12.0)}
    other = ZeroMeanGP(
        X, Y, categorical=1, covar_module=lambda d, shape: ScaleKernel(MaternKernel())
    )
    assert not any(isinstance(each, GroupedRBFKernel) for each in other.modules())
    inputs = other.input_transform
    torch.testing.assert_close(inputs.untransform(inputs(X)), X)
    assert math.isclose(float(inputs(X)[0, 1:4].norm()), 0.5**0.5)


def test_bad_options_and_levels(model):
    for options, says in (
        ({"categorical": "colour"}, "columns of flow, material, rig, got 'colour'"),
        ({"batch": 7}, "got 7"),
        ({"categorical": {"material": ["iron", "iron"]}}, "different levels"),
        ({"categorical": {"material": ["iron", "steel"]}}, "one of iron, steel, got 'brass'"),
    ):
        refused(ValueError, says, PhysicsMeanGP, FRAME, Y, physics=head, **options)
    wood = FRAME[:2].assign(material="wood")
    refused(ValueError, "brass, iron, steel, got 'wood'", predicted, model, wood)
    between, says = torch.tensor([[1.0, 1.5, 0.0]]).double(), r"\[0.0, 1.0, 2.0\].*got 1.5"
    refused(ValueError, f"material to be one of {says}", model.transform_inputs, between)
    refused(ValueError, "an input beside batches", ZeroMeanGP, X[:, 2:], Y, batch=0)
