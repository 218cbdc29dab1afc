"""Asking and telling in any order."""

import json
import os
import shutil

import pytest
import torch

from gpadjust import PhysicsMeanGP
from gpadjust.active import Collection, LogError, MeasurementWarning, qAdjustmentInformationGain
from tests.systems import measured as truth
from tests.systems import refused


@pytest.fixture
def make(laboratory):
    def make(**changes):
        arguments = laboratory(**changes)
        return Collection(**{k: v for k, v in arguments.items() if k not in ("oracle", "budget")})

    return make


def filled(collection, n=4):
    for _ in range(n):
        X = collection.ask(1)
        collection.tell(X, truth(X))
    return collection


def test_asked_points_are_pending_until_told(make):
    collection = make(batch_size=3)
    X = collection.ask()
    assert X.shape == (3, 2)
    assert torch.equal(collection.pending, X)
    assert "(0 measurements, 0 failed, 3 pending; inputs: 2, outputs: unknown" in repr(collection)
    collection.tell(X[1:2], truth(X[1:2]))
    assert "(1 measurements, 0 failed, 2 pending; inputs: 2, outputs: 1; no log" in repr(collection)
    assert torch.equal(collection.pending, X[[0, 2]])
    more = collection.ask(2)
    assert torch.equal(collection.pending, torch.cat([X[[0, 2]], more]))
    points = torch.cat([make().ask(8)])  # a design is spread
    assert len({tuple(x) for x in (points[:4] > torch.tensor([1.0, 0.0])).tolist()}) == 4
    assert len(points.unique(dim=0)) == 8


def test_asking_without_telling_asks_elsewhere(make):
    collection = filled(make())
    points = torch.cat([collection.ask() for _ in range(3)])
    apart = (points[:, None] - points).abs().amax(-1) + torch.eye(3)
    assert apart.min() > 1e-3
    assert torch.equal(collection.pending, points)


def test_points_that_nobody_asked_for(make, uniform):
    collection = make()
    X = uniform(5, 2, seed=2)
    collection.tell(X, truth(X)[:, 0])
    assert torch.equal(collection.X, X)
    assert collection.num_measured == 5
    assert collection.ask().shape == (1, 2)  # by a model: five are enough
    assert len(collection.model.data.Y) == 5
    collection.tell(X, truth(X) + 0.1)  # again
    assert torch.equal(collection.X, X.repeat(2, 1))


@pytest.mark.slow
@pytest.mark.parametrize("initial", [4, torch.tensor([[0.123456, 0.5], [1.9, -0.654321]])])
def test_what_was_set_need_not_be_what_was_asked_for(make, initial):
    collection = make(initial=initial)
    X = collection.ask(4)
    for x in ((1000 * X[:2]).round() / 1000, X[2:].float()):
        collection.tell(x, truth(x.double()))
    assert len(collection.pending) == 0
    assert torch.equal(collection.X[2:], X[2:].float().double())  # as it was told
    later = torch.cat([collection.ask() for _ in range(2)])
    assert (later[:, None] - X).abs().amax(-1).min() > 1e-3, "a point of the design came again"


def test_it_is_the_nearest_of_the_pending_points(make):
    close = torch.tensor([[1.0, 0.0], [1.01, 0.0], [1.02, 0.0]])
    collection = make(initial=close)
    X = collection.ask(3)
    collection.withdraw(torch.tensor([[1.013, 0.0]]))
    assert torch.equal(collection.pending, X[[0, 2]])
    collection.tell(torch.tensor([[1.5, 0.0]]), torch.ones(1))
    assert torch.equal(collection.pending, X[[0, 2]]), "another point"


@pytest.mark.parametrize("missing", [float("nan"), float("inf")])
def test_some_of_the_outputs(make, tmp_path, missing):
    path = tmp_path / "log.jsonl"
    collection = make(log=path, num_outputs=2)
    X = collection.ask(2)
    with pytest.warns(MeasurementWarning, match=r"1 of 2 .* measured \[nan, nan\]"):
        collection.tell(X, torch.tensor([[50.0, missing], [float("nan")] * 2]))
    records = [json.loads(line) for line in path.read_text().splitlines()[-2:]]
    assert [record["y"] for record in records] == [[50.0, None], [None, None]]
    collection.close()
    with make(log=path, num_outputs=2) as second:
        pass
    for each in (collection, second, make(log=path)):
        assert torch.equal(each.X, X[:1])
        assert torch.equal(each.Y.isnan(), torch.tensor([[False, True]]))
        assert torch.equal(each.failed_X, X[1:])
        assert len(each.pending) == each.num_observed == 0
        refused(RuntimeError, "2 measurements of each output, found 0", getattr, each, "model")


def test_failing_and_withdrawing(make, tmp_path):
    collection = make(log=tmp_path / "log.jsonl")
    X = collection.ask(4)
    with pytest.warns(MeasurementWarning, match="1 of 1 measurements failed.*OSError: leaks"):
        collection.fail(X[:1], OSError("leaks"))
    assert torch.equal(collection.failed_X, X[:1])
    collection.withdraw(X[1:2])
    assert torch.equal(collection.pending, X[2:])
    collection.withdraw()
    assert len(collection.pending) == 0
    # Withdrawn points may be asked for again, failed ones may not.
    assert torch.equal(collection.ask(3), X[1:])


