"""States of a linear chain under Gaussian errors, by all that was measured of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NO_VARIANCE = "a variance is not a positive number"


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

    def put(self, row: int, mean: Array, covariance: Array) -> None:
        """Write the moments of a row."""
        self.means[row] = mean
        self.covariances[row] = covariance


class Smoothed(NamedTuple):
    """Distribution of the states of a stretch by all that was measured."""

    states: Moments
    crossed: Array  # covariances of each state but the first with the one before, T x D x D


def smooth_chain(
    links: Sequence[Link], starts: Sequence[tuple[Array, Array]], noise: Array, process_noise: Array
) -> tuple[list[Smoothed], float]:
    """Smooth all stretches of a chain, one after the other (Rauch, Tung and Striebel 1965).

    The last entries of a state, beyond those that a stretch starts again with, are constants that
    all stretches share. Starts are means ``d`` and covariances ``d x d`` of the first state of each
    stretch, of the first one of all ``D`` entries; the noise is variances ``m``, the process noise
    ``d``.

    Returns:
        Distribution of the states of each stretch, and the log density of the measurements.

    Raises:
        LinAlgError: If a variance is not a positive number.
    """
    if not np.isfinite([*noise, *process_noise]).all():
        raise np.linalg.LinAlgError(_NO_VARIANCE)
    rows = _Rows.joined(links, starts, noise, process_noise)
    filtered = _filter(rows)
    states, gains = _smooth(rows, filtered)
    smoothed = []
    t = 0
    for link in links:
        end = t + len(link.measured)
        moments = Moments(states.means[t:end], states.covariances[t:end])
        back = np.swapaxes(gains[t : end - 1], -1, -2)
        smoothed.append(Smoothed(moments, moments.covariances[1:] @ back))
        t = end
    return smoothed, filtered.log_density


def draw_paths(
    stretches: Sequence[Smoothed], num_constants: int, rng: np.random.Generator
) -> list[Array]:
    """Draw the states of all stretches, ``T + 1 x D`` each; their last entries are constants."""
    paths = list[Array]()
    constants = None
    for (means, covariances), crossed in stretches:
        path = np.empty_like(means)
        mean, covariance = means[-1], covariances[-1]
        d = means.shape[1] - num_constants
        if constants is None:
            constants = _normal(mean[d:], covariance[d:, d:], rng)
        path[-1, d:] = constants
        gain = _gain(covariance[d:, d:], covariance[d:, :d])
        # x | theta ~ N(m + G (theta - m'), P - G C), G = C' P'^-1
        left = covariance[:d, :d] - gain @ covariance[d:, :d]
        path[-1, :d] = _normal(mean[:d] + gain @ (constants - mean[d:]), left, rng)
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
    """Return a state updated by measured outputs, ``m x D`` times the state (Kalman 1960).

    What was not measured is NaN; the noise is variances ``m`` of independent errors.

    Returns:
        Mean and covariance of the state, and the log density of what was measured.

    Raises:
        LinAlgError: If a variance is not a positive number.
    """
    log_density = 0.0
    for i in np.flatnonzero(~np.isnan(measured)):  # one by one, as their errors are independent
        spread = covariance @ outputs[i]
        variance = outputs[i] @ spread + noise[i]
        error = measured[i] - outputs[i] @ mean
        if not 0 < variance < math.inf:
            raise np.linalg.LinAlgError(_NO_VARIANCE)
        mean = mean + spread / variance * error
        covariance = covariance - np.outer(spread, spread) / variance
        log_density -= 0.5 * (error**2 / variance + math.log(2 * math.pi * variance))
    return mean, (covariance + covariance.T) / 2, float(log_density)


def expected_squares(
    links: Sequence[Link], stretches: Sequence[Smoothed], d: int
) -> tuple[Array, Array]:
    """Return expected squares of errors, given the distribution of the states.

    Returns:
        Squares of errors of the measurements, ``sum (T + 1) x m``, and of the first ``d`` entries
        of what the steps added, ``sum T x d``.
    """
    errors, added = list[Array](), list[Array]()
    for link, (states, crossed) in zip(links, stretches, strict=True):
        means, spread = states
        outputs = link.outputs
        off = link.measured - np.einsum("tij,tj->ti", outputs, means)
        errors.append(off**2 + np.einsum("tij,tjk,tik->ti", outputs, spread, outputs))
        lead = link.matrices[:, :d]
        step = means[1:, :d] - np.einsum("tij,tj->ti", lead, means[:-1]) - link.offsets[:, :d]
        of_both = np.einsum("tij,tij->ti", crossed[:, :d], lead)
        of_first = np.einsum("tij,tjk,tik->ti", lead, spread[:-1], lead)
        of_last = np.diagonal(spread[1:, :d, :d], axis1=1, axis2=2)
        added.append(step**2 + (of_last - 2 * of_both + of_first).clip(0))
    return np.concatenate(errors), np.concatenate(added)


class _Rows(NamedTuple):
    """A chain of ``M`` rows, ``x[t] = F[t] x[t - 1] + o[t] + N(0, Q[t])``, in blocks.

    ``B`` blocks of ``length`` rows, one after the other, are computed side by side.
    """

    number: int  # M
    F: Array  # length x B x D x D
    o: Array  # length x B x D
    Q: Array  # length x B x D x D
    outputs: Array  # length x B x m x D
    measured: Array  # length x B x m; 0 where there is nothing
    noise: Array  # length x B x m; infinite where there is nothing

    @classmethod
    def joined(
        cls,
        links: Sequence[Link],
        starts: Sequence[tuple[Array, Array]],
        noise: Array,
        process_noise: Array,
    ) -> _Rows:
        """Join stretches: from one to the next the constants stay, and the states start again."""
        measured = np.concatenate([link.measured for link in links])
        outputs = np.concatenate([link.outputs for link in links])
        M, _, D = outputs.shape
        d = len(process_noise)
        F = np.zeros((M, D, D))
        o = np.zeros((M, D))
        Q = np.zeros((M, D, D))
        Q[:, range(d), range(d)] = process_noise
        t = 0
        for link, (first, spread) in zip(links, starts, strict=True):
            F[t, d:, d:] = np.eye(D - d)
            o[t, :d] = first[:d]
            Q[t, :d, :d] = spread[:d, :d]
            steps = slice(t + 1, t + len(link.measured))
            F[steps] = link.matrices
            o[steps] = link.offsets
            t = steps.stop
        F[0] = 0.0
        o[0], Q[0] = starts[0]
        is_seen = ~np.isnan(measured)
        return cls(
            M,
            _cut(F, np.eye(D)),
            _cut(o, 0.0),
            _cut(Q, 0.0),
            _cut(outputs, 0.0),
            _cut(np.where(is_seen, measured, 0.0), 0.0),
            _cut(np.where(is_seen, noise, math.inf), math.inf),
        )


class _Filtered(NamedTuple):
    """The filter of all blocks, each from its start x, the state before its first row.

    From starts of 0 without variance the last state of a block is ``A x`` more than here, and the
    density of its measurements, by x, ``exp(eta' x - x' J x / 2)``.
    """

    before: Moments  # length x B x ...: of the state before, by measurements until then
    ahead: Moments  # of the state, by the measurements before it
    after: Moments  # and by its measurements
    A: Array  # B x D x D
    eta: Array  # B x D
    J: Array  # B x D x D
    log_density: float


def _filter(rows: _Rows) -> _Filtered:
    r"""Filter the chain, in some :math:`3 \sqrt M` steps (Särkkä and García-Fernández 2021).

    First all blocks are filtered from a start of 0, side by side; then the states at the starts of
    the blocks follow, one after the other; then all blocks are filtered again, from these.
    """
    B, D = rows.o.shape[1:]
    starts = Moments(np.zeros((B, D)), np.zeros((B, D, D)))
    block = _filter_blocks(rows, starts)
    mean, covariance = np.zeros(D), np.zeros((D, D))
    for k in range(B):
        starts.put(k, mean, covariance)
        # x | y ~ N(m + S (eta - J m), S), S = (P^-1 + J)^-1, for x ~ N(m, P)
        A = block.A[k]
        S = np.linalg.solve(np.eye(D) + covariance @ block.J[k], covariance)
        mean = A @ (mean + S @ (block.eta[k] - block.J[k] @ mean)) + block.after.means[-1, k]
        covariance = _even(A @ S @ A.T) + block.after.covariances[-1, k]
    return _filter_blocks(rows, starts)


def _filter_blocks(rows: _Rows, starts: Moments) -> _Filtered:
    """Filter all blocks from their starts, ``B`` moments (Kalman 1960)."""
    means, covariances = starts
    before, ahead, after = (Moments(np.empty_like(rows.o), np.empty_like(rows.Q)) for _ in range(3))
    A = np.zeros_like(covariances) + np.eye(means.shape[1])
    eta = np.zeros_like(means)
    J = np.zeros_like(covariances)
    log_density = 0.0
    for t, F in enumerate(rows.F):
        before.put(t, means, covariances)
        means = _times(F, means) + rows.o[t]
        covariances = _even(F @ covariances @ np.swapaxes(F, -1, -2)) + rows.Q[t]
        A = F @ A
        ahead.put(t, means, covariances)
        # One output by one, as their errors are independent: y = h' x + N(0, R)
        for i in np.flatnonzero(np.isfinite(rows.noise[t]).any(0)):
            h = rows.outputs[t, :, i]
            R = rows.noise[t, :, i]
            is_seen = np.isfinite(R)
            spread = _times(covariances, h)
            variance = (h * spread).sum(-1) + R
            if not (variance > 0).all() or not np.isfinite(variance[is_seen]).all():
                raise np.linalg.LinAlgError(_NO_VARIANCE)
            error = rows.measured[t, :, i] - (h * means).sum(-1)
            by_error = (error / variance)[:, None]
            log_density -= 0.5 * (error**2 / variance)[is_seen].sum()
            log_density -= 0.5 * np.log(2 * math.pi * variance[is_seen]).sum()
            # By the start, y = g' x + ...
            g = _times(np.swapaxes(A, -1, -2), h)
            by_start = g / variance[:, None]
            eta += g * by_error
            J += g[:, :, None] * by_start[:, None]
            A = A - spread[:, :, None] * by_start[:, None]
            means = means + spread * by_error
            scaled = spread / np.sqrt(variance)[:, None]
            covariances = covariances - scaled[:, :, None] * scaled[:, None]
        after.put(t, means, covariances)
    return _Filtered(before, ahead, after, A, eta, J, float(log_density))


def _smooth(rows: _Rows, filtered: _Filtered) -> tuple[Moments, Array]:
    """Return all states by all measurements, and the gains to each from the one after it.

    With gains G, ``x[t - 1] = G[t] x[t] + c[t] + N(0, L[t])``; again all blocks go side by side,
    first from an end of 0, then from their ends.
    """
    before, ahead = filtered.before, filtered.ahead
    G = _gain(ahead.covariances, rows.F @ before.covariances)
    c = before.means - _times(G, ahead.means)
    L = before.covariances - _even(G @ ahead.covariances @ np.swapaxes(G, -1, -2))
    ends = Moments(np.zeros_like(c[0]), np.zeros_like(L[0]))
    block, A = _smooth_blocks(G, c, L, ends)
    mean, covariance = last = [part[-1, -1] for part in filtered.after]
    for k in range(len(A) - 1, -1, -1):
        ends.put(k, mean, covariance)
        mean = A[k] @ mean + block.means[0, k]
        covariance = _even(A[k] @ covariance @ A[k].T) + block.covariances[0, k]
    smoothed, _ = _smooth_blocks(G, c, L, ends)
    # The state before the first row is nothing; that of the last row is its end.
    parts = zip(smoothed, last, strict=True)
    states = [np.concatenate([_joined(part, rows.number)[1:], end[None]]) for part, end in parts]
    return Moments(*states), _joined(G, rows.number)[1:]


def _smooth_blocks(G: Array, c: Array, L: Array, ends: Moments) -> tuple[Moments, Array]:
    """Return the states before each row by the ends of the blocks, and their products of gains."""
    means, covariances = ends
    smoothed = Moments(np.empty_like(c), np.empty_like(L))
    A = np.eye(c.shape[-1])
    for t in range(len(G) - 1, -1, -1):
        means = _times(G[t], means) + c[t]
        covariances = _even(G[t] @ covariances @ np.swapaxes(G[t], -1, -2)) + L[t]
        A = G[t] @ A
        smoothed.put(t, means, covariances)
    return smoothed, A


def _cut(rows: Array, padding: Array | float) -> Array:
    """Cut rows ``M x ...`` into blocks ``length x B x ...``, the last one padded."""
    length = math.isqrt(len(rows))
    number = -(-len(rows) // length)
    padded = np.empty((number * length, *rows.shape[1:]))
    padded[: len(rows)] = rows
    padded[len(rows) :] = padding
    return np.ascontiguousarray(np.swapaxes(padded.reshape(number, length, *rows.shape[1:]), 0, 1))


def _joined(blocks: Array, number: int) -> Array:
    """Return the first rows of blocks ``length x B x ...``, one block after the other."""
    return np.swapaxes(blocks, 0, 1).reshape(-1, *blocks.shape[2:])[:number]


def _times(matrices: Array, vectors: Array) -> Array:
    product: Array = (matrices @ vectors[..., None])[..., 0]
    return product


def _even(matrices: Array) -> Array:
    """Return matrices made symmetric, which rounding leaves nearly so."""
    even: Array = (matrices + np.swapaxes(matrices, -1, -2)) / 2
    return even


def _gain(covariance: Array, crossed: Array) -> Array:
    """Return ``crossed' covariance^-1``, also of constants without variance."""
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).clip(np.finfo(float).tiny))
    scaled = covariance / (scale[..., None] * scale[..., None, :])
    scaled = scaled + 1e-14 * np.eye(scale.shape[-1])
    solved = np.linalg.solve(scaled, crossed / scale[..., None])
    gain: Array = np.swapaxes(solved, -1, -2) / scale[..., None, :]
    return gain


def _normal(mean: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Draw from a normal distribution, whose variance may be zero in some directions."""
    values, vectors = np.linalg.eigh(covariance)
    draw: Array = mean + vectors @ (np.sqrt(values.clip(0)) * rng.standard_normal(len(mean)))
    return draw
