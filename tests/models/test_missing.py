"""Observations that are missing, NaN in the targets."""

import pytest
import torch

from gpadjust import fit
from gpadjust.validation import leave_one_out
from tests.systems import crude


@pytest.fixture
def gaps(data):
    """Inputs and two outputs, of which some are missing."""
    X, Y = data(n=14, num_outputs=2)
    Y[2:5, 0] = Y[7, 1] = Y[12, 0] = torch.nan
    return X, Y


def single_of(build, kind, model, X, Y, Yvar, physics, j):
    """The model of one output, of the rows where it was observed."""
    rows = ~Y[:, j].isnan()
    Yvar = None if Yvar is None else Yvar[rows][:, [j]]
    options = {} if kind == "ZeroMeanGP" else {"physics": lambda X: physics(X)[..., [j]]}
    single = build(kind, X[rows], Y[rows][:, [j]], Yvar, **options)
    named = dict(model.named_parameters())
    with torch.no_grad():
        for name, parameter in single.named_parameters():
            parameter.copy_(named[name][j])
    return single.eval(), rows


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_each_output_is_the_model_of_its_own_rows(
    gaps, build, kind, shuffle, uniform, same, close, known_noise
):
    X, Y = gaps
    Yvar = uniform(*Y.shape, low=0.01, high=0.1, seed=2) if known_noise else None
    model, Z = shuffle(build(kind, X, Y, Yvar)), uniform(5, 2, high=2.0, seed=4)
    new_X, new_Y = uniform(3, 2, high=2.0, seed=5), 5 + uniform(3, 2, seed=6)
    new_Y[0, 0] = new_Y[2, 1] = torch.nan
    noise = uniform(3, 2, low=0.01, high=0.1, seed=7)
    known = {"noise": noise} if known_noise else {}
    more = model.condition_on_observations(new_X, new_Y, **known)
    loo = leave_one_out(model)
    assert torch.equal(loo.Y.isnan(), Y.isnan())
    for j in range(2):
        single, rows = single_of(build, kind, model, X, Y, Yvar, crude, j)
        same(single, model, Z, 1e-8, [j])
        same(model.subset_output([j]), single, Z, 1e-8)
        own = leave_one_out(single)
        close(loo.mean[rows][:, [j]], own.mean)
        close(loo.variance[rows][:, [j]], own.variance)
        close(loo.score().nlpd[[j]], own.score().nlpd)
        close(loo.score().coverage[[j]], own.score().coverage)
        new = ~new_Y[:, j].isnan()
        one = {name: values[new][:, [j]] for name, values in known.items()}
        later = single.condition_on_observations(new_X[new], new_Y[new][:, [j]], **one)
        same(later, more, Z, 1e-7, [j])


@pytest.mark.slow
def test_fits_and_samples(gaps, build, kind, uniform):
    X, Y = gaps
    model, Z = build(kind, X, Y), uniform(5, 2, high=2.0, seed=4)
    result = fit(model, "map", num_screened=8, num_starts=2)
    assert result.log_likelihood.isfinite().all()
    functions, posterior = model.sample_functions(400, seed=0), model.posterior(Z)
    if kind != "RRA-paper":
        error = functions(Z).mean(0) - posterior.mean
        assert (error.abs() < 0.3 * posterior.variance.sqrt() + 1e-3 * Y.nanmean()).all()
    assert posterior.rsample(torch.Size([3])).isfinite().all()


def test_samples_of_hyper_parameters(gaps, held, uniform, same):
    model, singles = held("CKA", *gaps)
    Z = uniform(5, 2, high=2.0, seed=4)
    for i, single in enumerate(singles):
        torch.testing.assert_close(model.posterior(Z).mean[i], single.posterior(Z).mean)
        torch.testing.assert_close(model.rho(Z, mixed=False).variance[i], single.rho(Z).variance)


def test_units_are_of_what_was_observed(gaps, build):
    X, Y = gaps
    scale = build("CKA", X, Y).outcome_transform.stdvs
    for j in range(2):
        rows = ~Y[:, j].isnan()
        physics = {} if j == 0 else {"physics": lambda X: 4 + (2 * X[..., 1:]).cos()}
        own = build("CKA", X[rows], Y[rows][:, [j]], **physics)
        torch.testing.assert_close(scale[:, j], own.outcome_transform.stdvs[:, 0])
