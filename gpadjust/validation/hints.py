"""Hints at data of a kind that a model was not told of, each a sentence with the way out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.models import StackedGP, TermsGP
from gpadjust.validation.leave_one_out import LeaveOneOut

_ENOUGH = 12  # observations from which on residuals can say something
_FAR = 6.0  # robust standard deviations of residuals, beyond which one is an outlier
_MISSED = 2.5  # and that many of its own predicted ones
_CHANCE = 1e-3  # of residuals that grow with the mean where the noise does not
_GROWTH = 3.0  # of their typical size, from the third of least to that of largest means
_NOISE = 0.3  # share of the noise in predictions, from which on residuals tell of the noise
_BELOW = 0.1  # share of intervals that reach below zero
_DECADES = 1000.0  # ratio of an output's ends from which on it spans decades
_LEVELS = range(3, 13)  # numbers of different values that may be categories


def hints(model: TermsGP | StackedGP, loo: LeaveOneOut) -> list[str]:
    """What the data look like that the model was not told, in sentences with the option to give.

    Outliers, noise that grows with the mean, outputs that cannot be negative, columns that may be
    categories. Each is a question rather than a finding, as residuals of few observations tell
    little; of fewer than 12 they are not asked.

    Args:
        model: A fitted model, or a mixture.
        loo: Its predictions of left-out observations.
    """
    told, found = told_of(model), []
    growing = {"relative", "link"} & told.keys()  # errors may grow
    with torch.no_grad():
        noise = model.predict(loo.X, observation_noise=True).variance
        noise = (noise - model.predict(loo.X).variance).clamp_min(0) / loo.variance
    for j, name in enumerate(model.output_names):
        where = f"{name}: " if len(model.output_names) > 1 else ""
        seen = ~loo.Y[:, j].isnan()
        Y, mean, variance = (each[seen, j] for each in (loo.Y, loo.mean, loo.variance))
        own: list[str] = []
        if len(Y) >= _ENOUGH:
            z = loo.residuals[seen, j]
            grows = float(noise[seen, j].median()) > _NOISE and _grows(z.abs(), mean.abs())
            if grows and not growing:
                own.append(_GROWS)
            elif "heavy-tailed" not in told:
                own += _outliers(z)
        if not growing:
            own += _positive(Y, mean, variance)
        found += [where + sentence for sentence in own]
    return [*found, *_categories(model, loo.X, told)]


def told_of(model: TermsGP | StackedGP) -> dict[str, Any]:
    """The kinds of data that a model was told of: names of likelihoods, ``train_Yvar``, ``link``.

    The values are what it was told: variances, the link, the categories.
    """
    one: Any = model.parts[0][0].model if isinstance(model, StackedGP) else model
    given = {name: value for name, value in one.options.items() if value is not None}
    given |= dict.fromkeys(one.objects)
    likelihood = given.pop("likelihood", ())
    names = [likelihood] if isinstance(likelihood, str) else likelihood
    found: dict[str, Any] = dict.fromkeys(names or (), True)
    found |= {name: v for name, v in one.data().items() if name.endswith("var") and v is not None}
    if getattr(one, "link", None) is not None:
        found["link"] = one.link
    if one.levels:
        found["categorical"] = [one.input_names[i] for i in one.levels]
    return found


_GROWS = (
    "Left-out residuals grow with the size of the prediction: is the noise relative? Then give "
    "likelihood='relative' (--noise relative)."
)


def _grows(size: Tensor, mean: Tensor) -> bool:
    """Return whether residuals, in units of their predictions, grow with the mean."""
    from scipy.stats import spearmanr  # slow to import

    order = mean.argsort()
    third = len(order) // 3
    low, high = size[order[:third]].median(), size[order[-third:]].median()
    rank = spearmanr(size.numpy(), mean.numpy())
    grows: bool = rank.statistic > 0 and rank.pvalue < _CHANCE and bool(high > _GROWTH * low)
    return grows


def _outliers(z: Tensor) -> list[str]:
    """A sentence on observations far from their predictions, as most residuals are."""
    spread = 1.4826 * (z - z.median()).abs().median()
    count = int(((z.abs() > _FAR * spread) & (z.abs() > _MISSED)).sum())
    if not count:
        return []
    some = "1 observation is" if count == 1 else f"{count} observations are"
    return [
        f"{some} farther from the prediction of the others than {_FAR:.0f} standard deviations of "
        "most residuals: an outlier? Look at it; if such things happen, give "
        "likelihood='heavy-tailed' (--outliers)."
    ]


def _positive(Y: Tensor, mean: Tensor, variance: Tensor) -> list[str]:
    """A sentence on a positive output over decades, or with intervals that reach below zero."""
    if not len(Y) or (Y <= 0).any():
        return []
    way = "give outcome_transform='log' (--positive)"
    if Y.max() >= _DECADES * Y.min():
        decades = float((Y.max() / Y.min()).log10())
        return [
            f"The output is positive and spans {decades:.1f} decades, so that its largest values "
            f"decide scale and noise: if errors are relative, {way}."
        ]
    below = int((mean < 1.96 * variance.sqrt()).sum())
    if below < max(2, _BELOW * len(Y)):
        return []
    return [
        f"All observations are positive, but {below} of {len(Y)} left-out intervals reach below "
        f"zero: if the output cannot be negative, {way}."
    ]


def _categories(model: Any, X: Tensor, told: dict[str, Any]) -> list[str]:
    """A sentence on each column of few whole numbers, such as the number of a rig."""
    found = []
    for name, x in zip(model.input_names, X.unbind(-1), strict=True):
        values = x.unique()
        first = int(values[0]) if len(values) in _LEVELS else -1
        numbered = first in (0, 1) and torch.equal(values, first + torch.arange(len(values)).to(x))
        if numbered and len(x) >= 3 * len(values) and "categorical" not in told:
            bare = name.partition(" [")[0]
            found.append(
                f"{name} has {len(values)} different values, {first} to {int(values[-1])}: if they "
                f"are names rather than sizes, as of rigs, give categorical=[{name!r}] "
                f"(--categories {bare})."
            )
    return found
