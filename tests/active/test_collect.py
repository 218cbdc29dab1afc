"""The loop: what it measures, what it survives, and how it goes on."""

import json
import math

import pytest
import torch
from botorch import fit_gpytorch_mll
from botorch.acquisition import LogExpectedImprovement, qLogExpectedImprovement
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import CKA
from gpadjust.active import (
    CollectionError,
    LogError,
    MeasurementWarning,
    collect,
    qAdjustmentInformationGain,
)
from tests.point import assert_equal
from tests.systems import measured as truth
from tests.systems import refused

quiet = pytest.mark.filterwarnings("ignore::gpadjust.active.MeasurementWarning")


class Oracle:
    """The truth, which counts, and does something else at measurements of some numbers."""

    def __init__(self, instead=None, measure=truth):
        self.instead, self.measure = instead or {}, measure
        self.asked = []

    def __call__(self, X):
        self.asked.append(X)
        return self.instead.get(len(self.asked), lambda Y: Y)(self.measure(X))


def throw(error):
    def do(Y):
        raise error

    return do


def nothing(Y):
    return Y * math.nan


STOP = throw(KeyboardInterrupt())


def same(a, b):
    return a.X.shape == b.X.shape and torch.equal(a.X, b.X) and torch.equal(a.Y, b.Y)


def records(path, kind):
    """The records of a log that have a key."""
    return [record for record in map(json.loads, path.read_text().splitlines()) if kind in record]


@pytest.mark.parametrize("batch_size", [1, 3])
def test_budget(laboratory, bounds, batch_size):
    oracle = Oracle()
    result = collect(**laboratory(oracle=oracle, batch_size=batch_size))
    assert torch.equal(torch.cat(oracle.asked), result.X)
    assert [len(X) for X in oracle.asked] == {1: [1] * 7, 3: [3, 3, 1]}[batch_size]
    assert ((bounds[0] <= result.X) & (bounds[1] >= result.X)).all()
    torch.testing.assert_close(result.Y, truth(result.X))
    assert len(result.model.data.Y) == 7


@pytest.mark.slow
def test_it_teaches_more_than_chance(laboratory, bounds):
    options = {"num_restarts": 2, "raw_samples": 16}
    result = collect(**laboratory(budget=10, fit=None, optimizer_options=options))
    grid = torch.cartesian_prod(*(torch.linspace(*b, 9, dtype=torch.float64) for b in bounds.T))
    error = (result.model.predict(grid).mean - truth(grid)).abs().max()
    assert error < 0.1 * truth(grid).std()


def test_the_seed_decides(laboratory):
    state = torch.get_rng_state()
    first, again = collect(**laboratory(budget=5)), collect(**laboratory(budget=5))
    assert torch.equal(torch.get_rng_state(), state)
    assert same(first, again)
    assert not same(first, collect(**laboratory(budget=5, seed=1)))


def test_forms_of_outcomes_and_of_the_beginning(laboratory, uniform):
    for form in (lambda Y: Y[:, 0], lambda Y: Y.numpy(), torch.Tensor.float, torch.Tensor.item):
        result = collect(**laboratory(oracle=lambda X, f=form: f(truth(X)), budget=2))
        torch.testing.assert_close(result.Y, truth(result.X), rtol=1e-6, atol=1e-6)
        assert result.Y.dtype == torch.float64
    X = uniform(4, 2, seed=3)
    assert torch.equal(collect(**laboratory(initial=X, budget=5)).X[:4], X)
    known = collect(**laboratory(data=(X, truth(X)), budget=2))
    assert known.X.shape == (6, 2)
    assert torch.equal(known.X[:4], X)
    # Four points are enough for a model, so that no design was measured.
    assert not (known.X[4:, None] == result.X).all(-1).any()


def test_a_model_of_botorch(laboratory, bounds):
    def factory(X, Y):
        return SingleTaskGP(X, Y, input_transform=Normalize(2, bounds=bounds))

    def fit(model):
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))

    result = collect(**laboratory(model_factory=factory, fit=fit, budget=5))
    assert isinstance(result.model, SingleTaskGP)


