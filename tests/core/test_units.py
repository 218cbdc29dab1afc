"""Units of targets and inputs, constants, and forms of inputs: tensors, arrays, frames, Series."""

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.models.transforms import Normalize, Standardize

from gpadjust.core import CKA, GP, Term, ZeroMeanGP, fit
from gpadjust.physics import FormulaPhysics
from tests.systems import crude


@pytest.mark.parametrize("size", [1e-9, 1.0])
def test_no_variance_is_rounded_up(size, data, drawn, uniform, close):
    """GPyTorch's own distribution has variances of at least 1e-10, with a warning (an error)."""
    X, Y = data(n=12, num_outputs=2)
    model = drawn(CKA(X, size * Y, physics=lambda X: size * crude(X)))
    posterior = model.posterior(uniform(5, 2))
    close(posterior.distribution.variance, posterior.variance, 1e-10)


def test_the_physics_sees_inputs_before_their_transform(data, drawn, uniform, close):
    """Targets have units of their own, whatever their transform."""
    X, Y = data(n=12, num_outputs=2)
    Z, seen = uniform(4, 2, high=2.0, seed=1), []

    def physics(X):
        seen.append(X.max().item())
        return crude(X / 50)

    transform = Normalize(2)
    options = {"input_transform": transform, "outcome_transform": Standardize(2)}
    model = drawn(CKA(50 * X, Y, physics=physics, **options))
    plain = drawn(CKA(X, Y, physics=crude)).predict(Z)
    CKA(X, Y, physics=crude, input_transform=transform)  # has learnt a transform of its own
    close(model.predict(50 * Z).mean, plain.mean)
    close(model.predict(50 * Z).variance, plain.variance)
    assert min(seen) > 50


def test_inputs_come_back_as_they_came(data, drawn, uniform):
    X, Y = (values.numpy() for values in data(n=12, num_outputs=2))
    frames = pd.DataFrame(X, columns=["a", "b"]), pd.DataFrame(Y, columns=["p", "q"])
    Z = uniform(4, 2)
    expected = drawn(CKA(torch.tensor(X), torch.tensor(Y), physics=crude)).predict(Z)
    for train in ((X, Y), frames):
        model = drawn(CKA(*train, physics=crude))
        for values in (*model.predict(Z.numpy()), *model.interval(Z.numpy())):
            assert isinstance(values, np.ndarray)
            assert values.shape == (4, 2)
        np.testing.assert_allclose(model.predict(Z.numpy()).mean, expected.mean)
        assert model.posterior(Z.numpy()).mean.shape == (4, 2)
        functions = model.sample_functions(2, seed=0)
        assert torch.equal(functions(Z.numpy()), functions(Z))
        assert functions.evaluate_each(Z.expand(2, 4, 2).numpy()).shape == (2, 4, 2)
        later = model.condition_on_observations(*(values[:2] + 0.1 for values in train))
        assert later.predict(Z).mean.shape == (4, 2)
    frame = pd.DataFrame(Z.numpy(), columns=["a", "b"], index=[3, 5, 7, 9])
    for values in (*model.predict(frame), *model.interval(frame)):
        assert list(values.columns) == ["p", "q"]
        assert list(values.index) == [3, 5, 7, 9]
    np.testing.assert_allclose(model.predict(frame).mean, expected.mean)
    series = ZeroMeanGP(frames[0], frames[1]["p"])
    assert list(series.predict(frame).mean.columns) == ["p"]


def test_the_unit_of_targets(data):
    """Small where the prior mean is near the targets, their spread where it is far away."""
    X, Y = data(n=30, num_outputs=2)

    def unit(Y, physics):
        rho = Term("rho", mean=1.0, physics=0)
        return GP(X, Y, terms=[rho, Term("delta")], physics=[physics]).unit.mT

    spread = Y.std(0, correction=0, keepdim=True)
    torch.testing.assert_close(unit(Y, lambda X: 0 * crude(X)), spread)
    torch.testing.assert_close(unit(Y, lambda X: 1e6 * crude(X)), spread)
    near = (Y - crude(X)).square().mean(0, keepdim=True).sqrt()
    torch.testing.assert_close(unit(Y, crude), near.minimum(spread))
    met, size = unit(1e-3 * crude(X), lambda X: 1e-3 * crude(X)), crude(X).square().mean(0).sqrt()
    torch.testing.assert_close(met, 1e-9 * size.unsqueeze(0))
    constant = torch.full_like(Y, 3.0)
    torch.testing.assert_close(unit(constant, lambda X: 0 * crude(X)), constant[:1])


RANDOM = np.random.default_rng(0)
FRAME = pd.DataFrame({"a": RANDOM.uniform(size=9), "b": RANDOM.uniform(size=9)}, range(5, 14))
FRAME["y"], FRAME["v"] = np.sin(3 * FRAME.a) + 0.1 * FRAME.b, 0.01
inputs, y, v = FRAME[["a", "b"]], FRAME["y"], FRAME["v"]
WAVE = FormulaPhysics("sin(3*a)", ["a", "b"])


def test_targets_and_variances_are_series():
    model, frames = (
        CKA(inputs, Y, Yvar, physics=WAVE) for Y, Yvar in ((y, v), (FRAME[["y"]],) * 2)
    )
    assert torch.equal(model.data.Y, frames.data.Y)
    assert model.data.output_names == ("y",)
    assert model.data.Yvar.shape == (9, 1)
    more = model.condition_on_observations(inputs[:2], y[:2], noise=v[:2])
    assert len(more.data.X) == 11
    outputs = FRAME[["y", "b"]]
    each = ZeroMeanGP(inputs, outputs, outputs.var())
    assert each.data.Yvar[3].tolist() == outputs.var().tolist()


def test_a_series_of_inputs_is_one_column():
    model = CKA(FRAME["a"], y, physics=FormulaPhysics("sin(3*a)", ["a"]))
    fit(model, "map")
    found = model.predict(FRAME["a"]).mean
    assert isinstance(found, pd.DataFrame)
    pd.testing.assert_frame_equal(found, model.predict(FRAME[["a"]]).mean)
