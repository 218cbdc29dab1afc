"""The information about rho and delta, against other ways to compute it."""

import copy
import pickle

import mpmath
import pytest
import torch
from botorch.models import ModelListGP
from botorch.models.transforms import Normalize

from gpadjust import (
    CKA,
    RRA,
    BlackBoxPhysics,
    CalibratedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    ScaleGP,
    Unknown,
    VariationalCKA,
    ZeroMeanGP,
)
from gpadjust.active import qAdjustmentInformationGain
from gpadjust.core import MATERN52, StackedGP, Stationary
from tests.systems import crude, normal, refused, truth, uniform

ABOUT = ["rho", "delta", "both"]
D, Z = uniform(9, 2, high=2.0), uniform(3, 2, high=2.0, seed=5)
Y = truth(D) + 0.05 * normal(9, 2)


def made(structure=CKA, Y=Y[:, :1], Yvar=None, num_draws=1, **options):
    """A model with draws somewhere in its prior; without a center, unless one is asked for."""
    if structure not in (ZeroMeanGP, CalibratedPhysics):
        options = {"physics": lambda X: crude(X)[..., : Y.shape[-1]], **options}
    if structure in (CKA, RRA):
        options = {"center": 0.0, **options}
    model = structure(D, Y, Yvar, **options)
    u = normal(num_draws, *model.u.shape[1:], seed=3)
    if model.table.choices:
        u[..., -1] = 0.0  # the whole model
    # By a noise that is next to none determinants and differences are rounded.
    values = model.table.values(0.5 * u)
    noise = {n: v.clamp_min(1e-3) for n, v in values.items() if n.startswith("noise.")}
    model.set_draws(model.table.with_values(0.5 * u, noise))
    return model


def gain(model, X, about="both", **options):
    with torch.no_grad():
        return qAdjustmentInformationGain(model, about, **options)(X)


def assert_close(actual, expected, tolerance=1e-8):
    expected = torch.as_tensor(expected, dtype=torch.float64).expand_as(actual)
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def by_determinants(model, about, noise=None):
    """Half of log|Cov(y | D)| - log|Cov(y | D, asked)| in fifty digits, over draws and outputs."""
    total, values, X = 0.0, model.values, torch.cat([D, Z])
    f = model.physics[0](X).mT
    for s in range(len(model.u)):
        for j in range(model.num_outputs):
            seen = torch.cat([~model.data.Y[:, j].isnan(), torch.ones(len(Z)).bool()])
            n = int(seen.sum()) - len(Z)
            v = values["noise.variance"][s, j] if noise is None else noise / model.unit[j] ** 2
            covariances = {}
            for term in model.terms:
                own = {name: values.get(f"{term.name}.{name}") for name in PARTS}
                K = torch.zeros(len(X), len(X)).double()
                if term.kernel is not None:
                    z = X / own["kernel.lengthscale"][s, j]
                    K = own["kernel.outputscale"][s, j] * (-torch.cdist(z, z).square() / 2).exp()
                K = K + (0.0 if own["constant"] is None else own["constant"][s, j])
                if term.physics is not None:
                    b = f[j] - (term.has_center or 0.0)
                    K = b[:, None] * K * b / model.unit[j] ** 2
                covariances[term.name] = K[seen][:, seen]

            def of_new(*names, n=n, v=v, K=covariances):
                with mpmath.workdps(50):
                    all_ = sum(
                        (mpmath.matrix(K[name].tolist()) for name in names),
                        mpmath.zeros(len(Z) + n),
                    )
                    all_ = all_ + mpmath.diag(v.expand(len(Z) + n).tolist())
                    return float(mpmath.log(mpmath.det(all_) / mpmath.det(all_[:n, :n])))

            kept = {"rho": ["delta"], "delta": ["rho"], "both": []}[about]
            rest = [name for name in covariances if name in kept]
            total += (of_new(*covariances) - of_new(*rest)) / 2 / len(model.u)
    return total


