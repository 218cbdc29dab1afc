"""Asking and telling in any order."""

import json
import os
import shutil

import pytest
import torch

from gpadjust.active import Collection, LogError, MeasurementWarning
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
def test_a_result_is_of_the_nearest_of_the_pending_points(make):
    """A laboratory seldom sets inputs to the last digit."""
    first = [[1.0, 0.0], [1.01, 0.0], [1.02, 0.0], [0.123456, 0.5], [1.9, -0.654321]]
    collection = make(initial=first)
    X = collection.ask(5)
    set_X = [
        torch.tensor([[1.013, 0.0]]),
        torch.tensor([[1.5, 0.0]]),
        (1000 * X[3:]).round() / 1000,
    ]
    for x, pending in zip(set_X, ([0, 2, 3, 4], [0, 2, 3, 4], [0, 2]), strict=True):
        collection.tell(x, truth(x))
        assert torch.equal(collection.pending, X[pending])
    assert torch.equal(collection.X, torch.cat(set_X))  # as it was told
    collection.withdraw()
    assert torch.equal(collection.ask(2), X[[0, 2]])
    later = torch.cat([collection.ask() for _ in range(2)])
    assert (later[:, None] - X).abs().amax(-1).min() > 1e-3, "a point of the design came again"


def test_some_of_the_outputs(make, tmp_path):
    path = tmp_path / "log.jsonl"
    collection = make(log=path)
    X = collection.ask(2)
    with pytest.warns(MeasurementWarning, match=r"1 of 2 .* measured \[nan, nan\]"):
        collection.tell(X, torch.tensor([[50.0, torch.inf], [torch.nan] * 2]))
    records = [json.loads(line) for line in path.read_text().splitlines()[-2:]]
    assert [record["y"] for record in records] == [[50.0, None], [None, None]]
    collection.close()
    for each in (collection, make(log=path)):
        assert torch.equal(each.X, X[:1])
        assert torch.equal(each.Y.isnan(), torch.tensor([[False, True]]))
        assert torch.equal(each.failed_X, X[1:])
        assert len(each.pending) == each.num_observed == 0
        refused(RuntimeError, "2 measurements of each output, found 0", getattr, each, "model")


def test_failing_and_withdrawing(make):
    collection = make()
    X = collection.ask(3)
    with pytest.warns(MeasurementWarning, match="1 of 1 measurements failed.*leaks"):
        collection.fail(X[:1], "leaks")
    assert torch.equal(collection.failed_X, X[:1])
    collection.withdraw()
    assert len(collection.pending) == 0
    # Withdrawn points may be asked for again, failed ones may not.
    assert torch.equal(collection.ask(2), X[1:])


@pytest.mark.slow
def test_all_of_it_comes_back_from_the_log(make, tmp_path, uniform):
    path = tmp_path / "log.jsonl"
    collection = filled(make(log=path))
    with pytest.warns(MeasurementWarning):
        collection.fail(collection.ask(1), "no")
    collection.withdraw()
    collection.ask(2)
    other = uniform(1, 2)
    collection.tell(other, truth(other))
    again = make(log=shutil.copy(path, tmp_path / "copy.jsonl"))
    for name in ("X", "Y", "failed_X", "pending"):
        assert torch.equal(getattr(again, name), getattr(collection, name))
    assert again.num_measured == collection.num_measured == 6
    for _ in range(2):
        assert torch.equal(again.ask(), collection.ask())


REFUSED = [
    (torch.ones(2), torch.ones(1), ValueError, r"Expected X of shape n x 2, .* got \(2,\)"),
    (torch.ones(2, 2), torch.ones(3, 1), ValueError, r"shape 2 x 1, .* got \(3, 1\)"),
    (torch.ones(1, 2), torch.ones(1) * 1j, TypeError, "measured values to be real.*complex"),
]
LINES = [
    ('{"x": [0.5, 0.0], "y": [null]}', "nothing but NaN"),
    ('{"x": [0.5, 0.0], "y": ["a"]}', "to be real numbers"),
    ('{"x": [0.5, 0.0]}', "KeyError: 'y'"),
    ('{"asked": "abc"}', "Expected X to be real numbers"),
]


def test_bad_tellings_and_records_change_nothing(make, tmp_path):
    path = tmp_path / "log.jsonl"
    collection = filled(make(log=path), 1)
    before = path.read_text()
    for X, Y, error, words in REFUSED:
        refused(error, words, collection.tell, X, Y)
    assert path.read_text() == before
    assert len(collection.X) == 1
    collection.close()
    for line, words in LINES:
        path.write_text(before + line + "\n")
        refused(ValueError, rf"Line 4 of the .*jsonl, .* 2 inputs.*{words}", make, log=path)


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
