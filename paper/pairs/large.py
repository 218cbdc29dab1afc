"""100,000 observations of six inputs: inducing points for all, or an exact model of some."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, VariationalCKA, fit
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, markdown, table
from paper.common.verdicts import met
from paper.pairs import Large
from paper.pairs.functions import PAIRS

_TEST = 10_000  # added to the seed
_MOST = 5_000  # observations of the exact model that is meant
_GRAVITY = 9.81  # m / s^2
_LENGTHS = (0.5, 0.4)  # m
_HALF = torch.tensor([math.pi, math.pi, 5.0, 5.0, 6.0, 3.0], dtype=torch.float64)
NOISE = {"hartmann6": 0.05, "links": 0.1}
"""Standard deviation of the noise, in that of the function."""
_OUTPUTS = {"hartmann6": ("",), "links": (", first", ", second")}


class Data(NamedTuple):
    """Observations of a system, and the system.

    Attributes:
        X: ``n x 6``.
        Y: Noisy, ``n x m``.
        f: Without noise, ``n x m``.
        physics: f_p.
    """

    X: Tensor
    Y: Tensor
    f: Tensor
    physics: Callable[[Tensor], Tensor]


def draw_data(problem: str, n: int, seed: int) -> Data:
    """Draw observations at uniform inputs."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 6, generator=generator, dtype=torch.float64)
    physics: Callable[[Tensor], Tensor]
    if problem == "hartmann6":
        hartmann = PAIRS["hartmann6"]
        f = hartmann.truth(X)

        def physics(X: Tensor) -> Tensor:
            return torch.as_tensor(hartmann.low(X.detach().numpy())).unsqueeze(-1)
    else:
        X = (2 * X - 1) * _HALF
        f = links(X, (1.0, 0.8), damping=0.15, friction=0.5)

        def physics(X: Tensor) -> Tensor:  # masses 15 to 19 % off, no friction
            return links(X, (0.85, 0.95), damping=0.0, friction=0.0)

    noise = torch.randn(f.shape, generator=generator, dtype=torch.float64)
    return Data(X, f + NOISE[problem] * f.std(0) * noise, f, physics)


def links(X: Tensor, masses: tuple[float, float], damping: float, friction: float) -> Tensor:
    """The angular accelerations of an arm of two rods that hang in a vertical plane.

    Args:
        X: Angles (rad, the second relative to the first), angular velocities (rad/s) and torques
            (N m), ``... x 6``.
        masses: In kg; the rods are homogeneous.
        damping: N m s.
        friction: Of Coulomb, smoothed over .3 rad/s, N m.

    Returns:
        rad/s^2, ``... x 2``.
    """
    q1, q2, v1, v2, torque1, torque2 = X.unbind(-1)
    (m1, m2), (l1, l2) = masses, _LENGTHS
    c1, c2 = l1 / 2, l2 / 2
    coupling = m2 * l1 * c2
    a22 = m2 * l2**2 / 3
    a12 = a22 + coupling * q2.cos()
    a11 = m1 * l1**2 / 3 + m2 * l1**2 + a22 + 2 * coupling * q2.cos()
    lower = m2 * c2 * _GRAVITY * (q1 + q2).sin()
    upper = (m1 * c1 + m2 * l1) * _GRAVITY * q1.sin() + lower
    b1 = torque1 + coupling * q2.sin() * (2 * v1 * v2 + v2**2) - upper
    b2 = torque2 - coupling * q2.sin() * v1**2 - lower
    b1 = b1 - damping * v1 - friction * (v1 / 0.3).tanh()
    b2 = b2 - damping * v2 - friction * (v2 / 0.3).tanh()
    determinant = a11 * a22 - a12**2
    return torch.stack(
        [(a22 * b1 - a12 * b2) / determinant, (a11 * b2 - a12 * b1) / determinant], dim=-1
    )


def run(experiment: Large, learner: str, observations: int, problem: str, seed: int) -> Run:
    """Fit the model; the errors of f and of its intervals, of each output.

    Errors are in standard deviations of the function; ``seconds`` are those of building and
    fitting, with one thread.
    """
    settings = experiment.settings
    data = draw_data(problem, observations, seed)
    test = draw_data(problem, settings.num_test, seed + _TEST)
    # A first fit loads what any later one needs.
    fit(CKA(data.X[:10], data.Y[:10], physics=data.physics), "map")
    begin = time.perf_counter()
    if learner == "exact":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            model: Any = CKA(data.X, data.Y, physics=data.physics)
    else:
        number = settings.num_inducing
        model = VariationalCKA(data.X, data.Y, physics=data.physics, num_inducing=number)
    fit(model)
    found = {"seconds": time.perf_counter() - begin, **_scores(model, test)}
    if learner == "variational":
        rest = model.rest.kernel.outputscale.sqrt() * model.outcome_transform.stdvs.flatten()
        found["rest_sd"] = (rest / test.f.std(0)).tolist()
        with torch.no_grad():
            model.rest.kernel.raw_outputscale.fill_(-40.0)
        model.forget()
        found["coverage_without_rest"] = _scores(model, test)["coverage"]
    noise = model.likelihood.noise.sqrt().reshape(-1, test.f.shape[-1]).mean(0)
    found["noise_sd"] = (noise * model.outcome_transform.stdvs.flatten() / test.f.std(0)).tolist()
    return found


