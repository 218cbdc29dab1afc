"""Time and memory of many updates do not grow."""

import time
from resource import RUSAGE_SELF, getrusage

import pytest
import torch

from gpadjust import RRA


def wave(X):
    return torch.sin(6 * X[:, :1])


@pytest.mark.slow
def test_a_hundred_thousand_updates_take_no_more_time_or_memory_at_the_end():
    X = torch.linspace(0, 1, 20, dtype=torch.float64).unsqueeze(-1)
    model = RRA(X, 2 * wave(X) + X, physics=wave, num_features=20).eval()

    def thousand(start):
        begin = time.process_time()
        for i in range(start, start + 1000):
            x = X[i % 20 : i % 20 + 1]
            model.update(x, (2 + i / 1e5) * wave(x) + x, forget=500)
        model.predict(X)
        return time.process_time() - begin

    thousand(0)
    first = [thousand(1000 * k) for k in range(1, 4)]
    before = getrusage(RUSAGE_SELF).ru_maxrss
    for k in range(4, 97):
        thousand(1000 * k)
    grown = getrusage(RUSAGE_SELF).ru_maxrss - before
    last = [thousand(1000 * k) for k in range(97, 100)]
    sizes = sum(t.numel() for t in model.state_dict().values())
    print(
        f"first {min(first):.3f} s, last {min(last):.3f} s of 1,000; {grown} KiB; {sizes} numbers"
    )
    assert min(last) < 1.3 * min(first)
    assert grown < 20_000  # KiB: 0.2 KiB an update
    assert model.train_targets.shape[-1] == 20
    mean, _ = model.predict(X)
    assert (mean - 3 * wave(X) - X).abs().max() < 0.1
