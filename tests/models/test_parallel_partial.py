"""ParallelPartialGP: dense formulas, the limit of one output, the whole house, and bad input."""

import pytest
import torch
from torch import Size

from gpadjust import ParallelPartialGP, PhysicsError, compare, fit, load, save
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.report import report
from gpadjust.validation import leave_one_out
from tests.systems import same

T = torch.linspace(0, 1, 30, dtype=torch.float64)
TEST = torch.tensor([[0.8], [1.3]], dtype=torch.float64)
KINDS = [
    {},
    {"rho_mean": "learn"},
    {"delta_mean": "learn", "rho_mean": "learn"},
    {"coordinate": T},
    {"coordinate": T, "delta_mean": "learn"},
    {"physics": None},
]


def decay(X):
    return torch.exp(-X * T)


def truth(X):
    return decay(X) + 0.2 * X.sin() * T + 0.05 * torch.sin(6 * T * X)


def problem(n=12, sd=0.01):
    generator = torch.Generator().manual_seed(0)
    X = 0.5 + 1.5 * torch.rand(n, 1, dtype=torch.float64, generator=generator)
    return X, truth(X) + sd * torch.randn(n, len(T), dtype=torch.float64, generator=generator)


def make(X=None, Y=None, **options):
    own = problem()
    options = {"physics": decay, **options}
    return ParallelPartialGP(own[0] if X is None else X, own[1] if Y is None else Y, **options)


def settled(model):
    """The model with four samples that have no rounding errors worth speaking of."""
    names = [name for name, _ in model.shared.named_parameters()]
    sizes = {"raw_lengthscale": [0.5, 0.6, 0.4, 0.7], "raw_outputscale": [1.0, 2.0, 0.7, 1.5]}
    sizes["raw_noise"] = [1e-3, 2e-3, 1e-3, 1e-2]
    own = {name: sizes[name.rpartition(".")[-1]] for name in names if "raw" in name}
    own = {name: torch.tensor(values, dtype=torch.float64).log() for name, values in own.items()}
    model.hold(own, torch.Generator().manual_seed(0))
    return model


@torch.no_grad()
def dense(model, s):
    """The kernel of data and test points, of sample s."""
    X = torch.cat([model.data()["train_X"], TEST])
    return model.covar_module.at(X).covariance()[s]


@pytest.mark.parametrize("options", KINDS[:3] + KINDS[5:])
def test_prediction_is_that_of_the_dense_formula_of_each_output(options):
    model = settled(make(**options))
    s, j, n = 3, 7, 12
    noise = model.shared.noise.at(model.train_inputs[0])[s, 0]
    X, Y = model.data()["train_X"], model.data()["train_Y"]
    kernel = dense(model, s)
    f_p = decay(torch.cat([X, TEST]))[:, j] / model.unit[j]
    offset = torch.ones_like(f_p)
    columns = [f_p] * (options.get("rho_mean") == "learn")
    columns += [offset] * (model.learns_offset)
    mean = f_p if "physics" not in options else torch.zeros_like(f_p)
    for column in columns:
        kernel = kernel + 1e4 / column[:n].square().mean() * torch.outer(column, column)
    factor = torch.linalg.inv(kernel[:n, :n] + noise * torch.eye(n))
    expected = mean[n:] + kernel[n:, :n] @ factor @ (Y[:, j] / model.unit[j] - mean[:n])
    left = (kernel[n:, n:] - kernel[n:, :n] @ factor @ kernel[:n, n:]).diagonal()
    found_mean, found_variance = model.components(TEST, False)
    assert torch.allclose(found_mean[s, :, j], expected * model.unit[j], rtol=1e-5)
    scale = model.scales[s, j] * model.unit[j] ** 2
    assert torch.allclose(found_variance[s, :, j], left * scale, rtol=1e-2)


@pytest.mark.parametrize("options", KINDS[3:5])
def test_coupled_prediction_is_that_of_the_dense_formula_of_all(options):
    model = settled(make(**options))
    s, n, m = 2, 12, len(T)
    length, variance, noise = model.along[s]
    kernel = dense(model, s)
    kernel = kernel + 100.0 * model.learns_offset
    r = (T[:, None] - T).abs() * 5**0.5 / length
    along = variance * (1 + r + r**2 / 3) * (-r).exp() * torch.outer(model.profile, model.profile)
    every = torch.kron(kernel, along)
    factor = torch.linalg.inv(every[: n * m, : n * m] + noise * torch.eye(n * m))
    residual = ((model.data()["train_Y"] - decay(model.data()["train_X"])) / model.unit).flatten()
    cross = every[n * m :, : n * m]
    expected = (cross @ factor @ residual).reshape(2, m) * model.unit + decay(TEST)
    covariance = every[n * m :, n * m :] - cross @ factor @ cross.T
    mean, own = model.components(TEST, False)
    assert torch.allclose(mean[s], expected, atol=1e-5)
    size = (model.scales[s].sqrt() * model.unit).repeat(2)
    expected = covariance * torch.outer(size, size)
    assert torch.allclose(own[s].flatten(), expected.diagonal(), rtol=1e-2, atol=1e-9)
    joint = model.posterior(TEST).components.distribution.covariance_matrix[s]
    assert torch.allclose(joint, expected, rtol=1e-2, atol=1e-2 * float(expected.max()))


