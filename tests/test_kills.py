"""Processes that are killed at random moments: what goes on from the disk ends as another."""

import multiprocessing
import random
import time

import pytest
import torch

from tests.point import assert_equal

NAMES = ("planned", "searched", "trained")
KILLS = 12  # of each


@pytest.fixture(scope="module")
def start():
    """Starts a run in a folder, in a process that is forked from one which has imported all."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.killed_runs"])

    def begin(name, folder):
        from tests.killed_runs import go

        process = context.Process(target=go, args=(name, folder))
        process.start()
        return process

    return begin


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_run_that_is_killed_ends_as_one_that_is_not(start, name, tmp_path):
    def found(folder):
        process = start(name, folder)
        process.join()
        assert process.exitcode == 0
        return torch.load(folder / "found.pt", weights_only=False)

    found(tmp_path / "first")  # which waits for the imports
    begun = time.perf_counter()
    whole = found(tmp_path / "whole")
    span = time.perf_counter() - begun
    moments, kills, resumed = random.Random(NAMES.index(name)), 0, 0
    for number in range(4 * KILLS):  # runs, each killed until it ends
        folder = tmp_path / f"{number}"
        while kills < KILLS:
            process = start(name, folder)
            process.join(moments.uniform(0, span / 2))
            if not process.is_alive():
                assert process.exitcode == 0
                span /= 1.5  # the machine has become faster
                break
            process.kill()
            process.join()
            kills += 1
            if any(folder.rglob("*.ckpt")):
                resumed += 1
            else:  # the machine has become slower
                span *= 1.5
        assert_equal(found(folder), whole)
        if kills == KILLS:
            break
    assert resumed > 0
    assert kills == KILLS
