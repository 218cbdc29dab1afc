"""The memo: what it returns, forgets, and how it is copied."""

import copy
import pickle

import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics.black_box import RowMemo, row_keys
from tests.systems import refused

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


@given(a=st.lists(finite, min_size=3, max_size=3), b=st.lists(finite, min_size=3, max_size=3))
def test_keys_are_equal_exactly_when_rows_are(a, b):
    one, other, same = row_keys(torch.tensor([a, b, a], dtype=torch.float64))
    assert one == same
    assert (one == other) == (a == b)


def test_keys_of_a_strided_view():
    X = torch.arange(12, dtype=torch.float64).reshape(3, 4)
    assert row_keys(X[:, ::2]) == row_keys(X[:, ::2].contiguous())
    assert row_keys(X.T[:2].T) == row_keys(X[:, :2].clone())


def test_threads_share_a_memo_that_overflows(in_threads):
    memo = RowMemo(capacity=20)
    X = torch.arange(60, dtype=torch.float64).unsqueeze(-1)

    def ask(number):
        generator = torch.Generator().manual_seed(number)
        for _ in range(300):
            rows = X[torch.randint(60, (12,), generator=generator)]
            assert torch.equal(memo.recall(rows, torch.square), rows**2)
            assert len(memo) <= 20

    in_threads(ask)


def double(X):
    return 2 * X


def refuse(X):
    raise AssertionError(f"asked for {X.tolist()}")


@given(sizes=st.lists(st.integers(1, 7), min_size=1, max_size=8))
def test_all_batches_within_capacity_are_known(sizes):
    memo = RowMemo(capacity=100)
    X = torch.arange(sum(sizes), dtype=torch.float64).unsqueeze(-1)
    for batch in X.split(sizes):
        memo.recall(batch, double)
    assert len(memo) == len(X)
    assert torch.equal(memo.recall(X.flip(0), refuse), 2 * X.flip(0))


def test_copies_pickles_and_capacity():
    memo = RowMemo(capacity=3)
    old, new = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    memo.recall(old, double)
    memo.recall(new, double)
    assert len(memo) == 2
    memo.recall(new, refuse)
    refused(AssertionError, "asked for", memo.recall, old, refuse)
    memo.recall(torch.arange(9.0).unsqueeze(-1), double)
    assert len(memo) == 3
    memo, X = RowMemo(capacity=3), torch.tensor([[1.0]])
    memo.recall(X, double)
    for empty in (copy.deepcopy(memo), pickle.loads(pickle.dumps(memo))):
        assert (len(empty), empty.capacity) == (0, 3)


def test_what_it_returns_is_a_copy():
    memo, X = RowMemo(capacity=3), torch.tensor([[1.0]])
    memo.recall(X, double).fill_(99.0)
    memo.recall(X, refuse).fill_(99.0)
    assert memo.recall(X, refuse).item() == 2.0
    memo, X = RowMemo(capacity=3), torch.tensor([[1.0], [2.0]])
    memo.store(row_keys(X[:1]), X[:1])
    found = memo.recall(X, double, learn=False)
    assert found.flatten().tolist() == [1.0, 4.0]
    assert len(memo) == 1
    memo, X = RowMemo(capacity=3), torch.tensor([[1.0]])
    with torch.inference_mode():
        memo.recall(X, double)
    assert memo.recall(X, refuse).add_(1.0).item() == 3.0
