"""VariationalCKA: the exact model in the limit, BoTorch's contract, copies, and bad input."""

import copy
import pickle
from functools import cache

import pytest
import torch
from botorch.acquisition import UpperConfidenceBound
from botorch.acquisition.knowledge_gradient import qKnowledgeGradient
from botorch.acquisition.logei import qLogExpectedImprovement, qLogNoisyExpectedImprovement
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.fit import fit_gpytorch_mll
from botorch.models import ModelListGP
from botorch.models.approximate_gp import ApproximateGPyTorchModel
from botorch.models.transforms import Normalize
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.mlls import VariationalELBO

from gpadjust import CKA, StackedGP, VariationalCKA, compare, fit, load, save
from gpadjust.inference.collapsed_bound import CollapsedBound, observations
from gpadjust.models.summary import log_likelihood
from gpadjust.validation import Structure

LINE = torch.tensor([[0.0], [1.0]], dtype=torch.float64)


def wave(X):
    return torch.sin(6 * X[..., :1])


def waves(X):
    return torch.cat([wave(X), wave(X).square()], dim=-1)


def problem(n, num_outputs=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    noise = torch.randn(n, num_outputs, generator=generator, dtype=torch.float64)
    return X, 2 * waves(X)[:, :num_outputs] + X + 0.1 * noise


def make(X, Y, *args, num_inducing=10, **options):
    physics = waves if Y.shape[-1] == 2 else wave
    return VariationalCKA(X, Y, *args, physics=physics, num_inducing=num_inducing, **options)


@cache
def fitted_once(num_outputs):
    model = make(*problem(120, num_outputs))
    fit(model, num_screened=16, num_starts=2)
    return model


@pytest.fixture
def fitted(num_outputs):
    return copy.deepcopy(fitted_once(num_outputs))


@pytest.fixture
def one():
    return copy.deepcopy(fitted_once(1))


def take_optimum(model):
    """The best distribution of inducing values at the hyper-parameters that a model has."""
    likelihood = model.likelihood
    known = likelihood.noise if likelihood.noise.shape[-1] == len(model.train_inputs[0]) else None
    data = observations(model.start, model.train_inputs[0], model.train_targets, known)
    found = CollapsedBound(model.start, data, model.model.inducing_points).optimum()
    model.start.eval()
    model.model.hold(found.mean, found.root)
    return found.bound


def give_rest(model, variance=0.3, lengthscale=0.2):
    with torch.no_grad():
        model.rest.kernel.raw_outputscale.fill_(variance).log_()
        model.rest.kernel.base_kernel.raw_lengthscale.fill_(lengthscale).log_()
    model.forget()


@pytest.mark.parametrize("case", ["", "missing", "known noise"])
def test_points_at_all_inputs_make_the_exact_model(shuffle, close, num_outputs, case):
    X, Y = problem(25, num_outputs)
    if case == "missing":
        Y[::4, 0] = torch.nan
        keep = ~Y.isnan().all(-1)
        X, Y = X[keep], Y[keep]
    args = [0.01 + 0.02 * X.expand(Y.shape)] if case == "known noise" else []
    model = make(X, Y, *args, num_inducing=len(X))
    exact = CKA(X, Y, *args, physics=model.physics)
    shuffle(model.start, 1)
    exact.load_state_dict(model.start.state_dict())
    exact.eval()
    model.model.place(model.train_inputs[0].expand_as(model.model.inducing_points))
    bound = take_optimum(model)
    close(bound, log_likelihood(exact) + _jacobian(exact), 1e-4)
    Z = torch.linspace(-0.2, 1.2, 9, dtype=torch.float64).unsqueeze(-1)
    for name in ("posterior", "rho", "delta"):
        ours, theirs = getattr(model, name)(Z), getattr(exact, name)(Z)
        close(ours.mean, theirs.mean, 1e-3)
        close(ours.variance, theirs.variance, 1e-3)
        covariances = (p.distribution.covariance_matrix for p in (ours, theirs))
        close(*covariances, 1e-3)
    for ours, theirs in zip(
        model.interval(Z, 0.8, True), exact.interval(Z, 0.8, True), strict=True
    ):
        close(ours, theirs, 1e-3)


def _jacobian(model):
    """From a likelihood in the user's units to that in the model's."""
    count = (~model.train_targets.isnan()).sum(-1)
    return count * model._units()[1].squeeze(-1).log()


@pytest.mark.parametrize("rest", [False, True], ids=["none", "rest"])
def test_all_that_predicts_agrees(close, fitted, rest):
    before = fitted.predict(LINE).variance
    if rest:
        give_rest(fitted)
        scale = fitted.outcome_transform.stdvs.square()
        close(fitted.predict(LINE).variance, before + 0.3 * scale, 1e-6)
    Z = torch.linspace(0, 1, 5, dtype=torch.float64).unsqueeze(-1)
    mean, variance = fitted.predict(Z)
    posterior = fitted.posterior(Z)
    close(posterior.mean, mean)
    close(posterior.variance, variance, 1e-6)
    close(fitted.mean_functions()(Z)[0], mean)
    components = fitted.components(Z, False)
    close(components[0].squeeze(-3), mean)
    lower, upper = fitted.interval(Z, 0.95)
    close(upper - lower, 2 * 1.959963984540054 * variance.sqrt(), 1e-6)
    noise = fitted.likelihood.noise.squeeze(-1) * fitted.outcome_transform.stdvs.square()
    close(
        fitted.predict(Z, True).variance - variance, noise.reshape(1, -1).expand(mean.shape), 1e-6
    )
    f_p = fitted.physics(Z)
    close(fitted.rho(Z).mean * f_p + fitted.delta(Z).mean, mean)
    draws = fitted.sample_functions(3000, seed=0, num_features=512)(Z)
    sd = variance.sqrt()
    assert ((draws.mean(0) - mean).abs() < 5 * sd / 3000**0.5).all()
    torch.testing.assert_close(draws.std(0), sd.detach(), rtol=0.15, atol=0)


def test_botorch_predicts_the_same_less_the_rest(close, one):
    X = problem(12)[0].reshape(3, 4, 1)
    assert isinstance(one, ApproximateGPyTorchModel)
    theirs = ApproximateGPyTorchModel.posterior(one, X)
    close(theirs.mean, one.posterior(X).mean)
    close(theirs.variance, one.posterior(X).variance, 1e-6)
    give_rest(one)
    scale = one.outcome_transform.stdvs.square()
    ours = one.posterior(X).variance - 0.3 * scale
    close(ApproximateGPyTorchModel.posterior(one, X).variance, ours, 1e-6)


def test_variational_elbo_at_the_optimum_is_the_bound(close, fitted):
    X = problem(120, fitted.num_outputs)[0]
    bound = take_optimum(fitted)
    mll = VariationalELBO(fitted.likelihood, fitted.model, num_data=len(X))
    fitted.train()
    close(len(X) * mll(fitted(X), fitted.train_targets), bound, 1e-4)


def test_minibatches_raise_the_elbo(num_outputs):
    X, Y = problem(100, num_outputs)
    model = make(X, Y)
    mll = VariationalELBO(model.likelihood, model.model, num_data=len(X))
    learnt = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(learnt, lr=0.05)
    model.train()
    with torch.no_grad():
        before = mll(model(X), model.train_targets)
    for i in range(25):
        rows = slice(25 * (i % 4), 25 * (i % 4 + 1))
        optimizer.zero_grad()
        (-mll(model(X[rows]), model.train_targets[..., rows]).sum()).backward()
        if not i:
            center = [n for n, p in model.named_parameters() if p.grad is None and p.requires_grad]
            assert not center
        optimizer.step()
    with torch.no_grad():
        assert (mll(model(X), model.train_targets) > before + 0.1).all()
    model.posterior(X[:3], output_indices=[0])
    assert torch.equal(copy.deepcopy(model).predict(X).mean, model.predict(X).mean)


def test_fit_gpytorch_mll(close, fitted):
    X, _ = problem(120, fitted.num_outputs)
    with torch.no_grad():
        for term in fitted.covar_module.terms:
            term.kernel.outputscale *= 2
    fitted.forget()
    before = fitted.predict(X).mean
    mll = VariationalELBO(fitted.likelihood, fitted.model, num_data=len(X))
    fit_gpytorch_mll(mll, optimizer_kwargs={"options": {"maxiter": 10}}, max_attempts=1)
    after = fitted.predict(X).mean
    assert not torch.equal(after, before)
    close(copy.deepcopy(fitted).predict(X).mean, after)


def test_shapes_of_posteriors(close, num_outputs, fitted):
    X = problem(24)[0].reshape(2, 3, 4, 1)
    posterior = fitted.posterior(X)
    assert posterior.mean.shape == (2, 3, 4, num_outputs)
    assert posterior.rsample(torch.Size([5])).shape == (5, 2, 3, 4, num_outputs)
    close(posterior.mean[1, 2], fitted.posterior(X[1, 2]).mean)
    weights = torch.ones(num_outputs, dtype=torch.float64)
    sums = fitted.posterior(X, posterior_transform=ScalarizedPosteriorTransform(weights))
    close(sums.mean, posterior.mean.sum(-1, keepdim=True))
    last = fitted.posterior(X, output_indices=[num_outputs - 1])
    close(last.mean, posterior.mean[..., -1:])
    close(last.variance, posterior.variance[..., -1:], 1e-6)


def test_acquisition_functions(one):
    X, Y = problem(120)
    for acquisition in (
        UpperConfidenceBound(one, 0.2),
        qLogExpectedImprovement(one, Y.max()),
        qLogNoisyExpectedImprovement(one, X[:10]),
    ):
        options = {"maxiter": 3}
        best, _ = optimize_acqf(
            acquisition, LINE, q=1, num_restarts=1, raw_samples=4, options=options
        )
        assert 0.2 < best.item() < 0.4  # of the maximum, 0.28


def test_lists_of_models(close, one):
    X, Y = problem(120)
    exact = CKA(X[:20], Y[:20], physics=wave)
    both = ModelListGP(one, exact)
    close(both.posterior(LINE).mean[:, :1], one.posterior(LINE).mean)
    results = fit(both, "map", num_starts=1, num_screened=0)
    assert len(results) == 2
    assert both.subset_output([0]).posterior(LINE).mean.shape == (2, 1)


def test_gradients_to_inputs(one, gradient_is_right):
    X = torch.tensor([[0.3], [0.7]], dtype=torch.float64)
    gradient_is_right(lambda X: one.predict(X).mean.sum(), X)
    gradient_is_right(lambda X: one.posterior(X).variance.sum(), X)


def test_copies(fitted):
    give_rest(fitted)
    fresh = make(*problem(120, fitted.num_outputs))
    with torch.no_grad():
        fresh.predict(LINE)
    fresh.load_state_dict(fitted.state_dict())
    moved = copy.deepcopy(fitted).to(torch.float64).cpu()
    copies = [copy.deepcopy(fitted), pickle.loads(pickle.dumps(fitted)), fresh, moved]
    for each in copies:
        assert each.start.covar_module is each.model.covar_module
        for ours, theirs in zip(each.predict(LINE, True), fitted.predict(LINE, True), strict=True):
            assert torch.equal(ours, theirs)
        assert each.summary() == fitted.summary()


@pytest.mark.parametrize("noise", [None, 0.01])
def test_files(tmp_path, noise):
    X, Y = problem(60, 2)
    model = make(X, Y, noise, input_transform=None, center="mean", num_inducing=5)
    fit(model, num_screened=0)
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=waves)
    for ours, theirs in zip(again.predict(LINE, True), model.predict(LINE, True), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=0)
    assert again.summary() == model.summary()
    with pytest.raises(ValueError, match="subset"):
        save(model.subset_output([0]), tmp_path / "subset.pt")


