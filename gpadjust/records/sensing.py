"""Gains, offsets and delays of a log's sensors: unknown parameters after those of the physics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from gpadjust.physics import Physics, Unknown
from gpadjust.physics.unknown import Unknowns
from gpadjust.records.kalman import Array
from gpadjust.states import Sensors, StateSpec

_STEP = 1e-4  # of differences, in standard deviations of a prior
_LONGEST = 3.0  # standard deviations of the prior of a delay, up to which measurements begin later


class Sensing:
    r"""Measurements of ``d`` states that move, :math:`y_t = g \, x(t - \tau) + o`.

    A ValueError or a TypeError refuses other sensors, and other parameters than unknown numbers.

    Args:
        sensors: The sensors, of states.
        physics: The physics, whose parameters come first.
        spec: The entries of states and actions.
        step: The time from one row to the next.
    """

    def __init__(self, sensors: Sensors, physics: Physics, spec: StateSpec, step: float) -> None:
        names = [spec.states[i] for i in spec.moving]
        is_wrong = sensors.function is not None or bool(sensors.noise)
        is_wrong |= any(name in spec.angles for name in sensors.gain)
        if is_wrong or not {*sensors.outputs} <= {*names}:
            raise ValueError(
                f"Expected sensors of {', '.join(names)}, states that move, without a function, "
                f"noise (an argument of `smooth`) and gains of angles; found {sensors}."
            )
        self.step = step
        self.first = len(physics.unknowns)
        self.places = list[tuple[int, int]]()  # kind and state of each parameter
        priors = dict[str, Unknown]()
        for row, (kind, unknowns) in enumerate(sensors.unknowns.items()):
            for name, unknown in unknowns.items():
                priors[f"{name}_{kind}"] = unknown
                self.places.append((row, names.index(name)))
        Unknowns(priors).refuse_functions()
        self.unknowns = Unknowns.together([physics.unknowns, Unknowns(priors)])
        if len(self.unknowns) < self.first + len(priors):
            raise ValueError(f"The physics has a parameter of a name of {', '.join(priors)}.")
        self.longest = np.zeros(len(names), int)  # rows of a delay
        for name, unknown in sensors.delay.items():
            longest = float(unknown.value(torch.tensor(_LONGEST, dtype=torch.float64)))
            self.longest[names.index(name)] = math.ceil(max(longest, 0.0) / step)

    def values(self, parameters: Array) -> Array:
        """Return gains, offsets and delays in steps, ``... x 3 x d``, by parameters ``... x p``."""
        values = np.zeros((*parameters.shape[:-1], 3, len(self.longest)))
        values[..., 0, :] = 1.0
        rows, columns = zip(*self.places, strict=True)
        numbers = self.unknowns.to_values(torch.from_numpy(parameters)).numpy()
        values[..., rows, columns] = numbers[..., self.first :]
        values[..., 2, :] /= self.step
        return values

    def outputs(self, states: Array, parameters: Array, stretches: Sequence[slice]) -> Array:
        """Return outputs of the states of all stretches, ``M x d``."""
        gain, offset, delay = self.values(parameters)
        late = np.concatenate([_late(states[rows], delay) for rows in stretches])
        outputs: Array = gain * late + offset
        return outputs

    def corrected(self, measured: Array, parameters: Array, stretches: Sequence[slice]) -> Array:
        """Return the states ``M x d`` that measurements show; with a delay NaN at the end."""
        gain, offset, delay = self.values(parameters)
        shown = measured.copy()
        for i in np.flatnonzero(delay):
            for rows in stretches:
                at = np.arange(rows.stop - rows.start)
                shown[rows, i] = np.interp(at + delay[i], at, measured[rows, i], right=math.nan)
        corrected: Array = (shown - offset) / gain
        return corrected

    def linearised(self, states: Array, parameters: Array, measured: Array) -> tuple[Array, Array]:
        r"""Linearise outputs of a stretch near its states, ``n x d``.

        A measurement goes to the row k that is nearest to the time of its state, and
        :math:`x(t - \tau) - x_k` is as along these states.

        Returns:
            ``H``, ``n x d x (d + p)``, and measurements of ``H z``, ``n x d``, with z the states
            and parameters.
        """
        n, d = states.shape
        H = np.tile(np.eye(d, d + len(parameters)), (n, 1, 1))
        gain, offset, delay = self.values(parameters)
        late = _late(states, delay)
        speed = _late(states, delay, derivative=1)
        steps = _STEP * np.eye(len(parameters))
        slopes = self.values(parameters + steps) - self.values(parameters - steps)
        slopes = np.moveaxis(slopes / (2 * _STEP), 0, -1)
        # dy / dz = x(t - tau) dg/dz + do/dz - g x'(t - tau) dtau/dz
        of_parameters = late[..., None] * slopes[0] + slopes[1]
        of_parameters -= (gain * speed)[..., None] * slopes[2]
        errors = measured - (gain * late + offset) + of_parameters @ parameters
        H *= gain[:, None]
        y = np.full((n, d), math.nan)
        for i, rows in enumerate(np.rint(delay).astype(int).clip(0, n)):
            H[: n - rows, i, d:] = of_parameters[rows:, i]
            y[: n - rows, i] = errors[rows:, i]
        return H, y + gain * states


def _late(states: Array, delay: Array, derivative: int = 0) -> Array:
    """Return states of a stretch, ``n x d``, or their derivatives, as many steps before."""
    rows = np.arange(len(states))
    late = states.copy()
    for i in range(len(delay)):
        if delay[i] != 0 or derivative:
            at = (rows - delay[i]).clip(0, len(rows) - 1)
            late[:, i] = CubicSpline(rows, states[:, i])(at, derivative)
    return late
