"""Small problems in one thread, the user's number elsewhere, and one model in two threads."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from threading import Event

import pytest
import torch
from threadpoolctl import threadpool_info

from gpadjust.core import CKA, fit
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.threads import threads_for
from tests.systems import ripple, same, uniform


def test_conditioning_leaves_the_model_whole_also_in_another_thread(drawn):
    def first(X):
        return ripple(X)[..., :1]

    X = uniform(9, 2)
    model = drawn(CKA(X, 1.2 * first(X) + X[:, 1:], physics=first))
    Z, more = uniform(6, 2, seed=1), uniform(2, 2, seed=5)
    observed = first(more)
    done = Event()

    def condition():
        found = []
        while not done.is_set():
            found.append(model.condition_on_observations(more, observed).predict(Z))
        return found

    with torch.no_grad(), ThreadPoolExecutor(1) as pool:
        expected = model.predict(Z)
        conditioned = model.condition_on_observations(more, observed).predict(Z)
        others = pool.submit(condition)
        try:
            found = [model.predict(Z) for _ in range(10)]
        finally:
            done.set()
        for prediction in found:
            same(prediction, expected)
        for prediction in others.result():
            same(prediction, conditioned)
        for parameter in model.condition_on_observations(more, observed).parameters():
            parameter.add_(1.0)
        same(model.predict(Z), expected)


# The numbers of threads.


def of_a_new_thread():
    """Return the number of threads that PyTorch uses in a thread that begins now."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


def of_blas():
    return {part["num_threads"] for part in threadpool_info() if part["user_api"] == "blas"}


@pytest.fixture
def two():
    """The user's setting is 2, before and after; that of BLAS stays, too."""
    before, blas = torch.get_num_threads(), of_blas()
    torch.set_num_threads(2)
    yield
    assert (torch.get_num_threads(), of_a_new_thread()) == (2, 2)
    assert of_blas() == blas
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two")
def test_one_within_none_of_large_problems_and_after_an_error():
    before = of_blas()
    with threads_for(1000):
        assert (torch.get_num_threads(), of_blas()) == (2, before)
    with pytest.raises(KeyboardInterrupt), threads_for(12):
        raise KeyboardInterrupt
    with threads_for(12):
        assert (torch.get_num_threads(), of_blas()) == (1, {1})
        with threads_for(20):
            assert (torch.get_num_threads(), of_blas()) == (1, {1})
        assert (torch.get_num_threads(), of_blas()) == (1, {1})


@pytest.mark.usefixtures("two")
def test_threads_that_begin_meanwhile_and_those_with_another_setting():
    with threads_for(12), ThreadPoolExecutor(1) as pool:
        assert pool.submit(torch.get_num_threads).result() == 2
        pool.submit(lambda: torch.rand(9, 9) @ torch.rand(9, 9)).result()

    def work():
        torch.set_num_threads(3)
        with threads_for(12):
            inside = torch.get_num_threads()
        return inside, torch.get_num_threads()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == (1, 3)
    assert (torch.get_num_threads(), of_a_new_thread()) == (2, 3)
    torch.set_num_threads(2)


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("first_out", [0, 1])
def test_sections_that_overlap_in_two_threads(first_out):
    """The second thread begins, and computes, while the first is in its section."""
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as other:
        threads, sections = [one, other], [ExitStack(), ExitStack()]

        def enter(i):
            sections[i].enter_context(threads_for(12))
            return torch.get_num_threads()

        def leave(i):
            sections[i].close()
            return torch.get_num_threads()

        assert [threads[i].submit(enter, i).result() for i in (0, 1)] == [1, 1]
        assert (of_a_new_thread(), of_blas()) == (2, {1})
        last = 1 - first_out
        assert threads[first_out].submit(leave, first_out).result() == 2
        assert threads[last].submit(torch.get_num_threads).result() == 1
        assert threads[last].submit(leave, last).result() == 2


@pytest.mark.usefixtures("two")
def test_a_fit_has_one_thread_and_predictions_leave_the_setting(monkeypatch):
    """The setting is of all threads that begin: a limit for each prediction would reach them."""
    numbers = set()

    def law(X, p):
        numbers.add(torch.get_num_threads())
        return p.a[:, None] * X

    X = uniform(8, 1)
    physics = FunctionPhysics(law, unknowns={"a": Unknown(1.0, sd=0.5)})
    model = CKA(X, X.sin(), physics=physics)
    numbers.clear()
    fit(model, "map")
    assert numbers == {1}
    assert torch.get_num_threads() == 2
    with monkeypatch.context() as patch:
        patch.setattr(torch, "set_num_threads", lambda n: pytest.fail(f"set to {n}"))
        model.predict(X)
        model.posterior(X).rsample()
