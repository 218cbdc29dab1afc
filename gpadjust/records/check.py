"""Check before a fit: the directions of the parameters that a log tells, and better inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.physics import Physics, PhysicsError
from gpadjust.records import kalman
from gpadjust.records.chain import Chain, chain_of
from gpadjust.records.kalman import Array
from gpadjust.records.records import Records
from gpadjust.states import Sensors
from gpadjust.states.state_spec import side_by_side

_WEAK = 1.0  # a singular value: the log halves the variance of the prior
_SHARE = 0.2  # the least weight that is named
_PERIODS = (4, 16, 64)  # half periods of an input that is tried, in parts of the log
_LONGEST = 500  # steps of an input that is tried


class Direction(NamedTuple):
    """A direction of the parameters, and how clearly a log tells it."""

    weights: dict[str, float]  # in standard deviations of the priors, of norm 1
    value: float  # errors of the sensors by which one standard deviation moves all measurements
    input: str  # the one that would tell it best, and the value with both; empty if determined

    def __str__(self) -> str:
        """Return the direction, its value and the input in a sentence."""
        if self.value >= _WEAK:
            return f"The log tells {self._text} (singular value {self.value:.3g})."
        return f"The log cannot tell {self._text} (singular value {self.value:.2g}). {self.input}"

    def __repr__(self) -> str:
        # Short, as a list of them is printed.
        return f"Direction({self._text}: {self.value:.3g})"

    @property
    def _text(self) -> str:
        """The large weights: 0.71 a -0.71 b."""
        named = [f"{w:+.2f} {name}" for name, w in self.weights.items() if abs(w) > _SHARE]
        return " ".join(named).removeprefix("+")


def check_log(
    records: Records,
    physics: Physics | Callable[[Tensor], Tensor],
    step: float | None = None,
    *,
    start: Mapping[str, tuple[float, float]] | None = None,
    sensors: Sensors | None = None,
) -> list[Direction]:
    r"""Check which directions of the unknown parameters a log can tell, before a fit.

    With J the sensitivities of a free run to the parameters, at their guesses and in standard
    deviations of their priors, first states unknown, and R the variance of the sensors' noise, as
    large as the log is rough at most, these are the eigenvectors of :math:`J^\top R^{-1} J`, and
    the singular values the roots of its eigenvalues. One below 1 leaves the prior nearly as it is.
    f_p is evaluated some :math:`2 (d + p) + 2` times a row, for d states and p parameters.

    Args:
        records: The records, as of :func:`smooth`.
        physics: The next states, with unknown parameters.
        step: The control step, as of :func:`smooth`.
        start: Of hidden states by name, mean and standard deviation at the beginning.
        sensors: As of :func:`smooth`.

    Returns:
        The directions, the clearest first. Of those that the log does not tell, each names the
        square wave of an action, as large as those recorded, that would tell it best together with
        the log, or that none of a few does.

    Raises:
        ValueError: If the physics has no unknown parameters; and as :func:`smooth`, as are other
            errors.

    Example:
        >>> import torch
        >>> from gpadjust import FormulaPhysics, ODEPhysics, Unknown
        >>> from gpadjust.records import Record, Records, check_log
        >>> from gpadjust.states import StateSpec
        >>> t = 0.1 * torch.arange(60, dtype=torch.float64)
        >>> x = t.cos().unsqueeze(-1) + 0.01 * torch.randn(60, 1, dtype=torch.float64)
        >>> unknowns = {"a": Unknown(1.0, factor=2.0), "b": Unknown(1.0, factor=2.0)}
        >>> rate = FormulaPhysics("b * u - a * x", ["x", "u"], unknowns=unknowns)
        >>> log = Records(Record(t, x, torch.zeros_like(x)), StateSpec(["x"], ["u"]))
        >>> print(check_log(log, ODEPhysics(rate, 0.1, 1))[-1])  # doctest: +ELLIPSIS
        The log cannot tell 1.00 b (singular value 0). A square wave of u between ...
    """
    chain = chain_of(records, physics, step, start, sensors=sensors)
    if not chain.unknowns:
        raise ValueError("Expected a physics with unknown parameters; found none, to check.")
    noise = np.maximum(_roughness(chain), chain.least)
    information = _information(chain, noise)
    values, vectors = np.linalg.eigh(information)
    inputs = _Inputs(chain, noise, information)
    directions = []
    for value, vector in zip(np.sqrt(values.clip(0))[::-1], vectors.T[::-1], strict=True):
        vector = vector * np.sign(vector[np.abs(vector).argmax()])
        weights = dict(zip(chain.unknowns, vector.tolist(), strict=True))
        text = ""
        if value < _WEAK:
            text = inputs.best(vector)
        directions.append(Direction(weights, float(value), text))
    return directions


def _roughness(chain: Chain) -> Array:
    """Return variances of white noise by third differences, which are 20 times as large."""
    differences = [np.diff(chain.measured[rows], 3, axis=0) for rows in chain.stretches]
    squares = np.concatenate(differences) ** 2
    number = (~np.isnan(squares)).sum(0)
    variances: Array = np.nansum(squares, 0) / (20 * number.clip(1))
    return variances


def _information(chain: Chain, noise: Array, outputs: Array | None = None) -> Array:
    """Return the information of all stretches on the parameters, ``p x p``: J' J / R.

    ``outputs`` are in the place of each row of measurements, of which only NaN has an effect.
    """
    d, p = chain.d, chain.num_parameters
    information = np.zeros((p, p))
    links = chain.linearised(chain.first_path(np.zeros(p)))
    for link, start in zip(links, chain.starts, strict=True):
        if outputs is not None:
            link = link._replace(measured=np.tile(outputs, (len(link.measured), 1)))
        (smoothed,), _ = kalman.smooth_chain([link], [start], noise, chain.least)
        information += np.linalg.inv(smoothed.states.covariances[0, d:, d:]) - np.eye(p)
    even: Array = (information + information.T) / 2
    return even


class _Inputs:
    """Square waves of single actions, and the information of the log with each of them.

    Args:
        chain: The log.
        noise: Variances of the sensors.
        information: By the log alone, ``p x p``.
    """

    def __init__(self, chain: Chain, noise: Array, information: Array) -> None:
        self.chain = chain
        self.noise = noise
        self.of_log = information

    @cached_property
    def tried(self) -> list[tuple[str, Array]]:
        """Inputs in words, and the information with each; without those where f_p fails."""
        chain = self.chain
        length = min(max(len(record.times) for record in chain.steps), _LONGEST)
        recorded = torch.cat([record.actions for record in chain.steps])
        low, high = recorded.aminmax(dim=0)
        is_constant = low == high
        low, high = low - is_constant.to(low), high + is_constant.to(high)
        step = chain.steps.records[0].sampling_step
        outputs = np.where(chain.hidden, math.nan, 0.0)
        tried = []
        for j, name in enumerate(chain.spec.actions):
            for parts in _PERIODS:
                half = max(1, length // parts)
                actions = recorded.mean(0).repeat(length, 1)
                is_high = torch.arange(length) // half % 2 == 0
                actions[:, j] = torch.where(is_high, high[j], low[j])
                text = (
                    f"A square wave of {name} between {low[j]:.3g} and {high[j]:.3g} with half a "
                    f"period of {half * step:.3g}"
                )
                with suppress(PhysicsError, np.linalg.LinAlgError):
                    information = _information(_under(chain, actions), self.noise, outputs)
                    tried.append((text, self.of_log + information))
        return tried

    def best(self, vector: Array) -> str:
        """Return a sentence on the input that tells a direction best, beside all others."""
        if len(self.chain.spec.moving) < self.chain.spec.state_dim:
            return "Other inputs are tried for states that all move only."
        best = 0.0
        sentence = "None of the inputs that were tried does."
        for text, information in self.tried:
            # Of v' theta, with the prior N(0, 1): 1 / variance - 1
            variance = vector @ np.linalg.solve(information + np.eye(len(vector)), vector)
            value = math.sqrt(max(1 / float(variance) - 1, 0.0))
            if value >= _WEAK and value > best:
                best = value
                sentence = f"{text} would: {value:.3g}."
        return sentence


def _under(chain: Chain, actions: Tensor) -> Chain:
    """Return the chain of a single stretch under other actions, of which nothing is measured."""
    other = copy(chain)
    length = len(actions)
    other.lengths = np.array([length])
    other.firsts = np.array([0])
    other.stretches = [slice(0, length)]
    other.now = np.arange(length - 1)
    states = torch.zeros(length, chain.spec.state_dim, dtype=torch.float64)
    other.recorded = side_by_side(states, actions)
    other.within = actions.unsqueeze(1).expand(-1, chain.within.shape[1], -1)
    other.measured = np.full((length, chain.d), math.nan)
    other.first, other.starts = chain.first[:1], chain.starts[:1]
    return other