@pytest.mark.slow
def test_all_of_it_comes_back_from_the_log(make, tmp_path, uniform):
    path = tmp_path / "log.jsonl"
    collection = filled(make(log=path))
    X = collection.ask(3)
    with pytest.warns(MeasurementWarning):
        collection.fail(X[:1], "no")
    collection.withdraw(X[1:2])
    other = uniform(1, 2)
    collection.tell(other, truth(other))
    again = make(log=shutil.copy(path, tmp_path / "copy.jsonl"))
    for name in ("X", "Y", "failed_X", "pending"):
        assert torch.equal(getattr(again, name), getattr(collection, name))
    assert again.num_measured == collection.num_measured == 6
    assert torch.equal(again.ask(), collection.ask())
    assert torch.equal(again.ask(), collection.ask())


@pytest.mark.slow
def test_a_log_of_another_structure_is_no_hindrance(make, tmp_path):
    path = tmp_path / "log.jsonl"
    filled(make(log=path), 6)
    factory = lambda X, Y: PhysicsMeanGP(X, Y, physics=lambda X: X[..., :1])  # noqa: E731
    collection = make(log=path, model_factory=factory)
    assert collection.ask().shape == (1, 2)
    assert isinstance(collection.model, PhysicsMeanGP)


REFUSED = [
    (torch.ones(2), torch.ones(1), ValueError, r"Expected X of shape n x 2, .* got \(2,\)"),
    (torch.ones(2, 2), torch.ones(3, 1), ValueError, r"shape 2 x 1, .* got \(3, 1\)"),
    (torch.ones(2, 2), torch.ones(1), ValueError, r"shape 2 x 1, .* got \(1,\)"),
    (torch.ones(1, 2) * torch.nan, torch.ones(1), ValueError, "Expected X to be finite"),
    ("here", 1.0, TypeError, "Expected X to be real numbers, got 'here'"),
    (torch.ones(1, 2), torch.ones(1) * 1j, TypeError, "measured values to be real.*complex"),
]


def test_bad_tellings_change_nothing(make, tmp_path):
    path = tmp_path / "log.jsonl"
    collection = filled(make(log=path), 1)
    before = path.read_bytes()
    for X, Y, error, words in REFUSED:
        refused(error, words, collection.tell, X, Y)
    assert path.read_bytes() == before
    assert len(collection.X) == 1


def test_out_of_scope_a_collection_holds_no_log(make, tmp_path, bounds):
    path = tmp_path / "log.jsonl"
    filled(make(log=path), 1)
    with pytest.raises(ValueError, match="within the bounds") as kept:
        make(log=path, bounds=2 * bounds)
    assert kept.value.__traceback__
    with make(log=path) as second:
        assert len(second.X) == 1
        refused(LogError, r"log\.jsonl is held by process .*, this one: two", make, log=path)


def test_what_cannot_be_logged_is_not_taken(make, tmp_path, monkeypatch):
    path = tmp_path / "log.jsonl"
    collection = filled(make(log=path), 1)
    X, before = collection.ask(2), path.read_bytes()

    def full(file):
        raise OSError(28, "No space left on device")

    calls = [
        lambda: collection.tell(X, truth(X)),
        lambda: collection.fail(X, "no"),
        lambda: collection.withdraw(),
        lambda: collection.ask(),
    ]
    for call in calls:
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(LogError, match=r"No space left .* neither on the disk nor in the coll"):
            call()
        monkeypatch.undo()
        assert path.read_bytes() == before
        assert len(collection.X) == 1
        assert torch.equal(collection.pending, X)
    collection.tell(X, truth(X))
    collection.close()
    assert torch.equal(make(log=path).X, collection.X)


def test_a_record_that_does_not_belong(make, tmp_path):
    path = tmp_path / "log.jsonl"
    filled(make(log=path), 1)
    before = path.read_text()
    for line, words in (
        ('{"x": [0.5], "y": [1.0]}', r"Expected X of shape n x 2"),
        ('{"x": [0.5, 0.0], "y": [null]}', "nothing but NaN"),
        ('{"x": [0.5, 0.0], "y": ["a"]}', "to be real numbers"),
        ('{"x": [0.5, 0.0]}', "KeyError: 'y'"),
        ('{"asked": "abc"}', "Expected X to be real numbers"),
    ):
        path.write_text(before + line + "\n")
        refused(ValueError, rf"Line 4 of the .*jsonl, .* 2 inputs.*{words}", make, log=path)


def test_pending_points_of_the_acquisition_functions_own_count_too(make):
    own, given = torch.tensor([[0.3, 0.4]], dtype=torch.float64), []

    class Told(qAdjustmentInformationGain):
        def set_X_pending(self, X_pending=None):
            given.append(X_pending)
            super().set_X_pending(X_pending)

    collection = filled(make(acquisition=lambda model: Told(model, X_pending=own)))
    first = collection.ask(1)
    assert len(given) == 1
    collection.ask(1)
    for found, expected in zip(given[1:], (own, torch.cat([own, first]), own), strict=True):
        assert torch.equal(found, expected)
