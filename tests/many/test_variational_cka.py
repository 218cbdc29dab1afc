"""VariationalCKA: the exact model in the limit, later rows, copies and files, fits, bad input."""

import copy
import pickle
from functools import cache

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust.core import fit, load, save
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.many import VariationalCKA
from gpadjust.physics import FunctionPhysics, Unknown
from tests.many.numbers import at_random, exact_of, physics_of, problem, truth
from tests.systems import line, normal, refused, same, waves


def make(X, Y, *args, num_inducing=10, **options):
    options = {"physics": physics_of(Y.shape[-1])} | options
    return VariationalCKA(X, Y, *args, num_inducing=num_inducing, **options)


@pytest.fixture
def model(num_outputs):
    """A model at random numbers with some missing targets."""
    X, Y = problem(60, num_outputs)
    if num_outputs > 1:
        Y[::4, 0] = torch.nan
    return at_random(make(X, Y))


def with_rest(model):
    """The model with a rest, in units of its targets."""
    ones = torch.ones(model.num_outputs, 1).double()
    numbers = {"rest.kernel.lengthscale": 0.2 * ones, "rest.kernel.outputscale": 0.3 * ones}
    u = model.table.with_choice(model.u.detach(), 1)
    model.set_draws(model.table.with_values(u, numbers))
    return model


def points_everywhere(model):
    model.inducing = torch.arange(len(model.data.Y)).expand(model.num_outputs, -1).clone()
    model.set_draws(model.u.detach())
    return model


def test_points_at_all_rows_make_the_exact_model(model, close):
    model, exact, Z = points_everywhere(model), exact_of(model), line(9, -0.2, 1.2)
    for name in ("posterior", "rho", "delta"):
        ours, theirs = getattr(model, name)(Z), getattr(exact, name)(Z)
        close(ours.mean, theirs.mean, 1e-3)
        covariances = (p.distribution.covariance_matrix for p in (ours, theirs))
        close(*covariances, 1e-3)
    intervals = (each.interval(Z, 0.8, True) for each in (model, exact))
    for ours, theirs in zip(*intervals, strict=True):
        close(ours, theirs, 1e-3)
    for ours, theirs in zip(model.left_out(), exact.left_out(), strict=True):
        close(ours.nan_to_num(), theirs.nan_to_num(), 1e-3)


@pytest.mark.parametrize("has_rest", [False, True], ids=["", "rest"])
def test_left_out_is_the_model_without_the_row(model, close, has_rest):
    model = with_rest(model) if has_rest else model
    prediction = model.left_out().prediction
    Y, fresh = model.data.Y.clone(), copy.deepcopy(model)
    for row in (0, 7, 33):
        others = Y.clone()
        others[row] = torch.nan
        fresh.data = model.data._replace(Y=others)
        fresh.to(torch.float64)  # forgets the posterior
        mean, variance = fresh.predict(model.data.X[[row]], observation_noise=True)
        seen = ~Y[row].isnan()
        close(prediction.mean[row, seen], mean[0, seen], 1e-6)
        close(prediction.variance[row, seen], variance[0, seen], 1e-6)
        assert prediction.mean[row, ~seen].isnan().all()


@pytest.mark.parametrize("has_rest", [False, True], ids=["", "rest"])
def test_all_that_predicts_agrees(model, close, has_rest):
    Z = line(5)
    if has_rest:  # the inducing values take it for noise, so that they know less
        before = model.predict(Z).variance
        added = with_rest(model).predict(Z).variance - before
        assert (added > 0.3 * model.unit.mT.square()).all()
    mean, variance = model.predict(Z)
    f_p = physics_of(model.num_outputs)(Z)
    close(model.rho(Z).mean * f_p + model.delta(Z).mean, mean)
    assert (model.delta(Z).variance >= model.term("delta", Z).variance).all()
    draws = model.sample_functions(500, 0, 256)(Z).detach()
    sd = variance.sqrt().detach()
    assert ((draws.mean(0) - mean).abs() < 5 * sd / 500**0.5).all()
    torch.testing.assert_close(draws.std(0), sd, rtol=0.15, atol=0)
    many = line(5000)
    close(model.predict(many).variance[2500:], model.predict(many[2500:]).variance)


