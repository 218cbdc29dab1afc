"""Fitting the models of data that grow, each from where the one before it was."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust.dynamics.learnt import Learnt
from gpadjust.dynamics.model_recipe import ModelRecipe
from gpadjust.dynamics.transitions import Transitions
from gpadjust.inference import FitResult, fit
from gpadjust.inference.fitting import FitOptions, check_options
from gpadjust.inference.objective import Objective
from gpadjust.inference.warm_start import warm_start
from gpadjust.models import ExactGPBase
from gpadjust.states import StateSpec

_SEARCHED = 128  # points that a search is made on; more would tell the same, and take longer
_SEARCH = FitOptions(num_screened=64, num_starts=4, max_iterations=30)
_REFIT = FitOptions(num_screened=0, num_starts=1, max_iterations=15)


def checked_fit_options(options: FitOptions | None) -> FitOptions:
    """The options of the first fit, once they are found to be right."""
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(
            f"Expected fit_options as a dictionary of options of gpadjust.fit, found {options!r}."
        )
    if "method" in (options or {}):
        raise ValueError(
            "Dynamics are fitted by method 'map', a point estimate that each update goes on from; "
            "leave 'method' out of fit_options. For full Bayes, fit a model of the targets itself."
        )
    check_options("map", {**(options or {})})
    return {**(options or {})}


class Fitted(NamedTuple):
    """A fitted model.

    Args:
        model: The model.
        result: What the last fit has reached.
        searched_at: The number of transitions at the last search of the hyper-parameters.
    """

    model: ExactGPBase
    result: FitResult
    searched_at: int


def fit_all(
    recipe: ModelRecipe, data: Transitions, previous: Learnt | None, options: FitOptions
) -> Fitted:
    """Fit a model of all transitions, from where the one before it was.

    Args:
        recipe: Builds the model.
        data: All transitions, earlier ones first.
        previous: What was learnt from earlier ones, or None for a full search.
        options: Of this search.
    """
    n, observed = len(data.states), check_observed(recipe.targets.spec, data)
    model = recipe.build(data, quiet=previous is not None)
    if previous is None:
        return Fitted(model, fit(model, **options), n)
    searches = n >= 2 * previous.searched_at
    rows = search_rows(observed) if searches else None
    part = None if rows is None else recipe.build(data.some(rows), quiet=True)
    result = refit(model, previous.model, searches, part)
    return Fitted(model, result, n if searches else previous.searched_at)


def check_observed(spec: StateSpec, data: Transitions) -> Tensor:
    """Which outputs were observed in each transition, ``n x m``; an error if they are too few."""
    observed = ~data.next_states[:, spec.predicted].isnan()
    least, i = observed.sum(0).min(0)
    if least < 2:
        name = spec.states[spec.predicted[i]]
        of = "" if len(observed) < 2 else f" with a measured {name!r}"
        raise ValueError(
            f"Expected at least 2 transitions to learn from, got {least}{of}: there is no scale in "
            "fewer. Collect more before the first update."
        )
    return observed


def search_rows(observed: Tensor) -> Tensor | None:
    """The points of the model that a search is made on; None for all.

    Args:
        observed: Which outputs were observed at each point, ``n x m``.
    """
    num_points = len(observed)
    if num_points <= _SEARCHED:
        return None
    generator = torch.Generator().manual_seed(num_points)
    order = torch.randperm(num_points, generator=generator)
    observed = observed[order]
    # The model of these points needs two observations of each output, however seldom they are.
    needed = (observed & (observed.cumsum(0) <= 2)).any(-1)
    return torch.cat([order[needed], order[~needed]])[:_SEARCHED]


def refit(
    model: ExactGPBase, previous: ExactGPBase, searches: bool, part: ExactGPBase | None
) -> FitResult:
    """Fit a model from where an earlier one was, and from a new search if there is one.

    Args:
        model: The model to fit, in place.
        previous: The model with the hyper-parameters to start from.
        searches: Whether to search for better ones first.
        part: The model of the points at :func:`search_rows`, or None if these are all.
    """
    warm_start(model, previous)
    with warnings.catch_warnings():
        # The next update goes on from where this one stops.
        warnings.simplefilter("ignore", OptimizationWarning)
        if searches:
            _search(model, part)
        return fit(model, "map", **_REFIT)


def _search(model: ExactGPBase, part: ExactGPBase | None) -> None:
    """Give a model the best hyper-parameters of its own and those of a new search."""
    if part is None:
        fit(model, "map", **_SEARCH)
        return
    warm_start(part, model)
    fit(part, "map", **_SEARCH)
    objective = Objective(model)
    before = objective.parameters.current()
    warm_start(model, part)
    after = objective.parameters.current()
    better = objective(after) < objective(before)
    objective.assign(torch.where(better.unsqueeze(-1), after, before)[0])
