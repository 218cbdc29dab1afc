"""Categories among the inputs, and batches of which each has an offset."""

import pandas as pd
import pytest
import torch
from botorch.acquisition import LogExpectedImprovement
from botorch.models import ModelListGP
from botorch.optim import optimize_acqf
from gpytorch.kernels import MaternKernel, ScaleKernel

from gpadjust.core import CKA, MATERN52, RRA, StackedGP, Stationary, ZeroMeanGP, fit, load, save
from gpadjust.kinds.categories import Categories, levels_of, on_levels
from tests.systems import drawn, line, normal, refused, uniform

GENERATOR = torch.Generator().manual_seed(0)
N = 30
FLOW = uniform(N, high=2.0)
MATERIAL, RIG = (torch.randint(k, (N,), generator=GENERATOR) for k in (3, 4))
OFFSETS = torch.tensor([0.5, -0.6, 0.1, 0.3], dtype=torch.float64)
HEAD = torch.tensor([1.0, 2.0, 1.4], dtype=torch.float64)
NAMES = ["brass", "iron", "steel"]
Y = HEAD[MATERIAL] * (3 - FLOW.square()) + OFFSETS[RIG] + 0.03 * normal(N, seed=1)
Y = Y.unsqueeze(-1)
FRAME = pd.DataFrame(
    {
        "flow": FLOW.numpy(),
        "material": pd.Categorical([NAMES[i] for i in MATERIAL]),
        "rig": [f"R{i}" for i in RIG.tolist()],
    }
)
X = torch.stack([FLOW, MATERIAL.double(), RIG.double()], -1)
NEW = FRAME[:4].assign(rig="R9")
RIGS = Categories(batches="rig")


def head(X):
    return 0.9 * HEAD[X[:, 1].long()] * (3 - X[:, 0].square())


def same(actual, expected, tolerance=1e-8):
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def moments(model, frame):
    """Mean and variance as tensors, as the prediction of a frame is one."""
    return [torch.tensor(each.to_numpy()) for each in model.predict(frame)]


@pytest.fixture(scope="module")
def model():
    model = CKA(FRAME, Y, physics=head, input_transform=RIGS)
    fit(model, "map")
    return model


@pytest.mark.parametrize("profile", [None, MATERN52])
def test_the_covariance_is_exchangeable(profile):
    kernel = None if profile is None else Stationary(profile)
    model = drawn(ZeroMeanGP(X, Y, covar_module=kernel, input_transform=Categories([1], 2)))
    assert [term.name for term in model.terms] == ["f", "x3"]
    own = {name: value[:, 0, :, None, None] for name, value in model.values.items()}
    unlike = [(X[:, None, i] != X[:, i]).double() for i in (1, 2)]
    flow, material = own["f.kernel.lengthscale"].unbind(1)
    squares = ((FLOW[:, None] - FLOW) / flow).square() + unlike[0] / material.square()
    t = (5 * squares).sqrt()
    k = (-squares / 2).exp() if profile is None else (1 + t + t.square() / 3) * (-t).exp()
    names = ("f.kernel.outputscale", "f.constant", "x3.kernel.outputscale")
    scale, kappa, rigs = (own[name].squeeze(1) for name in names)
    expected = scale * k + kappa + rigs * (1 - unlike[1])
    f = model.evaluate(X)
    same(f.cross(f)[:, 0], expected)
    same(f.variance().expand(2, 1, N)[:, 0], expected.diagonal(dim1=-1, dim2=-2))


def test_levels_by_random_features_are_as_far_apart():
    """As many features come near the RBF kernel, of which they are samples."""
    options = {"physics": head, "input_transform": Categories([1])}
    models = RRA(X, Y, num_features=20_000, **options), CKA(X, Y, **options)
    one = torch.ones(1, 1, 3, dtype=torch.float64)
    own = {"lengthscale": 0.5 * one, "outputscale": one[..., :1]}
    rough, exact = (m.terms[0].kernel.covariance(own, X[None, None, :6]) for m in models)
    torch.testing.assert_close(rough, exact, rtol=0, atol=0.04)


