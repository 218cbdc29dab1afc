"""What the models become where a part of them vanishes."""

import gpytorch
import pytest
import torch
from botorch.models.transforms import Normalize, Standardize

from gpadjust import CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.models import BiasGP
from gpadjust.validation import leave_one_out
from tests.systems import crude

NOTHING = 1e-14  # an outputscale that switches a kernel off


def copy_parameters(source, target):
    """Give a module the parameters of another one, but not its bounds."""
    values = dict(source.named_parameters())
    with torch.no_grad():
        for name, parameter in target.named_parameters():
            parameter.copy_(values[name])


def give(model, source, **terms):
    """Give a model the noise of another one, and some of its kernels: the target's name first."""
    kernels = {term.name: term.kernel for term in source.terms}
    for term in model.terms:
        if term.name in terms:
            copy_parameters(kernels[terms[term.name]], term.kernel)
    copy_parameters(source.likelihood, model.likelihood)
    return model.eval()


def switch_off(kernel):
    with torch.no_grad():
        kernel.raw_outputscale.fill_(torch.tensor(NOTHING).log())


def agree(close, a, b, Z, tolerance=1e-8):
    a, b = a.posterior(Z), b.posterior(Z)
    close(a.mean, b.mean, tolerance)
    close(a.variance, b.variance, tolerance)


@pytest.fixture
def Z(uniform):
    return uniform(6, 2, low=-1.0, high=3.0, seed=7)


def test_without_physics_rho_or_delta(data, shuffle, close, Z, build, kernel_of):
    X, Y = data(num_outputs=2)
    model = shuffle(CKA(X, Y, physics=lambda X: X.new_zeros(len(X), 2)))
    agree(close, model, give(ZeroMeanGP(X, Y), model, f="delta"), Z)
    model = shuffle(build("CKA", X, Y))
    switch_off(kernel_of(model, "rho"))
    agree(close, model, give(build("PhysicsMeanGP", X, Y), model, delta="delta"), Z)
    model = shuffle(build("CKA", X, Y))
    switch_off(kernel_of(model, "delta"))
    scale_gp = give(build("ScaleGP", X, Y), model, rho="rho")
    agree(close, model, scale_gp, Z)
    close(model.rho(Z).mean, scale_gp.rho(Z).mean)
    close(model.rho(Z).variance, scale_gp.rho(Z).variance)


@pytest.mark.parametrize("transform", [None, Standardize(1)], ids=["none", "standardize"])
@pytest.mark.parametrize("kind", ["PhysicsMeanGP", "ScaleGP", "CKA"])  # RRA does on average
def test_the_physics_returns_far_from_the_data(data, build, kind, transform):
    X, Y = data()
    model = build(kind, X, Y, outcome_transform=transform).eval()
    far = torch.tensor([[500.0, -300.0], [-400.0, 100.0]], dtype=torch.float64)
    torch.testing.assert_close(model.posterior(far).mean, model.physics(far), rtol=1e-10, atol=0)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("transform", ["default", "none", "standardize"])
@pytest.mark.parametrize("kind", ["PhysicsMeanGP", "ScaleGP", "CKA", "RRA"])
def test_the_prior_mean_is_the_physics(
    data, build, kind, num_outputs, close, Z, transform, normalize
):
    X, Y = data(num_outputs=num_outputs)
    options = {
        "default": {},
        "none": {"outcome_transform": None},
        "standardize": {"outcome_transform": Standardize(num_outputs)},
    }[transform]
    if normalize:
        options["input_transform"] = Normalize(2)
    model = build(kind, X, Y, **options).eval()
    with gpytorch.settings.prior_mode():
        prior = model(model.model_inputs(Z)).mean.reshape(num_outputs, 6).mT
    if transform != "none":
        prior = model.outcome_transform.untransform(prior)[0]
    close(prior, crude(Z)[:, :num_outputs], 1e-12)


def test_the_physics_mean_gp_is_a_gp_of_the_residual(data, build, shuffle, close, Z, num_outputs):
    assert BiasGP is PhysicsMeanGP
    X, Y = data(num_outputs=num_outputs)
    model = shuffle(build("PhysicsMeanGP", X, Y))
    residual = ZeroMeanGP(X, Y - crude(X)[:, :num_outputs])
    posterior = give(residual, model, f="delta").posterior(Z)
    f_p = crude(Z)[:, :num_outputs]
    for mean, ours in (
        (posterior.mean + f_p, model.posterior(Z)),
        (posterior.mean, model.delta(Z)),
    ):
        close(ours.mean, mean)
        close(ours.variance, posterior.variance)


def test_rra_tends_to_cka_as_features_grow(data, build, shuffle, Z):
    X, Y = data()
    cka = shuffle(build("CKA", X, Y), spread=0.1)
    expected = cka.posterior(Z)

    def error(num_features):
        errors = []
        for seed in range(4):
            rra = build("RRA", X, Y, num_features=num_features, seed=seed)
            posterior = give(rra, cka, rho="rho", delta="delta").posterior(Z)
            mean = (posterior.mean - expected.mean).abs().mean()
            sd = (posterior.variance.sqrt() - expected.variance.sqrt()).abs().mean()
            errors.append(torch.stack([mean, sd]).detach())
        return torch.stack(errors).mean(0)

    few, many = error(20), error(500)
    assert (many < 0.35 * few).all()
    assert (many < 0.1 * Y.std()).all()


@pytest.mark.parametrize("cls", [PhysicsMeanGP, ScaleGP, CKA, RRA])
def test_a_perfect_physics_is_left_alone(data, close, Z, cls):
    X, _ = data()

    def physics(X):
        return 2 + X.sum(-1, keepdim=True)

    model = cls(X, physics(X), physics=physics).eval()
    close(model.posterior(Z).mean.detach(), physics(Z), 1e-12)
    if "rho" in model.term_names:
        close(model.rho(Z).mean.detach(), torch.ones(6, 1, dtype=torch.float64), 1e-9)
    if "delta" in model.term_names:
        assert model.delta(Z).mean.abs().max() < 1e-9


# Observations that are missing, NaN in the targets


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


def test_missing_observations_of_samples_and_units(gaps, held, uniform, same, build):
    model, singles = held("CKA", *gaps)
    Z = uniform(5, 2, high=2.0, seed=4)
    for i, single in enumerate(singles):
        torch.testing.assert_close(model.posterior(Z).mean[i], single.posterior(Z).mean)
        torch.testing.assert_close(model.rho(Z, mixed=False).variance[i], single.rho(Z).variance)
    X, Y = gaps
    scale = build("CKA", X, Y).outcome_transform.stdvs
    for j in range(2):
        rows = ~Y[:, j].isnan()
        physics = {} if j == 0 else {"physics": lambda X: 4 + (2 * X[..., 1:]).cos()}
        own = build("CKA", X[rows], Y[rows][:, [j]], **physics)
        torch.testing.assert_close(scale[:, j], own.outcome_transform.stdvs[:, 0])
