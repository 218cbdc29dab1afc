"""Noise that grows with the size of the measured quantity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import torch
from torch import Tensor

from gpadjust.core import GP, Noise
from gpadjust.core.data import Data
from gpadjust.core.kernels import exponents
from gpadjust.core.terms import Places, TermSum

_FLOOR = 1e-3  # smallest size, as a share of the largest
_NEAR = 0.5  # lengthscale of the sizes, as a share of the shortest lengthscale
_FAR = 1e-6  # weight of the mean of all log sizes, which decides far from the data
_SETTLED = 0.2  # change of a log size at which the iteration ends
_ROUNDS = 4


class RelativeNoise(Noise):
    r"""Noise of the variance :math:`s_0 + s_1 g(x)^2`, with both numbers unknown.

    The size g is the physics (the sum of several, with the prior means of the rhos) over its root
    mean square at the training inputs. In a model without physics, g is the posterior mean of rough
    fits there, whose logarithms an RBF kernel of half the shortest lengthscale averages.

    Args:
        sizes: Results of a fit without physics: training inputs ``m x n x d``, log sizes
            ``m x n``, lengthscales ``m x 1 x d``, and root mean squares ``m x 1``.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA, fit
        >>> X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
        >>> Y = (1 + 0.05 * torch.cos(99 * X)) * torch.exp(6 * X)
        >>> model = CKA(X, Y, physics=lambda X: torch.exp(6 * X), noise=RelativeNoise())
        >>> result = fit(model)
        >>> _, relative = model.noise.standard_deviations(model)
        >>> 0.02 < relative.median() < 0.1
        tensor(True)
    """

    def __init__(self, sizes: Sequence[Tensor] | None = None) -> None:
        super().__init__(("constant", "relative"))
        self.sizes = None if sizes is None else tuple(sizes)
        self.means: list[tuple[int, float]] = []  # number and prior mean of rho of each physics
        self.size: Tensor | float = 1.0 if sizes is None else sizes[-1]  # root mean square of g

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments."""
        return {"sizes": self.sizes}

    def of_data(self, data: Data, terms: TermSum) -> RelativeNoise:
        """Return the noise with g by the prior mean of a model of these terms."""
        new = RelativeNoise(self.sizes)
        new.means = [(t.physics, t.mean) for t in terms.terms if t.physics is not None]
        if new.means:
            f_p = torch.stack([mean * terms.f[i] for i, mean in new.means]).sum(0)
            size = f_p.square().mean(-1, keepdim=True).sqrt()
            new.size = size.where(size > 0, torch.ones_like(size))
        return new

    def shares(self, places: Places) -> Tensor:
        """Return 1 and the square of g, ``... x S x m x n x 2``."""
        squares = torch.ones_like(places.kernel_inputs[..., 0])
        if self.means:
            f_p = torch.stack([mean / self.size * places.f[i] for i, mean in self.means])
            squares = f_p.sum(0).square()
        elif self.sizes is not None:
            points, logs, lengths, _ = self.sizes
            middle = points.mean(-2, keepdim=True)
            # log g(x) = (sum_i k(x, x_i) log g_i + c mean_i log g_i) / (sum_i k(x, x_i) + c)
            x = (places.kernel_inputs - middle) / lengths
            near = exponents(x, (points - middle) / lengths).exp()
            total = (near @ logs.unsqueeze(-1)).squeeze(-1)
            mean = logs.mean(-1, keepdim=True)
            squares = (2 * (total + _FAR * mean) / (near.sum(-1) + _FAR)).exp()
        return torch.stack([torch.ones_like(squares), squares], -1)

    @torch.no_grad()
    def learnt(self, model: Any, fitted: Callable[[Noise], Any]) -> RelativeNoise:
        """Return the noise with the sizes of the posterior mean, if there is no physics."""
        if type(model).on_gaussian_scale is not GP.on_gaussian_scale:
            raise ValueError(
                "Expected RelativeNoise without a link: with one, noise is that of g(y), which a "
                "logarithm makes relative already. Leave one of them out."
            )
        if self.means:
            return self
        noise = RelativeNoise()
        x = model.data.kernel_inputs(model.data.X)
        old_logs = x.new_zeros(())
        ranges = (x.amax(-2) - x.amin(-2)).expand(model.num_outputs, -1)
        for _ in range(_ROUNDS):
            rough = fitted(noise)
            mean, _ = rough.conditioning().mean(rough.evaluate(model.data.X))
            # g is the absolute posterior mean, with a floor near its zeros.
            sizes = mean[0].abs().maximum(_FLOOR * mean[0].abs().amax(-1, keepdim=True))
            size = sizes.square().mean(-1, keepdim=True).sqrt()
            logs = (sizes / size).log()
            values = rough.values.items()
            lengths = [v[0].detach() for name, v in values if name.endswith("kernel.lengthscale")]
            shortest = torch.stack(lengths or [ranges]).amin(0).unsqueeze(-2)
            noise = RelativeNoise((x.expand(len(logs), -1, -1), logs, _NEAR * shortest, size))
            if (logs - old_logs).abs().amax() <= _SETTLED:
                break
            old_logs = logs
        return noise

    def standard_deviations(self, model: Any) -> tuple[Tensor, Tensor]:
        """Return draws ``N x m`` of the constant, in the user's units, and of the relative one."""
        values = model.table.values(model.draws)
        constant, relative = (values[f"noise.{name}"].squeeze(-1).sqrt() for name in self.names)
        # s_1 belongs to g = f_p / size, the user's share to f_p.
        share = relative / torch.as_tensor(self.size).squeeze(-1)
        return constant * model.unit.squeeze(-1), share

    def of_outputs(self, outputs: Sequence[int]) -> RelativeNoise:
        """Return the noise of some outputs."""
        return self._changed(lambda v: v[[*outputs]])

    def to(self, like: Tensor) -> RelativeNoise:
        """Return the noise on the device of a tensor."""
        return self._changed(lambda v: v.to(like))

    def _changed(self, change: Callable[[Tensor], Tensor]) -> RelativeNoise:
        new = copy(self)
        if self.sizes is not None:
            new.sizes = tuple(map(change, self.sizes))
        if isinstance(self.size, Tensor):
            new.size = change(self.size)
        return new