def test_a_state_brings_its_units_and_transforms_along(close):
    X, Y = problem(40)
    model = make(5 * X, 3 * Y, input_transform=Normalize(1))
    other = make(X, Y, input_transform=Normalize(1))
    other.load_state_dict(model.state_dict())
    close(other.data()["train_Y"], Y)
    close(other.train_inputs[0], other.input_transform(X))
    close(other.train_targets * model.outcome_transform.stdvs.squeeze(), Y.squeeze(-1))


def test_outputs_of_a_model(close):
    model = copy.deepcopy(fitted_once(2))
    give_rest(model)
    Z = problem(7)[0]
    for kept in ([0], [-1], [1, 0]):
        part = model.subset_output(kept)
        close(part.predict(Z, True).mean, model.predict(Z, True).mean[:, kept])
        close(part.predict(Z, True).variance, model.predict(Z, True).variance[:, kept], 1e-6)
        close(part.delta(Z).variance, model.delta(Z).variance[:, kept], 1e-6)
        close(part.evidence.reshape(-1), model.evidence[kept])
        part.load_state_dict(part.state_dict())
        close(part.predict(Z).mean, model.predict(Z).mean[:, kept])
        with pytest.raises(ValueError, match="Expected a whole model"):
            fit(part)
    with pytest.raises(ValueError, match="numbers of outputs from 0 to 1"):
        model.subset_output([2])


