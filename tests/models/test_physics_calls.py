"""How often the physics is evaluated: once for each distinct row."""

from collections import Counter

import pytest
import torch
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import fit


@pytest.fixture
def counting(crude_physics):
    class Counting:
        """The crude physics, with a record of the rows it was asked for."""

        def __init__(self):
            self.rows = Counter()
            self.num_outputs = 1

        def __call__(self, X):
            self.rows.update(tuple(row) for row in X.detach().tolist())
            return crude_physics(X)[..., : self.num_outputs]

    return Counting()


@pytest.mark.parametrize("kind", ["PhysicsMeanGP", "ScaleGP", "CKA", "RRA", "RRA-paper"])
def test_each_row_is_evaluated_once(data, build, uniform, counting, num_outputs, kind):
    counting.num_outputs = num_outputs
    X, Y = data(num_outputs=num_outputs)
    Z, new_X = uniform(4, 2, seed=1), uniform(2, 2, seed=2)
    model = build(kind, X, Y, physics=counting)
    fit(model, num_screened=8, num_starts=1)
    with torch.no_grad():
        model.posterior(Z)
        model.posterior(Z.unsqueeze(-2), observation_noise=True)
        conditioned = model.condition_on_observations(new_X, 3 + new_X[:, :num_outputs])
        conditioned.posterior(Z)
        fantasies = model.fantasize(new_X, SobolQMCNormalSampler(torch.Size([3])))
        fantasies.posterior(Z)
    expected = {tuple(row) for row in torch.cat([X, Z, new_X]).tolist()}
    assert set(counting.rows) == expected
    assert set(counting.rows.values()) == {1}


@pytest.mark.parametrize("kind", ["BiasGP", "ScaleGP", "CKA", "RRA", "RRA-paper"])
def test_rho_and_delta_do_not_evaluate_it_at_new_inputs(data, build, uniform, counting, kind):
    X, Y = data()
    model = build(kind, X, Y, physics=counting).eval()
    Z = uniform(4, 2, low=-3.0, seed=1)
    for name in ("rho", "delta"):
        if hasattr(model, name):
            getattr(model, name)(Z)
    assert set(counting.rows) == {tuple(row) for row in X.tolist()}


def test_ar1_evaluates_the_samples_only(data, build, uniform, counting):
    X, Y = data()
    model = build("AR1", X, Y, physics=counting, num_low=10)
    fit(model, num_screened=8, num_starts=1)
    model.posterior(uniform(4, 2))
    assert len(counting.rows) == 10
    assert set(counting.rows.values()) == {1}
