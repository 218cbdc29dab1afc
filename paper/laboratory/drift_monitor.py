"""A monitor of a model that is updated: has rho or delta left the interval that it had?"""

from __future__ import annotations

from statistics import NormalDist
from typing import Any

import torch
from torch import Tensor

from gpadjust.models import TermsGP

LEVEL = 0.95
FALSE_ALARMS = 1e-5  # at a check, of all terms and points together


class DriftMonitor:
    r"""A monitor of up to five training inputs that are far apart.

    There is an alarm where a mean m has left the interval :math:`m_0 \pm z s_0` of the reference
    time, and :math:`|m - m_0| > z' \sqrt{s_0^2 + s^2}`, with z' by ``FALSE_ALARMS``.
    """

    def __init__(self, model: TermsGP) -> None:
        data: Any = model.data()["train_X"]
        self.model, self.X = model, _far_apart(data, 5)
        self.reset()

    def reset(self) -> None:
        """Take the model as it is now for the reference."""
        self.reference = self._moments()

    def check(self) -> str | None:
        """Return the name of the function that is farthest from its interval, or None."""
        now = self._moments()
        count = sum(mean.numel() for mean, _ in now.values())
        normal = NormalDist()
        z, far = (normal.inv_cdf(1 - p / 2) for p in (1 - LEVEL, FALSE_ALARMS / count))
        excess = {}
        for name, (mean, sd) in now.items():
            mean_0, sd_0 = self.reference[name]
            least = torch.maximum(z * sd_0, far * (sd_0**2 + sd**2).sqrt())
            excess[name] = float(((mean - mean_0).abs() / least).max())
        worst = max(excess, key=excess.__getitem__)
        return worst if excess[worst] > 1 else None

    @torch.no_grad()
    def _moments(self) -> dict[str, tuple[Tensor, Tensor]]:
        found = {"prediction": self.model.predict(self.X)}
        found |= {name: self.model.term(name, self.X) for name in self.model.term_names}
        return {n: (p.mean, p.variance.clamp_min(0).sqrt()) for n, p in found.items()}


def _far_apart(X: Tensor, number: int) -> Tensor:
    """Some rows that are far apart, in units of the spread of each column; the middle one first."""
    spread = X.std(-2)
    scaled = (X - X.mean(-2)) / spread.where(spread > 0, torch.ones_like(spread))
    chosen = [int(scaled.square().sum(-1).argmin())]
    while len(chosen) < min(number, len(X)):
        distance = torch.cdist(scaled, scaled[chosen]).amin(-1)
        if not distance.any():
            break
        chosen.append(int(distance.argmax()))
    return X[chosen]
