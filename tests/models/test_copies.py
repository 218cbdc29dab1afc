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
            options["outcome_transform"] = Standardize(2)
        Yvar = 0.01 * torch.ones_like(Y) if request.param == "known-noise" else None
        return build(kind, X, Y, Yvar, **options)

    return make


def test_state_dict(make, shuffle, uniform, tmp_path, same):
    model, fresh = shuffle(make()), make()
    Z = uniform(4, 2, high=2.0)
    assert not torch.allclose(model.posterior(Z).mean, fresh.posterior(Z).mean, rtol=1e-3)
    torch.save(model.state_dict(), tmp_path / "model.pt")
    fresh.load_state_dict(torch.load(tmp_path / "model.pt"))
    same(model, fresh.eval(), Z, 1e-12)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))], ids=["deep", "pickle"]
)
def test_copy(make, shuffle, uniform, copied, same):
    model = shuffle(make())
    Z = uniform(4, 2, high=2.0)
    same(model, copied(model), Z, 1e-12)
    model.posterior(Z.clone().requires_grad_())
    twin = copied(model)
    same(model, twin, Z, 1e-12)
    before = model.posterior(Z).mean.detach()
    shuffle(twin.train(), seed=1)
    assert not torch.allclose(twin.posterior(Z).mean, before)
    torch.testing.assert_close(model.posterior(Z).mean.detach(), before)


def test_state_dict_on_other_data_brings_the_units_along(
    data, build, shuffle, uniform, same, kernel_of
):
    X, Y = data()
    model, other = shuffle(build("CKA", X, Y, center="mean")), build("CKA", X, 3 * Y, center="mean")
    other.load_state_dict(model.state_dict())
    assert torch.equal(other.outcome_transform.stdvs, model.outcome_transform.stdvs)
    center = model.terms[0].basis.offset.item()
    expected = build("CKA", X, 3 * Y, center=center, outcome_transform=None)
    square = 2 * model.outcome_transform.stdvs.log().item()
    with torch.no_grad():
        for name, parameter in expected.named_parameters():
            if parameter.requires_grad:
                parameter.copy_(dict(model.named_parameters())[name])
        kernel_of(expected, "delta").raw_outputscale += square
        expected.likelihood.noise_covar.raw_noise += square
    same(other.eval(), expected.eval(), uniform(4, 2))
