"""The memo: what it returns, forgets, and how it is copied."""

import copy
import pickle

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics.memo import RowMemo, row_keys

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


@given(sizes=st.lists(st.integers(1, 7), min_size=1, max_size=8))
def test_recalls_all_batches_within_capacity(sizes):
    memo = RowMemo(capacity=100)
    X = torch.arange(sum(sizes), dtype=torch.float64).unsqueeze(-1)
    for batch in X.split(sizes):
        memo.store(row_keys(batch), batch**2)
    assert len(memo) == len(X)
    assert torch.equal(memo.gather(memo.lookup(row_keys(X.flip(0)))), X.flip(0) ** 2)


def test_starts_again_when_full():
    memo = RowMemo(capacity=3)
    old, new = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    memo.store(row_keys(old), old)
    memo.store(row_keys(new), new)
    assert memo.lookup(row_keys(old)).tolist() == [-1, -1]
    assert torch.equal(memo.gather(memo.lookup(row_keys(new))), new)


def test_never_holds_more_than_its_capacity():
    memo = RowMemo(capacity=3)
    X = torch.arange(5.0).unsqueeze(-1)
    memo.store(row_keys(X), X)
    assert len(memo) == 3
    assert memo.lookup(row_keys(X)).tolist() == [0, 1, 2, -1, -1]


def test_gathered_values_are_copies():
    memo = RowMemo(capacity=3)
    X = torch.tensor([[1.0]])
    memo.store(row_keys(X), X)
    memo.gather(torch.tensor([0])).fill_(99.0)
    X.fill_(99.0)
    assert memo.gather(torch.tensor([0])).item() == 1.0


def test_outlives_inference_mode():
    memo = RowMemo(capacity=10)
    with torch.inference_mode():
        X = torch.tensor([[1.0], [2.0], [3.0]])
        memo.store(row_keys(X[:2]), X[:2] * 2)
        memo.store(row_keys(X[2:]), X[2:] * 2)
    Z = torch.tensor([[4.0]])
    memo.store(row_keys(Z), Z * 2)
    assert memo.gather(torch.arange(4)).flatten().tolist() == [2.0, 4.0, 6.0, 8.0]


def test_pickle_holds_the_rows_without_spare_room():
    memo = RowMemo(capacity=100_000)
    X = torch.arange(1025, dtype=torch.float64).unsqueeze(-1)
    memo.store(row_keys(X[:1024]), X[:1024])
    memo.store(row_keys(X[1024:]), X[1024:])
    loaded = pickle.loads(pickle.dumps(memo))
    assert torch.equal(loaded.gather(loaded.lookup(row_keys(X))), X)
    assert loaded._values.untyped_storage().nbytes() == 1025 * 8


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


def test_store_keeps_what_it_knows():
    memo = RowMemo(capacity=10)
    X = torch.tensor([[1.0], [2.0], [3.0]])
    memo.store(row_keys(X[:2]), X[:2])
    memo.store(row_keys(X), X)
    assert len(memo) == 3
    assert torch.equal(memo.gather(memo.lookup(row_keys(X))), X)


def test_deep_copy_is_empty_with_the_same_capacity():
    memo = RowMemo(capacity=3)
    memo.store(row_keys(torch.tensor([[1.0]])), torch.tensor([[2.0]]))
    duplicate = copy.deepcopy(memo)
    assert (len(memo), len(duplicate), duplicate.capacity) == (1, 0, 3)
    with pytest.raises(LookupError, match="memo is empty"):
        duplicate.gather(torch.tensor([0]))
