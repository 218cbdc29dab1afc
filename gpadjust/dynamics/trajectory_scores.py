"""How well trajectories are predicted, many steps ahead along recorded actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.dynamics.open_loop import Move, chosen_starts, follow, of_states, steps_ahead
from gpadjust.dynamics.particles import (
    about_centre,
    central_interval,
    check_enough,
    measurement_noise,
)
from gpadjust.dynamics.step_or_nan import step_or_nan
from gpadjust.dynamics.transitions import Transitions
from gpadjust.states import StateSpec
from gpadjust.validation import nlpd, rmse

LEVEL = 0.95
_CERTAIN = 1e-9  # of a typical change: a spread that is one of rounding errors


class TrajectoryScores(NamedTuple):
    r"""How well trajectories were predicted: ``H`` horizons, ``m = len(spec.moving)`` states.

    A window of k steps starts at a recorded state. Each particle follows one function drawn from
    the dynamics along the k recorded actions, whatever was recorded on the way; the noise that the
    dynamics learnt is added to where it ends, once, as to a measurement. (It is not added on the
    way: as noise of the process it would do more after k steps than is assumed here.) That is
    compared with the state that was measured after k steps, angles the shortest way round.

    Windows overlap, and all see the same functions: the scores of so many windows scatter more than
    those of as many independent predictions. A particle that is lost, because it would leave the
    bounds or the finite numbers or meet a failure of the physics, stays where it was before. A
    window is left out if the physics fails at the last state recorded in it, for the noise's sake.

    Args:
        horizons: The numbers of steps, ``H``.
        states: The names of the states that are scored, ``m``.
        nlpd: Mean negative log density of the Gaussian with the particles' mean and variance, in
            nats, ``H x m``. (The plug-in of an estimated variance: with 39 particles some 0.03 nats
            more than their number itself deserves.)
        coverage: Share of the windows whose end lies in the central 95 % of the particles,
            ``H x m``: between order statistics, which holds for any distribution.
        rmse: Root mean square error of the particles' mean, in the state's units, ``H x m``.
        energy: Mean energy score of all states together, ``H``,
            :math:`\frac1K \sum_i |x_i - y| - \frac{1}{2 K (K - 1)} \sum_{i \neq j} |x_i - x_j|` of
            ``K`` particles, each state in units of its typical change in a step (Gneiting and
            Raftery 2007, sec. 4.3; without bias of ``K``: Ferro 2014). Lower is better; of
            dynamics without doubt it is the distance itself.
        num_windows: Windows of each horizon, ``H``; without any the scores are NaN.
        lost: Share of the particles that were lost, ``H``.

    ``nlpd`` and ``coverage`` are NaN, too, for a state of which dynamics say no variance.
    """

    horizons: tuple[int, ...]
    states: tuple[str, ...]
    nlpd: Tensor
    coverage: Tensor
    rmse: Tensor
    energy: Tensor
    num_windows: Tensor
    lost: Tensor


class Ends(NamedTuple):
    """Where ``K`` particles of ``w`` windows are after some steps, and what was measured there.

    Args:
        particles: ``K x w x state_dim``, without noise.
        noise: The noise of a measurement, as a standard deviation, ``w x state_dim``.
        measured: ``w x state_dim``, NaN where an entry was not.
        lost: Which of the particles were lost, ``K x w`` booleans.
    """

    particles: Tensor
    noise: Tensor
    measured: Tensor
    lost: Tensor


def score_trajectories(
    spec: StateSpec,
    sample_functions: Callable[[int, int], Move],
    noise_variance: Move,
    data: Transitions,
    *,
    horizons: Sequence[int],
    num_functions: int,
    max_windows: int | None,
    units: Tensor | None,
    state_bounds: Tensor | None,
    seed: int,
) -> TrajectoryScores:
    """The scores of dynamics; see :meth:`~gpadjust.dynamics.Dynamics.score_trajectories`.

    Args:
        spec: What the entries of states and actions are.
        sample_functions: Draws so many functions of states and actions by a seed.
        noise_variance: Variances of measured next states about a function.
        data: Episodes, row by row.
        horizons: As there, like all that follows.
        num_functions: The number of functions.
        max_windows: The most windows of a horizon.
        units: What changes are measured in.
        state_bounds: Beyond which a particle is lost.
        seed: The seed.
    """
    horizons = checked_horizons(horizons)
    check_enough(num_functions, LEVEL)
    if max_windows is not None:
        checked_whole("max_windows", max_windows, 1)
    if units is None:
        units = typical_change(spec, data.states, data.next_states)
    units = of_states(units, "units", (spec.state_dim,))
    if not (units.isfinite() & (units > 0)).all():
        raise ValueError(f"Expected units that are finite and positive, got {units.tolist()}.")
    if state_bounds is not None:
        state_bounds = of_states(state_bounds, "state_bounds", (2, spec.state_dim))
    chosen = chosen_starts(steps_ahead(spec, data), horizons, max_windows)
    generator = torch.Generator().manual_seed(seed)
    # Dynamics of a user's may draw from PyTorch's generator all the same.
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        functions = sample_functions(num_functions, seed)
        found = follow(functions, num_functions, data, horizons, chosen, state_bounds)
        scores = []
        for horizon, starts in zip(horizons, chosen, strict=True):
            (particles, lost), last = found[horizon], data.some(starts + horizon - 1)
            noise = torch.zeros_like(last.states)
            if len(starts):
                noise = step_or_nan(noise_variance, last.states, last.actions).sqrt()
            known = ~noise.isnan().all(-1)
            ends = Ends(particles[:, known], noise[known], last.next_states[known], lost[:, known])
            scores.append(score_ends(spec, ends, units, generator))
    columns = {name: torch.stack([each[name] for each in scores]) for name in scores[0]}
    names = tuple(spec.states[i] for i in spec.moving)
    return TrajectoryScores(horizons=horizons, states=names, **columns)


def typical_change(spec: StateSpec, states: Tensor, next_states: Tensor) -> Tensor:
    """Root mean square change of each state in a step, ``state_dim``; 1 if it never changed."""
    size = spec.change(states, next_states).square().nanmean(0).sqrt()
    return size.where(size > 0, torch.ones_like(size))


def checked_horizons(horizons: Sequence[int]) -> tuple[int, ...]:
    """The numbers of steps, in order.

    Raises:
        ValueError: If they are not different whole numbers of at least 1.
    """
    try:
        given = tuple(horizons)
    except TypeError:
        given = ()
    if not given or len({*given}) < len(given):
        raise ValueError(
            f"Expected horizons as different numbers of steps, such as (1, 5, 15), got "
            f"{horizons!r}."
        )
    for each in given:
        checked_whole("each horizon", each, 1)
    return tuple(sorted(given))


def score_ends(
    spec: StateSpec, ends: Ends, units: Tensor, generator: torch.Generator
) -> dict[str, Tensor]:
    """The scores of one horizon; its noise is drawn from ``generator``."""
    moving = spec.moving
    if not len(ends.measured):
        none = units.new_full((len(moving),), torch.nan)
        found = dict.fromkeys(("nlpd", "coverage", "rmse"), none)
        return {**found, "energy": none[0], "num_windows": torch.tensor(0), "lost": none[0]}
    centre, cloud = about_centre(spec, ends.particles)
    cloud, y = cloud[..., moving], spec.change(centre, ends.measured)[:, moving]
    scale, noise = units[moving], ends.noise[:, moving]
    mean, variance = cloud.mean(0), cloud.var(0) + noise.square()
    says = (variance.sqrt() > _CERTAIN * scale).all(0)
    silent = torch.full_like(scale, torch.nan)

    drawn = measurement_noise(spec, ends.noise, len(cloud), generator)
    sample = cloud + drawn[..., moving]
    low, high = central_interval(sample, LEVEL)
    inside = ((y >= low) & (y <= high)).double().masked_fill(y.isnan(), torch.nan).nanmean(0)
    return {
        "nlpd": nlpd(mean, variance, y).where(says, silent),
        "coverage": inside.where(says, silent),
        "rmse": rmse(mean, y),
        "energy": energy_score(sample / scale, y / scale),
        "num_windows": torch.tensor(len(y)),
        "lost": ends.lost.double().mean(),
    }


def energy_score(sample: Tensor, y: Tensor) -> Tensor:
    """Mean energy score of samples ``K x w x m``; points ``w x m`` with NaN are left out."""
    known = ~y.isnan().any(-1)
    sample, y = sample[:, known].transpose(0, 1), y[known]
    num = sample.shape[1]
    error = (sample - y.unsqueeze(1)).norm(dim=-1).mean(1)
    # Window by window, as all pairs at once are w K^2; not by products, which cancel.
    mode = "donot_use_mm_for_euclid_dist"
    pairs = [torch.cdist(each, each, compute_mode=mode).sum().item() for each in sample]
    return (error - error.new_tensor(pairs) / (2 * num * (num - 1))).mean()
