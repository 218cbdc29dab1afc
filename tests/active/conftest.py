"""A laboratory: a system with two inputs, and how to look at it."""

import pytest
import torch
from botorch.acquisition import qNegIntegratedPosteriorVariance

from gpadjust import CKA
from tests.systems import measured, uniform

BOUNDS = torch.tensor([[0.0, -1.0], [2.0, 1.0]], dtype=torch.float64)


def f_p(X):
    return 2 + (2 * X[..., :1]).sin()


@pytest.fixture
def bounds():
    return BOUNDS.clone()


@pytest.fixture
def laboratory():
    """Arguments of `collect` that take little time; `laboratory(**changes)`."""
    points = BOUNDS[0] + 2 * uniform(16, 2, seed=7)

    def arguments(**changes):
        arguments = {
            "model_factory": lambda X, Y: CKA(
                X, Y, physics=lambda X: f_p(X).repeat(1, Y.shape[-1])
            ),
            "oracle": measured,
            "bounds": BOUNDS,
            "acquisition": lambda model: qNegIntegratedPosteriorVariance(model, mc_points=points),
            "budget": 7,
            "initial": 4,
            "fit": lambda model: None,  # of the loop, the priors' medians are enough
            "optimizer_options": {"num_restarts": 1, "raw_samples": 4, "options": {"maxiter": 3}},
        }
        return {**arguments, **changes}

    return arguments
