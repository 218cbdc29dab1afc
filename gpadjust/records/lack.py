"""What an equation lacks: its residual in each step, over states, actions and their past."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag
from scipy.stats import chi2
from torch import Tensor

from gpadjust.display import Display
from gpadjust.records import kalman
from gpadjust.records.chain import Chain, Estimate
from gpadjust.records.kalman import Array, Link
from gpadjust.states import StateSpec

_CHANCE = 0.01  # that a right equation lacks something
_AGAIN = 2.0  # standard deviations, by which either half tells what the other does
_FEW_BINS = 4  # of a test
_BINS = 8  # of a figure
_IN_BIN = 8  # steps, at least
_LAGS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # steps
_WIDE = 10.0  # times the changes per time: what may be missing
_FORCE = 2.0  # times the process noise: a force that may be missing
_LENGTH = 0.5  # lengthscale of a force that may be missing, in ranges of a state
_SMOOTH = 4  # functions of a force that may be missing
_ROUNDS = 20  # of expectation maximisation
_KINEMATIC = 0.03  # of a state's changes, by which they differ from the integral of another
_BOTH_SIGNS = 0.05  # the least share of either sign
_EXPLAINED = 0.5  # of what bins explain: a term that is short enough for a sentence

_TERMS = {
    "constant": "",
    "line": "*{0}",
    "square": "*{0}**2",
    "sign": "*sign({0})",
    "drag": "*{0}*abs({0})",
    "sin": "*sin({0})",
    "cos": "*cos({0})",
}
_KINDS = {("sign", True): ", as of dry friction", ("drag", True): ", as of drag"}


@dataclass(frozen=True, repr=False, eq=False)
class Lack(Display):
    """The residual of a state's equation over what it depends on most clearly.

    It is what the rate of change of the smoothed states has beyond the equation, in the unit of
    that derivative, with its process noise: a dot for each of ``N`` steps, and means in ``K`` bins.
    ``plot()`` draws it (:func:`~gpadjust.records.plots.plot_lack`).
    """

    spec: StateSpec
    state: str
    over: str  # a state or an action
    term: str  # such as "-0.12*sign(rate)"; empty if none of a few simple ones tells it
    shape: str  # of the term, such as "sign"
    lag: float | None  # the time by which the action acts late, to a factor of 2
    at: Tensor  # N, of what it depends on; of a lag the delayed action less the action
    residual: Tensor  # N
    middles: Tensor  # K
    means: Tensor  # K
    sd: Tensor  # K, of the means

    def __repr__(self) -> str:
        """Return a sentence on the missing effect."""
        if self.lag is not None:
            # Lags are tried in powers of two.
            return (
                f"{self.state}' lacks a lag: {self.over} acts some {self.lag / 2:.2g} to "
                f"{self.lag * 2:.2g} late. Try one state more, hidden, "
                f"q' = ({self.over} - q)/tau, and q in place of {self.over}."
            )
        if self.shape == "constant":
            return f"{self.state}' lacks about {self.term} throughout: try an offset."
        if self.term:
            kind = _KINDS.get((self.shape, self.state == self.over), "")
            return f"{self.state}' lacks about {self.term}{kind}: try such a term."
        low, high = self.means.min(), self.means.max()
        return (
            f"{self.state}' lacks {low:.2g} to {high:.2g}, depending on {self.over}: the figure of "
            "its residual shows which term."
        )


class _Candidate(NamedTuple):
    """What the residual of equation ``i`` may depend on: columns ``N x K``, of a lag or bins."""

    i: int
    over: str
    values: Array  # N, or with the lags N x 6
    columns: Array  # N x K
    is_lag: bool


def clearest_lack(chain: Chain, estimate: Estimate, step: float) -> Lack | None:
    """Return what the equations lack most clearly; None if nothing is clear.

    What bins of a state add to an equation are constants of the chain of states, beside the
    parameters, which may be anywhere. They are clear if their chi-square is beyond chance, and if
    either half of each stretch tells the same: what moves the machine for a while, whatever the
    states are, does not. Equations of a state whose rate is another state are left out.
    """
    search = _Search(chain, estimate, step)
    candidates = [*search.candidates()]
    if not candidates:
        return None
    best = min(candidates, key=lambda candidate: search.tested(candidate).chance)
    search.explain(best)  # the process noise estimated without it hid some of it
    result = search.tested(best)
    if result.chance + math.log(len(candidates)) > math.log(_CHANCE) or result.again < _AGAIN:
        return None
    return search.described(best, result.gain)


def robust_moments(chain: Chain, estimate: Estimate, step: float) -> tuple[Array, Array]:
    r"""Return mean and covariance of the parameters, allowing for forces that the equations lack.

    Equation i, unless the rate of its state is another state, has the further rate

    .. math:: \sum_j g_{ij}(x_j), \quad g_{ij} \sim GP(0, 4 Q_i / h^2 \, k),

    of each state, with an RBF kernel k whose lengthscale is half the range of the state: twice as
    large in a step h as the process noise Q of the chain, which is 0 where the equations are right.
    """
    search = _Search(chain, estimate, step)
    added = list[list[Array]]()
    for i in search.equations:
        size = _FORCE * math.sqrt(search.variances[1, i]) / step
        for values in search.middle.T:
            columns = _bins(values, _BINS)
            middles = columns.T @ values / columns.sum(0)
            off = (middles[:, None] - middles) / (_LENGTH * max(np.ptp(middles), 1e-300))
            # k = V diag(w) V', of which a few columns V sqrt(w) are nearly all
            w, V = np.linalg.eigh(np.exp(-0.5 * off**2))
            root = V[:, -_SMOOTH:] * np.sqrt(w[-_SMOOTH:].clip(0))
            added.append(search._added(i, size * columns @ root))
    d, p = chain.d, chain.num_parameters
    if not added:
        moments = estimate.stretches[0].states
        return moments.means[0, d:], moments.covariances[0, d:, d:]
    joined = [np.concatenate(parts, -1) for parts in zip(*added, strict=True)]
    K = joined[0].shape[-1]
    starts = [
        (np.append(x, np.zeros(K)), block_diag(spread, np.eye(K))) for x, spread in chain.starts
    ]
    links = [*map(_with, search.links, joined)]
    stretches, _ = kalman.smooth_chain(links, starts, *search.variances)
    mean, covariance = (part[0] for part in stretches[0].states)
    return mean[d : d + p], covariance[d : d + p, d : d + p]


class _Test(NamedTuple):
    """If a residual is clear: the log of its chance, what one half tells by the other, nats."""

    chance: float
    again: float
    gain: float


class _Search:
    """The chain about the smoothed states, and what may be added to it in each step."""

    def __init__(self, chain: Chain, estimate: Estimate, step: float) -> None:
        self.chain = chain
        self.estimate = estimate
        self.step = step
        self.variances = estimate.variances
        d = chain.d
        path = chain.path_of(estimate)
        self.links = chain.linearised(path)
        self.theta = path.parameters
        self.lengths = [len(link.matrices) for link in self.links]
        x, ahead = path.states[chain.now], path.states[chain.now + 1]
        self.middle = (x + ahead) / 2
        change = path.following - x
        # What a rate of change of 1 adds in a step, to second order: h (I + F) / 2.
        F = np.concatenate([link.matrices[:, :d, :d] for link in self.links])
        self.pushes = step * (np.eye(d) + F) / 2
        self.wide = _WIDE * np.sqrt(((ahead - x) ** 2).mean(0)) / step
        self.equations = []
        for i in range(d):
            rates = [rate for j in range(d) if j != i for rate in (x[:, j], self.middle[:, j])]
            squares = [np.square(change[:, i] - step * rate).mean() for rate in rates]
            is_rate = (
                min(squares, default=math.inf) <= _KINEMATIC**2 * np.square(change[:, i]).mean()
            )
            if self.wide[i] > 0 and not is_rate:
                self.equations.append(i)

    def candidates(self) -> Iterator[_Candidate]:
        """Yield bins of all states and actions, and lags of the actions, for each equation."""
        spec = self.chain.spec
        values = {spec.states[i]: self.middle[:, k] for k, i in enumerate(spec.moving)}
        actions = self.chain.recorded[self.chain.now, spec.state_dim :].numpy()
        values |= dict(zip(spec.actions, actions.T, strict=True))
        for name in spec.angles:
            values[name] = np.arctan2(np.sin(values[name]), np.cos(values[name]))
        for i in self.equations:
            for name, column in values.items():
                columns = _bins(column, _FEW_BINS)
                if columns.shape[1] > 1:
                    yield _Candidate(i, name, column, columns, is_lag=False)
                if _has_both_signs(column):  # one column is told from chance by less than bins
                    for term in (np.sign(column), column * np.abs(column)):
                        single = term[:, None] / np.sqrt((term**2).mean())
                        yield _Candidate(i, name, column, single, is_lag=False)
            for name in spec.actions:
                late = np.stack([self._late(values[name], lag) for lag in _LAGS], -1)
                size = np.sqrt((late**2).mean(0))
                if size.min() > 0 and len(self.middle) >= _IN_BIN * len(_LAGS):
                    yield _Candidate(i, name, late, late / size, is_lag=True)

    def _late(self, action: Array, lag: float) -> Array:
        """Return an action behind a lag of first order, in steps, less the action itself."""
        late = action.copy()
        end = 0
        for length in self.lengths:
            for t in range(end + 1, end + length):
                late[t] = late[t - 1] + (1 - math.exp(-1 / lag)) * (action[t - 1] - late[t - 1])
            end += length
        return late - action

    def explain(self, by: _Candidate) -> None:
        """Take the variances that are most likely with columns beside the equations."""
        links = [*map(_with, self.links, self._added(by.i, by.columns))]
        starts = self._starts(self.chain.starts, by.i, by.columns.shape[1])
        for _ in range(_ROUNDS):
            stretches, _ = kalman.smooth_chain(links, starts, *self.variances)
            noise, added = kalman.expected_squares(links, stretches, self.chain.d)
            mean_noise = np.nansum(noise, 0) / (~np.isnan(noise)).sum(0).clip(1)
            likely = self.chain.checked(np.stack([mean_noise, added.mean(0)]))
            likely[0, self.chain.hidden] = self.variances[0, self.chain.hidden]
            self.variances = likely * np.sqrt(likely / self.variances)  # and a little further

    def tested(self, candidate: _Candidate) -> _Test:
        """Test whether what columns add is beyond chance, and again in the other half."""
        precision, pull = self.halves(candidate)
        prior = np.eye(len(pull[0])) / self.wide[candidate.i] ** 2
        halves = np.linalg.solve(precision + prior, pull[..., None])[..., 0]
        # a_k' Lambda_l a_k and a_k' h_l, by the estimate a_k of one half and the other half l: the
        # ratio is standard normal if both have nothing in common.
        sizes = [halves[k] @ precision[1 - k] @ halves[k] for k in (0, 1)]
        products = [halves[k] @ pull[1 - k] for k in (0, 1)]
        again = min(products[k] / math.sqrt(max(sizes[k], 1e-300)) for k in (0, 1))
        # chi^2 = h' (Lambda + P^-1)^-1 h
        h = pull.sum(0)
        square = float(h @ np.linalg.solve(precision.sum(0) + prior, h))
        return _Test(float(chi2.logsf(square, len(h))), float(again), square / 2)

    def halves(self, of: _Candidate) -> tuple[Array, Array]:
        """Return precision, ``2 x K x K``, and pull, ``2 x K``, by both halves of the stretches."""
        K = of.columns.shape[1]
        prior = np.eye(K) / self.wide[of.i] ** 2
        precision = np.zeros((2, K, K))
        pull = np.zeros((2, K))
        triples = zip(self.links, self._added(of.i, of.columns), self.chain.firsts, strict=True)
        anywhere = np.diag(np.append(self.chain.first_variance, [_WIDE**2] * len(self.theta)))
        for link, added, first in triples:
            cut = len(added) // 2
            for k, part in enumerate((slice(0, cut), slice(cut, len(added)))):
                if part.stop == part.start:
                    continue
                end = part.stop + 1
                rows = slice(part.start, end)
                outputs, measured = link.outputs[rows], link.measured[rows]
                shorter = Link(link.matrices[part], link.offsets[part], outputs, measured)
                start = [(self.estimate.states[first + part.start], anywhere)]
                mean, covariance, *_ = self._smoothed([shorter], [added[part]], start, of.i)
                inverse = np.linalg.inv(covariance)
                precision[k] += inverse - prior
                pull[k] += inverse @ mean
        return precision, pull

    def described(self, of: _Candidate, gained: float) -> Lack:
        """Return the residual in bins beside parameters that suit the term that explains it."""
        i, d = of.i, self.chain.d
        starts = self.chain.starts
        best: tuple[float, str, Array, float, Array]
        best = (-math.inf, "", of.values, 0.0, self.theta)
        _, _, without, *_ = self._smoothed(self.links, None, starts, i)
        for shape, column in self._terms(of):
            size = np.sqrt((column**2).mean())
            added = self._added(i, column[:, None] / size)
            mean, _, density, parameters, _ = self._smoothed(self.links, added, starts, i)
            if density > best[0]:
                best = (density, shape, column, float(mean[0]) / size, parameters)
        density, shape, column, factor, theta = best
        # A wide prior costs a term what it does not cost the bins.
        if not of.is_lag and density - without < _EXPLAINED * gained - math.log(_WIDE):
            shape = ""
            theta = self.theta
        at = column if of.is_lag else of.values
        columns = _bins(at, _BINS)
        added = self._added(i, columns)
        links = [_at(link, d, theta) for link in self.links]
        alone = [(mean[:d], spread[:d, :d]) for mean, spread in starts]
        mean, covariance, _, _, left = self._smoothed(links, added, alone, i)
        residual = columns @ mean + left / self.pushes[:, i, i]
        middles = np.array([np.median(at[column > 0]) for column in columns.T])
        lag = None
        term = ""
        if of.is_lag:
            lag = _LAGS[int(shape)] * self.step
        elif shape:
            term = f"{factor:.2g}{_TERMS[shape].format(of.over)}"
        spec = self.chain.spec
        state = spec.states[spec.moving[i]]
        numbers = (at, residual, middles, mean, np.sqrt(np.diag(covariance)))
        return Lack(spec, state, of.over, term, shape, lag, *map(torch.from_numpy, numbers))

    def _terms(self, of: _Candidate) -> Iterator[tuple[str, Array]]:
        """Yield names and values of simple terms, ``N``, of which one may be what is missing."""
        if of.is_lag:
            yield from ((str(k), late) for k, late in enumerate(of.values.T))
            return
        x = of.values
        yield from (("constant", np.ones_like(x)), ("line", x), ("square", x**2))
        if _has_both_signs(x):
            yield from (("sign", np.sign(x)), ("drag", x * np.abs(x)))
        if of.over in self.chain.spec.angles:
            yield from (("sin", np.sin(x)), ("cos", np.cos(x)))

    def _added(self, i: int, columns: Array) -> list[Array]:
        """Return what columns ``N x K`` in equation i add to all states, for each stretch."""
        added = self.pushes[:, :, i, None] * columns[:, None]
        return np.split(added, np.cumsum(self.lengths)[:-1])

    def _starts(
        self, starts: list[tuple[Array, Array]], i: int, K: int
    ) -> list[tuple[Array, Array]]:
        """Return starts with further constants, of which nothing is known."""
        wide = self.wide[i] ** 2 * np.eye(K)
        return [(np.append(x, np.zeros(K)), block_diag(spread, wide)) for x, spread in starts]

    def _smoothed(
        self,
        links: list[Link],
        added: list[Array] | None,
        starts: list[tuple[Array, Array]],
        i: int,
    ) -> tuple[Array, Array, float, Array, Array]:
        """Smooth a chain with further constants.

        Return their mean and covariance, the log density, the constants before them, and what the
        steps add to state i beyond all.
        """
        K = 0
        if added is not None:
            K = added[0].shape[2]
            links = [*map(_with, links, added)]
        wider = self._starts(starts, i, K)
        stretches, density = kalman.smooth_chain(links, wider, *self.variances)
        left = []
        for link, (states, _) in zip(links, stretches, strict=True):
            ahead = np.einsum("tj,tj->t", link.matrices[:, i], states.means[:-1])
            left.append(states.means[1:, i] - ahead - link.offsets[:, i])
        mean, covariance = (part[0] for part in stretches[0].states)
        k = len(mean) - K
        constants = mean[self.chain.d : k]
        return mean[k:], covariance[k:, k:], density, constants, np.concatenate(left)


def _has_both_signs(values: Array) -> bool:
    return bool(_BOTH_SIGNS < (values > 0).mean() < 1 - _BOTH_SIGNS)


def _bins(values: Array, most: int) -> Array:
    """Return indicators of bins that hold as many values each, ``N x K``."""
    number = max(1, min(most, len(values) // _IN_BIN))
    inner = np.unique(np.quantile(values, np.arange(1, number) / number))
    place = np.searchsorted(inner, values, side="right")
    numbers = np.unique(place)
    return (place[:, None] == numbers).astype(float)


def _at(link: Link, d: int, theta: Array) -> Link:
    """Return a link of the states alone, with these parameters."""
    offsets = link.offsets[:, :d] + link.matrices[:, :d, d:] @ theta
    measured = link.measured - link.outputs[:, :, d:] @ theta
    return Link(link.matrices[:, :d, :d], offsets, link.outputs[:, :, :d], measured)


def _with(link: Link, added: Array) -> Link:
    """Return a link with further constants, which add ``T x d x K`` times these to the states."""
    T, d, K = added.shape
    D = link.matrices.shape[1]
    matrices = np.tile(np.eye(D + K), (T, 1, 1))
    matrices[:, :D, :D] = link.matrices
    matrices[:, :d, D:] = added
    offsets = np.pad(link.offsets, [(0, 0), (0, K)])
    outputs = np.pad(link.outputs, [(0, 0), (0, 0), (0, K)])
    return Link(matrices, offsets, outputs, link.measured)
