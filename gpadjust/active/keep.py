"""Points at which outputs stay, with a probability, where they have to."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.exceptions.errors import UnsupportedError
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.active.points import NEAR, distances

_CANDIDATES = 1024  # in all of the bounds, and as many near the points measured
_REACH = 0.1  # of the bounds' widths: how far from these
_DRAWS = 1024  # of outputs, by which probabilities are estimated: to 0.007 at 0.95
_AT_ONCE = 256  # candidates


@dataclass(frozen=True)
class Keep:
    """A limit of the outputs, and the probability with which a measurement keeps it.

    Args:
        limits: Numbers ``... x c`` of outputs ``... x m``, each of which is at most 0 where the
            outputs may be.
        probability: Of a measurement keeping them all.
    """

    limits: Callable[[Tensor], Tensor]
    probability: float

    @torch.no_grad()
    def probabilities(self, model: Any, X: Tensor) -> Tensor:
        """Probabilities ``n`` by a model, noise included, of points ``n x d``, each by itself."""
        found = []
        for some in X.split(_AT_ONCE):
            posterior = model.posterior(some.unsqueeze(-2), observation_noise=True)
            numbers = self.limits(posterior.rsample(torch.Size([_DRAWS])))
            inside = (numbers <= 0).all(-1)  # draws x n x ...
            found.append(inside.transpose(0, 1).flatten(1).double().mean(1))
        return torch.cat(found)

    def best_points(
        self,
        acquisition: AcquisitionFunction,
        model: Any,
        bounds: Tensor,
        q: int,
        measured: Tensor,
        pending: Tensor,
        failed: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Take the best of random points that are safe by the model (Sui et al. 2015).

        Args:
            acquisition: The acquisition function.
            model: The model.
            bounds: Bounds of the inputs, ``2 x d``.
            q: Number of points.
            measured: Points that were measured, ``n x d``.
            pending: As of :func:`~gpadjust.active.points.best_points`.
            failed: As of the same.

        Returns:
            The points, ``q x d``, and for each the one that would have been taken without limits,
            if that is another, ``l x d``.

        Raises:
            RuntimeError: If no point is safe.
        """
        points = self._candidates(bounds, torch.cat([measured, pending]))
        points = points[(distances(points, torch.cat([failed, pending]), bounds) >= NEAR).all(-1)]
        safe = self.probabilities(model, points) >= self.probability
        if safe.sum() < q:
            raise RuntimeError(
                f"The model knows {int(safe.sum())} of {len(points)} points as safe with a "
                f"probability of {self.probability:g}, but {q} are asked for. Tell measurements of "
                "points that you know as safe, nearer to each other, or lower the probability."
            )
        taken: list[Tensor] = []
        left_out: list[Tensor] = []
        for _ in range(q):
            away = torch.cat([pending, failed, *taken])
            if len(away):
                with suppress(UnsupportedError):  # of one point at a time, which is far from these
                    acquisition.set_X_pending(away)
            with torch.no_grad():
                values = torch.cat([acquisition(z.unsqueeze(-2)) for z in points.split(_AT_ONCE)])
            best = int(values.masked_fill(~safe, -torch.inf).argmax())
            if not safe[values.argmax()]:
                left_out.append(points[[int(values.argmax())]])
            taken.append(points[[best]])
            safe[best] = False
        return torch.cat(taken), torch.cat([bounds[:0], *left_out])

    def _candidates(self, bounds: Tensor, known: Tensor) -> Tensor:
        """Random points ``n x d`` in the bounds, half of them near those known."""
        seed = int(torch.randint(2**31, (1,)))
        everywhere = draw_sobol_samples(bounds, n=_CANDIDATES, q=1, seed=seed).squeeze(-2)
        near = known[torch.randint(len(known), (_CANDIDATES,))]
        near = near + _REACH * (bounds[1] - bounds[0]) * torch.randn_like(near)
        return torch.cat([everywhere, near.clamp(*bounds)])
