"""Conditioning and seeded draws in one thread, while another asks the same model."""

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


@pytest.mark.slow
def test_seeded_functions(model, uniform):
    Z = uniform(6, 2)
    expected = [model.sample_functions(2, seed=seed)(Z) for seed in range(4)]
    torch.manual_seed(11)
    following = torch.rand(3)

    def draw(i):
        if i % 5 == 4:
            return model.sample_functions(2)(Z)  # from the generator that all threads share
        return model.sample_functions(2, seed=i % 5)(Z)

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(draw, range(30)))
    for i, values in enumerate(found):
        if i % 5 < 4:
            assert torch.equal(values, expected[i % 5])
    torch.manual_seed(11)
    model.sample_functions(2, seed=3)
    assert torch.equal(torch.rand(3), following)


# One model asked by several threads at once


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "num_outputs", "known_noise"),
    [("CKA", 2, True), ("CKA", 1, False), ("AR1", 1, False), ("RRA", 1, False), ("RRA", 2, True)],
)
def test_answers_are_those_of_one_thread(data, build, kind, uniform, num_outputs, known_noise):
    X, Y = data(num_outputs=num_outputs)
    Yvar = 0.01 * torch.ones_like(Y) if known_noise else None
    fresh, model = build(kind, X, Y, Yvar), build(kind, X, Y, Yvar)
    questions = [uniform(6, 2, high=2.0, seed=s) for s in range(4)]

    def ask(model, Z):
        answers = [model.posterior(Z).mean, model.predict(Z).variance]
        answers += [model.term(name, Z).variance for name in model.term_names]
        assert model.posterior(Z).rsample().isfinite().all()
        assert model.sample_functions(2)(Z).isfinite().all()
        return answers

    with torch.no_grad():
        expected = [ask(model, Z) for Z in questions]
    for _ in range(2):
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda Z: ask(fresh, Z), 4 * questions))
        for i, answers in enumerate(found):
            for actual, right in zip(answers, expected[i % 4], strict=True):
                torch.testing.assert_close(actual.detach(), right)
        fresh.train()


MORE = [(kind, m, m > 1) for kind in ("CKA", "AR1", "RRA") for m in (1, 2)]
MORE += [(k, m, m == 1) for k in ("ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA") for m in (1, 2)]
