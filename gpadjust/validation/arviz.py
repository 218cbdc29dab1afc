"""Fitted models for ArviZ, whose plots and diagnostics then work on them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.core.summary import numbers_of
from gpadjust.words import about, name_among


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
        chains: Number of chains of each model, one after the other: 4 after a fit by ``"nuts"``.
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
    for model in models:
        if not isinstance(model, GP):
            raise TypeError(
                f"Expected models of gpadjust.core; found {type(model).__name__}. Of a model of "
                "several, as `gpadjust report` saves it, give one of its `models`."
            )
    if not models or any(
        model.draws.shape != models[0].draws.shape
        or len(model.draws) % chains
        or not np.array_equal(model.data.Y, models[0].data.Y, equal_nan=True)
        for model in models
    ):
        raise ValueError(
            "Expected fits of one model to the same data, with equally many draws, a multiple of "
            f"{chains} chains; found draws {[len(model.draws) for model in models]}."
        )
    generator = torch.Generator().manual_seed(seed)
    parts = [_groups(model, generator) for model in models]
    # Each variable has dimensions chain x draw, and rows of observations.
    groups: dict[str, dict[str, Any]] = {}
    for group in parts[0]:
        groups[group] = {}
        for name in parts[0][group]:
            arrays = [part[group][name] for part in parts]
            chained = [a.reshape(chains, -1, *a.shape[1:]).numpy() for a in arrays]
            groups[group][name] = np.concatenate(chained)
    first = models[0]
    u = first.table.prior_draws(len(first.draws) * len(models), seed)
    groups["prior"] = {name: draws.numpy()[None] for name, draws in _numbers(first, u).items()}
    groups["observed_data"] = {}
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    for j, name in enumerate(first.data.output_names):
        is_observed = ~first.data.Y[:, j].isnan()
        groups["observed_data"][name] = first.data.Y[is_observed, j].numpy()
        dims[_node(name)] = [_node(f"{name} row")]
        coords[_node(f"{name} row")] = is_observed.nonzero().flatten().numpy()
    for group, variables in groups.items():
        groups[group] = {_node(name): values for name, values in variables.items()}
    return from_dict(groups, dims=dims, coords=coords)


def _node(name: str) -> str:
    """Return a name of a ``DataTree``, whose paths have ``/`` between names: with U+2215 for it."""
    return name.replace("/", "\u2215")


def _groups(model: GP, generator: torch.Generator) -> dict[str, dict[str, Tensor]]:
    """Return variables by group and name, whose first dimension is that of draws."""
    copy = model.subset_draws(torch.zeros(1, dtype=torch.long))
    copy.set_draws(model.draws)
    Y = model.data.Y
    mean, variance = copy.left_out_at(copy.draws)
    log_density = copy.marginals_of(mean.unsqueeze(1), variance.unsqueeze(1)).log_density(Y)
    mean, variance = copy.components(model.data.X, observation_noise=True)
    white = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
    replicated = copy.off_gaussian_scale(mean + variance.sqrt() * white)
    columns = {name: (~Y[:, j].isnan(), j) for j, name in enumerate(model.data.output_names)}
    return {
        "posterior": _numbers(model, model.draws),
        "log_likelihood": {n: log_density[:, rows, j] for n, (rows, j) in columns.items()},
        "posterior_predictive": {n: replicated[:, rows, j] for n, (rows, j) in columns.items()},
    }


def _numbers(model: GP, u: Tensor) -> dict[str, Tensor]:
    """Return the numbers by name; of several outputs names begin with the output."""
    draws = {}
    for (output, name), number in numbers_of(model, u).items():
        subject = name_among(output, model.data.output_names)
        draws[about([subject], name)] = number.draws.expand(len(u))
    return draws
