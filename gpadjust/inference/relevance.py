"""Use of a physics: the same model without it, and it alone, weighed by their evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy

import torch
from torch import Tensor

from gpadjust.gp import AppendedPhysics, Term
from gpadjust.models import TermsGP
from gpadjust.models.hyperparameter_samples import NONE
from gpadjust.models.parameters import SIZES, hyperparameters

ADJUSTED, WITHOUT, ALONE = "adjusted", "without", "alone"
_PRIOR = {ADJUSTED: 0.32, WITHOUT: 0.08, ALONE: 0.6}
_MOST_ALONE = 0.75  # of the samples: those of the physics alone learn from no later observation


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
    if not _switched_off(other, [term for term in other.terms if is_scaled(term)]):
        return None
    mean = model.train_targets.nanmean(-1, keepdim=True)
    for term in other.terms:
        term.mean.copy_(mean if term.name == rest[0].name else torch.zeros_like(mean))
        term.given_mean.copy_(term.mean)  # of which typical sizes are
        if is_scaled(term) and term.basis.learns_center:
            term.basis.center.zero_()  # or it would move the mean
    return other


@torch.no_grad()
def alone(model: TermsGP) -> TermsGP | None:
    r"""A model with its functions switched off: rho and delta are their prior means.

    It is the physics and noise; None of a model that has no physics in its mean, other functions
    than rho and one delta, or functions whose priors are not the default ones.
    """
    with_physics = [term for term in model.terms if isinstance(term.basis, AppendedPhysics)]
    if not with_physics or any(term.learns_mean for term in model.terms):
        return None
    other = deepcopy(model)
    functions = [term for term in other.terms if term.kernel is not None]
    if any(not is_scaled(term) and term.basis is not None for term in functions):
        return None
    if not functions or not all((term.given_mean != 0).all() for term in with_physics):
        return None
    if not _switched_off(other, functions):
        return None
    rows = hyperparameters(other)
    if not any(row.raw.requires_grad for row in rows):  # of known noise: one that changes nothing
        next(row for row in rows if row.kind == "lengthscale").raw.requires_grad_(True)
    return other


def _switched_off(model: TermsGP, terms: Sequence[Term]) -> bool:
    """Fix functions of a model at next to nothing, if their hyper-parameters are the default's."""
    own = {id(p) for term in terms for p in term.parameters()}
    rows = [row for row in hyperparameters(model) if id(row.raw) in own]
    rows = [row for row in rows if row.kind != "other"]
    sizes = [row for row in rows if row.kind in SIZES]
    if len(sizes) != len(terms) or not all(row.is_free for row in sizes):
        return False
    if next(iter(model.named_priors()), None) is not None:
        return False
    if not all(row.raw.requires_grad for row in rows):
        return False
    for row in rows:
        row.raw.requires_grad_(False)
        if row in sizes:
            row.raw.copy_(row.to_raw(row.log_of(torch.full_like(row.raw, NONE))))
    return True


def probabilities(
    log_evidences: Mapping[str, Tensor], away: Tensor | float = 0.0
) -> dict[str, Tensor]:
    """Posterior probabilities of models by their log evidences.

    The model without its physics has a constant for free. The others have to explain it, which
    costs the logarithm of its size over the width of what varies, and is given back to them.

    Args:
        log_evidences: Of the model that adjusts its physics, of that without it, and of the
            physics alone, or of some of these.
        away: The constant between targets and their prior mean, in spreads of the targets. Below
            one it cannot be separated from the variation.
    """
    constant = torch.as_tensor(away).nan_to_num(nan=1.0, posinf=1.0).clamp_min(1.0).log()
    found = [
        torch.as_tensor(_PRIOR[name]).log() + evidence + (0 if name == WITHOUT else constant)
        for name, evidence in log_evidences.items()
    ]
    shares = torch.stack(torch.broadcast_tensors(*found)).softmax(0)
    return dict(zip(log_evidences, shares, strict=True))


def held(shares: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Shares of the samples that a model holds, by the probabilities of models.

    At least a quarter is of those that have functions.
    """
    if ALONE not in shares:
        return dict(shares)
    most = shares[ALONE].clamp_max(_MOST_ALONE)
    rest = (1 - most) / (1 - shares[ALONE]).clamp_min(torch.finfo(most.dtype).tiny)
    found = {name: each * rest for name, each in shares.items()} | {ALONE: most}
    # Where nothing is left of the others, it is the adjusted model.
    left = (1 - torch.stack([*found.values()]).sum(0)).clamp_min(0.0)
    return found | {ADJUSTED: found[ADJUSTED] + left}


@torch.no_grad()
def mixed(parts: Sequence[tuple[dict[str, Tensor], TermsGP]], which: Tensor) -> dict[str, Tensor]:
    """Samples of a model of which some have functions switched off.

    Args:
        parts: Raw parameters, ``S x`` their shape, by name, and the model that they are of: first
            of the model itself, then of those that have some of its parameters switched off.
        which: The part that each sample is of, ``S x batch_shape x (m)``.
    """
    (samples, model), number = parts[0], len(which)
    named = [dict(own.named_parameters()) for _, own in parts]
    means = [f"covar_module.terms.{i}.mean" for i in range(len(model.terms))]
    found = {}
    for name in (*samples, *means):
        every = [
            given.get(name, own[name].detach().expand(number, *own[name].shape))
            for (given, _), own in zip(parts, named, strict=True)
        ]
        chosen = every[0]
        for i, values in enumerate(every[1:], 1):
            is_own = (which == i).reshape(*which.shape, *[1] * (values.dim() - which.dim()))
            chosen = torch.where(is_own, values, chosen)
        found[name] = chosen
    return found
