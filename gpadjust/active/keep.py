"""Points at which outputs keep limits with a probability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.active.points import NEAR, distances, taken_as_pending

_CANDIDATES = 1024  # random points in the bounds, and as many near measured points
_REACH = 0.1  # standard deviation of the latter, in the bounds' widths
_DRAWS = 1024  # of outputs, for probabilities with a standard error of 0.007 at 0.95
_AT_ONCE = 256  # candidates


@dataclass(frozen=True)
class Keep:
    """Limits of the outputs, at most 0 where permitted, and the probability to keep them."""

    limits: Callable[[Tensor], Tensor]
    probability: float

    @torch.no_grad()
    def probabilities(self, model: Any, X: Tensor) -> Tensor:
        """Return the probability of a measurement within all limits at points ``n x d``."""
        shares = []
        for points in X.split(_AT_ONCE):
            posterior = model.posterior(points.unsqueeze(-2), observation_noise=True)
            numbers = self.limits(posterior.rsample(torch.Size([_DRAWS])))
            is_inside = (numbers <= 0).all(-1)  # draws x n x 1
            shares.append(is_inside.double().mean((0, -1)))
        return torch.cat(shares)

    def best_points(
        self, acquisition: AcquisitionFunction, collection: Any, q: int
    ) -> tuple[Tensor, Tensor]:
        """Return the best of random points that are safe by the model (Sui et al. 2015), ``q x d``.

        And the unsafe points with higher values of the acquisition function, ``l x d``, at most one
        for each. Raise a RuntimeError if fewer points are safe and apart.
        """
        bounds = collection.bounds
        avoided = torch.cat([collection.pending, collection.failed_X])
        # Candidates away from failed and pending points, with their probability by the model.
        points = _candidates(bounds, torch.cat([collection.X, collection.pending]))
        points = points[(distances(points, avoided, bounds) >= NEAR).all(-1)]
        is_safe = self.probabilities(collection.model, points) >= self.probability
        num_points = len(points)
        num_safe = int(is_safe.sum())
        best_points: list[Tensor] = []
        left_out: list[Tensor] = []
        for _ in range(q):
            if not is_safe.any():
                raise RuntimeError(
                    f"By the model {num_safe} of {num_points} points are safe with a probability "
                    f"of {self.probability:g}, of which {len(best_points)} are apart by {NEAR:g} "
                    f"of the bounds' widths; expected {q}. Add measurements at points that you "
                    "know as safe, closer to each other, or lower the probability."
                )
            others = torch.cat([avoided, *best_points])
            # A function without X_pending takes single points, which are apart from others here.
            with taken_as_pending(acquisition, others), torch.no_grad():
                values = torch.cat([acquisition(z.unsqueeze(-2)) for z in points.split(_AT_ONCE)])
            # The best safe point, and the best of all if it is not safe.
            best = points[[int(values.masked_fill(~is_safe, -torch.inf).argmax())]]
            if not is_safe[values.argmax()]:
                left_out.append(points[[int(values.argmax())]])
            best_points.append(best)
            # Candidates for the rest of the batch.
            is_apart = (distances(points, best, bounds) >= NEAR).all(-1)
            points, is_safe = points[is_apart], is_safe[is_apart]
        return torch.cat(best_points), torch.cat([bounds[:0], *left_out])


def _candidates(bounds: Tensor, centers: Tensor) -> Tensor:
    """Return random points ``n x d`` in the bounds, half of them near some centers."""
    seed = int(torch.randint(2**31, (1,)))
    everywhere = draw_sobol_samples(bounds, n=_CANDIDATES, q=1, seed=seed).squeeze(-2)
    # Safe regions grow from measured points, and may be small.
    near = centers[torch.randint(len(centers), (_CANDIDATES,))]
    near = near + _REACH * (bounds[1] - bounds[0]) * torch.randn_like(near)
    return torch.cat([everywhere, near.clamp(*bounds)])
