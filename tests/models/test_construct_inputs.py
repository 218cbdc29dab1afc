"""Models from BoTorch's datasets."""

import sys
from inspect import signature

import pytest
import torch
from botorch.utils.datasets import SupervisedDataset

from gpadjust.models.term_builder import ModelOptions
from tests.systems import crude


@pytest.fixture(autouse=True)
def _without_ax(monkeypatch):
    """As if no other test had imported Ax, beside which a physics has to be told its units."""
    monkeypatch.delitem(sys.modules, "ax", raising=False)


@pytest.mark.parametrize("known_noise", [False, True], ids=["learnt", "known"])
def test_a_model_from_a_dataset(data, build, kind, num_outputs, uniform, known_noise):
    X, Y = data(num_outputs=num_outputs)
    Yvar = uniform(*Y.shape, low=0.01, high=0.1) if known_noise else None
    dataset = SupervisedDataset(
        X, Y, feature_names=["a", "b"], outcome_names=["y", "z"][:num_outputs], Yvar=Yvar
    )
    options = {}
    if kind != "ZeroMeanGP":
        options["physics"] = lambda X: crude(X)[:, :num_outputs]
    if kind == "AR1":
        options |= {"bounds": torch.tensor([[0.0, 0.0], [2.0, 2.0]]), "num_low": 12}
    if kind.startswith("RRA"):
        options["num_features"] = 24
    if kind in ("CKA", "RRA"):
        options["center"] = 0.0
    direct = build(kind, X, Y, Yvar).eval()
    model = type(direct)(**type(direct).construct_inputs(dataset, **options)).eval()
    Z = uniform(4, 2)
    p, q = model.posterior(Z), direct.posterior(Z)
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