def test_names_of_levels_do_not_matter():
    order = torch.tensor([2.0, 0.0, 1.0]).double()
    other = X.clone()
    other[:, 1] = 10 + order[MATERIAL]
    a = drawn(ZeroMeanGP(X, Y, input_transform=Categories([1], [2])))
    b = drawn(ZeroMeanGP(other, Y, input_transform=Categories([-2], [2])))
    same(torch.stack(a.log_likelihood(a.u)[:1]), torch.stack(b.log_likelihood(b.u)[:1]))
    same(a.predict(X).variance, b.predict(other).variance)
    assert levels_of(b)[1] == (10.0, 11.0, 12.0)


def test_a_category_that_does_not_matter_is_as_if_left_out():
    options = {"physics": lambda X: X[:, 0], "num_features": 64}
    model = RRA(X[:, :2], Y, **options, input_transform=Categories([1]))
    plain = RRA(X[:, :1], Y, **options)
    for row in (*model.table.own, *plain.table.own):
        if row.name.endswith("lengthscale"):
            numbers = torch.tensor([2.0, 1e9]).double().log()
            row.location[:] = numbers[: row.location.shape[-1]]
    same(model.predict(X[:, :2]).mean, plain.predict(X[:, :1]).mean, 1e-6)
    far = torch.tensor([[0.3, 0.0], [0.3, 1.0], [0.3, 2.0]]).double()
    values = model.sample_functions(2, seed=0)(far)
    same(values, values[:, :1].expand_as(values), 1e-6)


def test_frames_and_new_rigs(model):
    assert levels_of(model) == {1: ("brass", "iron", "steel"), 2: ("R0", "R1", "R2", "R3")}
    same(model.data.X, X)
    mean, known = moments(model, FRAME)
    same(mean, model.predict(X).mean)
    assert (mean - Y).std() < 0.05
    offsets = model.term("rig", FRAME).mean
    found = torch.stack([offsets[i == RIG][0, 0] for i in range(4)])
    torch.testing.assert_close(found - found.mean(), OFFSETS - OFFSETS.mean(), rtol=0, atol=0.1)
    assert "lengthscale of material: " in model.summary()
    assert "rig: prior mean 0" in model.summary()
    new = moments(model, NEW)[1]
    assert (new > 20 * known[:4]).all()
    lower, upper = model.interval(NEW)
    assert list(upper.index) == [0, 1, 2, 3]
    assert (upper - lower > 0.5).all(axis=None)
    variance = model.values["rig.kernel.outputscale"] * model.unit.square()
    same(model.term("rig", NEW).variance, variance.squeeze(0).expand(4, 1))
    same(model.posterior(NEW).variance, new)
    functions = model.sample_functions(300, seed=0, num_features=256)
    both = functions(pd.concat([NEW, FRAME[:4].assign(rig="R7")]))
    torch.testing.assert_close(both.var(0)[:4], new, rtol=0.3, atol=0)
    assert (both[:, 0, 0] - both[:, 4, 0]).std() > 0.5 * variance.sqrt().item()  # two new rigs
    assert levels_of(model)[2] == ("R0", "R1", "R2", "R3")
    later = model.condition_on_observations(NEW[:1], Y[:1])
    assert (moments(later, NEW)[1] < 0.1 * new).all()
    assert (moments(later, NEW.assign(rig="R7"))[1] > 0.5 * new).all()


def test_files_and_mixtures(model, tmp_path):
    later = model.condition_on_observations(NEW[:1], Y[:1])
    assert save(later, tmp_path / "model.pt").missing == ()
    again = load(tmp_path / "model.pt", trusted=True)
    same(moments(again, NEW)[1], moments(later, NEW)[1])
    assert levels_of(again) == levels_of(model)
    stacked = StackedGP({"CKA": model}, [[1.0]], 4)
    assert moments(stacked.condition_on_observations(NEW, Y[:4]), NEW)[0].shape == (4, 1)
    assert levels_of(stacked) == levels_of(model)
    swept = on_levels(model, torch.tensor([[1.3, 0.6, 2.2], [0.4, 9.0, -1.0]]).double())
    same(swept, torch.tensor([[1.3, 1.0, 2.0], [0.4, 2.0, 0.0]]).double())


