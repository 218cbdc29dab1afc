"""Noise with heavy tails: outliers are found and hardly count, on top of any other noise."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal
from torch.nn.functional import silu

from gpadjust.core import CKA, fit, load, save
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import drawn, line, normal, refused, slopes

X = line(20)
Z = torch.tensor([[0.22], [0.47], [0.81]], dtype=torch.float64)
ROWS = [4, 13]


def wave(X):
    return torch.sin(5 * X[..., :1])


def both(X):
    return torch.cat([wave(X), wave(1 - X)], -1)


def truth(X):
    return wave(X) + 0.3 * X


def clean():
    return truth(X) + 0.03 * normal(20, 1, seed=1)


def gross(rows=ROWS, sizes=(0.6, -3.0)):
    Y = clean()
    Y[rows] += torch.tensor(sizes, dtype=torch.float64).unsqueeze(-1)
    return Y


def rows_of(mask):
    return mask.flatten().nonzero().flatten().tolist()


CASES = {
    "near and far": (gross(), ROWS, {}),
    "huge, and at the end": (gross([7, 19], [3000.0, 1.0]), [7, 19], {}),
    "neighbours": (gross([9, 10], [2.0, -2.0]), [9, 10], {}),
    "known variances": (gross(), ROWS, {"train_Yvar": 0.03**2}),
    "none, of known variances": (clean(), [], {"train_Yvar": 0.03**2}),
}


@pytest.mark.parametrize("name", CASES)
def test_outliers_are_found_and_hardly_count(name):
    Y, rows, options = CASES[name]
    model = CKA(X, Y, physics=wave, noise=HeavyTails(), **options)
    fit(model, "map")
    assert rows_of(model.noise.is_outlier) == rows
    assert rows_of(model.noise.outliers(model) > 0.5) == rows
    alone = torch.ones(20, dtype=torch.bool)
    alone[rows] = False
    without = CKA(X[alone], Y[alone], physics=wave, **options)
    fit(without, "map")
    assert (model.predict(Z).mean - without.predict(Z).mean).abs().max() < 0.01
    assert ("outliers: rows" in model.summary()) == bool(rows)


@pytest.mark.slow
def test_draws_agree_and_the_density_of_an_outlier_is_that_of_the_tails():
    model = CKA(X, gross(), physics=wave, noise=HeavyTails())
    fit(model)
    assert rows_of(model.noise.outliers(model) > 0.5) == ROWS
    assert (model.predict(X).mean - truth(X)).abs().max() < 0.15
    left_out = model.left_out()
    r = (model.data.Y - left_out.prediction.mean)[13].abs().item()
    tail = math.log(0.02 / (2 * r * math.log(1e3)))
    assert left_out.log_density(model.data.Y)[13].item() == pytest.approx(tail, abs=0.1)


def test_the_likelihood_is_the_dense_formula():
    added = torch.rand(1, 20, dtype=torch.float64)
    unknowns = {"rate": Unknown(5.0, sd=1.0)}
    law = FunctionPhysics(lambda X, p: torch.sin(p.rate * X[:, 0]), unknowns=unknowns)
    for base in (None, RelativeNoise()):
        model = CKA(X, gross(), physics=law, noise=HeavyTails(base=base, added=added))
        u = drawn(model, 1).u.detach()
        prior = model(X) if model.train() else None
        v = {name: value.item() for name, value in model.values.items() if "noise" in name}
        noise = torch.full((20,), v.get("noise.variance", v.get("noise.constant")) + 1e-11)
        if base is not None:
            f = law(X, law.unknowns.to_values(model.values["physics.rate"])).flatten()
            at_prior = law(X, law.unknowns.to_values(torch.zeros(1, 1).double())).square().mean()
            noise = noise + (v["noise.relative"] + 1e-11) * f.square() / at_prior
        noise = (noise + added[0]) * model.unit.square()[0]
        law_of_Y = MultivariateNormal(prior.mean, prior.covariance_matrix + noise.diag())
        expected = law_of_Y.log_prob(model.data.Y[:, 0]) + 20 * model.unit.log()
        value, slope = model.log_likelihood(u)
        torch.testing.assert_close(value, expected.detach(), rtol=1e-7, atol=1e-7)
        numeric = slopes(lambda u, m=model: m.log_likelihood(u, False)[0], u)
        torch.testing.assert_close(numeric, slope, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("is_shared", [False, True])
def test_outputs_have_outliers_of_their_own(is_shared):
    two = torch.cat([gross(), gross([2], [2.0]).flip(0)], -1)
    two[7, 0] = torch.nan
    unknowns = {"size": Unknown(1.0, sd=0.5)}
    law = FunctionPhysics(lambda X, p: both(X) * p.size[:, None], unknowns=unknowns)
    model = CKA(X, two, physics=law if is_shared else both, noise=HeavyTails())
    fit(model, "map")
    assert model.noise.outliers(model)[7, 0] == 0
    assert [rows_of(mask) for mask in model.noise.is_outlier.mT] == [ROWS, [17]]
    part = model.subset_output([1, 0])
    torch.testing.assert_close(part.noise.outliers(part), model.noise.outliers(model)[:, [1, 0]])


def test_a_file_has_the_share(tmp_path):
    save(CKA(X, gross(), physics=silu, noise=HeavyTails(0.1)), tmp_path / "model.pt")
    assert load(tmp_path / "model.pt", trusted=True).noise.share == 0.1


def test_later_rows_have_no_corrections():
    added = torch.zeros(1, 20, dtype=torch.float64)
    added[0, ROWS] = 1e5
    later = HeavyTails(added=added).appended(None, 3)
    assert later.added.shape == (1, 23)
    assert rows_of(later.added) == ROWS


REFUSED = [
    (lambda: HeavyTails(share=0.6), ValueError, "below 0.5"),
    (lambda: HeavyTails(base=0.1), TypeError, "train_Yvar"),
    (lambda: CKA(X, clean(), 0.1, physics=wave, noise=HeavyTails(base=RelativeNoise())),
     ValueError, "found both"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input(call, error, words):
    refused(error, words, call)