def _scores(model: Any, test: Data) -> Run:
    with torch.no_grad():
        mean, _ = model.predict(test.X)
        lower, upper = model.interval(test.X)
    spread = test.f.std(0)
    inside = ((test.f >= lower) & (test.f <= upper)).double()
    return {
        "rmse": ((mean - test.f).square().mean(0).sqrt() / spread).tolist(),
        "coverage": inside.mean(0).tolist(),
        "width": ((upper - lower).mean(0) / spread).tolist(),
    }


def tables(runs: Sequence[Run], experiment: Large) -> dict[str, Table]:
    """All tables, by name."""
    found = pd.DataFrame(runs)
    rows = {}
    for problem in NOISE:
        own = found[found["problem"] == problem]
        for (learner, n), label in experiment.axes["learner", "observations"].items():
            part = own[(own["learner"] == learner) & (own["observations"] == n)]
            for i, output in enumerate(_OUTPUTS[problem] if len(part) else ()):
                rows[f"{problem}{output}: {label} | {n:,} ({len(part)})"] = part.assign(output=i)
    columns: dict[str, Cell] = {
        "error of f": _of("rmse", 4),
        "intervals of 95 % hold": _of("coverage", 2),
        "without the rest": lambda part: (
            _of("coverage_without_rest", 2)(part) if "variational" in {*part["learner"]} else ""
        ),
        "width": _of("width", 3),
        "noise found (true)": lambda part: (
            f"{_of('noise_sd', 4)(part)} ({NOISE[part['problem'].iloc[0]]})"
        ),
        "s": lambda part: f"{part['seconds'].mean():.0f}",
    }
    header, _, *lines = table(rows, columns, " | observations (runs)").splitlines()
    rule = "| " + " | ".join(["---"] * (len(columns) + 2)) + " |"
    return {
        "many": Table("Models of many observations, one thread", "\n".join([header, rule, *lines])),
        "targets": Table("What was asked", _targets(found)),
    }


def _of(column: str, digits: int) -> Cell:
    """The mean of an entry for each output, of the one that the rows are about."""
    return lambda part: f"{_mean(part[column], part['output'].iloc[0]):.{digits}f}"


def _mean(column: pd.Series, output: int) -> float:
    return float(column.map(lambda values: values[output]).mean())


def _targets(found: pd.DataFrame) -> str:
    """Each target with the worst of all runs and outputs."""
    sparse, exact = (found[found["learner"] == name] for name in ("variational", "exact"))
    rows, ratios, gaps = [], [], []
    if len(sparse):
        seconds = sparse["seconds"].max()
        said = f"**{met(seconds <= 300)}**: {seconds:.0f} (one thread)"
        rows.append(["seconds, the slowest run", "300 (two cores)", said])
    for problem, own in sparse.groupby("problem"):
        beside = exact[exact["problem"] == problem]
        most = beside[beside["observations"] == beside["observations"].max()]
        for i in range(len(_OUTPUTS[str(problem)]) if len(most) else 0):
            ratios.append(_mean(own["rmse"], i) / _mean(most["rmse"], i))
            gaps.append(_mean(own["coverage"], i) - _mean(most["coverage"], i))
    if ratios:
        most = exact.groupby("problem")["observations"].max()
        said = "; the largest exact models have " + ", ".join(f"{n:,}" for n in most)
        verdict = "**undetermined**" if most.min() < _MOST else f"**{met(max(ratios) <= 1.2)}**"
        text = f"{{}} that of an exact model of {_MOST:,}"
        rows.append([text.format("error over"), "1.2", f"{verdict}: {max(ratios):.2f}{said}"])
        verdict = "**undetermined**" if most.min() < _MOST else f"**{met(min(gaps) >= 0)}**"
        rows.append([text.format("coverage less"), "0", f"{verdict}: {min(gaps):+.3f}"])
    return markdown(["worst of all outputs", "asked", "found"], rows)
