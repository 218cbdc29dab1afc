"""Points at which outputs stay, with a probability, where they have to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.active.points import NEAR, distances, taken_as_pending

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
        """Return probabilities ``n`` by a model, noise included, of each of ``n x d`` points."""
        found = []
        for some in X.split(_AT_ONCE):
            posterior = model.posterior(some.unsqueeze(-2), observation_noise=True)
            numbers = self.limits(posterior.rsample(torch.Size([_DRAWS])))
            inside = (numbers <= 0).all(-1)  # draws x n x 1
            found.append(inside.double().mean((0, -1)))
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
            RuntimeError: If fewer points are safe, or these are too near to each other.
        """
        points = self._candidates(bounds, torch.cat([measured, pending]))
        points = points[(distances(points, torch.cat([failed, pending]), bounds) >= NEAR).all(-1)]
        safe = self.probabilities(model, points) >= self.probability
        num_points, num_safe = len(points), int(safe.sum())
        taken: list[Tensor] = []
        left_out: list[Tensor] = []
        for _ in range(q):
            if not safe.any():
                raise RuntimeError(
                    f"The model knows {num_safe} of {num_points} points as safe with a probability "
                    f"of {self.probability:g}, of which {len(taken)} are apart by {NEAR:g} of the "
                    f"bounds' widths, but {q} are asked for. Tell measurements of points that you "
                    "know as safe, nearer to each other, or lower the probability."
                )
            away = torch.cat([pending, failed, *taken])
            # One that counts on none takes one point at a time, which is far from these anyway.
            with taken_as_pending(acquisition, away), torch.no_grad():
                values = torch.cat([acquisition(z.unsqueeze(-2)) for z in points.split(_AT_ONCE)])
            best = points[[int(values.masked_fill(~safe, -torch.inf).argmax())]]
            if not safe[values.argmax()]:
                left_out.append(points[[int(values.argmax())]])
            taken.append(best)
            apart = (distances(points, best, bounds) >= NEAR).all(-1)
            points, safe = points[apart], safe[apart]
        return torch.cat(taken), torch.cat([bounds[:0], *left_out])

    def _candidates(self, bounds: Tensor, known: Tensor) -> Tensor:
        """Return random points ``n x d`` in the bounds, half of them near those known."""
        seed = int(torch.randint(2**31, (1,)))
        everywhere = draw_sobol_samples(bounds, n=_CANDIDATES, q=1, seed=seed).squeeze(-2)
        near = known[torch.randint(len(known), (_CANDIDATES,))]
        near = near + _REACH * (bounds[1] - bounds[0]) * torch.randn_like(near)
        return torch.cat([everywhere, near.clamp(*bounds)])
