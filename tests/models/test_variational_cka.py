"""VariationalCKA: the exact model in the limit, BoTorch's contract, copies, and bad input."""

import copy
import pickle
from functools import cache
from inspect import signature

import pytest
import torch
from botorch.acquisition import UpperConfidenceBound
from botorch.acquisition.knowledge_gradient import qKnowledgeGradient
from botorch.acquisition.logei import qLogExpectedImprovement, qLogNoisyExpectedImprovement
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.acquisition.thompson_sampling import PathwiseThompsonSampling
from botorch.models import ModelListGP
from botorch.models.transforms import Normalize
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler
from botorch.sampling.pathwise import draw_matheron_paths
from torch import Size

from gpadjust import CKA, StackedGP, VariationalCKA, compare, fit, load, save
from gpadjust.inference.collapsed_bound import CollapsedBound, Observations
from gpadjust.models.component_noise import ComponentNoise
from gpadjust.validation import Structure
from tests.systems import line, refused, same, wave, waves

LINE = line(2)


def problem(n, num_outputs=1):
    generator = torch.Generator().manual_seed(0)
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


def take_optimum(model, points=None):
    """The best distribution of inducing values at the hyper-parameters that a model has."""
    points = model.inducing_points if points is None else points.expand_as(model.inducing_points)
    bound, mean, root = CollapsedBound(model.exact(), Observations.of(model), points).optimum()
    model.inducing_points, model.inducing_mean, model.inducing_root = points, mean, root
    model.eval().forget()
    return bound


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
    shuffle(model.exact(), 1)
    own, state = exact.state_dict(), model.state_dict()
    exact.load_state_dict({**own, **{name: state[name] for name in own if name in state}})
    exact.eval()
    bound = take_optimum(model, model.train_inputs[0])
    close(bound, exact.log_evidence()[1] + _jacobian(exact), 1e-4)
    Z = line(9, -0.2, 1.2)
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
    return count * model.units()[1].squeeze(-1).log()


@pytest.mark.slow
@pytest.mark.parametrize("rest", [False, True], ids=["none", "rest"])
def test_all_that_predicts_agrees(close, fitted, rest):
    before = fitted.predict(LINE).variance
    if rest:
        give_rest(fitted)
        scale = fitted.outcome_transform.stdvs.square()
        close(fitted.predict(LINE).variance, before + 0.3 * scale, 1e-6)
    Z = line(5)
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


def test_the_prior_before_a_fit_and_shapes_after_it(close, num_outputs, fitted):
    X, Y = problem(30, num_outputs)
    model, Z = make(X, Y), problem(7)[0]
    mean, variance = model.predict(Z)
    close(mean, model.physics(Z))
    prior = model.covar_module.at(model.model_inputs(Z)).variance() * model.units()[1].square()
    close(variance, model.outputs_last(prior), 1e-6)
    assert model.evidence.isnan().all()
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
    options = {"num_restarts": 1, "raw_samples": 4, "options": {"maxiter": 3}}
    for acquisition in (
        UpperConfidenceBound(one, 0.2),
        qLogExpectedImprovement(one, Y.max()),
        qLogNoisyExpectedImprovement(one, X[:10]),
    ):
        best, _ = optimize_acqf(acquisition, LINE, q=1, **options)
        assert 0.2 < best.item() < 0.4  # of the maximum, 0.28
    torch.manual_seed(0)
    Z = torch.tensor([0.28, 0.75], dtype=torch.float64).reshape(2, 1, 1)
    value = PathwiseThompsonSampling(one)(Z)
    assert value[0] > value[1]


@pytest.mark.slow
def test_paths_of_botorch(close, fitted):
    X, m = problem(4)[0], fitted.num_outputs
    torch.manual_seed(0)
    paths = draw_matheron_paths(fitted, torch.Size([200, 2]))
    values = paths(X)
    assert values.shape == ((200, 2, 2, 4) if m > 1 else (200, 2, 4))
    mean, variance = (fitted.outputs_first(each).detach() for each in fitted.predict(X))
    assert ((values.mean((0, 1)) - mean).abs() < 5 * (variance / 400).sqrt()).all()
    torch.testing.assert_close(values.flatten(0, 1).std(0), variance.sqrt(), rtol=0.2, atol=0)
    close(paths(X.expand(3, 200, 2, 4, 1)), values.expand(3, *values.shape))
    own = paths(X.repeat(50, 1)[:, None, None].expand(-1, 2, 1, 1))  # a point for each of 200
    assert own.shape == ((200, 2, 2, 1) if m > 1 else (200, 2, 1))
    close(own[7, ..., 0], values[7, ..., 3])


def test_lists_of_models_and_gradients_to_inputs(close, one, gradient_is_right):
    X, Y = problem(120)
    exact = CKA(X[:20], Y[:20], physics=wave)
    both = ModelListGP(one, exact)
    close(both.posterior(LINE).mean[:, :1], one.posterior(LINE).mean)
    results = fit(both, "map", num_starts=1, num_screened=0)
    assert len(results) == 2
    assert both.subset_output([0]).posterior(LINE).mean.shape == (2, 1)
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
        assert each.exact().covar_module.terms[0] is each.covar_module.terms[0]
        for ours, theirs in zip(each.predict(LINE, True), fitted.predict(LINE, True), strict=True):
            assert torch.equal(ours, theirs)
        assert each.summary() == fitted.summary()