@pytest.mark.parametrize("has_rest", [False, True], ids=["", "rest"])
def test_later_rows_are_observed_exactly(model, close, has_rest):
    m = model.num_outputs
    model = with_rest(model) if has_rest else points_everywhere(model)
    X, Y, Z = line(4, 1.3, 1.6), 2 * physics_of(m)(line(4, 1.3, 1.6)), line(6, 1.2, 1.7)
    Y[1, 0] = torch.nan if m > 1 else 0.0
    later = model.condition_on_observations(X, Y)
    posterior = model.posterior(torch.cat([X, Z]))
    mean, K = posterior.mean, posterior.gaussians[1][0]
    noise = (model.noise.variance(model.values, None) * model.unit.square())[0].detach()
    for j in range(m):  # the posterior of the first rows is the prior of the late ones
        seen = torch.arange(4)[~Y[:, j].isnan()]
        S = K[j][seen][:, seen] + noise[j] * torch.eye(len(seen)).double()
        gain = torch.linalg.solve(S, K[j][4:][:, seen].mT).mT
        expected = mean[4:, j] + gain @ (Y[seen, j] - mean[seen, j])
        close(later.predict(Z).mean[:, j], expected, 1e-5)
        variance = (K[j][4:, 4:] - gain @ K[j][seen][:, 4:]).diagonal()
        close(later.predict(Z).variance[:, j], variance, 1e-5)
    by_two = model.condition_on_observations(X[:2], Y[:2]).condition_on_observations(X[2:], Y[2:])
    close(by_two.predict(Z).variance, later.predict(Z).variance, 1e-5)
    close(by_two.to(torch.float64).predict(Z).mean, later.predict(Z).mean, 1e-5)  # made again
    if not has_rest:
        exact = exact_of(model).condition_on_observations(X, Y)
        close(later.predict(Z).mean, exact.predict(Z).mean, 1e-4)
    draws = later.sample_functions(200, 0, 128)(Z).detach()
    torch.testing.assert_close(draws.std(0), later.predict(Z).variance.sqrt(), rtol=0.3, atol=0)
    fantasies = model.condition_on_observations(X, torch.stack([Y, Y + 1, Y - 1]))
    close(fantasies.predict(Z).mean[0], later.predict(Z).mean, 1e-6)


def test_shapes_of_batches(model, close):
    m, X = model.num_outputs, problem(24)[0].reshape(2, 3, 4, 1)
    posterior = model.posterior(X)
    assert posterior.rsample(torch.Size([5])).shape == (5, 2, 3, 4, m)
    close(posterior.mean[1, 2], model.posterior(X[1, 2]).mean)
    close(model.posterior(X, output_indices=[m - 1]).mean, posterior.mean[..., -1:])


def test_copies_and_states(model):
    model.inducing = model.points(model.u.detach(), 10)  # of each output
    Z, before = line(5), with_rest(model).predict(line(5), True)
    fresh = make(*model.data[:2])
    fresh.inducing = 0 * fresh.inducing
    fresh.load_state_dict(model.state_dict())
    for each in (pickle.loads(pickle.dumps(model)), fresh, model.to("cpu")):
        same(each.predict(Z, True), before, rtol=1e-10, atol=0)
        assert each.summary() == model.summary()
    assert "varies in 0 of 1 draws" in make(*problem(10)).summary()


def test_a_file_has_inducing_points_and_later_rows(tmp_path):
    X, Y = problem(60, 2)
    model = with_rest(at_random(make(5 * X, Y, 0.01, input_transform=Normalize(1), center=0.5)))
    model.inducing = model.inducing.flip(-1)[:, 1:]
    model = model.condition_on_observations(X[:2] + 6, Y[:2])
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", input_transform=Normalize(1), physics=waves)
    same(again.predict(line(5), True), model.predict(line(5), True), rtol=1e-8, atol=1e-10)
    assert torch.equal(again.inducing, model.inducing)


def test_inducing_points_are_pivots():
    X, Y = problem(100, 2)
    Y[3:12, 1] = torch.nan
    model = at_random(make(X, Y))
    points = model.points(model.u.detach(), 8)
    assert points.shape == (2, 8)
    assert all(len(set(each.tolist())) == 8 for each in points)
    assert not Y[points[1], 1].isnan().any()
    f = model.evaluate(X)
    f.weights.pop("rest")
    K = f.cross(f)[0, 0].detach()

    def left(rows):
        k = K[rows, :32]
        inner = k[:, rows] + 1e-9 * torch.eye(8).double()
        return K.diagonal()[:32].sum() - (k * torch.linalg.solve(inner, k)).sum()

    first = points[0]
    assert first[0] == K[:32].diagonal().argmax()
    some = [left(torch.randperm(32)[:8]) for _ in range(20)]
    assert left(first) < sorted(some)[5]


