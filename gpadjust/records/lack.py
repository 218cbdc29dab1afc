"""What an equation lacks: its residual in each step, over states, actions and their past."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag
from scipy.stats import chi2
from torch import Tensor

from gpadjust.display import Display
from gpadjust.records import kalman
from gpadjust.records.chain import Chain, Estimate
from gpadjust.records.kalman import Array, Link, Smoothed
from gpadjust.states import StateSpec

_CHANCE = 0.01  # that a right equation lacks something
_AGAIN = 2.0  # standard deviations, by which either half tells what the other does
_FEW_BINS = 4  # of a test
_BINS = 8  # of a figure
_IN_BIN = 8  # steps, at least
_LAGS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # steps
_SMOOTH_SIGN = 0.05  # of the usual size: the width of a smooth sign
_WIDE = 10.0  # times the changes per time: what may be missing
_FORCE = 2.0  # times the process noise: a force that may be missing
_ROUNDS = 20  # of expectation maximisation
_LENGTH = 0.5  # lengthscale of a force that may be missing, in ranges of a state
_SMOOTH = 4  # functions of a force that may be missing
_KINEMATIC = 0.03  # of a state's changes, by which they differ from the integral of another
_BOTH_SIGNS = 0.05  # the least share of either sign

_TERMS = {
    "constant": "",
    "sign": "*sign({0})",
    "drag": "*{0}*abs({0})",
    "sin": "*sin({0})",
    "cos": "*cos({0})",
}
_KINDS = {"sign": "dry friction", "drag": "drag"}


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
            text = f"{self.state}' lacks about {self.term}"
            kind, spec = _KINDS.get(self.shape), self.spec
            if kind is None or self.over not in {*spec.states} - {*spec.angles}:
                text += ": try such a term."
            elif self.state == self.over:
                text += f", as of {kind}: try such a term."
            else:  # a force between two bodies moves both
                text += f", perhaps the reaction to {kind} in {self.over}': try such a term there."
            if self.shape == "sign":  # a jump spoils slopes, and so the search
                width = _SMOOTH_SIGN * self.at.square().mean().sqrt()
                text += f" Write F*tanh({self.over}/{width:.1g}) for it, with F unknown."
            return text
        low, high = self.means.min(), self.means.max()
        return (
            f"{self.state}' lacks {low:.2g} to {high:.2g}, depending on {self.over}: the figure of "
            "its residual shows which term."
        )


class _Effect(NamedTuple):
    """What equation ``i`` may lack over a state or an action."""

    i: int
    over: str
    shape: str | float  # such as "sign"; of a lag its number of steps
    at: Array  # N, of the state or the action; of a lag the delayed action less the action
    columns: Array  # N x K


def clearest_lack(chain: Chain, estimate: Estimate, step: float) -> Lack | None:
    """Return what the equations lack most clearly; None if nothing is clear.

    What a term, bins of a state or a lag add to an equation are constants of the chain of states,
    in addition to the parameters, which may be anywhere. They are clear if their chi-square is
    beyond chance, and if either half of each stretch tells the same: what moves the machine for a
    while, whatever the states are, does not. Equations of a state whose rate is another state are
    left out.
    """
    search = _Search(chain, estimate, step)
    tests = [(*search.test(effect), effect) for effect in search.effects()]
    if not tests:
        return None
    chance, again, effect = min(tests, key=lambda test: test[0])
    if chance + math.log(len(tests)) > math.log(_CHANCE) or again < _AGAIN:
        return None
    search.explain(effect)  # the process noise estimated without it has some of it
    return search.described(effect)


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
            added.append(search.added(i, size * columns @ root))
    d, p = chain.d, chain.num_parameters
    if not added:
        return estimate.of_parameters(d)
    together = [np.concatenate(parts, -1) for parts in zip(*added, strict=True)]
    fit = search.fitted(search.links, chain.starts, together, 1.0)
    mean, covariance = (part[0] for part in fit.stretches[0].states)
    return mean[d : d + p], covariance[d : d + p, d : d + p]


class _Fit(NamedTuple):
    """A chain with further constants, smoothed, and mean and covariance of these."""

    links: list[Link]
    stretches: list[Smoothed]
    mean: Array
    covariance: Array


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

    def effects(self) -> Iterator[_Effect]:
        """Yield bins and terms of all states and actions, and lags of the actions."""
        spec = self.chain.spec
        values = {spec.states[i]: self.middle[:, k] for k, i in enumerate(spec.moving)}
        actions = self.chain.recorded[self.chain.now, spec.state_dim :].numpy()
        values |= dict(zip(spec.actions, actions.T, strict=True))
        for name in spec.angles:
            values[name] = np.arctan2(np.sin(values[name]), np.cos(values[name]))
        for i in self.equations:
            for over, x in values.items():
                bins = _bins(x, _FEW_BINS)
                if bins.shape[1] == 1:
                    continue
                terms = {"bins": bins}
                if over == spec.states[spec.moving[i]]:
                    terms["constant"] = np.ones_like(x)
                if _BOTH_SIGNS < (x > 0).mean() < 1 - _BOTH_SIGNS:
                    terms |= {"sign": np.sign(x), "drag": x * np.abs(x)}
                if over in spec.angles:
                    terms |= {"sin": np.sin(x), "cos": np.cos(x)}
                for shape, term in terms.items():
                    yield _Effect(i, over, shape, x, term.reshape(len(x), -1))
            for over, lag in product(spec.actions, _LAGS):
                late = self._late(values[over], lag)
                if late.any() and len(late) >= _IN_BIN * len(_LAGS):
                    yield _Effect(i, over, lag, late, late[:, None])

    def _late(self, action: Array, lag: float) -> Array:
        """Return an action behind a lag of first order, in steps, less the action itself."""
        late = action.copy()
        end = 0
        for length in self.lengths:
            for t in range(end + 1, end + length):
                late[t] = late[t - 1] + (1 - math.exp(-1 / lag)) * (action[t - 1] - late[t - 1])
            end += length
        return late - action

    def test(self, effect: _Effect) -> tuple[float, float]:
        """Test if an effect is beyond chance, and again in the other half of the stretches.

        Return the log of its chance, and what one half tells by the other.
        """
        i = effect.i
        K = effect.columns.shape[1]
        prior = np.eye(K) / self.wide[i] ** 2
        precision = np.zeros((2, K, K))
        pull = np.zeros((2, K))
        added = self.added(i, effect.columns / np.sqrt((effect.columns**2).mean(0)))
        anywhere = np.diag(np.append(self.chain.first_variance, [_WIDE**2] * len(self.theta)))
        for link, of_link, first in zip(self.links, added, self.chain.firsts, strict=True):
            cut = len(of_link) // 2
            for k, part in enumerate((slice(0, cut), slice(cut, len(of_link)))):
                if part.stop == part.start:
                    continue
                rows = slice(part.start, part.stop + 1)
                outputs, measured = link.outputs[rows], link.measured[rows]
                shorter = Link(link.matrices[part], link.offsets[part], outputs, measured)
                start = [(self.estimate.states[first + part.start], anywhere)]
                fit = self.fitted([shorter], start, [of_link[part]], self.wide[i])
                inverse = np.linalg.inv(fit.covariance)
                precision[k] += inverse - prior
                pull[k] += inverse @ fit.mean
        # chi^2 = h' (Lambda + P^-1)^-1 h
        h = pull.sum(0)
        square = float(h @ np.linalg.solve(precision.sum(0) + prior, h))
        # a_k' Lambda_l a_k and a_k' h_l, by the estimate a_k of one half and the other half l: the
        # ratio is standard normal if both have nothing in common.
        a = np.linalg.solve(precision + prior, pull[..., None])[..., 0]
        sizes = [math.sqrt(max(a[k] @ precision[1 - k] @ a[k], 1e-300)) for k in (0, 1)]
        again = min(float(a[k] @ pull[1 - k]) / sizes[k] for k in (0, 1))
        return _log_chance(square, K), again

    def explain(self, effect: _Effect) -> None:
        """Take the variances that are most likely with an effect in addition to the equations."""
        added = self.added(effect.i, effect.columns)
        for _ in range(_ROUNDS):
            fit = self.fitted(self.links, self.chain.starts, added, self.wide[effect.i])
            noise, process_noise = kalman.expected_squares(fit.links, fit.stretches, self.chain.d)
            mean_noise = np.nansum(noise, 0) / (~np.isnan(noise)).sum(0).clip(1)
            likely = self.chain.checked(np.stack([mean_noise, process_noise.mean(0)]))
            likely[0, self.chain.hidden] = self.variances[0, self.chain.hidden]
            self.variances = likely * np.sqrt(likely / self.variances)  # and a little further

    def described(self, effect: _Effect) -> Lack:
        """Return the residual in bins, by parameters that suit the effect."""
        i, over, shape, at, columns = effect
        d = self.chain.d
        fit = self.fitted(self.links, self.chain.starts, self.added(i, columns), self.wide[i])
        theta = fit.stretches[0].states.means[0, d : d + len(self.theta)]
        spec = self.chain.spec
        lag = None
        name = term = ""
        if isinstance(shape, float):
            lag = shape * self.step
        elif shape != "bins":
            name = shape
            term = f"{fit.mean[0]:.2g}{_TERMS[shape].format(over)}"
        bins = _bins(at, _BINS)
        links = [_at(link, d, theta) for link in self.links]
        alone = [(mean[:d], spread[:d, :d]) for mean, spread in self.chain.starts]
        fit = self.fitted(links, alone, self.added(i, bins), self.wide[i])
        left = []
        for link, (states, _) in zip(fit.links, fit.stretches, strict=True):
            ahead = np.einsum("tj,tj->t", link.matrices[:, i], states.means[:-1])
            left.append(states.means[1:, i] - ahead - link.offsets[:, i])
        residual = bins @ fit.mean + np.concatenate(left) / self.pushes[:, i, i]
        middles = np.array([np.median(at[column > 0]) for column in bins.T])
        state = spec.states[spec.moving[i]]
        numbers = (at, residual, middles, fit.mean, np.sqrt(np.diag(fit.covariance)))
        return Lack(spec, state, over, term, name, lag, *map(torch.from_numpy, numbers))

    def added(self, i: int, columns: Array) -> list[Array]:
        """Return what columns ``N x K`` in equation i add to all states, for each stretch."""
        added = self.pushes[:, :, i, None] * columns[:, None]
        return np.split(added, np.cumsum(self.lengths)[:-1])

    def fitted(
        self,
        links: list[Link],
        starts: list[tuple[Array, Array]],
        added: list[Array],
        sd: Array | float,
    ) -> _Fit:
        """Smooth a chain with further constants, which are about 0 with this standard deviation."""
        K = added[0].shape[-1]
        prior = sd**2 * np.eye(K)
        links = [*map(_with, links, added)]
        wider = [(np.append(x, np.zeros(K)), block_diag(spread, prior)) for x, spread in starts]
        stretches, _ = kalman.smooth_chain(links, wider, *self.variances)
        mean, covariance = (part[0] for part in stretches[0].states)
        return _Fit(links, stretches, mean[-K:], covariance[-K:, -K:])


def _log_chance(square: float, K: int) -> float:
    """Return the log probability of a larger chi-square; of large ones to first order."""
    chance = float(chi2.logsf(square, K))
    if chance > -math.inf:
        return chance
    # z^(a - 1) exp(-z) / Gamma(a) for z = chi^2 / 2, a = K / 2
    return (K / 2 - 1) * math.log(square / 2) - square / 2 - math.lgamma(K / 2)


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