PARTS = ("kernel.lengthscale", "kernel.outputscale", "constant")
CASES = {
    "one output": made,
    "draws": lambda: made(num_draws=3),
    "two outputs, some missing": lambda: made(Y=with_missing(), num_draws=2),
    "without constants": lambda: made(constants=False),
    "PhysicsMeanGP": lambda: made(PhysicsMeanGP),
    "ScaleGP": lambda: made(ScaleGP),
}
NOT_ABOUT = {"PhysicsMeanGP": ["rho"], "ScaleGP": ["delta"]}


def with_missing():
    some = Y.clone()
    some[[1, 4], 0] = some[2, 1] = torch.nan
    return some


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_loss_of_entropy_of_observations(case):
    model = CASES[case]()
    for about in ABOUT:
        if about not in NOT_ABOUT.get(case, []):
            expected = by_determinants(model, about)
            assert expected > 1e-3
            assert_close(gain(model, Z, about), expected, 1e-6)


def test_a_center_and_known_noise():
    model = made(center=3.0)
    assert_close(gain(model, Z, "rho"), by_determinants(model, "rho"), 1e-6)
    variances = 1e-2 * (1 + D[:, :1])
    model = made(Yvar=variances)
    noise = torch.cat([variances[:, 0], variances.mean().expand(3)])
    assert_close(gain(model, Z, "rho"), by_determinants(model, "rho", noise), 1e-6)


def test_inducing_values_by_the_posterior_covariance():
    model = made(VariationalCKA, Y=Y, num_inducing=5, center=0.0)
    expected = 0.0
    for j in range(2):
        C = model.posterior(Z, [j]).distribution.covariance_matrix.detach()
        noise = model.values["noise.variance"][0, j] * model.unit[j].square()
        expected += 0.5 * torch.logdet(torch.eye(3).double() + C / noise.detach())
    assert_close(gain(model, Z), expected, 1e-6)


@pytest.mark.parametrize("about", ["rho", "delta"])
def test_it_is_the_expected_kullback_leibler_divergence(about):
    """Given simulated measurements at X, how far does the posterior of rho move?"""
    model = made(nested=False)
    points = torch.cat([D, Z])
    with torch.no_grad():
        simulated = model.posterior(Z, observation_noise=True).sample(torch.Size([4000]))
        before = getattr(model, about)(points).gaussians
        after = getattr(model.condition_on_observations(Z, simulated), about)(points).gaussians
    shift = after[0][:, 0, 0] - before[0][0, 0]
    K0, K1 = (K.reshape(-1, len(points), len(points))[0] for _, K in (before, after))
    K0 = K0 + 1e-9 * K0.diagonal().mean() * torch.eye(len(points))
    K1 = K1 + 1e-9 * K0.diagonal().mean() * torch.eye(len(points))
    quadratic = (shift * torch.linalg.solve(K0, shift.mT).mT).sum(-1)
    trace = torch.linalg.solve(K0, K1).trace() - len(points)
    divergence = (trace + quadratic + torch.logdet(K0) - torch.logdet(K1)) / 2
    error = divergence.std() / len(divergence) ** 0.5
    value = gain(model, Z, about).item()
    assert value > 5 * error
    assert abs(divergence.mean() - value) < 4 * error


def test_more_points_teach_more_but_less_each_in_any_order():
    model = made(num_draws=2)
    more = model.condition_on_observations(Z[:1], torch.ones(1, 1).double())
    for about in ABOUT:
        one, two, three = (gain(model, Z[:k], about) for k in (1, 2, 3))
        assert one < two < three
        assert_close(gain(model, Z[[2, 0, 1]], about), three)
        assert_close(one + gain(more, Z[1:], about), three)  # I(a, b) = I(a) + I(b | a)
    assert two <= one + gain(model, Z[1:2])
    both, rho, delta = (gain(model, Z, about) for about in ("both", "rho", "delta"))
    assert both > torch.maximum(rho, delta)


