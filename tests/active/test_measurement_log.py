"""Records that survive."""

import os

import pytest

from gpadjust.active.measurement_log import MeasurementLog

RECORDS = [{"x": [0.1, 1 / 3], "y": [2e-300]}, {"x": [1.0, 2.0], "failed": "no ü\nhere"}]


@pytest.fixture
def log(tmp_path):
    log = MeasurementLog(tmp_path / "new" / "log.jsonl")
    log.append(RECORDS[:1])
    log.append(RECORDS[1:])
    return log


def test_records_come_back(log):
    assert MeasurementLog(log.path).read() == RECORDS
    assert len(log.path.read_text().splitlines()) == 2


def test_nothing_is_no_records(tmp_path):
    assert MeasurementLog(tmp_path / "none").read() == []


def test_torn_anywhere_in_the_last_line(log):
    whole = log.path.read_bytes()
    first = whole.index(b"\n") + 1
    for size in range(first, len(whole) + 1):
        log.path.write_bytes(whole[:size])
        expected = RECORDS if size >= len(whole) - 1 else RECORDS[:1]
        assert log.read() == expected
        # What is appended next starts a line of its own.
        log.append([{"x": [5.0]}])
        assert log.read() == [*expected, {"x": [5.0]}]


def test_it_is_on_the_disk_when_append_returns(log, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_size))
    log.append(RECORDS[:1])
    assert synced == [log.path.stat().st_size]


def test_a_line_that_is_no_record(log):
    log.path.write_text('{"x": [1.0]}\n[1, 2]\n{"x": [2.0]}\n')
    with pytest.raises(ValueError, match=r"found b'\[1, 2\]' in line 2"):
        log.read()
