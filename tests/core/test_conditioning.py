"""Conditioning on further observations, fantasies of them, and targets that are missing."""

import copy
import pickle

import pytest
import torch
from botorch.models.transforms import Normalize
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.kernels import MaternKernel

from gpadjust.core import CKA, MATERN52, RRA, CalibratedPhysics, Stationary, ZeroMeanGP
from gpadjust.physics import FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.systems import crude


def calibrated(X, Y, Yvar=None, cls=CalibratedPhysics):
    def law(X, p):
        return torch.stack([p.a * y + X[..., 0].pow(p.b) for y in crude(X).mT], -1)

    unknowns = {"a": Unknown(1.0, sd=0.5), "b": Unknown(2.0, factor=1.5)}
    return cls(X, Y, Yvar, physics=FunctionPhysics(law, unknowns=unknowns))


BOUNDS = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
KINDS = {
    "CKA": lambda *data: CKA(*data, physics=crude),
    "RRA": lambda *data: RRA(*data, physics=crude),
    "ZeroMeanGP": ZeroMeanGP,
    "Normalize": lambda *data: CKA(
        *data, physics=crude, input_transform=Normalize(2, bounds=BOUNDS)
    ),
    "two physics": lambda *data: CKA(*data, physics=[crude, lambda X: crude(X).sin()]),
    "relative noise": lambda *data: CKA(*data[:2], physics=crude, noise=Relative()),
    "unknown parameters": lambda *data: calibrated(*data, cls=CKA),
    "CalibratedPhysics": calibrated,
}


def sampler(number):
    return SobolQMCNormalSampler(torch.Size([number]), seed=0)


@pytest.mark.parametrize("sizes", [(3,), (2, 1)], ids=str)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
def test_conditioning_is_a_model_of_all_rows(
    known, kind, sizes, data, drawn, numbers, give, same, uniform
):
    if known and kind == "relative noise":
        pytest.skip("has no known noise")
    X, Y = data(num_outputs=2, n=12)
    Y[4, 0] = Y[10, 1] = torch.nan
    Yvar, Z = uniform(*Y.shape, low=0.01, high=0.1, seed=2), uniform(5, 2, high=2.0, seed=4)
    model = drawn(KINDS[kind](X[:9], Y[:9], Yvar[:9] if known else None))
    conditioned, n, before = model, 9, model.predict(Z).mean
    for size in sizes:
        new = slice(n, n := n + size)
        noise = Yvar[new] if known else None
        conditioned = conditioned.condition_on_observations(X[new], Y[new], noise)
    whole = give(KINDS[kind](X, Y, Yvar if known else None), numbers(model))
    same(conditioned, whole, Z, 1e-7, noise=not known)
    for own, other in zip(conditioned.left_out(), whole.left_out(), strict=True):
        same_there = ~Y.isnan().expand_as(own)
        torch.testing.assert_close(own[same_there], other[same_there], rtol=1e-6, atol=1e-9)
    conditioned.set_draws(model.u[:1])  # and once more from the beginning
    same(conditioned, whole.subset_draws(torch.tensor([0])), Z, 1e-7, noise=not known)
    assert torch.equal(model.predict(Z).mean, before)