@pytest.mark.parametrize("transform", [None, Normalize(2)], ids=["raw", "Normalize"])
def test_transforms(close, transform):
    X, Y = problem(50)
    X = torch.cat([X, 100 * X.flip(0)], dim=-1)
    options = {"input_transform": transform, "outcome_transform": None}
    model = make(X, Y, **options)
    close(model.data()["train_Y"], Y)
    close(model.data()["train_X"], X)
    fit(model, num_screened=0)
    assert (model.predict(X).mean - Y).std() < 0.15


def test_it_is_not_conditioned(one):
    X, Y = problem(3)
    with pytest.raises(NotImplementedError, match="build it of all data"):
        one.condition_on_observations(X, Y)
    with pytest.raises(NotImplementedError, match="build it of all data"):
        one.fantasize(X, SobolQMCNormalSampler(torch.Size([2])))
    with pytest.raises(NotImplementedError, match="build it of all data"):
        qKnowledgeGradient(one, num_fantasies=2)(X.unsqueeze(0))


def test_bad_input(one):
    X, Y = problem(10)
    with pytest.raises(TypeError, match="float64"):
        make(X.float(), Y.float())
    with pytest.raises(ValueError, match="agree"):
        make(X, Y[:4])
    with pytest.raises(ValueError, match="one data set"):
        make(X.expand(2, -1, -1), Y.expand(2, -1, -1))
    for number in (0, 2.5):
        with pytest.raises(ValueError, match="num_inducing"):
            make(X, Y, num_inducing=number)
    with pytest.raises(ValueError, match="columns"):
        one.predict(torch.zeros(2, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="takes transformed inputs with 2 columns"):
        one(X)
    with pytest.raises(ValueError, match="no unknown term 'season'"):
        one.term("season", X)


def test_texts(one):
    assert repr(one) == "VariationalCKA of 'wave': 120 points, 1 input, 1 output"
    lines = one.summary().splitlines()
    assert lines[2].startswith("  evidence lower bound ")
    assert "  rest: none" in lines
    give_rest(one)
    assert any(line.startswith("    sd") for line in one.summary().split("  rest: ")[1].split("\n"))
    assert "  not fitted" in make(*problem(10)).summary().splitlines()
    assert one.term_names == ("rho", "delta")
    assert one.term("rest", LINE).mean.abs().max() == 0


def test_an_exact_model_of_many_points_warns():
    X, Y = problem(5001)
    with pytest.warns(UserWarning, match="gpadjust.VariationalCKA takes the same arguments"):
        CKA(X, Y, physics=wave)


def test_stacking_and_comparison_want_exact_models(one):
    with pytest.raises(TypeError, match="Expected exact models of gpadjust"):
        StackedGP({"many": one}, [[1.0]])
    with pytest.raises(ValueError, match="got 'bayes'"):
        compare(*problem(8), wave, structures=[Structure("many", VariationalCKA)])