@pytest.mark.parametrize("noise", [None, 0.01])
def test_all_of_a_model_moves(noise):
    model = make(*problem(40, 2), noise)
    model.predict(LINE)
    tensors = [*model.state_dict().values(), *model.data().values(), *model.train_inputs]
    assert {t.device.type for t in tensors if t is not None} == {"cpu"}
    assert not {"train_X", "train_Y", "columns"} & {n.strip("_") for n in model.state_dict()}
    model.to("meta")
    tensors = [*model.state_dict().values(), *model.data().values(), *model.train_inputs]
    tensors += [model.train_targets, model.likelihood.noise, model.search_rows]
    tensors += [model.at(model.train_inputs[0]).mean(), *model.rest.parameters()]
    assert {t.device.type for t in tensors if t is not None} == {"meta"}


def test_rows_arguments_and_states(close):
    X, Y = problem(1500)
    asked = []

    def physics(X):
        asked.append(len(X))
        return wave(X)

    model = VariationalCKA(X, Y, physics=physics, num_inducing=5)
    fit(model, num_screened=0, max_iterations=1)
    assert sorted(asked)[-2:] == [1000, 1500]
    ours, theirs = (signature(each).parameters for each in (VariationalCKA, CKA))
    assert ours.keys() - theirs.keys() == {"num_inducing", "seed"}
    assert {name: ours[name].default for name in theirs} == {
        name: each.default for name, each in theirs.items()
    }
    X, Y = problem(40)
    model = make(5 * X, 3 * Y, input_transform=Normalize(1))
    other = make(X, Y, input_transform=Normalize(1))
    other.load_state_dict(model.state_dict())
    close(other.data()["train_Y"], Y)
    close(other.train_inputs[0], other.input_transform(X))
    close(other.train_targets * model.outcome_transform.stdvs.squeeze(), Y.squeeze(-1))


@pytest.mark.parametrize("noise", [None, pytest.param(0.01, marks=pytest.mark.slow)])
def test_files(tmp_path, noise):
    X, Y = problem(60, 2)
    model = make(X, Y, noise, input_transform=None, center="mean", num_inducing=5)
    fit(model, num_screened=0)
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=waves)
    same(again.predict(LINE, True), model.predict(LINE, True), rtol=1e-10, atol=0)
    assert again.summary() == model.summary()
    refused(ValueError, "subset", save, model.subset_output([0]), tmp_path / "subset.pt")


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
        refused(ValueError, "Expected a whole model", fit, part)
    refused(ValueError, "numbers of outputs from 0 to 1", model.subset_output, [2])


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


def test_what_is_refused(one):
    class Halves(ComponentNoise):
        def selection(self, inputs):
            left = (inputs[..., 0] < 0.5).to(inputs)
            return torch.stack([left, 1 - left], dim=-1)

    X, Y = problem(10)
    refused(TypeError, "float64", make, X.float(), Y.float())
    refused(ValueError, "agree", make, X, Y[:4])
    refused(ValueError, "one data set", make, X.expand(2, -1, -1), Y.expand(2, -1, -1))
    refused(ValueError, "num_inducing", make, X, Y, num_inducing=0)
    refused(TypeError, "num_inducing", make, X, Y, num_inducing=2.5)
    says = "one variance for all observations, got Halves"
    refused(ValueError, says, make, X, Y, likelihood=Halves(2, Size()))
    refused(ValueError, "columns", one.predict, torch.zeros(2, 3, dtype=torch.float64))
    refused(ValueError, "no unknown term 'season'", one.term, "season", X)
    says, sampler = "build it of all data", SobolQMCNormalSampler(torch.Size([2]))
    refused(NotImplementedError, says, one.condition_on_observations, X, Y)
    refused(NotImplementedError, says, one.fantasize, X, sampler)
    refused(NotImplementedError, says, qKnowledgeGradient(one, num_fantasies=2), X.unsqueeze(0))
    refused(TypeError, r"exact models.*VariationalCKA", StackedGP, {"many": one}, [[1.0]])
    options = {"structures": [Structure("many", VariationalCKA)]}
    refused(TypeError, "TermsGP, got VariationalCKA", compare, X, Y, wave, **options)
    with pytest.warns(UserWarning, match="VariationalCKA"):
        CKA(*problem(5001), physics=wave)  # an exact model of many points


def test_texts(one):
    assert repr(one) == "VariationalCKA of 'wave': 120 points, 1 input, 1 output"
    lines = one.summary().splitlines()
    assert lines[2].startswith("  physics alone: RMSE ")
    assert lines[3].startswith("  evidence lower bound ")
    assert "  rest: none" in lines
    give_rest(one)
    assert any(line.startswith("    sd") for line in one.summary().split("  rest: ")[1].split("\n"))
    assert "  not fitted" in make(*problem(10)).summary().splitlines()
    assert one.term_names == ("rho", "delta")
    assert one.term("rest", LINE).mean.abs().max() == 0
