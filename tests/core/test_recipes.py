"""What docs/extending.md shows: each recipe as it stands, and what kinds of data may change."""

import re
from pathlib import Path

import pytest
import torch

from gpadjust.core import CKA, Stationary, fit

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
START = "\n## In a model\n"


def recipe(heading):
    """The names that the code below a heading makes."""
    text = PAGE.read_text().split(START, 1)[1].split(f"\n**{heading}**", 1)[1]
    names = {"__name__": "recipe"}
    exec(re.search(r"```python\n(.*?)```", text, flags=re.DOTALL)[1], names)
    return names


def law(X):
    return torch.cat([torch.sin(k * X[..., :1]) for k in (3, 4, 5, 6)], -1)


def one(X):
    return law(X)[..., 2:3]


@pytest.fixture(params=[1, 4])
def problem(request, uniform):
    """Inputs, targets and a physics of one or four outputs, of very different noise."""
    X, sizes = uniform(14, 1), torch.tensor([0.01, 0.03, 0.05, 0.1], dtype=torch.float64)
    physics = one if request.param == 1 else law
    F = physics(X)
    return X, 1.3 * F + X + sizes[-F.shape[-1] :] * torch.randn_like(F), physics


def check(model, X, Y):
    """Outputs are as by themselves, and conditioning, functions and joint draws agree."""
    m = Y.shape[-1]
    Z = torch.linspace(-0.1, 1.1, 7, dtype=torch.float64).unsqueeze(-1)
    mean, variance = model.predict(Z, observation_noise=True)
    assert mean.isfinite().all()
    assert (variance > 0).all()
    assert ((model.predict(X).mean - Y).square().mean(0) < 0.2 * Y.var(0)).all()
    for j in range(m):
        part = model.subset_output([j]).predict(Z, observation_noise=True)
        joint = model.posterior(Z, [j], observation_noise=True)
        torch.testing.assert_close(part.mean, mean[:, [j]], rtol=1e-6, atol=1e-8)
        for found in (part, joint):
            torch.testing.assert_close(found.variance, variance[:, [j]], rtol=1e-6, atol=1e-10)
    assert model.posterior(Z).rsample(torch.Size([5])).shape == (5, 7, m)
    later = model.condition_on_observations(Z[:2], mean[:2])
    assert (later.predict(Z[:2]).variance < model.predict(Z[:2]).variance).all()
    assert model.summary().count("noise:") == m


def test_a_structure(problem):
    X, Y, physics = problem
    model = recipe("A structure")["SeasonalCKA"](X, Y, physics=physics)
    fit(model)
    check(model, X, Y)
    single = model.subset_draws(torch.tensor([0]))
    parts = single.rho(X).mean * physics(X) + single.delta(X).mean + single.term("season", X).mean
    torch.testing.assert_close(parts, single.predict(X).mean, atol=1e-6, rtol=1e-6)


def test_a_kernel(problem):
    X, Y, physics = problem
    names = recipe("A kernel")
    for kernel in (Stationary(names["RATIONAL"]), names["Linear"]()):
        model = CKA(X, Y, physics=physics, delta_covar_module=kernel)
        fit(model)
        check(model, X, Y)
    k = Stationary(names["RATIONAL"])
    own = {n: torch.ones(1, 1, 1, dtype=torch.float64) for n in ("lengthscale", "outputscale")}
    expected = 1 / (1 + (X - X.T).square() / 2)
    torch.testing.assert_close(k.covariance(own, X).squeeze(), expected)


def test_a_noise(problem):
    X, Y, physics = problem
    model = CKA(X, Y, physics=physics, noise=recipe("A noise")["PartlyRelativeNoise"]())
    fit(model)
    check(model, X, Y)
    values = model.values
    noise = model.predict(X, True).variance - model.predict(X).variance
    f = model.places(X, values).f[0]
    v = [values[f"noise.{name}"].detach() for name in ("constant", "relative")]
    expected = ((v[0] + v[1] * f.square() + 1e-11 * (1 + f.square())) * model.unit**2).mean(0).mT
    torch.testing.assert_close(noise, expected, rtol=1e-6, atol=1e-12)


def test_a_basis(problem):
    X, Y, physics = problem
    model = recipe("A basis")["TrendCKA"](X, Y, physics=physics)
    fit(model)
    check(model, X, Y)
    # Far away rho is 1 and delta 0 again, and the trend goes on.
    far = torch.tensor([[1e5]], dtype=torch.float64)
    step = model.predict(far + 1).mean - model.predict(far).mean
    slope = step - (physics(far + 1) - physics(far))
    torch.testing.assert_close(slope, model.term("slope", far).mean, rtol=1e-4, atol=1e-4)


def test_an_inference_method(problem):
    X, Y, physics = problem
    model = CKA(X, Y, physics=physics, nested=False)
    before = torch.random.get_rng_state()
    recipe("An inference method")["laplace"](model, number=8)
    assert torch.equal(before, torch.random.get_rng_state())
    assert len(model.u) == 8
    check(model, X, Y)


def test_a_link(problem):
    X, Y, physics = problem
    positive = recipe("A link")["LogCKA"](X, Y.exp(), physics=lambda X: physics(X).exp())
    fit(positive)
    low, high = positive.interval(X)
    assert (low > 0).all()
    assert ((low < Y.exp() * 1.2) & (high > Y.exp() / 1.2)).double().mean() > 0.8
    mean, variance = positive.predict(X)
    draws = positive.posterior(X[:1]).rsample(torch.Size([100_000])).exp()
    torch.testing.assert_close(draws.mean(0), mean[:1], rtol=0.02, atol=0)
    torch.testing.assert_close(draws.std(0), variance[:1].sqrt(), rtol=0.05, atol=0)


X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
Y = (3 * X).sin()