def test_limiting_cases():
    """A repeated measurement without noise, or with much; f_p = 0; draws without f_p."""
    for noise, most in ((1e-12, 1e-2), (1e12, 1e-6)):
        model = made(Yvar=noise)
        again, elsewhere = gain(model, D[:1], "rho"), gain(model, D[:1] + 0.5, "rho")
        assert 0 <= again < most * max(elsewhere, 1)
    model = made(physics=lambda X: 0 * X[..., :1])
    assert_close(gain(model, Z, "rho"), 0.0)
    assert_close(gain(model, Z, "delta"), gain(model, Z, "both"))
    model = made(num_draws=2)
    whole = gain(model, Z, "rho")
    assert model.table.choices[2].text == "of no use"
    u = model.u.detach()
    model.set_draws(torch.cat([u, model.table.with_choice(u, 2)]))
    assert_close(gain(model, Z, "rho"), whole / 2)


def test_batches_pending_points_and_input_transforms():
    model = made(Y=Y, num_draws=2)
    for shape in ((2,), (1, 2), (3, 2), (5, 1, 2), (4, 5, 3, 2)):
        X = uniform(*shape, 2, high=2.0, seed=4)
        values = gain(model, X, "rho")
        each = [gain(model, x, "rho") for x in X.reshape(-1, *X.shape[-2:])]
        assert_close(values, torch.cat(each).reshape(shape[:-1] or (1,)))
    pending = qAdjustmentInformationGain(model, "rho", X_pending=Z[1:])
    assert_close(pending(Z[:1]).detach(), gain(model, Z, "rho"))
    pending.set_X_pending(None)
    assert_close(pending(Z[:1]).detach(), gain(model, Z[:1], "rho"))
    scaled = made(input_transform=Normalize(2, bounds=torch.tensor([[0.0, 0.0], [2.0, 2.0]])))
    assert_close(gain(scaled, Z, "rho"), gain(made(), Z, "rho"))


BLACK_BOX = BlackBoxPhysics(lambda X: crude(torch.from_numpy(X)).numpy())


@pytest.mark.parametrize(
    ("about", "options"),
    [
        ("delta", {}),
        ("both", {}),
        ("rho", {"structure": RRA, "num_features": 12}),
        ("rho", {"physics": BLACK_BOX, "delta_covar_module": Stationary(MATERN52)}),
    ],
)
def test_gradient(about, options, gradient_is_right):
    model = made(Y=Y, num_draws=2, **options)
    gradient_is_right(qAdjustmentInformationGain(model, about), uniform(2, 2, high=2.0, seed=6))


def test_copies_and_a_model_that_is_given_other_draws():
    model = made(physics=torch.nn.Linear(2, 1).double())
    acquisition = qAdjustmentInformationGain(model, "rho")
    value = acquisition(Z)
    for again in (copy.deepcopy(acquisition), pickle.loads(pickle.dumps(acquisition))):
        assert_close(again(Z), value)
    model.set_draws(0.2 + model.u.detach())
    assert_close(acquisition(Z), qAdjustmentInformationGain(model, "rho")(Z))
    assert not torch.allclose(acquisition(Z), value)


LAW = FunctionPhysics(
    lambda X, p: p.a[:, None] * crude(X)[..., :1], unknowns={"a": Unknown(1.0, sd=1.0)}
)
REFUSED = [
    (lambda: made(PhysicsMeanGP), "rho", TypeError, "PhysicsMeanGP has no unknown rho; use about"),
    (lambda: made(ScaleGP), "delta", TypeError, "ScaleGP has no unknown delta"),
    (lambda: made(ZeroMeanGP), "both", TypeError, "rho or delta.* found ZeroMeanGP"),
    (lambda: made(CalibratedPhysics, physics=LAW), "both", TypeError, "has neither rho nor delta"),
    (lambda: made(center=True), "delta", ValueError, "use about='rho' or 'both', .* center=0"),
    (lambda: made(VariationalCKA, num_inducing=5), "rho", TypeError, "rho: use about='both'"),
    (made, "epsilon", ValueError, r"about='epsilon'; expected 'rho'"),
    (lambda: ModelListGP(made()), "both", TypeError, "found ModelListGP"),
    (lambda: StackedGP({"a": made()}, [1.0]), "both", TypeError, "found StackedGP"),
]


@pytest.mark.parametrize(("make", "about", "error", "words"), REFUSED)
def test_what_has_no_such_adjustment_is_refused(make, about, error, words):
    refused(error, words, qAdjustmentInformationGain, make(), about)
