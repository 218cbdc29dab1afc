"""What other machines taught, as the prior of a fit."""

import pickle

import numpy as np
import pytest
import torch

from gpadjust import CKA, RRA, PhysicsMeanGP, VariationalCKA, fit, load, save
from gpadjust.gp.sister import Sister
from gpadjust.inference.sisters import sister_of
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.validation import leave_one_out


def wave(X):
    return torch.sin(6 * X[:, :1])


def two_waves(X):
    return wave(X).repeat(1, 2)


def machine(k, n, seed, kind=CKA, two=False):
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    Y = truth(X, k) + 0.02 * torch.randn(n, 1, generator=generator, dtype=torch.float64)
    if two:
        return kind(X, torch.cat([Y, wave(X) + 1], dim=-1), physics=two_waves)
    return kind(X, Y, physics=wave)


def truth(X, k=0.0):
    return (1.3 + 0.1 * k) * wave(X) + (1 + 0.2 * k) * X + 0.5 * torch.cos(9 * X)


AT = torch.linspace(0, 1, 41, dtype=torch.float64).unsqueeze(-1)
QUICK = {"num_draws": 128, "num_starts": 2, "num_screened": 16}


@pytest.fixture(scope="module")
def other():
    model = machine(0, 25, 0)
    fit(model, **QUICK)
    return model


def error(model):
    return (model.predict(AT).mean[:, :1] - truth(AT, 1)).square().mean().sqrt().item()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["bayes", "map"])
def test_a_machine_of_few_points_is_known_better_with_what_another_taught(other, method):
    options = {**QUICK} if method == "bayes" else {}
    without, model = machine(1, 5, 1), machine(1, 5, 1)
    fit(without, method, **options)
    result = fit(model, method, prior=other, **options)
    assert result.sisters.item() > 0.5
    assert error(model) < 0.8 * error(without)


def test_without_a_difference_a_term_is_what_the_other_knows(other):
    # Independent formula: the mixture's moments of the other machine, of terms and of the sum.
    model = machine(1, 5, 1)
    model.covar_module.sister = sister_of(model, [other])
    with torch.no_grad():
        for term in model.terms:
            term.kernel.outputscale = 1e-12
        model.eval()
        own = other.data()["train_X"]
        for name in ("rho", "delta"):
            (term,) = (t for t in model.terms if t.name == name)
            prior = model._at(term, model.model_inputs(own))
            shift, scale = model.units(term.unit)
            mean, variance = prior.mean() * scale + shift, prior.variance() * scale.square()
            known = other.term(name, own)
            torch.testing.assert_close(mean, known.mean.squeeze(-1), atol=0.01, rtol=0.05)
            torch.testing.assert_close(variance, known.variance.squeeze(-1), atol=1e-3, rtol=0.3)
            off = (variance / known.variance.squeeze(-1) - 1).abs()
            assert off.median() < 0.05  # single points depend on the draws
        within = AT[(own.min() < AT) & (own.max() > AT)].unsqueeze(-1)
        inputs = model.model_inputs(within)
        f, (shift, scale) = model.at(inputs), model.units()
        mean, variance = other.predict(within)
        torch.testing.assert_close(f.mean() * scale + shift, mean.squeeze(-1), atol=0.05, rtol=0.02)
        sd = f.variance().sqrt() * scale
        torch.testing.assert_close(sd, variance.squeeze(-1).sqrt(), atol=0.02, rtol=0.3)
        torch.testing.assert_close(
            f.covariance().diagonal(dim1=-1, dim2=-2), f.variance(), atol=1e-9, rtol=1e-6
        )


def test_a_posterior_is_that_of_a_prior_with_their_mean_and_covariance(other):
    model = machine(1, 5, 1)
    fit(model, "map", prior=other)
    with torch.no_grad():
        train, new = model.at(model.train_inputs[0]), model.at(model.model_inputs(AT))
        K = train.covariance().numpy() + model.likelihood.noise.item() * np.eye(5)
        cross = new.cross(train).numpy()
        residual = (model.train_targets - train.mean()).numpy()
        shift, scale = model.units()
        mean = (new.mean().numpy() + cross @ np.linalg.solve(K, residual)) * scale.item()
        known = (cross * np.linalg.solve(K, cross.T).T).sum(-1)
        variance = (new.variance().numpy() - known) * scale.item() ** 2
    found = model.predict(AT)
    np.testing.assert_allclose(found.mean.squeeze(-1).numpy(), mean + shift.item(), atol=1e-6)
    np.testing.assert_allclose(found.variance.squeeze(-1).numpy(), variance, atol=1e-7)


