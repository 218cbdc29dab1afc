"""States of a linear chain under Gaussian errors, by all that was measured of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Link(NamedTuple):
    """Steps of a stretch of the chain: ``x[t + 1] = matrices[t] x[t] + offsets[t]``."""

    matrices: Array  # T x D x D
    offsets: Array  # T x D
    outputs: Array  # which are measured of the states, outputs[t] x[t]; T + 1 x m x D
    measured: Array  # T + 1 x m; NaN where there is nothing


class Moments(NamedTuple):
    """Means and covariances of the states of a stretch."""

    means: Array  # T + 1 x D
    covariances: Array  # T + 1 x D x D


class Filtered(NamedTuple):
    """States of a stretch by what was measured before them, and by that and their own."""

    ahead: Moments
    known: Moments


class Smoothed(NamedTuple):
    """Distribution of the states of a stretch by all that was measured."""

    states: Moments
    crossed: Array  # covariances of each state but the first with the one before, T x D x D


def smooth_chain(
    links: Sequence[Link], starts: Sequence[tuple[Array, Array]], noise: Array, process_noise: Array
) -> tuple[list[Smoothed], float]:
    """All stretches of a chain, one after the other (Rauch, Tung and Striebel 1965).

    The last entries of a state, beyond those that a stretch starts again with, are constants that
    all stretches share. Starts are means ``d`` and covariances ``d x d`` of the first state of each
    stretch, of the first one of all ``D`` entries; the noise is variances ``m``, the process noise
    ``d``.

    Returns:
        What is known of each stretch, and the log density of what was measured.
    """
    (mean, covariance), log_density, filtered = starts[0], 0.0, []
    d = len(process_noise)
    for link, (first, spread) in zip(links, starts, strict=True):
        mean = np.concatenate([first[:d], mean[d:]])
        shared, covariance = covariance[d:, d:], np.zeros_like(covariance)
        covariance[:d, :d], covariance[d:, d:] = spread[:d, :d], shared
        found, gained = _filter(link, mean, covariance, noise, process_noise)
        filtered.append(found)
        log_density += gained
        mean, covariance = found.known.means[-1], found.known.covariances[-1]
    smoothed = []
    for link, found in zip(reversed(links), reversed(filtered), strict=True):
        last, spread = found.known.means[-1], found.known.covariances[-1]
        # What later stretches say of the constants reaches the end of this one through them.
        gain = _gain(spread[d:, d:], spread[d:])
        end = last + gain @ (mean[d:] - last[d:])
        end_spread = spread + gain @ (covariance[d:, d:] - spread[d:, d:]) @ gain.T
        smoothed.append(_backwards(link, found, end, end_spread))
        mean, covariance = (part[0] for part in smoothed[-1].states)
    return smoothed[::-1], log_density


def draw_paths(
    found: Sequence[Smoothed], num_constants: int, rng: np.random.Generator
) -> list[Array]:
    """Draw the states of all stretches, ``T + 1 x D`` each; their last entries are constants."""
    paths, constants = [], None
    for (means, covariances), crossed in found:
        path, mean, covariance = np.empty_like(means), means[-1], covariances[-1]
        d = means.shape[1] - num_constants
        if constants is None:
            constants = _normal(mean[d:], covariance[d:, d:], rng)
        path[-1, d:] = constants
        gain = _gain(covariance[d:, d:], covariance[d:, :d])
        own = covariance[:d, :d] - gain @ covariance[d:, :d]
        path[-1, :d] = _normal(mean[:d] + gain @ (constants - mean[d:]), own, rng)
        for t in range(len(crossed) - 1, -1, -1):
            gain = _gain(covariances[t + 1], crossed[t])
            mean = means[t] + gain @ (path[t + 1] - means[t + 1])
            path[t] = _normal(mean, covariances[t] - gain @ crossed[t], rng)
            path[t, d:] = constants
        paths.append(path)
    return paths


def measure(
    mean: Array, covariance: Array, outputs: Array, measured: Array, noise: Array
) -> tuple[Array, Array, float]:
    """A state by outputs of it, ``m x D`` times the state, that were measured (Kalman 1960).

    What was not measured is NaN; the noise is variances ``m`` of independent errors.

    Returns:
        Mean and covariance of the state, and the log density of what was measured.

    Raises:
        LinAlgError: If a variance is no positive number.
    """
    log_density = 0.0
    for i in np.flatnonzero(~np.isnan(measured)):  # one by one, as their errors are independent
        spread = covariance @ outputs[i]
        variance, error = outputs[i] @ spread + noise[i], measured[i] - outputs[i] @ mean
        if not 0 < variance < math.inf:
            raise np.linalg.LinAlgError("a variance is no positive number")
        mean = mean + spread / variance * error
        covariance = covariance - np.outer(spread, spread) / variance
        log_density -= 0.5 * (error**2 / variance + math.log(2 * math.pi * variance))
    return mean, (covariance + covariance.T) / 2, float(log_density)


def expected_squares(
    links: Sequence[Link], found: Sequence[Smoothed], d: int
) -> tuple[Array, Array]:
    """Squares of errors as they are expected given what is known of the states.

    Returns:
        Those of the measurements, ``sum (T + 1) x m``, and of the first ``d`` entries of what the
        steps added, ``sum T x d``.
    """
    errors, added = [], []
    for link, (states, crossed) in zip(links, found, strict=True):
        outputs, means, spread = link.outputs, states.means, states.covariances
        off = link.measured - np.einsum("tij,tj->ti", outputs, means)
        errors.append(off**2 + np.einsum("tij,tjk,tik->ti", outputs, spread, outputs))
        lead = link.matrices[:, :d]
        step = means[1:, :d] - np.einsum("tij,tj->ti", lead, means[:-1]) - link.offsets[:, :d]
        of_both = np.einsum("tij,tij->ti", crossed[:, :d], lead)
        of_first = np.einsum("tij,tjk,tik->ti", lead, spread[:-1], lead)
        of_last = np.diagonal(spread[1:, :d, :d], axis1=1, axis2=2)
        added.append(step**2 + (of_last - 2 * of_both + of_first).clip(0))
    return np.concatenate(errors), np.concatenate(added)


def _filter(
    link: Link, mean: Array, covariance: Array, noise: Array, process_noise: Array
) -> tuple[Filtered, float]:
    """Kalman's filter of a stretch, and the log density of what was measured in it."""
    D, d, log_density = len(mean), len(process_noise), 0.0
    shape = len(link.measured), D
    ahead, known = (Moments(np.empty(shape), np.empty((*shape, D))) for _ in range(2))
    added = np.zeros((D, D))
    added[:d, :d] = np.diag(process_noise)
    for t, measured in enumerate(link.measured):
        if t:
            matrix = link.matrices[t - 1]
            mean = matrix @ mean + link.offsets[t - 1]
            covariance = matrix @ covariance @ matrix.T + added
        ahead.means[t], ahead.covariances[t] = mean, covariance
        mean, covariance, gained = measure(mean, covariance, link.outputs[t], measured, noise)
        log_density += gained
        known.means[t], known.covariances[t] = mean, covariance
    return Filtered(ahead, known), float(log_density)


