"""SMT's multi-fidelity kriging, as its users run it."""

from __future__ import annotations

import torch
from botorch.posteriors import GPyTorchPosterior
from gpytorch.distributions import MultivariateNormal
from linear_operator.operators import DiagLinearOperator
from smt.applications import MFK
from torch import Tensor

_LEAST_VARIANCE = 1e-300  # SMT's may round to zero, which has no density


class SMTModel:
    """MFK with its defaults, trained, with BoTorch's way to ask for predictions.

    Args:
        low_X: Inputs of the low level, ``n_1 x d``, among them those of the high one.
        low_Y: Its values, ``n_1 x 1``.
        train_X: Inputs of the high level, ``n x d``.
        train_Y: Its values, ``n x 1``.
    """

    def __init__(self, low_X: Tensor, low_Y: Tensor, train_X: Tensor, train_Y: Tensor) -> None:
        self.mfk = MFK(print_global=False)
        self.mfk.set_training_values(low_X.numpy(), low_Y.numpy(), name=0)
        self.mfk.set_training_values(train_X.numpy(), train_Y.numpy())
        self.mfk.train()

    def posterior(self, X: Tensor, observation_noise: bool = False) -> GPyTorchPosterior:
        """Independent predictions at ``q x d`` inputs; the model has no observation noise."""
        mean = torch.as_tensor(self.mfk.predict_values(X.numpy())).squeeze(-1)
        variance = torch.as_tensor(self.mfk.predict_variances(X.numpy())).squeeze(-1)
        covariance = DiagLinearOperator(variance.clamp_min(_LEAST_VARIANCE))
        return GPyTorchPosterior(MultivariateNormal(mean, covariance))
