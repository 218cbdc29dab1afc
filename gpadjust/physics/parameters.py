"""Values of the unknown parameters of a physics, and their posterior."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_level
from gpadjust.display import Display, html_table, text_table
from gpadjust.physics.unknown import LARGEST, Curve, Unknown, Unknowns

_AS_WIDE = 0.8  # of a prior's standard deviation, or more
_AS_FAR = 0.3  # standard deviations of a prior, or less from its middle


class ParameterValues(dict[str, Any]):
    """Values of parameters by their names, as items or attributes: ``p["mass"]``, ``p.mass``.

    All are ``rows``, ``N x p`` or ``p`` of a single row; each name has ``N``, or a number. A
    function is called, ``p.friction(speed)``, with ``N`` values or one.
    """

    def __init__(self, names: Iterable[str], rows: Any) -> None:
        super().__init__((name, rows[..., i]) for i, name in enumerate(names))
        self.rows = rows
        self.functions = dict[str, Curve]()
        if names and isinstance(names, Unknowns):  # a function has no row of its own
            for name, (unknown, columns) in names.functions.items():
                self.functions[name] = Curve(unknown, self._of_function(columns))

    def _of_function(self, columns: list[int]) -> Any:
        """Return a function's values at its knots, which broadcast with its argument."""
        return self.rows[..., columns]

    def __missing__(self, name: str) -> Any:
        return self.__dict__.get("functions", {})[name]

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            names = ", ".join([*self, *self.__dict__.get("functions", ())])
            message = f"Unknown parameter {name!r}; expected one of {names}."
            raise AttributeError(message) from None


class PhysicsParameters(ParameterValues, Display):
    """The posterior of the unknown parameters of a physics, as draws.

    It maps names to ``K`` draws each, of ``draws``, ``K x p``: one, the value itself, after a point
    fit (``"map"``) or before any. Conditioning on further observations leaves them as they are.
    A function is called with ``n`` points: ``parameters.friction(speeds)`` is ``K x n``.

    Example:
        >>> g = Unknown(9.0, sd=1.0, unit="m/s²")
        >>> PhysicsParameters({"g": g}, [torch.tensor([9.7, 9.9])])
           mean  95 % interval   prior  unit
        g  9.8   9.705 to 9.895  9 ± 1  m/s²
    """

    def __init__(self, unknowns: Mapping[str, Unknown], draws: Sequence[Tensor]) -> None:
        self.draws = torch.stack([*draws], -1) if unknowns else torch.empty(1, 0)
        self.unknowns = unknowns if isinstance(unknowns, Unknowns) else Unknowns(unknowns)
        super().__init__(self.unknowns, self.draws)

    def _of_function(self, columns: list[int]) -> Tensor:
        """Return a function's values at its knots, ``K x 1 x k``."""
        return self.draws[:, columns].unsqueeze(1)

    @property
    def mean(self) -> Tensor:
        """Means, ``p``, in the parameters' units."""
        return self.draws.mean(0)

    @property
    def coordinates(self) -> Tensor:
        """Coordinates of the draws, ``K x p``, standard normal by the prior; finite at bounds."""
        z = self.unknowns.to_coordinates(self.draws)
        return z.nan_to_num(nan=torch.nan, posinf=LARGEST, neginf=-LARGEST)

    @property
    def center(self) -> Tensor:
        """Values at the mean of the coordinates, ``p``: of factors the geometric mean.

        If the data determine only a product or ratio of parameters, the center has it as the draws
        do; the mean does not.
        """
        if not self.unknowns:
            return self.mean
        return self.unknowns.to_values(self.coordinates.mean(0))

    @property
    def sd(self) -> Tensor:
        """Standard deviations, ``p``; zero of a single draw."""
        return self.draws.std(0, correction=0)

    def interval(self, level: float = 0.95) -> tuple[Tensor, Tensor]:
        """Return both ends of the central intervals of probability ``level``, ``p`` each."""
        check_level(level)
        ends = torch.tensor([(1 - level) / 2, (1 + level) / 2]).to(self.draws)
        low, high = self.draws.quantile(ends, dim=0)
        return low, high

    @property
    def untold(self) -> list[str]:
        """Names of parameters whose posterior is about their prior; none of a point fit."""
        coordinates = {name: u.coordinate(self[name]) for name, u in self.unknowns.items()}
        return [
            name
            for name, z in coordinates.items()
            # N(0, 1) by the prior
            if z.std(correction=0) > _AS_WIDE and z.mean().abs() < _AS_FAR
        ]

    def _rows(self) -> list[tuple[str, str, str, str, str]]:
        """Return the head and the rows of the table."""
        low, high = self.interval()
        rows = [("", "mean", "95 % interval", "prior", "unit")]
        for i, (name, unknown) in enumerate(self.unknowns.items()):
            interval = f"{low[i]:.4g} to {high[i]:.4g}"
            if not low[i] < high[i]:  # a point fit
                interval = "-"
            rows.append((name, f"{self.mean[i]:.4g}", interval, unknown.prior_text, unknown.unit))
        return rows

    def __repr__(self) -> str:
        return text_table(self._rows())

    def _repr_html_(self) -> str:
        head, *rows = self._rows()
        return html_table("Parameters of the physics", head, rows)


def even_normal(number: int, p: int, seed: int) -> Tensor:
    """Return standard normal draws ``number x p`` that fill space evenly (Sobol)."""
    engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=seed)
    shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    return torch.special.ndtri(shares)
