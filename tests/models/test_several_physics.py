"""Models of several physics at once."""

import pickle
from collections import Counter
from functools import partial

import pytest
import torch
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import (
    CKA,
    RRA,
    BlackBoxPhysics,
    FunctionPhysics,
    PhysicsError,
    PhysicsMeanGP,
    ScaleGP,
    fit,
)
from tests.systems import crude, holding, refused

CLASSES = [CKA, RRA, PhysicsMeanGP, ScaleGP]


def swing(X):
    return torch.stack([2 + (3 * X[..., 0]).sin(), 3 + X[..., 1]], dim=-1)


def drift(X):
    return torch.stack([10 + X[..., 0] * X[..., 1], 20 - X[..., 0].exp()], dim=-1)


def truth(X):
    return 1.5 * swing(X) - 0.2 * drift(X) + X[..., :1].square() / 4


def problem(uniform, n=14):
    X = uniform(n, 2, high=2.0)
    return X, truth(X), uniform(5, 2, high=2.0, seed=4)


@pytest.mark.parametrize("rho_mean", [None, [1.2, -0.3]], ids=["learnt", "given"])
def test_the_formulas(uniform, shuffle, dense, close, rho_mean):
    X, Y, Z = problem(uniform)
    physics = {"swing": swing, "drift": drift}
    model = shuffle(CKA(X, Y, physics=physics, rho_mean=rho_mean, center=0.0))
    with torch.no_grad():
        model.likelihood.noise = 0.3
        for term in model.terms[:2]:
            term.mean_variance *= 0.1
    assert model.term_names == ("rho_swing", "rho_drift", "delta")
    for j in range(2):
        formula = dense(model, X, Y, swing, drift, output=j)
        for posterior, (mean, covariance) in (
            (model.posterior(Z), formula.posterior(Z)),
            (model.term("rho_swing", Z), formula.rho(Z, 0)),
            (model.term("rho_drift", Z), formula.rho(Z, 1)),
            (model.term("delta", Z), formula.delta(Z)),
        ):
            close(posterior.mean[:, j], mean)
            close(posterior.variance[:, j], covariance.diagonal())


@pytest.mark.parametrize("cls", CLASSES)
@pytest.mark.parametrize("center", [0.0, "mean"])
def test_the_parts_make_the_whole(uniform, shuffle, close, cls, center):
    X, Y, Z = problem(uniform)
    options = {"center": center} if cls in (CKA, RRA) else {}
    model = shuffle(cls(X, Y, physics=[swing, drift], **options))
    parts = sum(model.rho(Z, i).mean * f(Z) for i, f in enumerate((swing, drift)))
    parts = parts + (model.delta(Z).mean if "delta" in model.term_names else 0)
    close(parts, model.posterior(Z).mean)
    close(model.predict(Z).mean, model.posterior(Z).mean)


