"""Data as NumPy arrays, DataFrames and numbers."""

import sys
from inspect import signature

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.utils.datasets import SupervisedDataset

from gpadjust import CKA
from gpadjust.models.term_builder import ModelOptions
from tests.systems import crude, refused


def test_arrays_and_frames(data, build, kind, uniform, same):
    X, Y = data(num_outputs=2)
    Z, Yvar = uniform(5, 2, high=2.0), uniform(*Y.shape, low=0.01, high=0.1)
    model = build(kind, X, Y, Yvar)
    assert (model.input_names, model.output_names) == (("x1", "x2"), ("y1", "y2"))
    arrays = build(kind, X.numpy(), Y.numpy(), Yvar.numpy())
    frame = pd.DataFrame(X.numpy(), columns=["speed", "load"])
    named = pd.DataFrame(Y.numpy(), columns=["head [m]", "flow"])
    frames = build(kind, frame, named, Yvar.numpy())
    assert (frames.input_names, frames.output_names) == (("speed", "load"), ("head [m]", "flow"))
    assert frames.subset_output([1]).output_names == ("flow",)
    index = [f"run {i}" for i in range(5)]
    asked = pd.DataFrame(Z.numpy(), columns=frame.columns, index=index)

    def answers(model, Z):
        return [*model.predict(Z), *model.interval(Z, level=0.8)]

    for other in (arrays, frames):
        same(other, model, Z)
        new = other.condition_on_observations(Z.numpy(), Z.numpy(), noise=torch.ones_like(Z))
        expected = model.condition_on_observations(Z, Z, noise=torch.ones_like(Z))
        same(new, expected, Z)
        # Results come as the inputs came.
        for of_array, right in zip(answers(other, Z.numpy()), answers(model, Z), strict=True):
            assert isinstance(of_array, np.ndarray)
            np.testing.assert_allclose(of_array, right.detach(), atol=1e-12)
    for of_frame, of_array in zip(*(answers(frames, z) for z in (asked, Z.numpy())), strict=True):
        assert [*of_frame.columns] == ["head [m]", "flow"]
        assert [*of_frame.index] == index
        assert np.array_equal(of_frame.to_numpy(), of_array)
    assert isinstance(frames.posterior(asked).mean, torch.Tensor)


def test_orders_integers_series_and_gaps(data, build, uniform, same):
    X, Y = data()
    frame = pd.DataFrame(X.numpy(), columns=["speed", "load"])
    model, other = build("CKA", frame, Y), frame[["load", "speed"]]
    refused(ValueError, r"\('speed', 'load'\).*order", model.predict, other)
    refused(ValueError, r"\('speed', 'load'\).*order", model.condition_on_observations, other, Y)
    whole = (10 * X).round()
    series = pd.Series(Y.squeeze(-1).numpy(), name="u")
    with pytest.raises(ValueError, match=r"train_Y.*reshape\(-1, 1\)"):
        CKA(whole.numpy().astype(int), series, physics=lambda X: 2 + X.sum(-1) / 10)
    model = CKA(whole.numpy().astype(int), series.to_frame(), physics=lambda X: 2 + X.sum(-1) / 10)
    assert model.output_names == ("u",)
    expected = CKA(whole, Y, physics=lambda X: 2 + X.sum(-1) / 10)
    Z = uniform(5, 2)
    torch.testing.assert_close(model.posterior(Z).mean, expected.posterior(Z).mean)
    X, Y = data(num_outputs=2)
    Y[3, 1] = torch.nan
    frame = pd.DataFrame(Y.numpy().astype(object)).where(~Y.isnan().numpy(), None)
    same(build("CKA", X, frame), build("CKA", X, Y), uniform(5, 2), 1e-12)


@pytest.mark.parametrize("noise", [0.04, 4, [0.04, 0.3], np.array([0.04, 0.3])], ids=str)
def test_known_noise(data, build, kind, uniform, same, noise):
    X, Y = data(num_outputs=2)
    every = torch.as_tensor(noise, dtype=torch.float64).expand(Y.shape).clone()
    same(build(kind, X, Y, noise), build(kind, X, Y, every), uniform(5, 2, high=2.0), 1e-12)


# Models from BoTorch's datasets


@pytest.fixture(autouse=True)
def _without_ax(monkeypatch):
    """As if no other test had imported Ax, beside which a physics has to be told its units."""
    monkeypatch.delitem(sys.modules, "ax", raising=False)


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_a_model_from_a_dataset(data, build, kind, num_outputs, uniform, known_noise):
    X, Y = data(num_outputs=num_outputs)
    Yvar = uniform(*Y.shape, low=0.01, high=0.1) if known_noise else None
    names = {"feature_names": ["a", "b"], "outcome_names": ["y", "z"][:num_outputs]}
    options = {} if kind == "ZeroMeanGP" else {"physics": lambda X: crude(X)[:, :num_outputs]}
    if kind == "AR1":
        options |= {"bounds": torch.tensor([[0.0, 0.0], [2.0, 2.0]]), "num_low": 12}
    options |= {"num_features": 24} if kind.startswith("RRA") else {}
    options |= {"center": 0.0} if kind in ("CKA", "RRA") else {}
    direct = build(kind, X, Y, Yvar).eval()
    made_of = direct.construct_inputs(SupervisedDataset(X, Y, **names, Yvar=Yvar), **options)
    Z = uniform(4, 2)
    p, q = type(direct)(**made_of).posterior(Z), direct.posterior(Z)
    torch.testing.assert_close(p.mean, q.mean)
    torch.testing.assert_close(p.variance, q.variance)


def test_every_option_is_taken(data, build, kind):
    X, Y = data()
    model, names = build(kind, X, Y), {"feature_names": ["a", "b"], "outcome_names": ["y"]}
    dataset = SupervisedDataset(X, Y, **names)
    names = {*signature(type(model)).parameters, *ModelOptions.__annotations__}
    options = dict.fromkeys(names - {"options", "train_X", "train_Y", "train_Yvar"})
    arguments = type(model).construct_inputs(dataset, **options)
    assert arguments.keys() == options.keys() | {"train_X", "train_Y"}
