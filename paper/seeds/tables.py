"""How far answers are apart, and which warnings were right."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from paper.common.claims import met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.seeds import LONG, MANY, SETS, SHORT, SMOOTH, Seeds

_OFF = 0.3  # predicted standard deviations: where an answer is wrong


def tables(records: Sequence[Record], experiment: Seeds) -> dict[str, Table]:
    """All tables, by name."""
    rows, shifts, ratios, wrong, right = [], [], [], [], []
    for data in (str(data) for data in SETS):
        own, longer = (
            [r for r in records if r["data"] == data and r["fit"] == fit] for fit in (SHORT, LONG)
        )
        if not own:
            continue
        shift, ratio = _spread(own)
        shifts.append(shift)
        ratios.append(ratio)
        off = [math.nan] * len(own)
        apart = math.nan
        if longer:
            mean, sd = _mixture(longer)
            off = [_away(record, mean, sd) for record in own]
            apart = max(_away(record, mean, sd) for record in longer)
            wrong += [r["warned"] for r, away in zip(own, off, strict=True) if away > _OFF]
            right += [r["warned"] for r, away in zip(own, off, strict=True) if away <= _OFF]
        held = [record["held"] for record in own]
        seconds = sorted(record["seconds"] for record in own)[len(own) // 2]
        rows.append(
            [
                data,
                f"{shift:.2f}",
                f"{ratio:.2f}",
                f"{math.fsum(held) / len(held):.2f} ({min(held):.2f})",
                f"{math.fsum(off) / len(off):.2f} ({max(off):.2f})",
                f"{apart:.2f}",
                f"{sum(record['warned'] for record in own)}",
                f"{seconds:.2f}",
            ]
        )
    header = ["", "mean moves, sd", "widths", "95 % hold (least)", "off, sd (most)", "long runs"]
    coverage = {
        str(data): [r["held"] for r in records if r["data"] == str(data) and r["fit"] == MANY]
        for data in SMOOTH
    }
    of_sets = [
        [name, f"{len(held)}", f"{math.fsum(held) / len(held):.3f}", f"{min(held):.2f}"]
        for name, held in coverage.items()
        if held
    ]
    targets: list[list[str]] = []

    def enter(text: str, good: bool, numbers: str) -> None:
        targets.append([f"O{len(targets) + 1}", text, f"**{met(good)}**: {numbers}"])

    if shifts:
        of_all = math.sqrt(math.fsum(shift**2 for shift in shifts) / len(shifts))
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
        means = [math.fsum(held) / len(held) for held in coverage.values() if held]
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


def _spread(records: Sequence[Record]) -> tuple[float, float]:
    """How far means are apart, in predicted standard deviations, and the ratio of widths."""
    mean, sd = _values(records)
    shift = (mean - mean.mean(0)).square().sum(0).mean() / max(1, len(mean) - 1)
    widths = [record["log_width"] for record in records]
    return float((shift / sd.square().mean()).sqrt()), math.exp(max(widths) - min(widths))


def _mixture(records: Sequence[Record]) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of what several fits predict, half and half."""
    mean, sd = _values(records)
    variance = sd.square().mean(0) + mean.var(0, unbiased=False)
    return mean.mean(0), variance.sqrt()


def _away(record: Record, mean: torch.Tensor, sd: torch.Tensor) -> float:
    """The root mean square of how far predicted means are away, in standard deviations."""
    own, _ = _values([record])
    return float(((own[0] - mean).square().mean() / sd.square().mean()).sqrt())


def _values(records: Sequence[Record]) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and standard deviations, ``records x points``."""
    mean, sd = (
        torch.tensor([record[name] for record in records], dtype=torch.float64)
        for name in ("mean", "sd")
    )
    return mean, sd