def _backwards(link: Link, filtered: Filtered, end: Array, spread: Array) -> Smoothed:
    """The smoother of a stretch whose last state is known by all that was measured."""
    means, covariances = filtered.known.means.copy(), filtered.known.covariances.copy()
    means[-1], covariances[-1] = end, spread
    crossed = np.empty_like(link.matrices)
    for t in range(len(link.matrices) - 1, -1, -1):
        ahead = filtered.ahead.covariances[t + 1]
        gain = _gain(ahead, link.matrices[t] @ covariances[t])
        crossed[t] = covariances[t + 1] @ gain.T
        means[t] += gain @ (means[t + 1] - filtered.ahead.means[t + 1])
        covariances[t] += gain @ (covariances[t + 1] - ahead) @ gain.T
        covariances[t] = (covariances[t] + covariances[t].T) / 2
    return Smoothed(Moments(means, covariances), crossed)


def _gain(covariance: Array, crossed: Array) -> Array:
    """``crossed' covariance^-1``, also of constants that are known, which have no variance."""
    scale = np.sqrt(np.diag(covariance).clip(np.finfo(float).tiny))
    scaled = covariance / np.outer(scale, scale) + 1e-14 * np.eye(len(scale))
    gain: Array = np.linalg.solve(scaled, crossed / scale[:, None]).T / scale
    return gain


def _normal(mean: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """A draw, also where there is no variance in some directions."""
    values, vectors = np.linalg.eigh(covariance)
    found: Array = mean + vectors @ (np.sqrt(values.clip(0)) * rng.standard_normal(len(mean)))
    return found
