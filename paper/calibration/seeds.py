"""How far the seed of a fit moves its answer, and how far that is from one of long sampling."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import CKA, fit
from paper.calibration import LONG, MANY, SETS, SHORT, SMOOTH, Data, Seeds
from paper.common.experiment import Run, Table
from paper.common.runs import timed
from paper.common.tables import markdown
from paper.common.verdicts import met

_MANY = 4096  # points that tell the size of a function
_OFF = 0.3  # predicted standard deviations: where an answer is wrong

Function = Callable[[Tensor], Tensor]


def functions(num_inputs: int, seed: int) -> tuple[Function, Function]:
    """A smooth function of weights that are drawn, and its physics: ``n x d`` to ``n x 1``."""
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.logspace(0.0, -0.8, num_inputs, dtype=torch.float64)
    a, b, c = (
        torch.randn(num_inputs, generator=generator, dtype=torch.float64)
        * sizes[torch.randperm(num_inputs, generator=generator)]
        for _ in range(3)
    )

    def crude(X: Tensor) -> Tensor:
        return (3 * X @ a + 0.5).cos() + X @ b

    def truth(X: Tensor) -> Tensor:
        return (1.2 + 0.4 * (2 * X @ c).sin()) * crude(X) + 0.3 * (X @ b - X @ a).square()

    X = SobolEngine(num_inputs, scramble=True, seed=seed).draw(_MANY, dtype=torch.float64)
    size = truth(X).std()
    return (lambda X: (truth(X) / size).unsqueeze(-1), lambda X: (crude(X) / size).unsqueeze(-1))


def run(experiment: Seeds, data: str, kind: str, seed: int) -> Run:
    """Fit a data set; what is predicted at new inputs."""
    (given,) = {each for each in SETS + SMOOTH if str(each) == data}
    settings, own = experiment.settings, seed if kind == MANY else 0
    X, Y, Z, truth, physics = _drawn(given, 1_000 * given.num_inputs + own, settings.points)
    model = CKA(X, Y, physics=physics)
    options: dict[str, Any] = {}
    if kind == LONG:
        first = max(128, min(1024, 5_120_000 // len(X) ** 2))
        options = {"num_draws": settings.effort * first, "num_samples": settings.samples}
    _, found = timed(lambda: fit(model, seed=seed, **options), time.process_time)
    mean, variance = (each.squeeze(-1) for each in model.predict(Z))
    low, high = (each.squeeze(-1) for each in model.interval(Z))
    return {
        "mean": mean.tolist(),
        "sd": variance.sqrt().tolist(),
        "log_width": float((high - low).log().mean()),
        "held": float(((low <= truth) & (truth <= high)).double().mean()),
        "error": math.sqrt(float((mean - truth).square().mean())),
        **found,
    }


def _drawn(given: Data, seed: int, points: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Function]:
    """Inputs, targets, new inputs, the truth there, and the physics."""
    truth, physics = functions(given.num_inputs, seed)
    generator = torch.Generator().manual_seed(seed)
    engine = SobolEngine(given.num_inputs, scramble=True, seed=seed)
    X = engine.draw(given.each * given.num_inputs, dtype=torch.float64)
    Y = truth(X)
    Y = Y + given.noise * torch.randn(Y.shape, generator=generator, dtype=Y.dtype)
    Z = torch.rand(points, given.num_inputs, generator=generator, dtype=torch.float64)
    return X, Y, Z, truth(Z).squeeze(-1), physics


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def tables(runs: Sequence[Run], experiment: Seeds) -> dict[str, Table]:
    """All tables, by name."""
    rows, shifts, ratios, wrong, right = [], [], [], [], []
    for data in map(str, SETS):
        own, longer = (
            [r for r in runs if r["data"] == data and r["fit"] == fit] for fit in (SHORT, LONG)
        )
        if not own:
            continue
        shift, ratio = _spread(own)
        shifts.append(shift)
        ratios.append(ratio)
        off, apart = [math.nan] * len(own), math.nan
        if longer:
            mean, sd = _mixture(longer)
            off = [_away(run, mean, sd) for run in own]
            apart = max(_away(run, mean, sd) for run in longer)
            wrong += [r["warned"] for r, away in zip(own, off, strict=True) if away > _OFF]
            right += [r["warned"] for r, away in zip(own, off, strict=True) if away <= _OFF]
        held = [run["held"] for run in own]
        numbers = [
            f"{shift:.2f}",
            f"{ratio:.2f}",
            f"{_mean(held):.2f} ({min(held):.2f})",
            f"{_mean(off):.2f} ({max(off):.2f})",
            f"{apart:.2f}",
            f"{sum(run['warned'] for run in own)}",
            f"{sorted(run['seconds'] for run in own)[len(own) // 2]:.2f}",
        ]
        rows.append([data, *numbers])
    header = ["", "mean moves, sd", "widths", "95 % hold (least)", "off, sd (most)", "long runs"]
    coverage = {
        str(data): [r["held"] for r in runs if r["data"] == str(data) and r["fit"] == MANY]
        for data in SMOOTH
    }
    of_sets = [
        [name, f"{len(held)}", f"{_mean(held):.3f}", f"{min(held):.2f}"]
        for name, held in coverage.items()
        if held
    ]
    targets: list[list[str]] = []

    def enter(text: str, good: bool, numbers: str) -> None:
        targets.append([f"O{len(targets) + 1}", text, f"**{met(good)}**: {numbers}"])

    if shifts:
        of_all = math.sqrt(_mean([shift**2 for shift in shifts]))
        enter(
            "the mean moves by at most .1 predicted sd, root mean square of the sets",
            of_all <= 0.1,
            f"{of_all:.3f}, at most {max(shifts):.2f}",
        )
        typical = math.prod(ratios) ** (1 / len(ratios))
        enter(
            "widths differ by at most a factor of 1.1, geometric mean of the sets",
            typical <= 1.1,
            f"{typical:.2f}, at most {max(ratios):.2f}",
        )
    if of_sets:
        means = [_mean(held) for held in coverage.values() if held]
        enter(
            "95 % intervals of a smooth function without noise hold .90, mean of 20 sets",
            min(means) >= 0.9,
            ", ".join(f"{mean:.3f}" for mean in means),
        )
    if wrong or right:
        enter(
            "a warning for 8 in 10 of the answers that are off by more than .3 sd, seldom else",
            sum(wrong) >= 0.8 * len(wrong) and sum(right) <= 0.1 * len(right),
            f"{sum(wrong)} of {len(wrong)}, else {sum(right)} of {len(right)}",
        )
    return {
        "targets": Table("Targets", markdown(["", "target", ""], targets)),
        "seeds": Table(
            "Answers by several seeds", markdown([*header, "warnings", "CPU seconds"], rows)
        ),
        "coverage": Table(
            "Smooth functions without noise", markdown(["", "sets", "95 % hold", "least"], of_sets)
        ),
    }


def _spread(runs: Sequence[Run]) -> tuple[float, float]:
    """How far means are apart, in predicted standard deviations, and the ratio of widths."""
    mean, sd = _values(runs)
    shift = (mean - mean.mean(0)).square().sum(0).mean() / max(1, len(mean) - 1)
    widths = [run["log_width"] for run in runs]
    return float((shift / sd.square().mean()).sqrt()), math.exp(max(widths) - min(widths))


def _mixture(runs: Sequence[Run]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the equal mixture of several fits' predictions."""
    mean, sd = _values(runs)
    variance = sd.square().mean(0) + mean.var(0, unbiased=False)
    return mean.mean(0), variance.sqrt()


def _away(run: Run, mean: Tensor, sd: Tensor) -> float:
    """The root mean square of how far predicted means are away, in standard deviations."""
    own, _ = _values([run])
    return float(((own[0] - mean).square().mean() / sd.square().mean()).sqrt())


def _values(runs: Sequence[Run]) -> tuple[Tensor, Tensor]:
    """Means and standard deviations, ``runs x points``."""
    mean, sd = (
        torch.tensor([run[name] for run in runs], dtype=torch.float64) for name in ("mean", "sd")
    )
    return mean, sd