def test_outputs_declared_levels_and_kernels_of_gpytorch():
    levels = {"material": ["steel", "iron", "brass", "zinc"]}
    transform = Categories(batches=["rig"], levels=levels)
    model = drawn(ZeroMeanGP(FRAME, torch.cat([Y, -Y], -1), input_transform=transform), 1)
    same(model.data.X[:, 1], 2 - MATERIAL.double())
    zinc = moments(model, FRAME[:4].assign(material="zinc"))[1]
    assert (zinc > moments(model, FRAME[:4])[1]).all()
    matern = ScaleKernel(MaternKernel(active_dims=[0]))
    model = drawn(ZeroMeanGP(X, Y, covar_module=matern, input_transform=Categories([1], [2])))
    other = X - torch.tensor([0.0, 1.0, 0.0]) * (X[:, 1:2] > 0)
    same(model.predict(X).mean, model.predict(other).mean)  # it does not read the material


def test_which_columns_are_categories():
    years = pd.Categorical([2020, 2021, 2022] * 4)
    text = pd.Series(["low", "high"] * 6, dtype=object)
    frame = pd.DataFrame({"size": line(12)[:, 0], "text": text, "year": years})
    model = ZeroMeanGP(frame, uniform(12, 1), input_transform=Categories())
    assert levels_of(model) == {1: ("high", "low"), 2: (2020.0, 2021.0, 2022.0)}
    ids = frame.assign(text=[f"no {i}" for i in range(12)])
    for texts in (ids, frame.assign(text=["1", "2"] * 6)):
        refused(TypeError, "text", ZeroMeanGP, texts, uniform(12, 1), input_transform=Categories())
    named = ZeroMeanGP(ids, uniform(12, 1), input_transform=Categories(["text"]))
    assert len(levels_of(named)[1]) == 12
    assert levels_of(ZeroMeanGP(X, Y, input_transform=Categories())) == {}
    assert levels_of(ZeroMeanGP(X, Y)) == {}


def test_botorch_optimises_the_inputs_of_a_material(model):
    several = ModelListGP(model, model.subset_output([0]))
    same(several.posterior(X[:3]).mean, model.predict(X[:3]).mean.expand(3, 2))
    bounds = torch.tensor([[0.0, 0.0, 0.0], [2.0, 2.0, 3.0]]).double()
    best, _ = optimize_acqf(
        LogExpectedImprovement(model, 0.0), bounds, 1, 2, 16, fixed_features={1: 1.0, 2: 3.0}
    )
    assert best[0, 1:].tolist() == [1.0, 3.0]
    x = torch.tensor([[0.7, 1.0, 3.0]]).double().requires_grad_()
    (slope,) = torch.autograd.grad(model.posterior(x).mean.sum(), x)
    assert slope[0, 0] < 0
    assert slope[0, 1:].tolist() == [0.0, 0.0]


WOOD = FRAME[:2].assign(material="wood")
BETWEEN = torch.tensor([[1.0, 1.5, 0.0]]).double()
REFUSED = [
    ({"columns": "colour"}, "inputs flow, material, rig; found 'colour'"),
    ({"batches": 7}, "found 7"),
    ({"levels": {"material": ["iron", "iron"]}}, "different levels of material"),
    ({"levels": {"material": ["iron", "steel"]}}, "one of iron, steel; found brass"),
    (lambda model: model.predict(WOOD), "brass, iron, steel; found wood"),
    (lambda model: model.predict(BETWEEN), "one of 0.0, 1.0, 2.0; found 1.5.*fixed_features"),
    (lambda _: ZeroMeanGP(X[:, 2:], Y, input_transform=Categories(batches=0)),
     "in addition to batches"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "words"), REFUSED)
def test_bad_columns_and_levels(model, case, words):
    options = {} if callable(case) else {"input_transform": Categories(**case)}
    call = case if callable(case) else lambda _: CKA(FRAME, Y, physics=head, **options)
    refused(ValueError, words, call, model)
