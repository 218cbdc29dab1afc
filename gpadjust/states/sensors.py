"""Measured outputs of a state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from gpadjust.checks import check_choice, check_kind, checked_number
from gpadjust.states.state_spec import StateSpec, checked_names


@dataclass(frozen=True, eq=False)
class Sensors:
    r"""The measured outputs of a state, with noise; the rest of the state is hidden.

    Args:
        outputs: The names of the measured states, angles as their sine and cosine; or the names of
            the outputs of ``function``.
        function: Outputs ``N x len(outputs)`` of states ``N x state_dim``, in PyTorch. Default: the
            states with the names ``outputs``.
        noise: Guesses of the standard deviations of the noise, by the name of the output, each with
            the weight of ten measurements. Default: at first a tenth of the change of an output in
            a step, then an estimate.
        gain, offset, delay: Of a log, :func:`~gpadjust.records.smooth` estimates these: by the name
            of the output an :class:`~gpadjust.physics.Unknown` each, with
            :math:`y_t = \text{gain} \, x(t - \text{delay}) + \text{offset}`, the delay in the
            unit of the times. Default: 1, 0 and 0.

    Raises:
        TypeError, ValueError: If there is no output, names are not strings, ``function`` is not a
            function, or a guess has an unknown name or is not positive; later, if a function
            returns another shape, or an output is not a state and there is no function.

    Example:
        >>> import torch
        >>> from gpadjust.states import Sensors, StateSpec
        >>> spec = StateSpec(["theta", "theta_dot"], ["torque"], angles=["theta"])
        >>> encoder = Sensors(["theta"])
        >>> values = encoder.measure(spec, torch.tensor([[0.5, 2.0]]))
        >>> encoder.spec(spec).observe(values)
        tensor([[0.4794, 0.8776]])
        >>> camera = Sensors(["height"], lambda states: states[:, :1].cos())
        >>> camera.measure(spec, torch.tensor([[0.5, 2.0]]))
        tensor([[0.8776]])
    """

    outputs: Sequence[str]
    function: Callable[[Tensor], Tensor] | None = None
    _: KW_ONLY
    noise: Mapping[str, float] = field(default_factory=dict)
    gain: Mapping[str, Any] = field(default_factory=dict)
    offset: Mapping[str, Any] = field(default_factory=dict)
    delay: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check names and guesses."""
        object.__setattr__(self, "outputs", checked_names("outputs", self.outputs))
        if not self.outputs:
            raise ValueError("outputs must be one or more different names; found none.")
        # The class is frozen: attributes are set by the base class.
        if self.function is not None:
            check_kind("function", self.function, Callable, "a function of states")
        object.__setattr__(self, "noise", dict(self.noise))
        for name, guess in self.noise.items():
            checked_number(f"The noise of {name!r}", guess, above=0)
            check_choice("output", name, self.outputs)
        for argument, unknowns in self.unknowns.items():
            for name in unknowns:
                check_choice(f"output of {argument}", name, self.outputs)

    @property
    def unknowns(self) -> dict[str, Mapping[str, Any]]:
        """Unknown parameters by ``"gain"``, ``"offset"`` and ``"delay"``, and by output."""
        return {"gain": self.gain, "offset": self.offset, "delay": self.delay}

    def spec(self, spec: StateSpec) -> StateSpec:
        """Return a spec with the outputs as its states."""
        if self.function is not None:
            return StateSpec(self.outputs, spec.actions)
        for name in self.outputs:
            if name not in spec.states:
                raise ValueError(
                    f"Sensors: there is no state {name!r}; the states are {spec.states}. For other "
                    "outputs give a function, Sensors(names, function)."
                )
        # A measured angle is observed by its sine and cosine, as is the state.
        angles = [name for name in self.outputs if name in spec.angles]
        return StateSpec(self.outputs, spec.actions, angles=angles)

    def measure(self, spec: StateSpec, states: Tensor) -> Tensor:
        """Return outputs ``N x len(outputs)`` of states ``N x state_dim``, without noise."""
        # An estimate of these is in the fit of a log, not in the sensors.
        if any(self.unknowns.values()):
            raise ValueError(
                "Sensors: an unknown gain, offset or delay is for `smooth` and `identify`; give "
                "these sensors to one of them, and correct later measurements by its estimate."
            )
        if self.function is None:
            return states[:, [spec.states.index(name) for name in self.outputs]]
        values: Any = self.function(states)  # of the user: anything
        shape = len(states), len(self.outputs)
        if not isinstance(values, Tensor) or values.shape != shape:
            raise ValueError(
                f"Sensors: function must return a tensor of shape {shape[0]} x {shape[1]}, the "
                f"outputs {self.outputs} of each state; found {tuple(np.shape(values))}."
            )
        return values

    def describe(self) -> dict[str, Any]:
        """Return the sensors in plain values, with True for a function."""
        settings = {"outputs": [*self.outputs], "function": self.function is not None}
        if self.noise:  # left out by default, as in older files
            settings["noise"] = self.noise
        return settings