@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
def test_batches_of_observations(known, data, drawn, same, uniform, close):
    X, Y = data(num_outputs=2)
    model = drawn(CKA(X, Y, 0.01 if known else None, physics=crude))
    new_X, Z = uniform(3, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    new_Y = 4 + uniform(4, 3, 2, 2, seed=5)
    batch = model.condition_on_observations(new_X, new_Y)
    twice = batch.condition_on_observations(new_X[:, :1] + 0.1, new_Y[:, :, :1])
    for i in range(3):
        one = model.condition_on_observations(new_X[i], new_Y[2, i])
        two = one.condition_on_observations(new_X[i, :1] + 0.1, new_Y[2, i, :1])
        for found, single in ((batch, one), (twice, two)):
            for ask in ("predict", "posterior", "rho", "delta"):
                many, expected = getattr(found, ask)(Z), getattr(single, ask)(Z)
                assert many.mean.shape == (4, 3, 5, 2)
                close(many.mean[2, i], expected.mean)
                close(many.variance.expand(4, 3, 5, 2)[2, i], expected.variance)
            close(found.interval(Z)[0][2, i], single.interval(Z)[0])
            own = found.predict(Z + torch.arange(3).reshape(3, 1, 1)).mean[2, i]
            close(own, single.predict(Z + i).mean)
    assert batch.posterior(Z).rsample(torch.Size([6])).shape == (6, 4, 3, 5, 2)
    assert batch.sample_functions(7, seed=0)(Z).shape == (7, 4, 3, 5, 2)


@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("m", [1, 2])
def test_fantasies(m, known, data, drawn, uniform, close):
    X, Y = data(num_outputs=m)
    model = drawn(CKA(X, Y, 0.01 if known else None, physics=lambda X: crude(X)[..., :m]))
    new_X, Z = uniform(4, 2, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    fantasy = model.fantasize(new_X, sampler(6))
    prediction, posterior = fantasy.predict(Z), fantasy.posterior(Z)
    assert posterior.mean.shape == prediction.mean.shape == (6, 4, 5, m)
    assert posterior.mean.std(0).max() > 1e-6
    close(prediction.variance.expand(6, 4, 5, m), posterior.variance.expand(6, 4, 5, m))
    if known:
        noise = torch.full((4, 2, m), 0.3, dtype=torch.float64)
        assert model.fantasize(new_X, sampler(6), observation_noise=noise).batch_shape == (6, 4)


def test_no_new_points(data, drawn, same, close, uniform):
    X, Y = data(num_outputs=2)
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(5, 2)
    same(model.condition_on_observations(X[:0], Y[:0]), model, Z)
    fantasy = model.fantasize(torch.empty(4, 0, 2, dtype=torch.float64), sampler(3))
    close(fantasy.predict(Z).mean, model.predict(Z).mean.expand(3, 4, 5, 2))


def test_fantasies_average_to_the_model(data, drawn, uniform):
    model = drawn(CKA(*data(), physics=lambda X: crude(X)[..., :1]))
    new_X, Z = uniform(1, 1, 2, high=2.0, seed=3), uniform(5, 2, high=2.0, seed=4)
    one = model.subset_draws(torch.tensor([0]))  # each draw averages by itself
    average = one.fantasize(new_X, sampler(2048)).posterior(Z).mean.mean(0)
    torch.testing.assert_close(average, one.posterior(Z).mean[None], rtol=1e-3, atol=1e-3)


def test_gradients_to_new_inputs_and_targets(data, drawn, uniform):
    X, Y = data(num_outputs=2)
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(2, 2, high=2.0)

    def predict(new_X, new_Y):
        return model.condition_on_observations(new_X, new_Y).predict(Z)

    def after_another(new_X, new_Y):
        later = model.condition_on_observations(new_X, new_Y)
        return later.condition_on_observations(Z + 0.1, Y[:2]).predict(Z)

    new = uniform(2, 2, high=2.0, seed=7).requires_grad_(), Y[:2].clone().requires_grad_()
    for function in (predict, after_another):
        assert torch.autograd.gradcheck(function, new, rtol=1e-3, atol=1e-4)


def test_copies(data, drawn, same, uniform):
    X, Y = data(num_outputs=2)
    for noise in (None, 0.1):
        model = drawn(CKA(X, Y, noise, physics=crude))
        for each in (model, model.condition_on_observations(X[:2] + 0.1, Y[:2])):
            same(copy.deepcopy(each), each, uniform(5, 2), 1e-12)
            assert noise is None or each.data.Yvar.shape == each.data.Y.shape


@pytest.fixture
def gaps(data):
    X, Y = data(n=14, num_outputs=2)
    Y[2:5, 0] = Y[7, 1] = Y[12, 0] = torch.nan
    return X, Y


APART = {"CKA": CKA, "RRA": RRA, "ZeroMeanGP": ZeroMeanGP}


@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("name", APART)
def test_each_output_is_the_model_of_its_own_rows(
    name, known, gaps, drawn, numbers, give, same, alike, close, uniform
):
    cls, (X, Y) = APART[name], gaps
    Yvar = uniform(*Y.shape, low=0.01, high=0.1, seed=2) if known else None
    physics = {} if cls is ZeroMeanGP else {"physics": crude}
    model, Z = drawn(cls(X, Y, Yvar, **physics)), uniform(5, 2, high=2.0, seed=4)
    new_X, new_Y = uniform(3, 2, high=2.0, seed=5), 5 + uniform(3, 2, seed=6)
    new_Y[0, 0] = new_Y[2, 1] = torch.nan
    noise = uniform(3, 2, low=0.01, high=0.1, seed=7) if known else None
    more = model.condition_on_observations(new_X, new_Y, noise)
    value, _ = model.log_likelihood(model.u)
    for j in range(2):
        rows, new = ~Y[:, j].isnan(), ~new_Y[:, j].isnan()
        variances = Yvar[rows][:, [j]] if known else None
        if physics:
            physics = {"physics": lambda X, j=j: crude(X)[..., [j]]}
        single = cls(X[rows], Y[rows][:, [j]], variances, **physics)
        give(single, {n: v[:, [j]] for n, v in numbers(model).items()})
        last = model.terms[-1].name
        for part in (model, model.subset_output([j])):
            outputs = [j] if part is model else slice(None)
            alike(single.predict(Z), part.predict(Z), outputs=outputs)
            alike(single.posterior(Z), part.posterior(Z), outputs=outputs)
            alike(single.term(last, Z), part.term(last, Z), outputs=outputs)
            # Known noise elsewhere is the mean of the observed variances.
            alike(single.predict(Z, True), part.predict(Z, True), outputs=outputs)
        for own, whole in zip(single.left_out(), model.left_out(), strict=True):
            close(own, whole[:, rows][..., [j]])
        units = rows.sum() * (single.unit / model.unit[[j]]).log().squeeze(-1)
        close(single.log_likelihood(single.u)[0], value[:, [j]] + units)
        one = None if noise is None else noise[new][:, [j]]
        later = single.condition_on_observations(new_X[new], new_Y[new][:, [j]], one)
        same(later, more, Z, 1e-7, [j], noise=not known)


@pytest.mark.parametrize("name", [*APART, "matern", "gpytorch"])
def test_means_alone_are_those_with_covariances(name, gaps, drawn, close, uniform):
    """Also with a graph, of batches of inputs, and of a model that was pickled."""
    kernels = {"matern": Stationary(MATERN52), "gpytorch": MaternKernel()}
    options = {} if name == "ZeroMeanGP" else {"physics": crude}
    if name in kernels:
        options["delta_covar_module"] = kernels[name]
    model, Z = drawn(APART.get(name, CKA)(*gaps, **options)), uniform(3, 5, 2, high=2.0, seed=4)
    for each in (model, pickle.loads(pickle.dumps(model))):
        given = each.conditioning()
        for X in (Z[0], Z, Z.clone().requires_grad_()):
            close(given.mean_alone(each.evaluate(X)), given.mean(each.evaluate(X))[0])


def test_nothing_new_is_learnt_of_what_is_missing(gaps, drawn, same, close, uniform):
    X, Y = gaps
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(5, 2, seed=4)
    nothing = torch.full((2, 2), torch.nan, dtype=torch.float64)
    same(model.condition_on_observations(X[:2] + 0.1, nothing), model, Z)
    functions = model.sample_functions(3, seed=0)
    assert functions(Z).isfinite().all()
    known = CKA(X, Y, 0.1, physics=crude)
    new_Y, noise = crude(X[:2]), torch.full((2, 2), 0.1, dtype=torch.float64)
    new_Y[0, 1] = torch.nan
    predicted = []
    for value in (0.1, 7.0, torch.nan):
        noise[0, 1] = value
        predicted.append(known.condition_on_observations(X[:2] + 0.1, new_Y, noise).predict(Z))
    close(predicted[1].variance, predicted[0].variance)
    close(predicted[2].mean, predicted[0].mean)


def test_each_of_a_batch_misses_its_own(gaps, drawn, close, uniform):
    X, Y = gaps
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(5, 2, seed=4)
    new_X, new_Y = uniform(3, 2, seed=5), 5 + uniform(2, 3, 2, seed=6)
    new_Y[0, 1, 0] = new_Y[1, 2, 1] = torch.nan
    found = model.condition_on_observations(new_X, new_Y).predict(Z)
    for i in range(2):
        expected = model.condition_on_observations(new_X, new_Y[i]).predict(Z)
        close(found.mean[i], expected.mean)
        close(found.variance.expand(2, 5, 2)[i], expected.variance)
