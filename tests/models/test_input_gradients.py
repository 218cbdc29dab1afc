"""Gradients of predictions in X."""

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import BlackBoxPhysics


def differences(function, X, step=1e-5):
    """Central differences of a function whose rows depend on their own row of X only."""
    columns = []
    for i in range(X.shape[-1]):
        shift = torch.zeros_like(X)
        shift[..., i] = step
        columns.append((function(X + shift) - function(X - shift)) / (2 * step))
    return torch.stack(columns, dim=-1)


@pytest.mark.parametrize("black_box", [False, True], ids=["torch", "numpy"])
@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "normalize"])
@pytest.mark.parametrize("moment", ["mean", "variance"])
def test_posterior(
    data, build, kind, num_outputs, crude_physics, uniform, black_box, normalize, moment
):
    X, Y = data(num_outputs=num_outputs)
    options = {"input_transform": Normalize(2)} if normalize else {}
    if black_box and kind != "ZeroMeanGP":
        options["physics"] = BlackBoxPhysics(
            lambda X: crude_physics(torch.from_numpy(X))[:, :num_outputs].numpy()
        )
    model = build(kind, X, Y, **options).eval()
    Z = uniform(5, 1, 2, high=2.0, seed=3)

    def function(Z):
        return getattr(model.posterior(Z), moment).sum(-1)

    leaf = Z.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf).sum(), leaf)
    with torch.no_grad():
        expected = differences(function, Z)
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-6)


def test_terms(data, build, kind, uniform):
    model = build(kind, *data(num_outputs=2)).eval().requires_grad_(False)
    Z = uniform(3, 2, high=2.0, seed=3).requires_grad_()
    for name in model.term_names:

        def moments(Z, name=name):
            posterior = model.term(name, Z)
            return posterior.mean, posterior.variance

        assert torch.autograd.gradcheck(moments, Z)