@pytest.mark.slow
def test_failures_are_skipped_and_counted(laboratory, tmp_path):
    path, oracle = tmp_path / "log.jsonl", Oracle({6: throw(OSError("no gas")), 7: nothing})
    with pytest.warns(MeasurementWarning) as caught:
        result = collect(**laboratory(oracle=oracle, log=path))
    for warning, words in zip(caught, ("OSError: no gas", "measured [nan]"), strict=True):
        assert words in str(warning.message)
    assert len(oracle.asked) == 7
    assert result.X.shape == (5, 2)
    assert torch.equal(result.failed_X, torch.cat(oracle.asked[5:]))
    assert [record["x"] for record in records(path, "failed")] == result.failed_X.tolist()


@pytest.mark.slow
@quiet
@pytest.mark.parametrize("analytic", [False, True])
def test_a_failing_region_does_not_hold_the_loop(laboratory, analytic):
    options = {}
    if analytic:
        options["acquisition"] = lambda model: LogExpectedImprovement(model, best_f=10.0)

    def measure(X):
        if X[0, 1] > 0.8:
            raise ValueError("out of reach")
        return truth(X)

    oracle = Oracle(measure=measure)
    result = collect(**laboratory(oracle=oracle, budget=10, max_failures=10, **options))
    seen = torch.cat(oracle.asked)
    assert len(result.X) + len(result.failed_X) == 10
    apart = (seen[:, None] - seen).abs().amax(-1) + torch.eye(10)
    assert apart[(seen[:, 1] > 0.8)].min() > 1e-3


def test_a_design_goes_on_until_each_output_is_known(laboratory):
    def second_is_missing(Y):
        return torch.cat([Y[:, :1], Y[:, :1] * math.nan], -1)

    oracle = Oracle(dict.fromkeys(range(1, 6), second_is_missing), lambda X: truth(X).repeat(1, 2))
    options = {"oracle": oracle, "acquisition": qAdjustmentInformationGain}
    result = collect(**laboratory(budget=8, **options))
    assert result.num_observed == 3
    assert result.model.num_outputs == 2
    result = collect(**laboratory(budget=1, data=(result.X, result.Y), **options))
    assert result.num_observed == 4


@quiet
def test_several_failures_in_a_row_stop_it(laboratory, tmp_path):
    path = tmp_path / "log.jsonl"
    broken = Oracle(dict.fromkeys(range(3, 20), throw(OSError("no gas"))))
    words = r"failed 3 times in a row.*no gas.*log is at .*log\.jsonl"
    with pytest.raises(CollectionError, match=words) as error:
        collect(**laboratory(oracle=broken, log=path, max_failures=3, budget=20))
    assert isinstance(error.value.__cause__, OSError)
    assert error.value.collection.X.shape == (2, 2)
    # After a repair it goes on.
    result = collect(**laboratory(log=path, budget=8))
    assert (len(result.X), len(result.failed_X)) == (5, 3)


@pytest.mark.parametrize(
    ("what", "message", "logged"),
    [
        (lambda Y: [1.5, math.nan], r"of shape 1 x 1, .* \(2,\)", [1.5, "NaN"]),
        (lambda Y: {"Y": Y[0].numpy() * 0}, "to be real numbers", {"Y": [0.0]}),
        (lambda Y: {(1, 2): 3}, "to be real numbers", "{(1, 2): 3}"),
    ],
)
def test_a_result_that_cannot_be_taken_is_not_lost(laboratory, tmp_path, what, message, logged):
    path, oracle = tmp_path / "log.jsonl", Oracle({3: what})
    with pytest.raises(CollectionError, match=f"{message}.*still pending") as caught:
        collect(**laboratory(oracle=oracle, log=path))
    error = caught.value
    assert torch.equal(error.X, oracle.asked[2])
    assert str(error.result) == str(what(truth(error.X)))
    assert torch.equal(error.collection.pending, error.X)
    (record,) = records(path, "refused")
    assert record["refused"] == logged
    assert record["of"] == error.X.tolist()
    # It goes on by hand, or by another call.
    with error.collection as collection:
        collection.tell(error.X, truth(error.X))
        collection.run(truth, 5)
    assert collection.num_measured == 5
    assert same(collect(**laboratory(log=path, budget=5)), collect(**laboratory(budget=5)))


