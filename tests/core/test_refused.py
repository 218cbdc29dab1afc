"""What the core refuses: a call, its error, and the decisive words of this."""

import pandas as pd
import pytest
import torch
from botorch.models import ModelListGP, SingleTaskGP
from botorch.models.transforms.input import AppendFeatures, InputPerturbation, Warp
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.kernels import RBFKernel

from gpadjust import compare, core
from gpadjust.core import (
    CKA,
    GP,
    MATERN32,
    RRA,
    Noise,
    OfGPyTorch,
    StackedGP,
    Term,
    ZeroMeanGP,
    fit,
)  # fmt: skip
from gpadjust.kinds import HeavyTails
from gpadjust.many import VariationalCKA
from gpadjust.physics import FormulaPhysics
from tests.systems import line, normal, refused, uniform, wave, waves

X = line(12)
Y = 1.3 * wave(X) + X + 0.05 * normal(12, 1)
MODEL = CKA(X, Y, physics=wave)
KNOWN = CKA(X, Y, 0.1, physics=wave)
TWO = CKA(X, waves(X) + X, physics=waves)
ZERO = ZeroMeanGP(X, Y)
FRAME = pd.DataFrame({"a": X[:, 0], "m": ["steel", "brass"] * 6})
BA = pd.DataFrame({"b": X[:, 0], "a": X[:, 0].sin()})
NAMED = ZeroMeanGP(BA, Y)
FUNCTIONS = MODEL.sample_functions(3, seed=0)
ROWS = torch.zeros(3, 1, dtype=torch.float64)


class NoShares(Noise):
    def __init__(self):
        super().__init__(("a", "b"))


class Negative(NoShares):
    def shares(self, places):
        return -torch.stack([places.X[..., 0], places.X[..., 0]], -1)


class Forgetful(Noise):
    """A noise with numbers of two outputs, of which a subset does not take its own."""

    def shares(self, places):
        return torch.tensor([1.0, 10.0]).double().reshape(2, 1, 1)


def fantasy():
    return ZERO.fantasize(X[:2].expand(3, 2, 1), SobolQMCNormalSampler(torch.Size([2])))


def choices(*parts):
    return GP(
        X, Y, terms=[Term("f", core.Stationary())], choices=[core.Choice(*part) for part in parts]
    )


def cka(**options):
    return CKA(X, Y, physics=wave, **options)


