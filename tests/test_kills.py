"""Processes that are killed at random moments: what goes on from the disk ends as another."""

import multiprocessing
import random
import time

import pytest
import torch

from gpadjust.control import MPCAgent, PolicySearchAgent
from gpadjust.rl import DynaSAC
from tests.killed_runs import go
from tests.point import assert_equal

KILLS = 5


@pytest.fixture(scope="module")
def start():
    """Starts a run in a folder, in a process that is forked from one which has imported all."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.killed_runs"])

    def begin(target, *arguments):
        process = context.Process(target=target, args=arguments)
        process.start()
        return process

    begin(int).join()  # after the imports
    return begin


@pytest.mark.slow
@pytest.mark.parametrize("kind", [MPCAgent, PolicySearchAgent, DynaSAC])
def test_a_run_that_is_killed_ends_as_one_that_is_not(start, kind, tmp_path):
    def found(folder):
        process = start(go, kind, folder)
        process.join()
        assert process.exitcode == 0
        return torch.load(folder / "found.pt", weights_only=False)

    begun = time.perf_counter()
    whole = found(tmp_path / "whole")
    span = time.perf_counter() - begun
    moments, folder, resumed = random.Random(kind.__name__), tmp_path / "killed", 0
    for _ in range(KILLS):
        process = start(go, kind, folder)
        process.join(moments.uniform(0, span / 2))
        if not process.is_alive():  # at its end
            assert process.exitcode == 0
            break
        process.kill()
        process.join()
        if any(folder.rglob("*.ckpt")):
            resumed += 1
        else:  # the machine has become slower
            span *= 1.5
    assert_equal(found(folder), whole)
    assert resumed > 0
