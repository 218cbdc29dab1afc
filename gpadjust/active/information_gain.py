"""Information of measurements about the error of the physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.utils.transforms import (
    average_over_ensemble_models,
    concatenate_pending_points,
    t_batch_mode_transform,
)
from torch import Tensor

from gpadjust.gp import SumOfTerms
from gpadjust.gp.gaussian import cholesky
from gpadjust.models import TermsModel, VariationalCKA
from gpadjust.models.exact_conditioning import Factors, conditional_covariance
from gpadjust.models.terms_gp import TermsGP

About = Literal["rho", "delta", "both"]
Covariance = Callable[[Tensor], Tensor]


class qAdjustmentInformationGain(AcquisitionFunction):  # noqa: N801, as BoTorch names its own
    r"""The information that measurements at a batch of points give about rho, delta, or both.

    For :math:`y(x) = \rho(x) f_p(x) + \delta(x) + \varepsilon` it is the mutual information of the
    observations at the points X and the whole function :math:`\rho`, given the data D (Lindley
    1956; MacKay 1992), in nats, written as the observations' loss of entropy (Houlsby et al. 2011):

    .. math::
        I(y(X); \rho \mid D)
        = \tfrac{1}{2} \log\det \mathrm{Cov}(y(X) \mid D)
        - \tfrac{1}{2} \log\det \mathrm{Cov}(y(X) \mid D, \rho).

    Both are known exactly. The first is the model's own. For the second, subtract the known
    :math:`\rho f_p` from all observations: what is left is
    :math:`\delta(x) + \varepsilon`, and as rho and delta are independent a priori (Kennedy and
    O'Hagan 2000), it is a regression on delta alone, at the same points with the same noise S,

    .. math::
        \mathrm{Cov}(y(X) \mid D, \rho) = k_\delta(X, X)
        - k_\delta(X, D) \, (k_\delta(D, D) + S_D)^{-1} \, k_\delta(D, X) + S_X.

    About :math:`\delta` it is the same with :math:`F_p k_\rho F_p^T` in the place of
    :math:`k_\delta`; about both, only the noise :math:`S_X` is left. Each determinant is taken in
    units of the noise, :math:`\det(I + S_X^{-1/2} C S_X^{-1/2})` for the covariance C of what is
    not noise, which is never singular. Thus

    .. math:: I(y; \rho, \delta) = I(y; \rho) + I(y; \delta \mid \rho) \geq I(y; \rho) \geq 0.

    Where :math:`f_p(x) = 0` an observation is of delta alone. It still tells about rho as far as
    it tells what delta was at measured points nearby.

    It needs no samples, is differentiable as far as f_p is, and counts independent outputs
    together. An unknown constant mean (``rho_mean="learn"``) is a part of its function. Of a model
    that holds samples of its hyper-parameters, the information is averaged over them. New
    observations are as noisy as the model thinks; with known noise (``train_Yvar``), as noisy as
    the old ones on average.

    References:
        M. C. Kennedy and A. O'Hagan, *Predicting the output from a complex computer code when fast
        approximations are available*, Biometrika 87, 2000. D. V. Lindley, *On a measure of the
        information provided by an experiment*, Annals of Mathematical Statistics 27, 1956. D. J. C.
        MacKay, *Information-based objective functions for active data selection*, Neural
        Computation 4, 1992. N. Houlsby, F. Huszar, Z. Ghahramani and M. Lengyel, *Bayesian active
        learning for classification and preference learning*, arXiv:1112.5745, 2011.

    Args:
        model: A :class:`~gpadjust.CKA`, :class:`~gpadjust.RRA`,
            :class:`~gpadjust.ScaleGP` or
            :class:`~gpadjust.PhysicsMeanGP`.
        about: ``"rho"``, ``"delta"``, or ``"both"``: all that the model does not know. Of a model
            with one of them only, ``"both"`` is about that one.
        X_pending: Points that are being measured, ``k x d``.

    Raises:
        TypeError: If the model has no such adjustment, or is no adjustment of a physics. What is
            told of unknown parameters of the physics does not count.
        ValueError: If ``about`` is unknown, or ``"delta"`` of a model with a center, as by default,
            whose delta is not independent of rho a priori; with ``center=0.0`` it is.

    Example:
        >>> import torch
        >>> from botorch.optim import optimize_acqf
        >>> from gpadjust import CKA
        >>> train_X = torch.tensor([[0.1], [0.2], [0.9]], dtype=torch.float64)
        >>> model = CKA(train_X, 2 * train_X.exp(), physics=torch.exp)
        >>> acquisition = qAdjustmentInformationGain(model, about="rho")
        >>> bounds = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
        >>> X, value = optimize_acqf(acquisition, bounds, q=2, num_restarts=2, raw_samples=8)
        >>> X.shape
        torch.Size([2, 1])
    """

    def __init__(
        self, model: TermsModel, about: About = "both", X_pending: Tensor | None = None
    ) -> None:
        _check(model, about)
        super().__init__(model=model)
        self.about = about
        self.set_X_pending(X_pending)
        self._made: tuple[Any, Covariance, Covariance | None] | None = None

    @concatenate_pending_points  # type: ignore[untyped-decorator]
    @t_batch_mode_transform()  # type: ignore[untyped-decorator]
    @average_over_ensemble_models  # type: ignore[untyped-decorator]
    def forward(self, X: Tensor) -> Tensor:
        """Return the information in nats.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            The information of each batch of ``q`` points, ``batch_shape``.
        """
        self.model.eval()
        _, whole, remaining = self._covariances()
        return information_gain(self.model, X, whole, remaining)

    def _covariances(self) -> tuple[Any, Covariance, Covariance | None]:
        """Covariance of f_a given the data, and given also the adjustment in question.

        The first entry tells of which data: they are made again after the model is given others.
        """
        model: Any = self.model
        source = model.conditioning()
        if self._made is None or self._made[0] is not source:
            whole: Covariance = (
                (lambda inputs: model.conditioning().joint(model.at(inputs))[1])
                if isinstance(model, VariationalCKA)
                else UnknownCovariance(model)
            )
            kept = {"rho": model.other_names, "delta": model.rho_names, "both": ()}[self.about]
            others = tuple(name for name in kept if name in model.term_names)
            self._made = source, whole, UnknownCovariance(model, others) if others else None
        return self._made


def _check(model: Any, about: str) -> None:
    """Raise what :class:`qAdjustmentInformationGain` raises."""
    if about not in get_args(About):
        raise ValueError(f"Unknown {about=}; expected 'rho', 'delta' or 'both'.")
    name = type(model).__name__
    if isinstance(model, TermsModel) and not model.term_names:
        raise TypeError(
            f"{name} has neither rho nor delta to learn about; what observations "
            "tell of parameters of the physics is not computed. CKA has both."
        )
    if not isinstance(model, TermsModel) or not model.rho_names:
        raise TypeError(
            f"Expected a model with rho or delta (CKA, RRA, ScaleGP, PhysicsMeanGP, BiasGP), got "
            f"{name}; for a model without them, take BoTorch's qNegIntegratedPosteriorVariance."
        )
    if about == "both":
        return
    if isinstance(model, VariationalCKA):
        raise TypeError(
            "The inducing values of a VariationalCKA do not tell what would remain unknown if "
            f"{about} were known: ask about 'both', or take an exact CKA of some thousand points."
        )
    if not set(model.rho_names if about == "rho" else ("delta",)) & set(model.term_names):
        other = "delta" if about == "rho" else "rho"
        raise TypeError(f"{name} has no unknown {about}; ask about {other!r}, or take CKA.")
    if about == "delta" and model.has_center:
        raise ValueError(
            f"The {name} takes a center from f_p (by default it is learnt), so that delta is not "
            "independent of rho a priori and its information has no closed form: ask about 'rho' "
            "or 'both', or build and fit the model with center=0.0."
        )


class UnknownCovariance:
    r"""Posterior covariance of a sum of terms, as if the data were of these and noise alone.

    With the terms' covariance K of the data, noise included, and U of new points with the data,

    .. math:: k(X, X) - U K^{-1} U^T.

    Where constant means with the bases H and the prior variances :math:`\kappa` are unknown, K is
    that without them, and :math:`R (\mathrm{diag}(\kappa)^{-1} + H^T K^{-1} H)^{-1} R^T` with
    :math:`R = H_X - U K^{-1} H` is added (Rasmussen and Williams 2006, eq. 2.42), so that vague
    priors cost no digits.

    Args:
        model: The model, in eval mode.
        names: The names of the terms. Default: all.
    """

    def __init__(self, model: TermsGP, names: tuple[str, ...] | None = None) -> None:
        conditioning = model.conditioning()
        (self.train,) = conditioning.train_inputs
        self.terms = [t for t in model.terms if names is None or t.name in names]
        self.constants = [term for term in self.terms if term.learns_mean]
        self.kernel = SumOfTerms(self.terms, known_means=True)
        self.has_kernel = any(term.kernel is not None for term in self.terms)
        if names is None and not self.constants:
            self.factors = conditioning.factors()
            return
        covariance = torch.diag_embed(conditioning.target_noise())
        if self.has_kernel:
            covariance = covariance + self.kernel.forward(self.train, self.train)
        self.factors = Factors.of(covariance, conditioning.targets)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return ``... x q x q`` without noise, at transformed inputs ``... x q x d``."""
        batch = torch.broadcast_shapes(inputs.shape[:-2], self.train.shape[:-2])
        train = self.train.expand(*batch, *self.train.shape[-2:])
        if self.has_kernel:
            prior, cross = self.kernel.forward(inputs, inputs), self.kernel.forward(inputs, train)
        else:
            q, n = inputs.shape[-2], self.train.shape[-2]
            prior, cross = inputs.new_zeros(*batch, q, q), inputs.new_zeros(*batch, q, n)
        white = self.factors.whiten(cross)
        covariance = conditional_covariance(prior, white)
        if not self.constants:
            return covariance
        # In units of the constants' prior, where the matrix to invert is at least the identity.
        known = self.factors.whiten(self._columns(self.train).mT)
        rest = self._columns(inputs) - white @ known.mT
        identity = torch.eye(known.shape[-2], dtype=known.dtype, device=known.device)
        chol = torch.linalg.cholesky(identity + known @ known.mT)
        root = torch.linalg.solve_triangular(chol, rest.mT, upper=False)
        return covariance + root.mT @ root

    def _columns(self, inputs: Tensor) -> Tensor:
        """The constants' bases, for a prior variance of one, ``... x q x k``."""
        columns: Any = self.kernel.basis_of_means(inputs)
        return columns * torch.stack([t.mean_variance.sqrt() for t in self.constants], dim=-1)


def information_gain(
    model: TermsModel,
    X: Tensor,
    unknown: Covariance,
    remaining: Covariance | None = None,
    counted: Tensor | None = None,
) -> Tensor:
    r"""The information of noisy observations at a batch of points, in nats.

    With the covariance C of what is unknown at the points X and the noise variances S it is
    :math:`\tfrac{1}{2} \log\det(I + S^{-1/2} C S^{-1/2})`, which is never singular, less the same
    for what would remain unknown; summed over the independent outputs.

    Args:
        model: The model, in eval mode.
        X: Raw inputs, ``batch_shape x q x d``.
        unknown: The covariance given the data.
        remaining: The covariance if the function in question were known, too. Default: none.
        counted: Which observations are made, ``batch_shape x q`` booleans. Default: all.

    Returns:
        The information, ``batch_shape``; of a model that holds samples of its hyper-parameters, of
        each of these, ``batch_shape x S``.
    """
    inputs = model.model_inputs(X)
    (train,) = model.conditioning().train_inputs
    batch_shape = torch.broadcast_shapes(inputs.shape[:-2], train.shape[:-2])
    inputs = inputs.expand(*batch_shape, *inputs.shape[-2:])
    noise = model.observation_noise(inputs).expand(inputs.shape[:-1])
    if counted is not None:
        for _ in range(noise.dim() - counted.dim()):
            counted = counted.unsqueeze(-2)
        noise = noise.masked_fill(~counted, torch.inf)  # such an observation tells nothing
    information = _log_sds(unknown(inputs), noise)
    if remaining is not None:
        information = information - _log_sds(remaining(inputs), noise)
    return information.sum(-1) if model.num_outputs > 1 else information


def _log_sds(covariance: Tensor, noise: Tensor) -> Tensor:
    """Half the log-determinant of noisy observations' covariance, in units of their noise."""
    sd = noise.sqrt()
    identity = torch.eye(sd.shape[-1], dtype=sd.dtype, device=sd.device)
    matrix = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2)) + identity
    chol, info = torch.linalg.cholesky_ex(matrix)
    if info.any():
        # What rounding leaves of a covariance far above the noise. Elsewhere the eigenvalues are 1
        # or more, and a nugget would be taken for information.
        failed = (info > 0)[..., None, None]
        sound = torch.linalg.cholesky(torch.where(failed, identity, matrix))
        chol = torch.where(failed, cholesky(matrix)[0], sound)
    log_sds: Tensor = chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    return log_sds
