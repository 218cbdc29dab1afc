"""What an adjusted physics says of rho, delta and its physics."""

from __future__ import annotations

from typing import Any

import torch
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from torch import Tensor

from gpadjust.gp import AppendedPhysics, PhysicsInput
from gpadjust.models.cholesky_strategy import Weights
from gpadjust.models.physics_parameters import PhysicsParameters
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import ArrayLike
from gpadjust.physics import Physics


class AdjustedModel(TermsModel):
    r"""A model of :math:`f_a(x) = \sum_i \rho_i(x) f_i(x) + \delta(x)`: its terms in users' words.

    The terms that scale a physics are the rhos; with a centre c, :math:`f_p - c` is what they
    scale, and :math:`\delta = \delta_0 - \sum_i c_i \rho_i` for the model's own term
    :math:`\delta_0`.
    """

    input_transform: Any

    @property
    def physics(self) -> Physics:
        """The physics f_p; of several, all of them side by side."""
        physics: Physics = self.input_transform.physics
        return physics

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """What the model knows of the unknown parameters of the physics.

        Raises:
            ValueError: If the physics has none.
        """
        return PhysicsParameters.of(self.input_transform if self.has_unknowns else None)

    @property
    def rho_names(self) -> tuple[str, ...]:
        """The names of the terms that scale a physics, one for each physics."""
        return tuple(t.name for t in self.terms if isinstance(t.basis, AppendedPhysics))

    @property
    def other_names(self) -> tuple[str, ...]:
        """The names of the other terms: delta, and those of a structure of your own."""
        return tuple(t.name for t in self.terms if not isinstance(t.basis, AppendedPhysics))

    def rho(self, X: ArrayLike, physics: str | int | None = None) -> Posterior:
        r"""The posterior of the scaling :math:`\rho` at ``X``; f_p is not evaluated there.

        After the default fit rho and delta apart are far less certain than their sum: observations
        are of the sum alone, and how much of it is rho's depends on centre and sizes, which few
        data tell.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            physics: Which of several physics, by its name or number.

        Returns:
            A posterior over ``batch_shape x q x m``, without units.

        Raises:
            ValueError: If the model has no such rho.
        """
        return self.term(self.rho_name(physics), X)

    def delta(self, X: ArrayLike) -> Posterior:
        r"""The posterior of the bias :math:`\delta`, in the targets' units; as :meth:`rho`.

        Like rho it is far less certain than their sum.
        """
        return self.term("delta", X)

    def rho_name(self, physics: str | int | None = None) -> str:
        """The name of the term that scales a physics, which is given by name or number."""
        names = self.rho_names
        if not names:
            raise ValueError(f"{type(self).__name__} has no rho, as it has no physics.")
        short = [name.removeprefix("rho_") for name in names]
        if physics is None and len(names) == 1:
            return names[0]
        if isinstance(physics, int) and -len(names) <= physics < len(names):
            return names[physics]
        if physics in (*names, *short):
            return names[(*names, *short).index(physics) % len(names)]
        raise ValueError(
            f"Expected physics to be one of {', '.join(short)}, or a number from 0 to "
            f"{len(names) - 1}, got {physics!r}."
        )

    def term_mean(self, name: str, output: int = 0) -> float:
        """The prior mean of a term, to which it falls back far from the data.

        Of a model that holds samples of its hyper-parameters, or a batch, that of the first.
        """
        shift, scale = self._term_units(name)
        mean = self._prior_mean(self.train_inputs[0], self._term_weights(name, or_known=True))
        return float((mean[..., :1] * scale + shift).reshape(-1, self.num_outputs)[0, output])

    def fallback(self, X: ArrayLike) -> Tensor:
        """What the model says where there are no data: its prior mean, such as f_p itself.

        Weights of the physics that are unknown (``rho_mean="learn"``) are those it began with, 1,
        or least squares of several; after a point fit they are its estimates.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            ``batch_shape x q x m``, in the units of the targets.
        """
        inputs = self.model_inputs(X)
        shift, scale = self._units()
        values = self._prior_mean(inputs, self._bases(inputs)) * scale + shift
        # The same for all samples of hyper-parameters but for rounding.
        values = self._outputs_last(values)
        return values if self.num_samples is None else values.mean(MCMC_DIM)

    def _inputs_without_basis(self, X: Tensor) -> Tensor:
        transform = getattr(self, "input_transform", None)
        if isinstance(transform, PhysicsInput):
            return transform.without_physics(X)
        return super()._inputs_without_basis(X)

    def _term_weights(self, name: str, or_known: bool = False) -> Weights:
        weights = super()._term_weights(name, or_known)
        for term in self.terms if name == "delta" else ():
            if not isinstance(term.basis, AppendedPhysics):
                continue
            if term.basis.learns_center or term.basis.offset.any():
                weights.append((term, -term.basis.origin / term.basis.scale))
        return weights

    def _term_units(self, name: str) -> tuple[Tensor, Tensor]:
        shift, scale = super()._term_units(name)
        if name in self.rho_names:
            return shift, torch.ones_like(scale)
        if name in ("delta", "f"):
            return self._units()  # the shift of the targets is taken from the bias
        return shift, scale
