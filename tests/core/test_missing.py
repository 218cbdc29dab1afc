"""Targets that are missing: each output is the model of its own rows."""

import pickle

import pytest
import torch
from gpytorch.kernels import MaternKernel

from gpadjust.core import CKA, MATERN52, RRA, Stationary, ZeroMeanGP
from tests.systems import crude


@pytest.fixture
def gaps(data):
    X, Y = data(n=14, num_outputs=2)
    Y[2:5, 0] = Y[7, 1] = Y[12, 0] = torch.nan
    return X, Y


CASES = {"CKA": CKA, "RRA": RRA, "ZeroMeanGP": ZeroMeanGP}


@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("name", CASES)
def test_each_output_is_the_model_of_its_own_rows(
    name, known, gaps, drawn, numbers, give, same, close, uniform
):
    cls, (X, Y) = CASES[name], gaps
    Yvar = uniform(*Y.shape, low=0.01, high=0.1, seed=2) if known else None
    physics = {} if cls is ZeroMeanGP else {"physics": crude}
    model, Z = drawn(cls(X, Y, Yvar, **physics)), uniform(5, 2, high=2.0, seed=4)
    new_X, new_Y = uniform(3, 2, high=2.0, seed=5), 5 + uniform(3, 2, seed=6)
    new_Y[0, 0] = new_Y[2, 1] = torch.nan
    noise = uniform(3, 2, low=0.01, high=0.1, seed=7) if known else None
    more, value = (
        model.condition_on_observations(new_X, new_Y, noise),
        model.log_likelihood(model.u),
    )
    for j in range(2):
        rows, new = ~Y[:, j].isnan(), ~new_Y[:, j].isnan()
        variances = Yvar[rows][:, [j]] if known else None
        if physics:
            physics = {"physics": lambda X, j=j: crude(X)[..., [j]]}
        single = cls(X[rows], Y[rows][:, [j]], variances, **physics)
        give(single, {n: v[:, [j]] for n, v in numbers(model).items()})
        for part in (model, model.subset_output([j])):
            outputs = [j] if part is model else slice(None)
            for ask in (
                lambda model: model.predict(Z),
                lambda model: model.posterior(Z),
                lambda model: model.term(model.terms[-1].name, Z),
            ):
                close(ask(single).mean, ask(part).mean[..., outputs])
                close(ask(single).variance, ask(part).variance[..., outputs])
            # Known noise elsewhere is the mean of what was observed.
            close(single.predict(Z, True).variance, part.predict(Z, True).variance[..., outputs])
        for own, whole in zip(single.left_out(), model.left_out(), strict=True):
            close(own, whole[:, rows][..., [j]])
        units = rows.sum() * (single.unit / model.unit[[j]]).log().squeeze(-1)
        close(single.log_likelihood(single.u)[0], value[0][:, [j]] + units)
        one = None if noise is None else noise[new][:, [j]]
        later = single.condition_on_observations(new_X[new], new_Y[new][:, [j]], one)
        same(later, more, Z, 1e-7, [j], noise=not known)


@pytest.mark.parametrize("name", [*CASES, "matern", "gpytorch"])
def test_means_alone_are_those_with_covariances(name, gaps, drawn, close, uniform):
    """Also with a graph, of batches of inputs, and of a model that was pickled."""
    kernels = {"matern": Stationary(MATERN52), "gpytorch": MaternKernel()}
    options = {} if name == "ZeroMeanGP" else {"physics": crude}
    if name in kernels:
        options["delta_covar_module"] = kernels[name]
    model, Z = drawn(CASES.get(name, CKA)(*gaps, **options)), uniform(3, 5, 2, high=2.0, seed=4)
    for each in (model, pickle.loads(pickle.dumps(model))):
        given = each.conditioning()
        for X in (Z[0], Z, Z.clone().requires_grad_()):
            close(given.mean_alone(each.evaluate(X)), given.mean(each.evaluate(X))[0])


def test_left_out_predictions_are_missing_too(gaps, drawn):
    X, Y = gaps
    for part in drawn(CKA(X, Y, physics=crude)).left_out():
        assert torch.equal(part.isnan(), Y.isnan().expand_as(part))


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
