"""Records that survive."""

import copy
import gc
import multiprocessing
import os
import pickle
import time

import pytest

from gpadjust.active import LogError
from gpadjust.active.measurement_log import MeasurementLog
from tests.systems import refused

BOUNDS = [[0.0], [1.0]]
RECORDS = [{"x": [0.1, 1 / 3], "y": [2e-300]}, {"x": [1.0, 2.0], "failed": "no ü\nhere"}]


@pytest.fixture
def log(tmp_path):
    log = MeasurementLog(tmp_path / "new" / "log.jsonl")
    assert log.open(BOUNDS) == []
    log.append(RECORDS[:1])
    log.append(RECORDS[1:])
    return log


def read(log):
    """What another one finds in the file, after this one is done with it."""
    log.close()
    other = MeasurementLog(log.path)
    try:
        return other.open(BOUNDS)
    finally:
        other.close()


def test_torn_anywhere_in_the_last_line(log):
    assert read(log) == RECORDS
    whole = log.path.read_bytes()
    header, first, *_ = (len(line) for line in whole.split(b"\n"))
    within = (0, 1, header - 1, header, header + 1, header + 2)
    for size in (*within, *range(header + first + 2, len(whole) + 1)):
        log.path.write_bytes(whole[:size])
        expected = RECORDS if size >= len(whole) - 1 else RECORDS[: size > header + 2]
        other = MeasurementLog(log.path)
        assert other.open(BOUNDS) == expected
        # What is appended next starts a line of its own.
        other.append([{"x": [5.0]}])
        assert read(other) == [*expected, {"x": [5.0]}]


def test_it_is_on_the_disk_when_append_returns(log, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_size))
    log.append(RECORDS[:1])
    assert synced == [log.path.stat().st_size]


def test_what_is_no_log_or_record_is_left_as_it_is(log, tmp_path):
    log.close()
    whole = log.path.read_bytes()
    for line in (b"[1, 2]", b'{"x": [NaN]}', b"\xff", b"[" * 100_000):
        log.path.write_bytes(whole + line + b"\n{}\n")
        words = r"each line of .*log\.jsonl, found b'.* in line 4"
        refused(ValueError, words, log.open, BOUNDS)
    for path in (tmp_path, log.path / "log.jsonl"):  # a folder, and a file as one
        words = r"cannot be opened: .*Name a file in a folder"
        refused(LogError, words, MeasurementLog(path).open, BOUNDS)
    path = tmp_path / "notes"
    for content in (b"my diary", b"{}", b'{"loss": 1.0}\n', b"\n\n", b"a\nb"):
        path.write_bytes(content)
        refused(ValueError, "notes", MeasurementLog(path).open, BOUNDS)
        assert path.read_bytes() == content


def test_a_full_disk_leaves_whole_records(log):
    """By a limit on the size of files, which the kernel keeps as a full disk does."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    whole = log.path.read_bytes()
    words = r"log\.jsonl cannot be written: .*make room"
    for room in (0, 7, 50):
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + room, before[1]))
        try:
            refused(LogError, words, log.append, RECORDS)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert log.path.read_bytes() == whole
    log.append(RECORDS)
    assert read(log) == 2 * RECORDS


@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
def test_what_is_not_synced_is_not_kept(log, monkeypatch, error):
    def fsync(file):
        monkeypatch.undo()
        raise error

    whole = log.path.read_bytes()
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises((LogError, KeyboardInterrupt)):
        log.append(RECORDS)
    assert log.path.read_bytes() == whole


def test_a_torn_end_that_stays_is_removed_before_the_next(log, monkeypatch):
    def fsync(file):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fsync)
    refused(LogError, "Input/output error", log.append, [{"x": [9.0]}])
    with log.path.open("ab") as file:
        file.write(b'{"x": [9.')  # as if it could not be cut off
    monkeypatch.undo()
    log.append(RECORDS)
    assert read(log) == 2 * RECORDS


def test_one_log_holds_a_file_until_it_is_closed_or_deleted(log):
    other = MeasurementLog(log.path)
    words = rf"log\.jsonl is held by process {os.getpid()} .*this"
    refused(LogError, words, other.open, BOUNDS)
    log.close()
    assert other.open(BOUNDS) == RECORDS
    refused(LogError, "is held by process", log.append, RECORDS)
    del other
    gc.collect()
    log.append(RECORDS)  # again, as nobody else has written
    assert read(log) == 2 * RECORDS
    other = MeasurementLog(log.path)
    other.open(BOUNDS)
    other.append(RECORDS)
    other.close()
    refused(LogError, "something else has written to it", log.append, RECORDS)
    assert read(other) == 3 * RECORDS


def test_a_copy_does_not_hold_the_file(log):
    others = copy.copy(log), pickle.loads(pickle.dumps(log))
    for other in others:
        refused(LogError, "is held by process", other.append, RECORDS)
    log.close()
    others[0].append(RECORDS)
    assert read(others[0]) == 2 * RECORDS


@pytest.mark.slow
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
def test_neither_does_a_fork_nor_a_process_that_was_killed(log, tmp_path):
    def child(queue):
        with pytest.raises(LogError) as caught:
            log.append(RECORDS)
        log.close()
        own = MeasurementLog(tmp_path / "own.jsonl")
        own.open(BOUNDS)
        own.append(RECORDS)
        queue.put(str(caught.value))
        time.sleep(60)

    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    process = context.Process(target=child, args=(queue,))
    process.start()
    assert f"is held by process {os.getpid()}" in queue.get()
    own = MeasurementLog(tmp_path / "own.jsonl")
    refused(LogError, f"is held by process {process.pid} on", own.open, BOUNDS)
    process.kill()
    process.join()
    assert own.open(BOUNDS) == RECORDS
    refused(LogError, "is held by process", MeasurementLog(log.path).open, BOUNDS)
    log.append(RECORDS)
    assert read(log) == 2 * RECORDS
