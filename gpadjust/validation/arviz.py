"""Fitted models for ArviZ, whose plots and diagnostics then work on them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.core.summary import numbers_of

_Groups = dict[str, dict[str, Tensor]]


@torch.no_grad()
def to_arviz(*models: GP, chains: int = 1, seed: int = 0) -> Any:
    """Return the draws of fits of one model as ArviZ's ``DataTree``.

    Its groups are posterior and prior (the numbers of ``model.summary()``, in the user's units),
    log_likelihood, posterior_predictive and observed_data (of each output, at its training rows).
    The log likelihood is that of each observation given all others, which ``az.loo`` needs of a
    Gaussian process (Buerkner, Gabry and Vehtari 2021). A number that a nested model lacks is drawn
    from its prior there. A ``DataTree`` has no names with ``/``: ``N/mm`` is ``N∕mm``.

    Args:
        models: The model, fitted several times by different seeds: a chain each.
        chains: How many chains the draws of each model are, one after the other: 4 after a fit by
            ``"nuts"``.
        seed: Seed of the draws from the prior and of observations.

    Raises:
        ImportError: Without ArviZ, ``pip install "gpadjust[arviz]"``.
        TypeError: If a model is a stack of several.
        ValueError: If the models have different data or numbers of draws.

    Example:
        >>> import torch
        >>> from gpadjust import ZeroMeanGP, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> models = [ZeroMeanGP(X, X.sin()) for _ in range(2)]
        >>> results = [fit(model, seed=seed) for seed, model in enumerate(models)]
        >>> to_arviz(*models).posterior.sizes["chain"]
        2
    """
    try:
        from arviz_base import from_dict
    except ImportError as error:
        raise ImportError('to_arviz needs ArviZ; run `pip install "gpadjust[arviz]"`.') from error
    for each in models:
        if not isinstance(each, GP):
            raise TypeError(
                f"Expected models of gpadjust.core; found {type(each).__name__}. Of a model of "
                "several, as `gpadjust report` saves it, give one of its `models`."
            )
    if not models or any(
        each.draws.shape != models[0].draws.shape
        or len(each.draws) % chains
        or not np.array_equal(each.data.Y, models[0].data.Y, equal_nan=True)
        for each in models
    ):
        raise ValueError(
            "Expected fits of one model to the same data, with equally many draws, a multiple of "
            f"{chains} chains; found draws {[len(each.draws) for each in models]}."
        )
    generator = torch.Generator().manual_seed(seed)
    parts = [_groups(model, generator) for model in models]
    groups: dict[str, Any] = {}
    for group in parts[0]:
        groups[group] = {
            name: np.concatenate([_chains(part[group][name], chains) for part in parts])
            for name in parts[0][group]
        }
    first = models[0]
    u = first.table.prior_draws(len(first.draws) * len(models), seed)
    groups["prior"] = {name: each.numpy()[None] for name, each in _numbers(first, u).items()}
    dims, coords, groups["observed_data"] = {}, {}, {}
    for j, name in enumerate(first.data.output_names):
        rows = ~first.data.Y[:, j].isnan()
        row = _node(f"{name} row")
        dims[_node(name)], coords[row] = [row], rows.nonzero().flatten().numpy()
        groups["observed_data"][name] = first.data.Y[rows, j].numpy()
    groups = {
        group: {_node(name): values for name, values in variables.items()}
        for group, variables in groups.items()
    }
    return from_dict(groups, dims=dims, coords=coords)


def _node(name: str) -> str:
    """Return a name of a ``DataTree``, whose paths have ``/`` between names: with U+2215 for it."""
    return name.replace("/", "\u2215")


def _groups(model: GP, generator: torch.Generator) -> _Groups:
    """Return variables by group and name, whose first dimension is that of draws."""
    every = model.subset_draws(torch.zeros(1, dtype=torch.long))
    every.set_draws(model.draws)
    Y, likelihood, predictive = model.data.Y, {}, {}
    mean, variance = every.left_out_at(every.draws)
    log_density = every.marginals_of(mean.unsqueeze(1), variance.unsqueeze(1)).log_density(Y)
    mean, variance = every.components(model.data.X, observation_noise=True)
    white = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
    replicated = every.off_gaussian_scale(mean + variance.sqrt() * white)
    for j, name in enumerate(model.data.output_names):
        rows = ~Y[:, j].isnan()
        likelihood[name], predictive[name] = log_density[:, rows, j], replicated[:, rows, j]
    return {
        "posterior": _numbers(model, model.draws),
        "log_likelihood": likelihood,
        "posterior_predictive": predictive,
    }


def _numbers(model: GP, u: Tensor) -> dict[str, Tensor]:
    """Return the numbers by name; of several outputs names begin with the output."""
    several = model.num_outputs > 1
    return {
        f"{output}: {name}" if several and output else name: each.draws.expand(len(u))
        for (output, name), each in numbers_of(model, u).items()
    }


def _chains(draws: Tensor, chains: int) -> np.ndarray:
    return draws.reshape(chains, -1, *draws.shape[1:]).numpy()
