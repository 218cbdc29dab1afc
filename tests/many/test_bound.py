"""The bound in plain linear algebra and beside the exact evidence, its gradient, and its blocks."""

import pytest
import torch

from gpadjust.many import VariationalCKA, bound
from gpadjust.physics import FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.many.numbers import at_random, exact_of, problem
from tests.systems import slopes, waves

NUGGET = 1e-8  # of inducing values, in their mean variance


def law(X, p):
    return torch.stack([p.a * (p.w * X[..., 0]).sin(), p.a + X[..., 0]], -1)


UNKNOWN = FunctionPhysics(law, unknowns={"a": Unknown(1.0, sd=0.5), "w": Unknown(6.0, factor=1.2)})
CASES = {
    "": {},
    "missing": {},
    "known noise": {},
    "unknown parameters": {"physics": UNKNOWN},
    "relative noise": {"noise": Relative()},
}


@pytest.fixture(params=CASES)
def model(request):
    """A model of two outputs and a few inducing points, at random numbers."""
    X, Y = problem(25, 2)
    Yvar = 0.01 + 0.02 * X.expand(Y.shape) if request.param == "known noise" else None
    if request.param == "missing":
        Y[::4, 0], Y[1:4, 1] = torch.nan, torch.nan
    options = {"physics": waves} | CASES[request.param]
    return at_random(VariationalCKA(X, Y, Yvar, num_inducing=6, **options))


def with_all_rows(model):
    model.inducing = torch.arange(len(model.data.Y)).expand(model.num_outputs, -1)
    return model


def titsias(model, j):
    """Titsias (2009), by inverses, of one output."""
    f, y = model.evaluate(model.data.X), model.data.Y.mT[j] / model.unit[j]
    f.weights.pop("rest")
    seen, points = ~y.isnan(), model.inducing[j]
    K = f.cross(f).expand(1, 2, -1, -1)[0, j].detach()
    noise = model.noise.variance(model.values, model.places(model.data.X, model.values), True)
    S = noise.expand(1, 2, len(y))[0, j, seen].diag().detach()
    Kuu, Kuf = K[points][:, points], K[points][:, seen]
    Kuu = Kuu + NUGGET * Kuu.diagonal().mean() * torch.eye(len(points)).double()
    Q = Kuf.mT @ Kuu.inverse() @ Kuf
    mean = f.mean.expand(1, 2, -1)[0, j, seen].detach()
    law = torch.distributions.MultivariateNormal(mean, Q + S)
    return law.log_prob(y[seen]) - 0.5 * ((K.diagonal()[seen] - Q.diagonal()) / S.diagonal()).sum()


def test_the_bound_is_titsias(model, close):
    value, _ = model.log_likelihood(model.u)
    expected = torch.stack([titsias(model, j) for j in range(2)]).unsqueeze(0)
    close(value.sum(), expected.sum(), 1e-4)
    close(model.conditioning().bound(), expected, 1e-4)


def test_it_is_below_the_exact_evidence_which_all_rows_reach(model, close):
    exact = exact_of(model)
    evidence, gradient = exact.log_likelihood(exact.u)
    assert (model.log_likelihood(model.u)[0] < evidence - 1e-3).all()
    value, slope = with_all_rows(model).log_likelihood(model.u)
    close(value, evidence, 1e-4)
    names = [row.name for row in model.table.own for _ in range(row.location.shape[-1])]
    own = torch.tensor([not name.startswith(("rest", "choice")) for name in names])
    is_shared = model.table.problems == 1
    own = torch.cat([own.repeat(2), own.new_ones(2)]) if is_shared else own
    close(slope[..., own], gradient, 1e-4)
    assert (slope[..., ~own] == 0).all()


@pytest.mark.parametrize("choice", [0, 1], ids=["", "rest"])
def test_gradient(model, choice):
    u = model.table.with_choice(model.u.detach(), choice)
    _, gradient = model.log_likelihood(u)
    assert (gradient.abs() > 1e-6).sum() > 10
    numeric = slopes(lambda u: model.log_likelihood(u, False)[0], u).expand_as(gradient)
    assert (numeric - gradient).abs().max() < 1e-4 * (1 + gradient.abs().amax())


def test_blocks_are_one_block(model, close, monkeypatch):
    before, posterior = model.log_likelihood(model.u), model.conditioning()
    left_out = posterior.left_out()
    monkeypatch.setattr(bound, "_AT_ONCE", 6 * 2 * 4)
    model.to(torch.float64)  # forgets the posterior
    for ours, theirs in zip(model.log_likelihood(model.u), before, strict=True):
        close(ours, theirs)
    again = model.conditioning()
    assert again is not posterior
    close(again.alpha, posterior.alpha, 1e-6)
    for ours, theirs in zip(again.left_out(), left_out, strict=True):
        close(ours.nan_to_num(), theirs.nan_to_num(), 1e-7)


def test_rounding_does_not_lift_the_bound():
    X, Y = problem(300, 1)
    model = VariationalCKA(X, Y, physics=lambda X: waves(X)[..., :1], num_inducing=8, center=0.0)
    names = ("rho", "delta")
    numbers = {f"{name}.kernel.lengthscale": torch.full((1, 1), 200.0).double() for name in names}
    numbers |= {f"{name}.kernel.outputscale": torch.full((1, 1), 1e10).double() for name in names}
    u = model.table.with_values(model.u.detach(), numbers)
    value, gradient = model.log_likelihood(u)
    noise = model.noise.variance(model.table.values(u), None)
    assert value < -0.5 * len(X) * (2 * torch.pi * noise).log().squeeze()  # without any residual
    assert gradient.isfinite().all()