def with_gaps(X):
    """Two outputs, the second of which is not measured everywhere."""
    Y = truth(X).repeat(1, 2)
    Y[X[:, 1] > 0.2, 1] = math.nan
    return Y


GAPS = {"acquisition": qAdjustmentInformationGain}
RUNS = {  # what oracles do of the whole run, the interrupted one and the next; options
    "the first point": ({}, {1: STOP}, {}, {"initial": 3}),
    "a point": ({}, {6: STOP}, {}, {"initial": 3}),
    "a batch by a fit": ({}, {3: STOP}, {}, {"batch_size": 2, "initial": 3, "fit": None}),
    "an unchanged model": ({5: nothing, 6: nothing}, {5: nothing, 6: STOP}, {1: nothing}, {}),
    "some outputs": ({}, {6: STOP}, {}, GAPS),
}


@quiet
@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_an_interrupted_run_ends_as_if_it_had_not_been(laboratory, tmp_path, name):
    *kinds, options = RUNS[name]
    measure = with_gaps if options is GAPS else truth
    oracles = [Oracle(instead, measure) for instead in kinds]
    log = {"log": tmp_path / "log.jsonl"}
    whole = collect(**laboratory(oracle=oracles[0], **options))
    with pytest.raises(KeyboardInterrupt):
        collect(**laboratory(oracle=oracles[1], **log, **options))
    result = collect(**laboratory(oracle=oracles[2], **log, **options))
    assert torch.equal(oracles[2].asked[0], oracles[1].asked[-1])
    for part in ("X", "failed_X"):
        assert torch.equal(getattr(result, part), getattr(whole, part))
    torch.testing.assert_close(result.Y, whole.Y, rtol=0, atol=0, equal_nan=True)
    assert_equal([*result.model.parameters()], [*whole.model.parameters()])
    assert len(whole.failed_X) == len(kinds[0])
    assert (0 < whole.Y.isnan().sum() < 6) == (options is GAPS)
    assert torch.equal(whole.model.data.Y.isnan(), whole.Y.isnan())


def test_killed_at_any_byte(laboratory, tmp_path):
    options = {"batch_size": 2, "budget": 6, "initial": 4}
    path = tmp_path / "log.jsonl"
    whole = collect(**laboratory(log=path, **options))
    content = path.read_bytes()
    line_ends = [i + 1 for i, byte in enumerate(content) if byte == ord("\n")]
    for size in [3, line_ends[-4] - 5, line_ends[-2]]:
        path.write_bytes(content[:size])
        oracle = Oracle()
        assert same(collect(**laboratory(oracle=oracle, log=path, **options)), whole)
        lost = 6 - content[: size + 1].count(b'"y"')
        assert sum(map(len, oracle.asked)) in (lost, lost + 1)


def test_a_log_is_free_when_it_is_done(laboratory, tmp_path):
    path = tmp_path / "log.jsonl"
    first = collect(**laboratory(log=path, budget=2))
    second = collect(**laboratory(log=path, budget=3))
    assert first.num_measured == 2
    with pytest.raises(KeyboardInterrupt) as kept:
        collect(**laboratory(oracle=Oracle({1: STOP}), log=path))
    assert kept.value.__traceback__
    refused(LogError, "something else has written to it", first.ask)
    assert same(collect(**laboratory(log=path, budget=3)), second)
    assert same(second, collect(**laboratory(budget=3)))


