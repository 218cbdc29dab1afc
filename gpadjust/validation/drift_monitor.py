"""An alarm when rho, delta or the prediction has left the interval that it had."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import check_level
from gpadjust.models import TermsGP
from gpadjust.models.training_data import ArrayLike, to_tensor


class _Moments(NamedTuple):
    mean: Tensor  # q x m
    sd: Tensor


@dataclass(frozen=True, repr=False)
class Alarm:
    """A function that has left its interval; it prints as a sentence.

    Attributes:
        name: ``"rho"``, ``"delta"`` or another term; ``"prediction"`` of their sum.
        output: The name of the output.
        point: The inputs, by their names.
        observation: What :meth:`DriftMonitor.check` was told, or the number of its calls.
        interval: The interval at the reference time.
        value: The mean now.
        level: Of the interval.
        f_p: What that says of the physics; empty for a model without.
    """

    name: str
    output: str
    point: dict[str, float]
    observation: Any
    interval: tuple[float, float]
    value: float
    level: float
    f_p: str = ""

    def __repr__(self) -> str:
        where = ", ".join(f"{name} = {value:.4g}" for name, value in self.point.items())
        low, high = self.interval
        when = f"{self.observation:,}" if isinstance(self.observation, int) else self.observation
        text = (
            f"{self.name} of {self.output} at {where} left its {100 * self.level:g} % interval, "
            f"{low:.4g} to {high:.4g}, at observation {when}: it is {self.value:.4g}."
        )
        return f"{text} {self.f_p}".strip()


class DriftMonitor:
    r"""A monitor of a model that is updated: has rho or delta left the interval that it had?

    At some points it remembers the posterior of each term and of the prediction at a reference
    time, mean :math:`m_0` and standard deviation :math:`s_0`. There is an alarm where the mean m is
    outside of the interval :math:`m_0 \pm z s_0` and the difference counts,

    .. math:: |m - m_0| > z' \sqrt{s_0^2 + s^2},

    with z' such that, of all terms, points and outputs together, the probability is
    ``false_alarms`` at a check if nothing drifts. Rho and delta apart are less certain than the
    prediction, which therefore is the first to leave.

    Args:
        model: The model, as it is at the reference time: after :func:`~gpadjust.fit`, and best
            after as many updates as it takes to forget.
        X: The points, raw inputs ``q x d``. Default: up to 5 training inputs that are far apart.
        level: Probability of the interval.
        false_alarms: As above. Checks that follow each other closely are nearly the same one.

    Raises:
        TypeError: If the model is none that can be updated.
        ValueError: If a probability is not between 0 and 1.

    Example:
        >>> import torch
        >>> from gpadjust import RRA
        >>> from gpadjust.validation import DriftMonitor
        >>> X = torch.linspace(0, 1, 40, dtype=torch.float64).unsqueeze(-1)
        >>> model = RRA(X, 2 * X.sin(), physics=torch.sin)
        >>> monitor = DriftMonitor(model)
        >>> for i in range(40):
        ...     model.update(X[i : i + 1], 3 * X[i : i + 1].sin(), forget=20)
        ...     if alarm := monitor.check():
        ...         break
        >>> alarm.name
        'prediction'
    """

    def __init__(
        self,
        model: TermsGP,
        X: ArrayLike = None,
        level: float = 0.95,
        false_alarms: float = 1e-5,
    ) -> None:
        if not isinstance(model, TermsGP):
            raise TypeError(
                f"Expected a model that can be updated, got {type(model).__name__}: take an RRA or "
                "a CKA."
            )
        check_level(level)
        check_level(1 - false_alarms)
        self.model, self.level, self.false_alarms = model, level, false_alarms
        data: Any = model.data()["train_X"]
        self.X = _far_apart(data, 5) if X is None else to_tensor(X, "X")
        self.num_checks = 0
        self.reset()

    def reset(self) -> None:
        """Take the model as it is now for the reference, as after a repair."""
        self.reference = self._moments()
        self._said: set[tuple[str, int]] = set()

    def check(self, observation: Any = None) -> Alarm | None:
        """Compare the model as it is now.

        Args:
            observation: What the alarm is to call the last observation: its number, or a time.
                Default: the number of the check.

        Returns:
            The alarm of what is farthest from its interval, of those that there was no alarm of
            before, or None.
        """
        self.num_checks += 1
        now, worst = self._moments(), (1.0, "", 0)
        count = sum(each.mean.numel() for each in now.values())
        normal = NormalDist()
        z, far = (normal.inv_cdf(1 - p / 2) for p in (1 - self.level, self.false_alarms / count))
        for name, (mean, sd) in now.items():
            before = self.reference[name]
            away = (mean - before.mean).abs()
            excess = away / torch.maximum(z * before.sd, far * (before.sd**2 + sd**2).sqrt())
            for i, value in enumerate(excess.flatten().tolist()):
                if value > worst[0] and (name, i) not in self._said:
                    worst = value, name, i
        _, name, i = worst
        if not name:
            return None
        # A prediction and its parts leave together: one alarm for a point.
        self._said |= {(each, i) for each in now} if name == "prediction" else {(name, i)}
        return self._alarm(name, i, now, z, self.num_checks if observation is None else observation)

    def _alarm(
        self, name: str, i: int, now: dict[str, _Moments], z: float, observation: Any
    ) -> Alarm:
        row, output = divmod(i, self.model.num_outputs)
        mean, sd = (each[row, output].item() for each in self.reference[name])
        value, point = now[name].mean[row, output].item(), self.X[row]
        return Alarm(
            name,
            self.model.output_names[output],
            dict(zip(self.model.input_names, point.tolist(), strict=True)),
            observation,
            (mean - z * sd, mean + z * sd),
            value,
            self.level,
            self._of_physics(row, output, now["prediction"].mean[row, output].item()),
        )

    def _of_physics(self, row: int, output: int, prediction: float) -> str:
        if not self.model.rho_names:
            return ""
        f_p = self.model.fallback(self.X[[row]])[0, output].item()
        off = 100 * (f_p / prediction - 1) if prediction else float("inf")
        size = f", {abs(off):.2g} % too {'large' if off * prediction > 0 else 'small'}"
        return f"There f_p is {f_p:.4g}{size if abs(off) < 1000 else ''}."

    @torch.no_grad()
    def _moments(self) -> dict[str, _Moments]:
        found = {"prediction": self.model.predict(self.X)}
        found |= {name: self.model.term(name, self.X) for name in self.model.term_names}
        return {n: _Moments(p.mean, p.variance.clamp_min(0).sqrt()) for n, p in found.items()}


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
