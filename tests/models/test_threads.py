"""Conditioning in one thread, while another asks the same model."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
import torch

from gpadjust import StackedGP, fit


@pytest.fixture(params=["CKA", "RRA", "AR1", "samples", "mixture"])
def model(request, data, build):
    X, Y = data(n=9)
    if request.param == "mixture":
        models = {name: build(name, X, Y) for name in ("CKA", "PhysicsMeanGP")}
        return StackedGP(models, [[0.5], [0.5]], num_components=4)
    if request.param == "samples":
        sampled = build("CKA", X, Y)
        fit(sampled, num_samples=3, num_draws=32, num_starts=1, num_screened=4)
        return sampled
    return build(request.param, X, Y).eval()


def test_conditioning_leaves_the_model_whole_also_in_another_thread(model, data, uniform):
    Z, (X, Y) = uniform(6, 2), data(n=2, seed=5)
    with torch.no_grad():
        expected = model.predict(Z)
        conditioned = model.condition_on_observations(X, Y).predict(Z)
    done = Event()

    def condition():
        found = []
        while not done.is_set():
            found.append(model.condition_on_observations(X, Y).predict(Z))
        return found

    with torch.no_grad(), ThreadPoolExecutor(1) as pool:
        others = pool.submit(condition)
        try:
            found = [model.predict(Z) for _ in range(30)]
        finally:
            done.set()
        for right, many in ((expected, found), (conditioned, others.result())):
            for one in many:
                torch.testing.assert_close(one, right)
    before, state = model.predict(Z), {n: v.clone() for n, v in model.state_dict().items()}
    new = model.condition_on_observations(X, Y)
    with torch.no_grad():
        for parameter in new.parameters():
            parameter.add_(1.0)
    torch.testing.assert_close(model.predict(Z), before)
    assert all(torch.equal(v, state[n]) for n, v in model.state_dict().items())