PAIR = {"a": MODEL, "b": ZERO}
LIST = ModelListGP(MODEL, ZERO)
SINGLE = torch.float32
REFUSED = [
    # Data and options.
    (lambda: cka(kernel=None), TypeError, "'kernel' of CKA; expected some of center, .*, rho_mean"),
    (lambda: cka(likelihood="relative"), TypeError, "input transforms of gpadjust.kinds"),
    (lambda: compare(X, Y, wave, likelihood=0.1), TypeError, "'likelihood' of ZeroMeanGP"),
    (lambda: cka(rho_mean="learn"), ValueError, "Expected rho_mean as numbers"),
    (lambda: cka(delta_mean="learn"), TypeError, "Expected delta_mean as a number"),
    (lambda: cka(center="learn"), TypeError, "Expected center as a number, or center=True"),
    (lambda: cka(noise=HeavyTails), TypeError, r"noise as an instance, HeavyTails\(\)"),
    (lambda: cka(input_transform=Warp(1, [0])), ValueError, r"not learnt; Warp.*requires_grad_"),
    (lambda: cka(input_transform=InputPerturbation(ROWS)), ValueError, "one row of each row"),
    (lambda: cka(input_transform=AppendFeatures(ROWS)), ValueError, r"\(36, 2\) of \(12, 1\)"),
    (lambda: NAMED.posterior(NAMED.data.X[0]), ValueError, r"One point is `X.reshape\(1, -1\)`"),
    (lambda: MODEL.posterior(X[:, 0]), ValueError, r"One column is `X.reshape\(-1, 1\)`"),
    (lambda: cka(outcome_transform="log"), ValueError, "LinkedCKA"),
    (lambda: CKA(FRAME, Y, physics=wave), TypeError, r"found str\..*Categories\(\)"),
    (lambda: CKA(X, Y, physics=lambda X: X.expand(12, 2)), ValueError, "1 outputs of physics"),
    (lambda: CKA(X.expand(2, -1, -1), Y, physics=wave), ValueError, "two dimensions"),
    (lambda: CKA(X, Y[:4], physics=wave), ValueError, "as many rows"),
    (lambda: CKA(X, Y, physics=[]), ValueError, "at least one physics"),
    (lambda: CKA(X, Y, physics=[wave, wave], rho_mean=[1.0]), ValueError, "numbers, of 2 physics"),
    (lambda: RRA(X, Y, physics=wave, num_features=7), ValueError, "even number of features"),
    (lambda: CKA(BA, Y, physics=FormulaPhysics("a - b", ["a", "b"])), ValueError, "in the order"),
    (lambda: ZERO.rho(X), ValueError, "Unknown term 'rho'; expected one of f"),
    (lambda: core.save("a comparison", "model.pt"), TypeError, "comparison.recommended"),
    (lambda: core.save(LIST, "model.pt"), TypeError, "found ModelListGP.*each of model.models"),
    (lambda: ZERO.set_train_data(X, Y), NotImplementedError, "condition_on_observations"),
    (lambda: NAMED.predict(pd.DataFrame({"a": [0.1], "b": [0.2]})), ValueError, "columns"),
    (lambda: MODEL.interval(X, 95), ValueError, "between 0 and 1"),
    # Terms, kernels, noises and choices.
    (lambda: GP(X, Y, terms=[MATERN32]), TypeError, "Term"),
    (lambda: GP(X, Y, terms=[Term("f", MATERN32)]), TypeError, "Profile"),
    (lambda: GP(X, Y, terms=[]), ValueError, "different names"),
    (lambda: GP(X, Y, terms=[Term("f"), Term("f")]), ValueError, "different names"),
    (lambda: GP(X, Y, terms=[Term("a.b")]), ValueError, "without dots"),
    (lambda: GP(X, Y, terms=[Term("rho", physics=0)]), ValueError, "has physics number 0"),
    (lambda: OfGPyTorch(RBFKernel(batch_shape=torch.Size([2]))), ValueError, "without batch shape"),
    (lambda: ZeroMeanGP(X, Y, noise=0.01), TypeError, "train_Yvar"),
    (lambda: ZeroMeanGP(X, Y, 0.01, noise=Noise()), ValueError, "found both"),
    (lambda: ZeroMeanGP(X, Y, noise=NoShares()).predict(X, True), ValueError, "override"),
    (lambda: ZeroMeanGP(X, Y, noise=Negative()).predict(X, True), ValueError, "negative"),
    (lambda: CKA(X, waves(X), physics=waves, noise=Forgetful()).subset_output([0]).predict(X, True),
     ValueError, "of_outputs"),
    (lambda: choices(("a", 1.0)), ValueError, "several"),
    (lambda: choices(("a", 0.7), ("b", 0.7)), ValueError, "sum to 1"),
    (lambda: choices(("a", 1.5), ("b", -0.5)), ValueError, "positive"),
    (lambda: choices(("a", 0.5), ("b", 0.5, ("f.proces",))), ValueError, "Unknown numbers"),
    # Further observations, and outputs.
    (lambda: MODEL.condition_on_observations(X[:2], Y[:2] / 0), ValueError, "Expected finite Y"),
    (lambda: MODEL.condition_on_observations(X[:2] / 0, Y[:2]), ValueError, "X to be finite.*row"),
    (lambda: MODEL.condition_on_observations(X[:2], Y[:3]), ValueError, r"Y of .* \.\.\. x 2 x 1"),
    (lambda: MODEL.condition_on_observations(X[:1], Y[:1], Y[:1]), ValueError, "model learns it"),
    (lambda: KNOWN.condition_on_observations(X[:1], Y[:1], -X[1:2]), ValueError, "not negative"),
    (lambda: TWO.subset_output([]), ValueError, "numbers of outputs from 0 to 1"),
    (lambda: TWO.subset_output([2]), ValueError, "numbers of outputs from 0 to 1"),
    (lambda: TWO.subset_output([0.5]), ValueError, "numbers of outputs from 0 to 1"),
    (lambda: TWO.posterior(X).scalarized(Y[0]), ValueError, "weights of 2 outputs"),
    (lambda: cka()(X[:3]), RuntimeError, "call the model on its training inputs"),
    (lambda: cka().subset_draws(torch.zeros(4).long()).train()(X), RuntimeError, "holds 4 draws"),
    # Functions.
    (lambda: MODEL.sample_functions(0), ValueError, "num_functions must be at least 1"),
    (lambda: MODEL.sample_functions(1, num_features=7), ValueError, "even number of features"),
    (lambda: FUNCTIONS.evaluate_each(uniform(2, 4, 1)), ValueError, "3 functions, 3 x q x d"),
    (lambda: FUNCTIONS(uniform(4, 3)), ValueError, r"X of shape \.\.\. x q x 1"),
    (lambda: cka(delta_covar_module=RBFKernel()).sample_functions(2), NotImplementedError, "no ra"),
    # Fits.
    (lambda: fit(ZERO, "vi"), ValueError, "Unknown method 'vi'"),
    (lambda: fit(ZERO, num_draws=6), ValueError, "multiple of 4"),
    (lambda: fit(LIST), TypeError, "found ModelListGP.*for part in model.models"),
    (lambda: fit(fantasy()), ValueError, "one data set"),
    (lambda: fit(SingleTaskGP(X, Y, outcome_transform=None)), TypeError, "SingleTaskGP"),
    (lambda: fit(MODEL, "nuts"), ValueError, "nested=False"),
    (lambda: fit(ZERO, "nuts", num_draws=8), ValueError, "from 16 on; found 8"),
    (lambda: fit(VariationalCKA(X, Y, physics=wave, num_inducing=4), "nuts"), ValueError, "no den"),
    # Mixtures.
    (lambda: StackedGP({"a": 1}, [1.0]), TypeError, "by name"),
    (lambda: StackedGP({"a": ZERO, "b": NAMED}, [1.0, 0.0]), ValueError, "same data"),
    (lambda: StackedGP(PAIR, [0.5, 0.4]), ValueError, "sum to 1"),
    (lambda: StackedGP(PAIR, [1.5, -0.5]), ValueError, "sum to 1"),
    (lambda: StackedGP(PAIR, [1.0]), ValueError, "in shape"),
    (lambda: StackedGP(PAIR, {"a": 0.5, "none": 0.5}), ValueError, "in shape"),
    (lambda: StackedGP(PAIR, [0.5, 0.5], 0), ValueError, "num_components"),
    (lambda: StackedGP(PAIR, [0.5, 0.5]).sample_functions(3), NotImplementedError, r"models\[0\]"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
@pytest.mark.filterwarnings("ignore:Data .outcome observations. is not standardized")
def test_refused(call, error, words):
    refused(error, words, call)


@pytest.mark.parametrize("model", [MODEL, StackedGP(PAIR, [0.5, 0.5], 4)])
def test_a_refused_type_changes_nothing(model):
    before = model.predict(X)
    for call in (model.float, model.half, lambda: model.to(SINGLE), lambda: model.to(X.to(SINGLE))):
        refused(TypeError, "compute in float64; found torch.float", call)
    after = model.double().to("cpu").to(X).to(torch.float64).predict(X)
    assert all(map(torch.equal, after, before))