@pytest.mark.slow
def test_noise_is_no_function_and_a_function_is_found():
    X = line(400)
    for seed in range(2):
        Y = torch.cat([0.1 * normal(400, 1, seed=seed), 0.1 * normal(400, 1, seed=seed + 9)], -1)
        Y[:, 1:] += 0.3 * (40 * X).sin()
        Y[::5, 1] = torch.nan
        model = make(X, Y, physics=lambda X: 0 * waves(X) + 0.1, num_inducing=3)
        u = model._with_rest(model.conditioning(), seed)
        values = model.table.values(u)
        assert model.table.chosen(values).tolist() == [[0, 1]]
        model.set_draws(u)
        noise = model.noise.variance(model.values, None)[0, :, 0].sqrt() * model.unit[:, 0]
        assert noise[1].item() == pytest.approx(0.1, rel=0.2)
        lower, upper = model.interval(X)
        inside = ((lower < 0.3 * (40 * X).sin()) & (upper > 0.3 * (40 * X).sin())).double().mean(0)
        assert inside[1] > 0.9


@cache
def fitted_once(fine):
    X, Y = problem(400, fine=fine)
    model = make(X, Y, num_inducing=6 if fine else 12)
    return model, fit(model)


@pytest.mark.slow
def test_a_fit_meets_the_exact_one():
    model, result = fitted_once(0.0)
    X, f = model.data.X, truth(model.data.X)[..., :1]
    assert result.method == "map"
    assert result.converged
    assert model.is_fitted
    noise = model.noise.variance(model.values, None).sqrt().squeeze() * model.unit.squeeze()
    assert noise.item() == pytest.approx(0.1, rel=0.1)
    lower, upper = model.interval(X)
    assert ((lower < f) & (f < upper)).double().mean() > 0.85
    exact = exact_of(model)
    assert 0 <= exact.log_likelihood(exact.u)[0] + exact.log_jacobian() - result.log_evidence < 1.0
    torch.testing.assert_close(model.predict(X).mean, exact.predict(X).mean, rtol=0, atol=0.02)
    assert len(model.subset_rows(torch.arange(30)).conditioning().alpha[0, 0]) == 30


@pytest.mark.slow
def test_what_few_points_cannot_show_is_in_the_intervals():
    model, _ = fitted_once(0.5)
    X, f = line(300), truth(line(300), 0.5)[..., :1]

    def coverage(model):
        lower, upper = model.interval(X)
        return ((lower < f) & (f < upper)).double().mean()

    assert 0.88 < coverage(model) < 0.995
    without = copy.deepcopy(model)
    without.set_draws(model.table.with_choice(model.u.detach(), 0))
    assert coverage(without) < 0.6
    left_out = model.left_out()
    inside = (left_out.quantile(0.025) < model.data.Y) & (left_out.quantile(0.975) > model.data.Y)
    assert 0.88 < inside.double().mean() < 0.995


def test_an_error_leaves_the_model_as_it_was(monkeypatch):
    model = at_random(make(*problem(30)))
    before, prediction = copy.deepcopy(model.state_dict()), model.predict(line(4))

    def fail(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("gpadjust.many.variational_cka.rest_of", fail)
    with pytest.raises(KeyboardInterrupt):
        fit(model, seed=1)
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, before[name])
    assert all(map(torch.equal, model.predict(line(4)), prediction))


@pytest.mark.parametrize("case", ["constant", "few rows", "unknown parameters"])
def test_inputs_that_do_not_vary_few_rows_and_unknown_parameters(case):
    X, Y = problem(30, 2)
    X = {"constant": torch.cat([X, torch.ones_like(X)], dim=-1), "few rows": X[:4]}.get(case, X)
    unknowns = {"w": Unknown(5.0, sd=1.0)}
    law = FunctionPhysics(lambda X, p: waves(p.w[:, None] * X[:, :1] / 6), unknowns=unknowns)
    is_shared = case == "unknown parameters"
    model = make(X, Y[: len(X)], physics=law if is_shared else waves)
    evidence = fit(model).log_evidence
    assert evidence.shape == ((1,) if is_shared else (2,))
    assert evidence.isfinite().all()
    assert ((model.predict(X).mean - model.data.Y).std(0) < 0.2).all()


REFUSED = [
    (lambda X, Y: make(X, Y, num_inducing=0), ValueError, "num_inducing"),
    (lambda X, Y: make(X, Y, noise=HeavyTails()), ValueError, "CKA takes it"),
    (lambda X, Y: make(X, Y, nested=True), TypeError, "nested"),
    (lambda X, Y: fit(make(X, Y), num_draws=8), ValueError, "num_draws=None"),
    (lambda X, Y: make(X, Y).condition_on_observations(X, Y).left_out(), NotImplementedError,
     "Build a model of all data"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_what_is_refused(call, error, words):
    refused(error, words, call, *problem(10))