@pytest.mark.parametrize("options", [KINDS[1], KINDS[3]])
def test_a_row_left_out_is_predicted_by_a_model_without_it(options):
    X, Y = problem(8)
    model = settled(make(X, Y, **options))
    mean, variance = model.left_out()
    rest = make(X[1:], Y[1:], **options)
    settled(rest)
    for name in ("scales", "noises", "along", "profile"):
        setattr(rest, name, getattr(model, name))
    rest.unit, rest._remembered = model.unit, None
    rest._prepare(decay(X[1:]))
    own = rest.components(X[:1], True)
    assert torch.allclose(mean[:, 0], own[0].squeeze(1), rtol=1e-4)
    assert torch.allclose(variance[:, 0], own[1].squeeze(1), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("options", KINDS)
def test_the_whole_house(options, tmp_path):
    model = make(**options)
    assert not model.is_fitted
    fit(model)
    mean, variance = model.predict(TEST)
    posterior = model.posterior(TEST)
    same(posterior.mixture_mean, mean)
    assert torch.allclose(posterior.mixture_variance, variance, rtol=1e-3, atol=1e-10)
    assert posterior.rsample(Size([2])).shape[-2:] == (2, 30)
    same(model.posterior(TEST, [3, 1]).mixture_mean, mean[:, [3, 1]])
    single, whole = model.interval(TEST), model.interval(TEST, simultaneous=True)
    assert (whole[0] <= single[0]).all()
    assert (whole[1] >= single[1]).all()
    noisy = model.interval(TEST, observation_noise=True, simultaneous=True)
    assert (noisy[1] - noisy[0] > whole[1] - whole[0]).all()
    loo = leave_one_out(model)
    assert loo.score().coverage.mean() > 0.85
    assert loo.score().rmse.mean() < 0.1
    more = model.condition_on_observations(TEST, truth(TEST))
    assert more.components(TEST, False)[1].mean() < model.components(TEST, False)[1].mean()
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", **({"physics": decay} if "physics" not in options else {}))
    same(again.predict(TEST).variance, variance)
    assert again.is_fitted
    assert "30 outputs" in repr(model)
    assert "lengthscale of x" in model.summary()
    with pytest.raises(TypeError, match="section for each output"):
        report(model, tmp_path / "page.html")
    result = fit(model, "map")
    assert bool(result.converged)
    assert model.num_samples == 1


def test_regressor():
    from gpadjust.sklearn import CKARegressor

    X, Y = problem()
    regressor = CKARegressor(decay, model="parallel_partial").fit(X.numpy(), Y.numpy())
    assert regressor.predict(TEST.numpy()).shape == (2, 30)


def test_neighbours_average_noise():
    X, Y = problem(12, 0.03)
    errors = []
    for options in ({}, {"coordinate": T}):
        model = make(X, Y, **options)
        fit(model)
        errors.append((model.predict(X).mean - truth(X)).square().mean().sqrt())
    assert errors[1] < 0.8 * errors[0]


def test_gradients_reach_inputs():
    for options in KINDS[2:4]:
        model = make(**options)
        X = TEST.clone().requires_grad_()
        model.predict(X).mean.sum().backward()
        step = torch.zeros_like(TEST)
        step[0] = 1e-5
        up, down = (model.predict(TEST + sign * step).mean.sum() for sign in (1, -1))
        assert torch.allclose(X.grad[0, 0], (up - down) / 2e-5, rtol=1e-5)


def test_bad_input():
    X, Y = problem()
    missing = Y.clone()
    missing[2, 3] = torch.nan
    unknown = FunctionPhysics(lambda X, p: p.k * X * T, unknowns={"k": Unknown(1.0, sd=0.1)})
    for options, message in [
        ({"Y": missing}, "missing"),
        ({"physics": unknown}, "unknown parameters"),
        ({"physics": lambda X: X}, "1 columns"),
        ({"coordinate": T[:3]}, "30 finite numbers"),
        ({"coordinate": T, "rho_mean": "learn"}, "beside a coordinate"),
        ({"train_Yvar": 0.1}, "train_Yvar as None"),
        ({"rho_mean": "fit"}, "'learn' or a number"),
    ]:
        with pytest.raises((ValueError, PhysicsError), match=message):
            make(**options)
    model = make()
    with pytest.raises(ValueError, match="without missing"):
        model.condition_on_observations(TEST, missing[2:4])
    with pytest.raises(NotImplementedError, match="output_indices"):
        model.subset_output([0])
    with pytest.raises(ValueError, match="at most 64 outputs"):
        compare(X, torch.cat([Y, Y, Y], -1), decay)