@pytest.mark.slow
def test_a_machine_that_has_nothing_to_do_with_it_is_left_out():
    X = torch.linspace(0, 1, 25, dtype=torch.float64).unsqueeze(-1)
    rough = CKA(X, wave(X) + 2 * torch.sin(37 * X) - 3, physics=wave)
    fit(rough, "map")
    model, without = machine(1, 7, 1), machine(1, 7, 1)
    result = fit(model, prior=rough, **QUICK)
    fit(without, **QUICK)
    assert result.sisters.item() < 0.2
    assert error(model) < 1.3 * error(without)


@pytest.mark.slow
@pytest.mark.parametrize("num_others", [1, 2])
def test_the_whole_house(other, tmp_path, num_others):
    others = [other, machine(0.5, 25, 3)][:num_others]
    for each in others[1:]:
        fit(each, "map")
    model = machine(1, 6, 1)
    result = fit(model, prior=others, **QUICK)
    assert "other machines help" in repr(result)
    mean = model.predict(AT).mean
    save(model, tmp_path / "model.pt")
    torch.testing.assert_close(load(tmp_path / "model.pt", trusted=True).predict(AT).mean, mean)
    torch.testing.assert_close(pickle.loads(pickle.dumps(model)).predict(AT).mean, mean)
    sd = model.predict(AT).variance.sqrt()
    functions = model.sample_functions(300, seed=0)(AT)
    assert ((functions.mean(0) - mean).abs() < 0.4 * sd + 1e-3).all()
    assert (functions.std(0) / sd).median() == pytest.approx(1, abs=0.2)
    torch.testing.assert_close(model.mean_functions()(AT).mean(0), mean)
    X, Y = AT[3:5], truth(AT[3:5], 1)
    more = model.condition_on_observations(X, Y)
    model.update(X, Y, forget=100)
    torch.testing.assert_close(more.predict(AT).mean, model.predict(AT).mean, atol=1e-6, rtol=1e-6)
    leave_one_out(model)
    assert "rho" in model.summary()
    fit(model, "map")  # again, without
    assert model.covar_module.sister is None


@pytest.mark.slow
def test_of_several_outputs_each_has_a_probability(tmp_path):
    taught, model = machine(0, 20, 0, two=True), machine(1, 5, 1, two=True)
    fit(taught, "map")
    result = fit(model, prior=taught, **QUICK)
    assert result.sisters.shape == (2,)
    subset = model.subset_output([1])
    torch.testing.assert_close(subset.predict(AT).mean, model.predict(AT).mean[:, 1:])
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", trusted=True)
    torch.testing.assert_close(again.predict(AT).mean, model.predict(AT).mean)
    assert isinstance(model.covar_module.sister, Sister)


def test_what_cannot_be_a_prior_says_so(other):
    model = machine(1, 5, 1)
    with pytest.raises(ValueError, match="got none"):
        fit(model, prior=[])
    with pytest.raises(ValueError, match=r"call fit\(other\)"):
        fit(model, prior=machine(0, 6, 0))
    with pytest.raises(TypeError, match="fitted CKA"):
        fit(model, prior=machine(0, 6, 0, PhysicsMeanGP))
    with pytest.raises(ValueError, match="output names"):
        fit(machine(1, 5, 1, two=True), prior=other)
    with pytest.raises(ValueError, match="random features"):
        fit(machine(1, 5, 1, RRA), prior=other)
    with pytest.raises(TypeError, match="a CKA does"):
        fit(VariationalCKA(AT, truth(AT), physics=wave, num_inducing=4), prior=other)
    with pytest.raises(ValueError, match="rho_mean=1"):
        fit(CKA(AT, truth(AT), physics=wave, rho_mean="learn"), prior=other)
    law = FunctionPhysics(lambda X, p: p.a * wave(X)[:, 0], unknowns={"a": Unknown(1.0, sd=0.5)})
    with pytest.raises(ValueError, match="priors by hand"):
        fit(CKA(AT, truth(AT), physics=law), prior=other)
    with pytest.raises(TypeError, match="fitted CKA"):
        fit(model, prior=3)
