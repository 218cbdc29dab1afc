"""How often the physics is evaluated: a simulator once a row, a formula once a call."""

from collections import Counter

import pytest
import torch
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import BlackBoxPhysics, FunctionPhysics, fit
from tests.systems import crude


@pytest.fixture
def counting():
    class Counting:
        """The crude physics, with a record of the rows it was asked for."""

        def __init__(self):
            self.rows = Counter()
            self.num_outputs = 1

        def __call__(self, X):
            self.rows.update(tuple(row) for row in X.detach().tolist())
            return crude(X)[..., : self.num_outputs]

    return Counting()


PHYSICAL = ["PhysicsMeanGP", "ScaleGP", "CKA", "RRA"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", PHYSICAL)
def test_each_row_is_evaluated_once(data, build, uniform, counting, num_outputs, kind):
    counting.num_outputs = num_outputs
    X, Y = data(num_outputs=num_outputs)
    Z, new_X = uniform(4, 2, seed=1), uniform(2, 2, seed=2)
    simulator = BlackBoxPhysics(lambda x: counting(torch.from_numpy(x)).numpy())
    model = build(kind, X, Y, physics=simulator)
    fit(model, "map", num_screened=8, num_starts=1)
    with torch.no_grad():
        model.posterior(Z)
        model.posterior(Z.unsqueeze(-2), observation_noise=True)
        model.predict(Z)
        model.sample_functions(3)(Z)
        conditioned = model.condition_on_observations(new_X, 3 + new_X[:, :num_outputs])
        conditioned.posterior(Z)
        fantasies = model.fantasize(new_X, SobolQMCNormalSampler(torch.Size([3])))
        fantasies.posterior(Z)
        for name in model.term_names:
            model.term(name, uniform(4, 2, low=-3.0, seed=3))
    expected = {tuple(row) for row in torch.cat([X, Z, new_X]).tolist()}
    assert set(counting.rows) == expected
    assert set(counting.rows.values()) == {1}


@pytest.mark.parametrize("kind", PHYSICAL)
def test_each_call_evaluates_it_once(data, build, uniform, counting, kind):
    X, Y = data()
    model = build(kind, X, Y, physics=FunctionPhysics(counting)).eval()
    functions = model.sample_functions(3)
    model.posterior(X)
    counting.rows.clear()
    for number, call in enumerate((model.posterior, model.predict, functions), start=1):
        call(X)
        assert set(counting.rows.values()) == {number}


def test_ar1_evaluates_the_samples_only(data, build, uniform, counting):
    X, Y = data()
    model = build("AR1", X, Y, physics=counting, num_low=10)
    fit(model, "map", num_screened=8, num_starts=1)
    model.posterior(uniform(4, 2))
    assert len(counting.rows) == 10
    assert set(counting.rows.values()) == {1}