GIVEN = torch.ones(4, 2, dtype=torch.float64)
PAIR = (GIVEN.cumsum(0), GIVEN)
FIXED = {"fixed_features": {1: 0.5}}
NEEDS = "With fixed_features, .* {} or more .* found 0"
REFUSED = [
    ({"budget": 0}, "budget must be at", ValueError),
    ({"model_factory": 3}, "Expected model_factory to be callable, got 3", TypeError),
    ({"initial": 1}, "initial, a number of points, must", ValueError),
    ({"initial": [[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]}, "points of initial to differ", ValueError),
    ({"data": torch.ones(3, 2)}, r"data to be a pair \(X, Y\), got tensor", TypeError),
    ({"data": (GIVEN, GIVEN[:, :1] * math.nan)}, "the Y of data to hold an obs", ValueError),
    ({"seed": -1}, "seed must be at least 0; found -1", ValueError),
    ({"optimizer_options": [1]}, r"to be a dictionary, got \[1\]", TypeError),
    ({"optimizer_options": {"q": 2}}, r"without \['q'\]", ValueError),
    ({"optimizer_options": {"num_restart": 2}}, r"Unknown .* \['num_restart'\]", ValueError),
    ({"optimizer_options": FIXED, "initial": None}, NEEDS.format(2), ValueError),
    ({"optimizer_options": FIXED, "data": PAIR, "initial": 5}, "5 or .* found 0 and 4", ValueError),
    ({"log": 3}, "log to be the path of a file, got 3", TypeError),
    (
        {"acquisition": qAdjustmentInformationGain(CKA(*PAIR, physics=torch.sin))},
        "pass `lambda model: qAdjustmentInformationGain",
        TypeError,
    ),
    ({"acquisition": qLogExpectedImprovement}, "`lambda model: .*argument: 'best_f'", TypeError),
    ({"model_factory": CKA}, r"partial\(CKA, physics=f_p\)`.*argument: 'physics'", TypeError),
    ({"model_factory": CKA(*PAIR, physics=torch.sin)}, "got a model; pass", TypeError),
    ({"model_factory": SingleTaskGP, "fit": None}, "default fit .* Pass fit=", TypeError),
    ({"fit": lambda: None}, r"`lambda model: fit\(.* too many", TypeError),
]


@pytest.mark.parametrize(("changes", "words", "error"), REFUSED)
def test_what_cannot_be_collected_by_is_refused(laboratory, changes, words, error):
    oracle = Oracle()
    refused(error, words, collect, **laboratory(oracle=oracle, **changes))
    assert not oracle.asked


LATE = [
    ({"acquisition": lambda model: model}, "TypeError.* AcquisitionFunction, got CKA"),
    ({"model_factory": lambda X, Y: 3}, "TypeError.*factory to make a botorch Model; found int"),
    ({"fit": lambda model: 1 / 0}, r"\(ZeroDivisionError: division by zero\)\. The 4 meas"),
    (
        {"acquisition": lambda model: LogExpectedImprovement(model, 1.0), "batch_size": 2},
        "LogExpectedImprovement takes one .* got q = 2",
    ),
]


@pytest.mark.parametrize(("changes", "words"), LATE)
def test_what_shows_after_measurements_does_not_lose_them(laboratory, changes, words):
    with pytest.raises(CollectionError, match=words) as caught:
        collect(**laboratory(**changes))
    data = caught.value.collection.X, caught.value.collection.Y
    torch.testing.assert_close(data[1], truth(data[0]))
    assert len(data[0]) == 4
    assert torch.equal(collect(**laboratory(data=data, budget=1)).X[:4], data[0])


def test_points_are_within_constraints_and_have_their_fixed_features(laboratory):
    # x1 <= 1; x2 = 0.5
    below = [(torch.tensor([0]), -torch.ones(1, dtype=torch.float64), -1.0)]
    options = {"num_restarts": 1, "raw_samples": 4, "inequality_constraints": below, **FIXED}
    first = [[0.2, 0.5], [0.9, 0.5]]
    X = collect(**laboratory(initial=first, optimizer_options=options, budget=5)).X
    assert (X[:, 0] <= 1 + 1e-6).all()
    assert (X[:, 1] == 0.5).all()


def test_a_log_that_does_not_belong(laboratory, tmp_path):
    path = tmp_path / "log.jsonl"
    collect(**laboratory(log=path, budget=2))
    for changes, words in (
        ({"bounds": [[0.0, -2.0], [4.0, 2.0]]}, r"log\.jsonl has measurements within the bounds"),
        ({"data": PAIR}, r"Line 3 of the log .* 2 inputs and 2 outputs"),
    ):
        refused(ValueError, words, collect, **laboratory(log=path, **changes))
