"""Conditioning in one thread, while another asks the same model."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
import torch

from gpadjust.core import CKA, RRA, StackedGP, ZeroMeanGP
from gpadjust.kinds import AR1, LinkedCKA
from tests.systems import ripple, uniform


def first(X):
    return ripple(X)[..., :1]


def stacked(X, Y, physics):
    models = {"CKA": CKA(X, Y, physics=physics), "zero mean": ZeroMeanGP(X, Y)}
    return StackedGP(models, [0.5, 0.5], num_components=4)


MODELS = {
    "CKA": CKA,
    "RRA": lambda *data, physics: RRA(*data, physics=physics, num_features=16),
    "LinkedCKA": LinkedCKA,
    "AR1": lambda *data, physics: AR1(*data, physics=physics, bounds=[[0, 0], [1, 1]], num_low=8),
    "StackedGP": stacked,
}


@pytest.mark.parametrize("name", MODELS)
def test_conditioning_leaves_the_model_whole_also_in_another_thread(name, drawn):
    X = uniform(9, 2)
    model = MODELS[name](X, 1.2 * first(X) + X[:, 1:], physics=first)
    for each in getattr(model, "models", [model]):
        drawn(each)
    Z, more = uniform(6, 2, seed=1), uniform(2, 2, seed=5)
    observed = first(more)
    with torch.no_grad():
        expected = model.predict(Z)
        conditioned = model.condition_on_observations(more, observed).predict(Z)
    done = Event()

    def condition():
        found = []
        while not done.is_set():
            found.append(model.condition_on_observations(more, observed).predict(Z))
        return found

    with torch.no_grad(), ThreadPoolExecutor(1) as pool:
        others = pool.submit(condition)
        try:
            found = [model.predict(Z) for _ in range(10)]
        finally:
            done.set()
    for right, many in ((expected, found), (conditioned, others.result())):
        for one in many:
            torch.testing.assert_close(one, right)
    new = model.condition_on_observations(more, observed)
    with torch.no_grad():
        for parameter in new.parameters():
            parameter.add_(1.0)
    torch.testing.assert_close(model.predict(Z), expected)
