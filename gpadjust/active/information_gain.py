"""Information of measurements about the error of the physics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.utils.transforms import concatenate_pending_points, t_batch_mode_transform
from torch import Tensor

from gpadjust.core import GP
from gpadjust.core.gaussian import Conditioning, factor
from gpadjust.core.terms import WeightedSum
from gpadjust.many import VariationalCKA

About = Literal["rho", "delta", "both"]


class qAdjustmentInformationGain(AcquisitionFunction):  # noqa: N801, as BoTorch names its own
    r"""The information of measurements at a batch of points about rho, delta, or both.

    For :math:`y(x) = \rho(x) f_p(x) + \delta(x) + \varepsilon` it is the mutual information of the
    observations at the points X and the whole function :math:`\rho`, given the data D (Lindley
    1956; MacKay 1992), in nats, written as the observations' loss of entropy (Houlsby et al. 2011):

    .. math::
        I(y(X); \rho \mid D)
        = \tfrac{1}{2} \log\det \mathrm{Cov}(y(X) \mid D)
        - \tfrac{1}{2} \log\det \mathrm{Cov}(y(X) \mid D, \rho).

    Both have a closed form. The first is the covariance of the model. As rho and delta are
    independent a priori (Kennedy and O'Hagan 2000), the second is that of a regression on delta
    alone, at the same points with the same noise S,

    .. math::
        \mathrm{Cov}(y(X) \mid D, \rho) = k_\delta(X, X)
        - k_\delta(X, D) \, (k_\delta(D, D) + S_D)^{-1} \, k_\delta(D, X) + S_X.

    About :math:`\delta` it is the same with :math:`F_p k_\rho F_p^T` in place of
    :math:`k_\delta`; about both, only the noise :math:`S_X` remains. Determinants are in units of
    the noise, and never singular.

    The acquisition needs no samples, is differentiable if f_p is, sums the information of
    independent outputs, and averages over the draws of the model's unknown numbers. Unknown
    constants are part of their functions. New observations have the noise that the model predicts;
    with known noise (``train_Yvar``), the average of the old ones.

    References:
        Kennedy and O'Hagan, Biometrika 87, 2000. Lindley, Annals of Mathematical Statistics 27,
        1956. MacKay, Neural Computation 4, 1992. Houlsby et al., arXiv:1112.5745, 2011.

    Args:
        model: A :class:`~gpadjust.CKA`, or another model with a physics and with rho or delta.
        about: ``"rho"``, ``"delta"``, or ``"both"``: all unknown functions of the model.
        X_pending: Points that are being measured, ``k x d``.

    Raises:
        TypeError: If the model has no physics, or not this adjustment. Information about unknown
            parameters of the physics is not included.
        ValueError: If ``about`` is unknown, or is ``"delta"`` for a model with a center, the
            default, as delta and rho are then not independent a priori; ``center=0.0`` has none.

    Example:
        >>> import torch
        >>> from botorch.optim import optimize_acqf
        >>> from gpadjust import CKA
        >>> train_X = torch.tensor([[0.1], [0.2], [0.9]], dtype=torch.float64)
        >>> model = CKA(train_X, 2 * train_X.exp(), physics=torch.exp)
        >>> acquisition = qAdjustmentInformationGain(model, about="rho")
        >>> bounds = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
        >>> X, value = optimize_acqf(acquisition, bounds, q=2, num_restarts=2, raw_samples=8)
    """

    def __init__(self, model: GP, about: About = "both", X_pending: Tensor | None = None) -> None:
        self._remaining_names = _remaining(model, about)
        super().__init__(model=model)
        self.about = about
        self.set_X_pending(X_pending)
        self._cached: tuple[Conditioning, Conditioning] | None = None

    @concatenate_pending_points  # type: ignore[untyped-decorator]
    @t_batch_mode_transform()  # type: ignore[untyped-decorator]
    def forward(self, X: Tensor) -> Tensor:
        """Return the information in nats, ``batch_shape``, of inputs ``batch_shape x q x d``."""
        model: Any = self.model
        conditioning = model.conditioning()
        values = conditioning.train.values
        places = model.places(X, values)
        f = model.term_sum.evaluate(values, places)
        noise = model.noise.variance(values, places)
        # log det Cov(y(X) | D) / 2
        gain = _log_sds(conditioning.joint(f)[1], noise)
        if self._remaining_names:  # minus log det Cov(y(X) | D, rho) / 2
            remaining = self._without_adjustment(conditioning)
            gain = gain - _log_sds(remaining.joint(self._part(f))[1], noise)
        return gain.sum(-1).mean(-1)  # over outputs, and over draws

    def _without_adjustment(self, conditioning: Conditioning) -> Conditioning:
        """Return the posterior of the other terms, as if the data were these terms and noise."""
        # One factorisation for all calls of an optimisation.
        if self._cached is None or self._cached[0] is not conditioning:
            train = self._part(conditioning.train)
            part = Conditioning(train, conditioning.noise, conditioning.targets)
            self._cached = (conditioning, part)
        return self._cached[1]

    def _part(self, f: WeightedSum) -> WeightedSum:
        """Return the sum of the terms outside of ``about``."""
        weights = {n: w for n, w in f.weights.items() if n in self._remaining_names}
        return replace(f, weights=weights)


def _remaining(model: Any, about: str) -> tuple[str, ...]:
    """Return the names of the terms outside of ``about``, or raise an error."""
    if about not in get_args(About):
        raise ValueError(f"Unknown {about=}; expected 'rho', 'delta' or 'both'.")
    name = type(model).__name__
    if not isinstance(model, GP) or not model.physics:
        raise TypeError(
            f"Expected a model with a physics and with rho or delta, such as CKA; found {name}. "
            "For other models take BoTorch's qNegIntegratedPosteriorVariance."
        )
    # Terms without a process, such as f_p itself, have nothing unknown.
    terms = [term for term in model.terms if term.varies]
    parts = {
        "rho": tuple(term.name for term in terms if term.physics is not None),
        "delta": tuple(term.name for term in terms if term.physics is None),
    }
    if not terms:
        raise TypeError(
            f"{name} has neither rho nor delta, and the information about parameters of the "
            "physics is not included. Take CKA, which has both."
        )
    if about == "both":
        return ()  # only noise remains
    if isinstance(model, VariationalCKA):
        raise TypeError(
            f"The inducing values of a VariationalCKA have no posterior given {about}: use "
            "about='both', or an exact CKA of some thousand points."
        )
    other = "delta" if about == "rho" else "rho"
    if not parts[about]:
        raise TypeError(f"{name} has no unknown {about}; use about={other!r}, or take CKA.")
    if about == "delta" and any(term.has_center for term in terms):
        raise ValueError(
            f"The {name} has a center of f_p, so that delta is not independent of rho a priori and "
            "its information has no closed form: use about='rho' or 'both', or build the model "
            "with center=0.0."
        )
    return parts[other]


def _log_sds(covariance: Tensor, noise: Tensor) -> Tensor:
    """Return half the log determinant of observations, in units of their noise ``... x q``."""
    # log det(I + S^-1/2 C S^-1/2) / 2 = sum_i log L_ii
    sd = noise.sqrt()
    scaled = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    one = torch.ones_like(scaled[..., 0])
    chol = factor(scaled, one, one.bool())
    return chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
