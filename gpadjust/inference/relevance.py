"""Use of a physics: the same model without it, weighed by its evidence."""

from __future__ import annotations

import math
from copy import deepcopy

import torch
from torch import Tensor

from gpadjust.gp import AppendedPhysics, Term
from gpadjust.models import TermsGP
from gpadjust.models.parameters import Hyperparameter, hyperparameters

_DOUBT = 0.2  # prior probability that a physics is of no use
_NONE = 1e-20  # variance of a rho that is switched off, in its typical size


def is_scaled(term: Term) -> bool:
    """Return whether a term is a function that scales a physics."""
    return isinstance(term.basis, AppendedPhysics) and term.kernel is not None


@torch.no_grad()
def without_physics(model: TermsGP) -> TermsGP | None:
    r"""A model with the physics switched off, :math:`\rho = 0`, or None if it has no such part.

    It is a Gaussian process of the same parameters around the mean of the targets: of a sum of
    functions that scale a physics and one :math:`\delta`, whose priors are the default ones.
    """
    scaled = [term for term in model.terms if is_scaled(term)]
    rest = [term for term in model.terms if not is_scaled(term) and term.scaled_by is None]
    is_plain = bool(rest) and all(t.basis is None and t.kernel is not None for t in rest)
    if not (scaled and is_plain) or any(term.learns_mean for term in model.terms):
        return None
    centers = [term.basis for term in scaled if term.basis.learns_center]
    if any(basis.learnt is None and basis.center.any() for basis in centers):
        return None
    other = deepcopy(model)
    rows = _of_scaled(other)
    sizes = [row for row in rows if row.kind == "scaling"]
    learnt = [row for row in rows if row.raw.requires_grad]
    if len(sizes) != len(scaled) or not all(row.is_free for row in sizes):
        return None
    if next(iter(model.named_priors()), None) is not None or len(learnt) < len(rows):
        return None
    for row in rows:
        row.raw.requires_grad_(False)
        if row.kind == "scaling":
            row.raw.copy_(row.to_raw(row.log_of(torch.full_like(row.raw, _NONE))))
    mean = model.train_targets.nanmean(-1, keepdim=True)
    for term in other.terms:
        term.mean.copy_(mean if term.name == rest[0].name else torch.zeros_like(mean))
        term.given_mean.copy_(term.mean)  # of which typical sizes are
        if is_scaled(term) and term.basis.learns_center:
            term.basis.center.zero_()  # or it would move the mean
    return other


def _of_scaled(model: TermsGP) -> list[Hyperparameter]:
    """The rows of the hyper-parameters of functions that scale a physics."""
    own = {id(p) for t in model.terms if is_scaled(t) for p in t.parameters()}
    rows = [row for row in hyperparameters(model) if id(row.raw) in own]
    return [row for row in rows if row.kind != "other"]


def probability(log_evidence: Tensor, without: Tensor, away: Tensor | float = 0.0) -> Tensor:
    """Posterior probability that the physics is of use, of log evidences with and without it.

    The model without has a constant for free. The other draws it from a distribution as wide as
    the constant itself, which costs the logarithm of that over the width of what varies.

    Args:
        log_evidence: Of the model with its physics.
        without: Of that without.
        away: The constant between targets and their prior mean, in spreads of the targets. Below
            one it cannot be separated from the variation.
    """
    constant = torch.as_tensor(away).nan_to_num(nan=1.0, posinf=1.0).clamp_min(1.0).log()
    return (log_evidence - without + constant + math.log(1 / _DOUBT - 1)).sigmoid()


@torch.no_grad()
def mixed(
    samples: dict[str, Tensor],
    others: dict[str, Tensor],
    model: TermsGP,
    without: TermsGP,
    share: Tensor,
) -> dict[str, Tensor]:
    """Samples of a model of which the last ones have the physics switched off.

    Args:
        samples: Raw parameters of the model, ``S x`` their shape, by name.
        others: Of the model without physics.
        model: The model.
        without: That without physics.
        share: Of the samples that are the model's, ``batch_shape x (m)``.
    """
    (number,) = {len(values) for values in samples.values()}
    kept = (number * share).round()
    steps = torch.arange(number, device=share.device).reshape(-1, *[1] * share.dim())
    is_on = steps < kept
    named = dict(model.named_parameters()), dict(without.named_parameters())
    means = [f"covar_module.terms.{i}.mean" for i in range(len(model.terms))]
    found = {}
    for name in (*samples, *means):
        on, off = (
            given.get(name, own[name].detach().expand(number, *own[name].shape))
            for given, own in zip((samples, others), named, strict=True)
        )
        which = is_on.reshape(*is_on.shape, *[1] * (on.dim() - is_on.dim()))
        found[name] = torch.where(which, on, off)
    return found
