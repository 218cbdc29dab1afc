"""Copies of a model: state dicts, pickles, deep copies."""

import copy
import pickle

import pytest
import torch
from botorch.models.transforms import Normalize, Standardize


def picklable_physics(X):
    return torch.stack([2 + X.sum(-1), 3 + X[..., 0].sin()], dim=-1)


@pytest.fixture(params=["plain", "transformed", "known-noise"])
def make(request, data, build, kind):
    """Builds a two-output model of one kind and one set of options, on data of a seed."""

    def make(seed=0):
        X, Y = data(num_outputs=2, seed=seed)
        options = {} if kind == "ZeroMeanGP" else {"physics": picklable_physics}
        if request.param == "transformed":
            options["input_transform"] = Normalize(2)
            options["outcome_transform"] = None if kind == "RRA-paper" else Standardize(2)
        Yvar = 0.01 * torch.ones_like(Y) if request.param == "known-noise" else None
        return build(kind, X, Y, Yvar, **options)

    return make


def same_predictions(a, b, Z):
    for name in ("posterior", "rho", "delta"):
        if callable(getattr(a, name, None)):
            p, q = getattr(a, name)(Z), getattr(b, name)(Z)
            torch.testing.assert_close(p.mean, q.mean, rtol=1e-12, atol=1e-12)
            torch.testing.assert_close(p.variance, q.variance, rtol=1e-12, atol=1e-12)


def test_state_dict(make, shuffle, uniform):
    model, fresh = shuffle(make()), make()
    Z = uniform(4, 2, high=2.0)
    assert not torch.allclose(model.posterior(Z).mean, fresh.posterior(Z).mean, rtol=1e-3)
    fresh.load_state_dict(model.state_dict())
    same_predictions(model, fresh.eval(), Z)


def test_state_dict_through_a_file(make, shuffle, uniform, tmp_path):
    model = shuffle(make())
    torch.save(model.state_dict(), tmp_path / "model.pt")
    fresh = make()
    fresh.load_state_dict(torch.load(tmp_path / "model.pt"))
    same_predictions(model, fresh.eval(), uniform(4, 2))


def test_pickle(make, shuffle, uniform):
    model = shuffle(make())
    Z = uniform(4, 2, high=2.0)
    same_predictions(model, pickle.loads(pickle.dumps(model)), Z)
    model.posterior(Z)
    same_predictions(model, pickle.loads(pickle.dumps(model)), Z)


def test_deepcopy(make, shuffle, uniform):
    model = shuffle(make())
    Z = uniform(4, 2, high=2.0)
    twin = copy.deepcopy(model)
    same_predictions(model, twin, Z)
    before = model.posterior(Z).mean.detach()
    shuffle(twin.train(), seed=1)
    twin.posterior(Z)
    torch.testing.assert_close(model.posterior(Z).mean.detach(), before)


def test_deepcopy_after_a_prediction_with_gradients(make, uniform):
    model = make()
    Z = uniform(4, 2, high=2.0).requires_grad_()
    model.posterior(Z)
    same_predictions(model, copy.deepcopy(model), Z.detach())


def test_state_dict_on_other_data_brings_the_units_along(data, build, shuffle, uniform):
    X, Y = data()
    model = shuffle(build("CKA", X, Y, center="mean"))
    other = build("CKA", X, 3 * Y, center="mean")
    other.load_state_dict(model.state_dict())
    expected = build("CKA", X, 3 * Y, outcome_transform=None)
    scale = model.outcome_transform.stdvs.squeeze()
    assert torch.equal(other.outcome_transform.stdvs.squeeze(), scale)
    with torch.no_grad():
        for name, parameter in expected.named_parameters():
            parameter.copy_(dict(model.named_parameters())[name])
        expected.delta_covar_module.raw_outputscale += 2 * scale.log()
        expected.likelihood.noise_covar.raw_noise += 2 * scale.log()
        offset = model.rho_covar_module and model._column.offset
        expected._column.offset.copy_(offset)
    Z = uniform(4, 2)
    torch.testing.assert_close(other.eval().posterior(Z).mean, expected.eval().posterior(Z).mean)
