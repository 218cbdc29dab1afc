"""Swinging up the pole of a cart-pole, as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.checks import check_switch, checked_options, finite_array
from gpadjust.systems.cart_pole import (
    CART_POLE_RAW_SPEC,
    CART_POLE_SPEC,
    REAL_CART_POLE,
    START_MEAN,
    START_STD,
    TIME_STEP,
    CartPoleEquation,
    cart_pole_cost,
    equation_physics,
)
from gpadjust.systems.cart_pole_view import CartPoleView
from gpadjust.systems.rendering import RENDER_MODES, ViewedEnv

MAX_FORCE = 10.0
MAX_START = 100.0  # far beyond what forces do; the equation can be integrated there


class CartPoleSwingUpEnv(ViewedEnv[CartPoleView]):
    r"""Swing up the pole of a cart-pole and balance it, by pushing the cart.

    The pole hangs at first. The action, a force in [-10, 10] N, is held for a time step; stronger
    forces are clipped. The observation is
    :math:`[x, \sin\theta, \cos\theta, \dot{x}, \dot\theta]`, with the angle from upright;
    ``state`` has the true state in float64. The reward is minus the cost
    of the state that was reached, in [-1, 0], by the distance of the tip from its goal; the
    ``info`` of a step has the ``"cost"``. An episode does not terminate; ``gym.make`` truncates it
    after 25 steps.

    ``reset(options={"state": [x, theta, x_dot, theta_dot]})`` starts from this state.

    Environments can be pickled at any time and go on as they were, with their random state; the
    window of a copy opens again.

    Args:
        render_mode: ``"human"`` shows a window, ``"rgb_array"`` lets ``render`` return a frame.
            Both need the package ``pygame-ce``.
        encode_angle: Whether the observation has sine and cosine in place of the angle. Without,
            it is the state :math:`[x, \theta, \dot{x}, \dot\theta]`, the angle not wrapped.
        equation: The system. Default: the real one.
        time_step: In s.

    Raises:
        TypeError: If ``encode_angle`` is no bool, ``equation`` no equation or ``time_step`` no
            number.
        ValueError: If there is no such render mode, or ``time_step`` is not positive.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("gpadjust.systems:gpadjust/CartPoleSwingUp-v0")
        >>> observation, info = env.reset(options={"state": [0.0, 0.0, 0.0, 0.0]})
        >>> observation
        array([0., 0., 1., 0., 0.], dtype=float32)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.high)
        >>> round(reward, 3)
        -0.004
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": round(1 / TIME_STEP)}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        encode_angle: bool = True,
        equation: CartPoleEquation = REAL_CART_POLE,
        time_step: float = TIME_STEP,
    ) -> None:
        super().__init__(render_mode)
        check_switch("encode_angle", encode_angle)
        if not isinstance(equation, CartPoleEquation):
            raise TypeError(
                f"equation must be a CartPoleEquation, such as REAL_CART_POLE; found {equation!r}."
            )
        self.equation = equation
        self.physics = equation_physics(equation, time_step)
        self.metadata = {**self.metadata, "render_fps": max(round(1 / time_step), 1)}
        self.state_spec = CART_POLE_SPEC if encode_angle else CART_POLE_RAW_SPEC
        high = [np.inf, 1.0, 1.0, np.inf, np.inf] if encode_angle else [np.inf] * 4
        bound = np.array(high, dtype=np.float32)
        self.observation_space = gym.spaces.Box(-bound, bound, dtype=np.float32)
        self.action_space = gym.spaces.Box(-MAX_FORCE, MAX_FORCE, (1,), dtype=np.float32)
        self._force = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: For the random start, and those that follow.
            options: ``{"state": ...}``, the four entries of the state to start from, of magnitude
                at most 100. Default: drawn around the hanging pole at rest, with standard
                deviation 0.2.

        Returns:
            The observation and an empty ``info``.

        Raises:
            TypeError: If ``options`` is no dictionary.
            ValueError: If ``options`` has another key, or the state is not four such numbers.
        """
        super().reset(seed=seed)
        options = checked_options("options", options, ("state",))
        if "state" in options:
            given = finite_array(options["state"], (4,))
            if given is None or (np.abs(given) > MAX_START).any():
                raise ValueError(
                    "options['state'] must be four finite numbers, x, theta, x_dot and theta_dot, "
                    f"of magnitude at most {MAX_START:g}; found {options['state']!r}."
                )
            state = given
        else:
            state = self.np_random.normal(START_MEAN, START_STD)
        self.state = state
        self._force = 0.0
        self._show()
        return self._observe(state), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push the cart for a time step.

        Args:
            action: The force in N, of shape ``(1,)``; clipped to [-10, 10].

        Returns:
            Observation, reward, False, False and ``{"cost": ...}``.

        Raises:
            ValueError: If the action is not one finite number.
            gymnasium.error.ResetNeeded: If no episode was started.
        """
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset before the first step.")
        force = finite_array(action, (1,))
        if force is None:
            raise ValueError(
                f"The action must be one finite force, of shape (1,); found {action!r}."
            )
        force = force.clip(-MAX_FORCE, MAX_FORCE)
        with torch.no_grad():
            row = torch.from_numpy(np.concatenate([self.state, force]))
            state = self.physics(row.unsqueeze(0)).squeeze(0)
            cost = cart_pole_cost(state, self.equation.pole_length).item()
        self.state = state.numpy()
        self._force = float(force[0])
        self._show()
        return self._observe(self.state), -cost, False, False, {"cost": cost}

    def _open_view(self, frames_per_second: int | None) -> CartPoleView:
        return CartPoleView(self.equation.pole_length, MAX_FORCE, frames_per_second)

    def _draw(self, view: CartPoleView, state: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        return view.draw(state[0], state[1], self._force)

    def _observe(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        return self.state_spec.observe(torch.from_numpy(state)).numpy().astype(np.float32)
