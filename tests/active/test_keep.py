"""Measurements only where limits are kept with a probability."""

from functools import partial

import pytest
import torch
from botorch.acquisition import AcquisitionFunction, PosteriorStandardDeviation

from gpadjust import CKA, ZeroMeanGP, fit
from gpadjust.active import Collection, collect, qAdjustmentInformationGain
from gpadjust.active.keep import Keep
from tests.systems import line, refused

BOUNDS = [[0.0], [1.0]]
MOST = 1.5


def steep(X):
    return 3 * X.square()


def below(Y):
    return Y - MOST


def point_fit(model):
    return fit(model, "map")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.core.SamplingWarning")
def test_a_forbidden_region_is_hardly_entered():
    """Beyond 0.707 the outputs are too large; f_p says so beyond 0.79 only."""
    measured, left_out = [], 0
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        result = collect(
            partial(CKA, physics=lambda X: 2.4 * X.square()),
            lambda X, g=generator: steep(X) + 0.02 * torch.randn(X.shape, generator=g).double(),
            BOUNDS,
            qAdjustmentInformationGain,
            budget=9,
            initial=[[0.0], [0.15], [0.3]],
            keep=below,
            seed=seed,
        )
        measured.append(result.X[3:])
        left_out += len(result.left_out)
        assert (result.left_out > 0.5).all()
    points = torch.cat(measured)
    assert (steep(points) > MOST).sum() <= 1  # of 12, at a probability of 0.95
    assert points.max() > 0.5
    assert left_out > 0


def test_probabilities_are_those_of_the_normal_distribution():
    X = line(8)
    model = ZeroMeanGP(X, torch.cat([X.sin(), X.cos()], -1), torch.full((8, 2), 1e-2).double())
    at = torch.tensor([[0.2], [0.9]], dtype=torch.float64)
    torch.manual_seed(0)
    found = Keep(lambda Y: (Y - 0.8).abs() - 0.2, 0.9).probabilities(model, at)
    mean, variance = model.predict(at, observation_noise=True)
    each = torch.special.ndtr((1.0 - mean) / variance.sqrt())
    each = each - torch.special.ndtr((0.6 - mean) / variance.sqrt())
    assert torch.allclose(found, each.prod(-1), atol=0.05)


def test_an_interrupted_run_goes_on_with_what_was_left_out(tmp_path):
    def made():
        return Collection(
            partial(CKA, physics=lambda X: 2.4 * X.square()),
            BOUNDS,
            PosteriorStandardDeviation,
            initial=[[0.0], [0.3]],
            keep=below,
            fit=lambda model: None,
            log=tmp_path / "log.jsonl",
        )

    with made() as first:
        first.run(steep, 4)
        before, points = first.left_out, first.ask()
        assert "left out" in repr(first)
    with made() as again:
        assert torch.equal(again.left_out[: len(before)], before)
        assert torch.equal(again.pending, points)


class Nearest(AcquisitionFunction):
    """Best at 0.5; it notes the pending points."""

    def __init__(self, own=None):
        super().__init__(torch.nn.Module())
        self.set_X_pending(own)
        self.noted = []

    def forward(self, X):
        if not self.noted or self.noted[-1] is not self.X_pending:
            self.noted.append(self.X_pending)
        return -(X - 0.5).abs().sum((-2, -1))


@pytest.fixture
def harmless():
    """A collection, by an acquisition function, of outputs far below the limit."""

    def harmless(acquisition):
        X = torch.tensor([[0.0], [0.5], [1.0]])
        options = {"data": (X, X / 10), "keep": below, "fit": point_fit}
        return Collection(ZeroMeanGP, BOUNDS, lambda model: acquisition, **options)

    return harmless


def test_points_pending_by_the_acquisition_function_itself_stay_so(harmless):
    own = torch.tensor([[0.3], [0.4]], dtype=torch.float64)
    acquisition = Nearest(own)
    collection = harmless(acquisition)
    points = torch.cat([collection.ask(2), collection.ask(1)])
    for i, found in enumerate(acquisition.noted):
        assert torch.equal(found, torch.cat([own, points[:i]]))
    assert len(acquisition.noted) == 3
    assert torch.equal(acquisition.X_pending, own)


def test_points_of_a_batch_are_apart_and_none_of_them_is_left_out(harmless):
    collection = harmless(Nearest())
    points = collection.ask(3)
    assert points.flatten().sort().values.diff().min() >= 0.01
    assert len(collection.left_out) == 0
    words = r"of which \d\d are apart by 0\.01 of the bounds"
    refused(RuntimeError, words, collection.ask, 101)


SAFE = {"initial": [[0.1], [0.2]]}
UNSAFE = {"data": (torch.tensor([[0.0], [0.5], [1.0]]), torch.tensor([[5.0], [6.0], [5.0]]))}
REFUSED = [
    ({"initial": [[0.1]]}, ValueError, "first points must be known as safe.*found 1 and 0"),
    ({**SAFE, "probability": 95}, ValueError, "probability must be"),
    ({**SAFE, "keep": 1.5}, TypeError, "keep to be callable"),
    ({**SAFE, "optimizer_options": {"num_restarts": 4}}, ValueError, "no optimizer_options"),
    (UNSAFE, RuntimeError, r"0 of \d+ points are safe with a probability of 0\.95"),
]


@pytest.mark.parametrize(("options", "error", "words"), REFUSED)
def test_bad_options_and_unsafe_points_are_refused(options, error, words):
    options = {"keep": below, "fit": lambda model: None, **options}

    def call():
        Collection(ZeroMeanGP, BOUNDS, PosteriorStandardDeviation, **options).ask()

    refused(error, words, call)


def test_first_points_are_to_be_told_first():
    collection = Collection(ZeroMeanGP, BOUNDS, PosteriorStandardDeviation, **SAFE, keep=below)
    X = collection.ask(2)
    collection.tell(X[:1], steep(X[:1]))
    refused(RuntimeError, r"1 are pending: tell\(\) their results first", collection.ask)
