"""Fitting the models of data that grow, each from where the one before it was."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust.dynamics.learnt import Learnt
from gpadjust.dynamics.model_recipe import ModelRecipe
from gpadjust.dynamics.transitions import Transitions
from gpadjust.inference import FitOptions, FitResult, SampleResult, fit
from gpadjust.inference.fitting import check_options
from gpadjust.inference.warm_start import warm_start
from gpadjust.models import TermsModel
from gpadjust.states import StateSpec

_SEARCH = FitOptions(num_screened=64, num_starts=4, max_iterations=30)
_REFIT = FitOptions(num_screened=0, num_starts=1, max_iterations=15)


class DynamicsFitOptions(FitOptions, total=False):
    """The options of :func:`gpadjust.fit` for dynamics, the method among them."""

    method: str | None


def kept(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that later fits have, too: all but those of the first search."""
    return {name: value for name, value in options.items() if name not in _REFIT}


def checked_fit_options(
    options: DynamicsFitOptions | None, model: type[TermsModel]
) -> DynamicsFitOptions:
    """The options of the first fit, once they are found to be right."""
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(
            f"Expected fit_options as a dictionary of options of gpadjust.fit, found {options!r}."
        )
    own: Any = {**(options or {})}
    method = own.pop("method", None)
    if model.not_sampled:
        if method == "bayes":
            raise ValueError(model.not_sampled)
        method = method or "map"
    check_options("bayes" if method is None else method, own)
    return {**(options or {})}


class Fitted(NamedTuple):
    """A fitted model.

    Args:
        model: The model.
        result: What the last fit has reached.
        searched_at: The number of transitions at the last search of the hyper-parameters.
    """

    model: TermsModel
    result: FitResult | SampleResult
    searched_at: int


def fit_all(
    recipe: ModelRecipe, data: Transitions, previous: Learnt | None, options: DynamicsFitOptions
) -> Fitted:
    """Fit a model of all transitions, from where the one before it was.

    Args:
        recipe: Builds the model.
        data: All transitions, earlier ones first.
        previous: What was learnt from earlier ones, or None for a full search.
        options: Of this search; of later ones the method and what it holds.
    """
    n = len(data.states)
    observed_outputs(recipe.targets.spec, data)
    model = recipe.build(data, quiet=previous is not None)
    given: Any = options
    if previous is None:
        return Fitted(model, fit(model, **given), n)
    warm_start(model, previous.model)
    searches = n >= 2 * previous.searched_at
    held: Any = kept(given)
    with warnings.catch_warnings():
        # The next update goes on from where this one stops.
        warnings.simplefilter("ignore", OptimizationWarning)
        result = fit(model, **held, **(_SEARCH if searches else _REFIT))
    return Fitted(model, result, n if searches else previous.searched_at)


def observed_outputs(spec: StateSpec, data: Transitions) -> Tensor:
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
