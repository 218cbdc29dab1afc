"""Inputs that were measured with noise."""

import numpy as np
import pytest
import torch
from torch.nn.functional import silu

from gpadjust.core import CKA, GP, CalibratedPhysics, Term, ZeroMeanGP, fit, load, save
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, PhysicsError, Unknown
from tests.systems import line, normal, refused, uniform

SD = 0.05
TEST = line(41, 0.05, 0.95)


def f_p(X):
    return torch.sin(6 * X[..., :1])


def truth(X):
    return 1.2 * f_p(X) + X.square()


def case(seed=3, truth=truth, n=30):
    draw = torch.Generator().manual_seed(seed)
    true = torch.rand(n, 1, generator=draw, dtype=torch.float64)
    noise = torch.randn(2, n, 1, generator=draw, dtype=torch.float64)
    return true + SD * noise[0], truth(true) + 0.02 * noise[1]


X, Y = case()


def model_of(X, Y, variances, structure=CKA, **options):
    base = options.pop("base", None)
    noisy = NoisyInputs(X, variances, base)
    return structure(noisy.X, Y, noise=noisy, **options)


def test_true_inputs_vary_less_than_measured_ones():
    noisy = NoisyInputs(X, SD**2)
    total = noisy.X.var(0) + noisy.spread.square().mean(0)
    torch.testing.assert_close(total, X.var(0) - SD**2)
    some = torch.zeros_like(X)
    some[:10] = SD**2
    noisy = NoisyInputs(X, some)
    assert torch.equal(noisy.X[10:], X[10:])
    assert not noisy.spread[10:].any()


def test_moments_are_those_of_the_function_at_the_true_inputs():
    noisy = NoisyInputs(X, SD**2)
    two = lambda X: torch.cat([f_p(X), X.exp()], -1)  # noqa: E731
    model = GP(noisy.X, torch.cat([Y, Y], -1), terms=[Term("rho", mean=1.0, physics=0)],
               physics=[two], noise=noisy)  # fmt: skip
    learnt = noisy.learnt(model, model.with_noise)
    values = two(noisy.X + noisy.spread * normal(100_000, 30, 1)) / model.unit[:, 0]
    expected = (values.mean(0) - two(noisy.X) / model.unit[:, 0]).mT
    torch.testing.assert_close(learnt.shift, expected, atol=5e-3, rtol=0.0)
    torch.testing.assert_close(learnt.added, values.var(0).mT, rtol=0.04, atol=1e-3)


@pytest.mark.slow
def test_an_unknown_parameter_is_nearer_to_the_truth():
    true = uniform(200, 1)
    X, Y = true + 0.1 * normal(200, 1, seed=1), 2 * (true - 0.5) + 0.02 * normal(200, 1, seed=2)
    law = FunctionPhysics(lambda X, p: p.a * (X[:, 0] - 0.5), unknowns={"a": Unknown(1.0, sd=2.0)})
    options = {"physics": law}
    slopes = []
    for model in (
        CalibratedPhysics(X, Y, **options), model_of(X, Y, 0.01, CalibratedPhysics, **options),
    ):  # fmt: skip
        fit(model, "map")
        slopes.append(model.physics_parameters.mean.item())
    assert slopes[0] < 1.85  # by 12 %, as errors in variables have it
    assert abs(slopes[1] - 2) < 0.1


def test_exact_inputs_change_nothing():
    plain, model = CKA(X, Y, physics=f_p), model_of(X, Y, 0.0, physics=f_p)
    for each in (plain, model):
        fit(each, "map")
    assert torch.equal(plain.predict(TEST).mean, model.predict(TEST).mean)


@pytest.mark.slow
@pytest.mark.parametrize("is_inner", [True, False])
def test_outliers_of_noisy_inputs(is_inner, tmp_path):
    off = Y.clone()
    off[5] += 4.0
    noisy = NoisyInputs(X, SD**2, base=None if is_inner else HeavyTails())
    noise = HeavyTails(base=noisy) if is_inner else noisy
    model = CKA(noisy.X, off, physics=silu, noise=noise)
    fit(model, "map")
    assert model.noise.is_outlier.flatten().nonzero().tolist() == [[5]]
    alone = torch.arange(30) != 5
    without = model_of(X[alone], off[alone], SD**2, physics=silu)
    fit(without, "map")
    first = model.predict(TEST, True)
    assert (first.mean - without.predict(TEST).mean).abs().max() < 0.15
    assert not save(model, tmp_path / "model.pt").missing
    torch.testing.assert_close(load(tmp_path / "model.pt", trusted=True).predict(TEST, True), first)
    fit(model, "map")
    assert torch.equal(model.predict(TEST).mean, first.mean)


def test_a_black_box_that_cannot_be_asked_everywhere():
    X = line(12)

    def root(X):
        if (X < 0).any():
            raise ValueError("no root")
        return np.sqrt(X[:, :1])

    model = model_of(X, X.sqrt() + 0.1, 1e-3, physics=BlackBoxPhysics(root))
    fit(model, "map")
    assert model.noise.added.argmax() <= 1  # where the root is steep
    noisy = NoisyInputs(X, 1e-3)
    never = BlackBoxPhysics(lambda X: np.where(np.isin(X, noisy.X), X, np.nan))
    with pytest.raises(PhysicsError):
        fit(CKA(noisy.X, X, physics=never, noise=noisy), "map")


def test_frames_stay_frames():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame(X.numpy(), columns=["length"], index=range(5, 35))
    noisy = NoisyInputs(frame, pd.DataFrame({"length": np.full(30, SD**2)}))
    assert list(noisy.X.columns) == ["length"]
    assert list(noisy.X.index) == list(frame.index)
    np.testing.assert_allclose(noisy.X, NoisyInputs(X, [SD**2]).X)
    assert isinstance(NoisyInputs(X.numpy(), SD**2).X, np.ndarray)
    assert CKA(noisy.X, Y, physics=f_p, noise=noisy).data.input_names == ("length",)


REFUSED = [
    (lambda: NoisyInputs(X, -1.0), ValueError, "Expected variances in variances"),
    (lambda: NoisyInputs(X, 1.0), ValueError, "not standard deviations"),
    (lambda: NoisyInputs(X, 1e-3, base=0.1), TypeError, "train_Yvar"),
    (lambda: fit(CKA(X[:9], Y[:9], physics=f_p, noise=NoisyInputs(X, 1e-3))), ValueError, "30 inp"),
    (lambda: fit(CKA(X, Y, physics=f_p, noise=NoisyInputs(X, 1e-3))), ValueError, "noisy.X"),
]


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input(call, error, words):
    refused(error, words, call)


def test_later_inputs_are_exact():
    added, moved = torch.full((2, 30), 0.1).double(), torch.full((2, 30), 0.2).double()
    noisy = NoisyInputs(X, SD**2, added=added, moved=moved)
    model = ZeroMeanGP(noisy.X, torch.cat([Y, 2 * Y.flip(0)], -1), noise=noisy)
    # (y - left-out mean) / variance is K^-1 (y - mean - shift).
    mean, variance = model.left_out().prediction
    alpha = model.conditioning().alpha[0].mT / model.unit.mT
    torch.testing.assert_close((model.data.Y - mean) / variance, alpha)
    later = model.condition_on_observations(TEST[:1], 3 + truth(TEST[:1]).expand(-1, 2))
    assert (later.predict(TEST[:1]).mean > model.predict(TEST[:1]).mean).all()
    for corrections in (later.noise.added, later.noise.shift):
        assert corrections[:, :30].all()
        assert not corrections[:, 30:].any()
    fit(later, "map")