def test_names_and_errors(uniform, close):
    X, Y, Z = problem(uniform)
    model = CKA(X, Y, physics=[swing, drift]).eval()
    for named in (1, -1, "drift", "rho_drift"):
        close(model.rho(Z, physics=named).mean, model.term("rho_drift", Z).mean)
    for wrong in (None, 2, "weight"):
        refused(ValueError, r"swing, drift, or a number", model.rho, Z, physics=wrong)
    assert CKA(X, Y, physics=[swing]).term_names == ("rho", "delta")
    assert CKA(X, Y, physics=[lambda X: swing(X), drift]).rho_names == ("rho_f_1", "rho_drift")
    X, Y, _ = problem(uniform)

    def broken(X):
        return swing(X) / (X[:, :1] < 5)

    model = CKA(X, Y, physics={"good": swing, "bad": broken}).eval()
    with pytest.raises(PhysicsError, match=r"'bad'.*NaN or inf in 1 of 2"):
        model.posterior(torch.tensor([[0.0, 0.5], [9.0, 0.5]], dtype=torch.float64))
    with pytest.raises(ValueError, match=r"rho_mean.*'learn'.*2 numbers"):
        CKA(X, Y, physics=[swing, drift], rho_mean=[1.0])
    with pytest.raises(ValueError, match=r"2 kernels of rho.*got 1"):
        CKA(X, Y, physics=[swing, drift], rho_covar_module=[None])
    refused(PhysicsError, "number of outputs", CKA, X, Y, physics=[swing, lambda X: X[:, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("cls", CLASSES)
def test_far_from_the_data_their_weighted_sum_remains(uniform, cls):
    X = problem(uniform, 24)[0]
    model = cls(X, 1.5 * swing(X) - 0.2 * drift(X), physics=[swing, drift])
    fit(model, "map", num_screened=16, num_starts=2)
    for j in range(2):
        weights = [model.term_mean(name, j) for name in model.rho_names]
        torch.testing.assert_close(weights, [1.5, -0.2], rtol=1e-3, atol=0)
    far = torch.tensor([[9.0, -9.0]], dtype=torch.float64)
    expected = 1.5 * swing(far) - 0.2 * drift(far)
    torch.testing.assert_close(model.posterior(far).mean, expected, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("cls", CLASSES)
def test_each_is_evaluated_once_a_call(uniform, cls):
    X, Y, Z = problem(uniform)
    counts = Counter()

    def counted(f):
        return FunctionPhysics(lambda X: counts.update({f: len(X)}) or f(X), name=f.__name__)

    model = cls(X, Y, physics=[counted(swing), counted(drift)]).eval()
    functions = model.sample_functions(2)
    model.posterior(Z)
    condition = partial(model.condition_on_observations, Y=truth(Z))
    for call in (model.posterior, model.predict, functions, condition):
        counts.clear()
        call(Z)
        assert counts == {swing: 5, drift: 5}
    counts.clear()
    model.rho(Z, physics=0)
    assert not counts


@pytest.mark.parametrize("cls", CLASSES)
def test_conditioning_and_copies(uniform, shuffle, same, cls):
    X, Y, Z = problem(uniform)
    model = shuffle(cls(X, Y, physics=[swing, drift]))
    more = torch.cat([X, Z + 0.1]), torch.cat([Y, truth(Z + 0.1)])
    rebuilt = cls(*more, physics=[swing, drift])
    rebuilt.load_state_dict(model.state_dict())
    conditioned = model.condition_on_observations(Z + 0.1, truth(Z + 0.1))
    same(conditioned, rebuilt.eval(), Z, 1e-6)
    same(pickle.loads(pickle.dumps(model)), model, Z, 1e-12)
    same(model.subset_output([1]), model, Z, 1e-9, [1])
    functions = model.sample_functions(1000, seed=0)(Z)
    error = functions.mean(0) - model.posterior(Z).mean
    assert (error.abs() < 0.15 * model.posterior(Z).variance.sqrt()).all()
    holding(model, 0.0, 0.2)
    assert model.posterior(Z).mean.shape == (2, 5, 2)
    assert model.rho(Z, physics="drift").mixture_mean.shape == (5, 2)


def wave(*weights):
    return lambda X: torch.sin(X @ torch.tensor(weights, dtype=X.dtype)).unsqueeze(-1)


def latin_hypercube(n, d, seed):
    generator = torch.Generator().manual_seed(seed)
    cells = torch.stack([torch.randperm(n, generator=generator) for _ in range(d)], dim=-1)
    X = (cells + torch.rand(n, d, generator=generator)) / n
    return X.double(), torch.rand(500, d, generator=generator).double()


def error(model, Z, truth):
    return (model.predict(Z).mean - truth(Z)).square().mean().sqrt().item()


@pytest.mark.slow
def test_the_right_one_of_three_has_the_weight():
    """It is right but for a factor and a bias."""
    right = lambda X: wave(9.0, 0.0)(X) * wave(0.0, 7.0)(X)  # noqa: E731
    wrong = wave(6.0, 8.0), lambda X: wave(-7.0, 10.0)(X) + X[:, :1] ** 2

    def truth(X):
        return (1 + 0.3 * torch.sin(3 * X[:, -1:])) * right(X) + 0.5 * X[:, :1] ** 2

    shares, ratios = [], []
    for seed in range(5):
        X, Z = latin_hypercube(20, 2, seed)
        model = CKA(X, truth(X), physics={"right": right, "one": wrong[0], "two": wrong[1]})
        alone = CKA(X, truth(X), physics=right)
        fit(model, "map"), fit(alone, "map")
        sizes = torch.stack([model.term(n, Z).mean.abs().mean() for n in model.rho_names])
        shares.append((sizes[0] / sizes.sum()).item())
        ratios.append(error(model, Z, truth) / error(alone, Z, truth))
    assert sum(share >= 0.9 for share in shares) >= 4
    # Errors are 1e-4 to 1e-6 of the targets here, so that those of the other two rhos show.
    assert torch.tensor(ratios).median() <= 4


@pytest.mark.slow
def test_two_physics_each_right_in_half_of_the_box():
    def first(X):
        return wave(12.0, 0.0)(X) * torch.cos(9 * X[:, 1:])

    def second(X):
        return torch.cos(10 * X[:, :1] + 8 * X[:, 1:]) + X[:, 1:]

    def truth(X):
        share = torch.sigmoid((X[:, :1] - 0.5) / 0.05)
        return (1 - share) * first(X) + share * second(X)

    ratios = []
    for seed in range(5):
        X, Z = latin_hypercube(20, 2, seed)
        errors = []
        for physics in ({"a": first, "b": second}, first, second):
            model = CKA(X, truth(X), physics=physics, center=0.0)
            fit(model, "map")
            errors.append(error(model, Z, truth))
        ratios.append(errors[0] / min(errors[1:]))
    assert sum(ratio <= 0.5 for ratio in ratios) >= 4


# How often the physics is evaluated: a simulator once a row, a formula once a call


@pytest.fixture
def counting():
    """The crude physics, with a record of the rows it was asked for."""

    def counting(X):
        counting.rows.update(tuple(row) for row in X.detach().tolist())
        return crude(X)[..., : counting.num_outputs]

    counting.rows, counting.num_outputs = Counter(), 1
    return counting


PHYSICAL = ["ScaleGP", "CKA", "RRA"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", PHYSICAL)
def test_each_row_is_evaluated_once(data, build, uniform, counting, num_outputs, kind):
    counting.num_outputs = num_outputs
    X, Y = data(num_outputs=num_outputs)
    Z, new_X = uniform(4, 2, seed=1), uniform(2, 2, seed=2)
    simulator = BlackBoxPhysics(lambda x: counting(torch.from_numpy(x)).numpy())
    model = build(kind, X, Y, physics=simulator)
    fit(model, "map", num_screened=8, num_starts=1)
    with torch.no_grad():
        model.posterior(Z)
        model.posterior(Z.unsqueeze(-2), observation_noise=True)
        model.predict(Z)
        model.sample_functions(3)(Z)
        conditioned = model.condition_on_observations(new_X, 3 + new_X[:, :num_outputs])
        conditioned.posterior(Z)
        fantasies = model.fantasize(new_X, SobolQMCNormalSampler(torch.Size([3])))
        fantasies.posterior(Z)
        for name in model.term_names:
            model.term(name, uniform(4, 2, low=-3.0, seed=3))
    expected = {tuple(row) for row in torch.cat([X, Z, new_X]).tolist()}
    assert set(counting.rows) == expected
    assert set(counting.rows.values()) == {1}


@pytest.mark.parametrize("kind", PHYSICAL)
def test_each_call_evaluates_it_once(data, build, uniform, counting, kind):
    X, Y = data()
    model = build(kind, X, Y, physics=FunctionPhysics(counting)).eval()
    functions = model.sample_functions(3)
    model.posterior(X)
    counting.rows.clear()
    for number, call in enumerate((model.posterior, model.predict, functions), start=1):
        call(X)
        assert set(counting.rows.values()) == {number}


def test_ar1_evaluates_the_samples_only(data, build, uniform, counting):
    X, Y = data()
    model = build("AR1", X, Y, physics=counting, num_low=10)
    fit(model, "map", num_screened=8, num_starts=1)
    model.posterior(uniform(4, 2))
    assert len(counting.rows) == 10
    assert set(counting.rows.values()) == {1}
