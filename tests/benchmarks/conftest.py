"""Times side by side."""

import time

import pytest
import torch


def ratio(ours, theirs, rounds):
    times = ([], [])
    for _ in range(rounds):
        for action, record in zip((ours, theirs), times, strict=True):
            start = time.perf_counter()
            action()
            record.append(time.perf_counter() - start)
    medians = [torch.tensor(record).median().item() for record in times]
    return medians[0] / medians[1]


@pytest.fixture
def record_ratio(benchmark):
    """Times two actions by turns and records the ratio of their median times under a name."""

    def record(name, ours, theirs, rounds=9):
        if rounds > 1:
            ours(), theirs()
        value = benchmark.pedantic(ratio, args=(ours, theirs, rounds), rounds=1)
        benchmark.extra_info[name] = round(value, 3)
        print(f"{name}: {value:.3f}")

    return record
