"""Gradients of predictions in X."""

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import BlackBoxPhysics
from tests.systems import crude


@pytest.mark.parametrize("black_box", [False, True], ids=["torch", "numpy"])
@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "normalize"])
def test_posterior(data, build, kind, num_outputs, uniform, black_box, normalize):
    X, Y = data(num_outputs=num_outputs)
    options = {"input_transform": Normalize(2)} if normalize else {}
    if black_box and kind != "ZeroMeanGP":
        options["physics"] = BlackBoxPhysics(
            lambda X: crude(torch.from_numpy(X))[:, :num_outputs].numpy()
        )
    model = build(kind, X, Y, **options).eval().requires_grad_(False)
    Z = uniform(3, 2, high=2.0, seed=3).requires_grad_()

    def moments(Z):
        posterior = model.posterior(Z)
        return posterior.mean, posterior.variance

    assert torch.autograd.gradcheck(moments, Z, rtol=1e-4)
    assert torch.autograd.gradcheck(model.predict, Z, rtol=1e-4)


def test_terms(data, build, kind, uniform):
    model = build(kind, *data(num_outputs=2)).eval().requires_grad_(False)
    Z = uniform(3, 2, high=2.0, seed=3).requires_grad_()
    for name in model.term_names:

        def moments(Z, name=name):
            posterior = model.term(name, Z)
            return posterior.mean, posterior.variance

        assert torch.autograd.gradcheck(moments, Z)
