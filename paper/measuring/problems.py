"""What is measured: the truth, the physics, and where one may measure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.dynamics import AngleInput
from gpadjust.physics import ODEPhysics
from gpadjust.systems import CartPoleEquation, cart_pole
from gpadjust.systems.swing_up import REAL_CART_POLE, SUBSTEP, TIME_STEP
from paper.common.learners import LEARNERS
from paper.forrester.problem import LOWER, UPPER, crude_b, truth
from paper.structures.functions import PAIRS

CART_POLE_LIMITS = (1.0, math.pi, 3.0, 8.0, 10.0)  # m, rad, m/s, rad/s, N, to either side
_TEST_SEED = 20_000  # beyond those of runs, so that their points are others


@dataclass(frozen=True)
class Problem:
    """A system to measure, and what is believed of it.

    Attributes:
        bounds: Lower and upper bounds of the inputs, ``2 x d``.
        truth: Maps ``n x d`` to ``n x m``, without noise.
        physics: f_p, of the same shapes.
        angles: The inputs that are angles.
    """

    bounds: Tensor
    truth: Callable[[Tensor], Tensor]
    physics: Callable[[Tensor], Tensor]
    angles: tuple[int, ...] = ()

    def sobol(self, n: int, seed: int) -> Tensor:
        """The first ``n`` points of a scrambled Sobol sequence in the bounds, ``n x d``."""
        return draw_sobol_samples(self.bounds, n=n, q=1, seed=seed).squeeze(-2)

    def uniform(self, n: int, seed: int) -> Tensor:
        """Independent points in the bounds, ``n x d``."""
        generator = torch.Generator().manual_seed(seed)
        unit = torch.rand(n, self.bounds.shape[1], generator=generator, dtype=torch.float64)
        return self.bounds[0] + (self.bounds[1] - self.bounds[0]) * unit

    def test_points(self, n: int) -> tuple[Tensor, Tensor]:
        """The points that all runs are scored at, and the truth there."""
        X = self.sobol(n, _TEST_SEED)
        return X, self.truth(X)

    def model(self, X: Tensor, Y: Tensor, kind: str) -> Any:
        """A new model of measurements, of ``paper.common.learners``."""
        transform = AngleInput(self.angles) if self.angles else None
        return LEARNERS[kind].make(X, Y, physics=self.physics, input_transform=transform)


def problem(name: str, seed: int) -> Problem:
    """The problem of a given name; the seed is that of the physics, where it is random."""
    return _MAKE[name](seed)


def _forrester(seed: int) -> Problem:
    bounds = torch.tensor([[LOWER], [UPPER]], dtype=torch.float64)
    return Problem(bounds, truth, crude_b)


def _pair(name: str) -> Callable[[int], Problem]:
    """A pair of low and high fidelity."""

    def make(seed: int) -> Problem:
        functions = PAIRS[name]
        return Problem(functions.bounds, functions.truth, functions.smooth_physics())

    return make


def _cart_pole(seed: int) -> Problem:
    upper = torch.tensor(CART_POLE_LIMITS, dtype=torch.float64)
    believed: Any = cart_pole(seed).physics
    return Problem(
        torch.stack([-upper, upper]),
        _change(REAL_CART_POLE),
        _change(believed.rhs),
        angles=(1,),
    )


def _change(equation: CartPoleEquation | Callable[[Tensor, Tensor], Tensor]) -> ODEPhysics:
    """The change of the state in a time step, from state and force."""
    substeps = round(TIME_STEP / SUBSTEP)
    return ODEPhysics(
        equation, TIME_STEP, state_dim=4, substeps=substeps, difference=True, name="cart_pole"
    )


_MAKE: dict[str, Callable[[int], Problem]] = {
    "forrester": _forrester,
    "currin": _pair("currin"),
    "park91a": _pair("park91a"),
    "cartpole": _cart_pole,
}
