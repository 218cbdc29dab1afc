"""Repeated rows with unequal replicates: the answers of single rows at the cost of distinct ones.

There was one form of it, the exact one. Whether a row stands twice by accident was first told by
the least difference of two outputs, which of few rows is far larger than the step of their grid and
told less; now by Euclid's algorithm.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from gpadjust import CKA, fit
from gpadjust.inference import SamplingWarning
from gpadjust.validation import leave_one_out, rmse
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import frame, groups, markdown, number, of, table
from paper.common.verdicts import met
from paper.laboratory import Repeats

_SAME = 1e-8


def physics(X: Tensor) -> Tensor:
    """A wave along the first input."""
    return torch.sin(6 * X[:, :1])


def truth(X: Tensor) -> Tensor:
    """The wave is larger and bends with the second input."""
    return 1.2 * physics(X) + X[:, 1:].square()


def rows_of(experiment: Repeats, number: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows at few distinct inputs, as often as a geometric share says; and points to predict."""
    settings, draw = experiment.settings, torch.Generator().manual_seed(seed)
    places = torch.rand(settings.distinct, 2, generator=draw, dtype=torch.float64)
    share = 0.9 ** torch.arange(settings.distinct, dtype=torch.float64)
    more = torch.multinomial(share, number - settings.distinct, True, generator=draw)
    X = places[torch.cat([torch.arange(settings.distinct), more])]
    Y = truth(X) + settings.noise * torch.randn(number, 1, generator=draw, dtype=torch.float64)
    return X, Y, torch.rand(300, 2, generator=draw, dtype=torch.float64)


def run(experiment: Repeats, rows: str, method: str, seed: int) -> Run:
    """Fit a model of rows together and of single rows; or of rows of which some stand twice."""
    warnings.simplefilter("ignore", SamplingWarning)
    if rows == "copies":
        return _copies(experiment, method, seed)
    X, Y, test = rows_of(experiment, int(rows), seed)
    found: dict[str, Any] = {}
    together, seconds = _fitted(X, Y, method)
    with patch("gpadjust.models.terms_gp._DISTINCT", 0.0):
        single, found["seconds_single"] = _fitted(X, Y, method)
        alike = CKA(X, Y, physics=physics)
    alike.load_state_dict(together.state_dict())
    found |= {"seconds": seconds, **_scores(together, test)}
    found["rmse_single"] = _scores(single, test)["rmse"]
    # At the same hyper-parameters, and after a fit of its own.
    for name, other in (("off_given", alike), ("off_fitted", single)):
        found[name] = _off(together, other, test)
    return found


def _fitted(X: Tensor, Y: Tensor, method: Any) -> tuple[CKA, float]:
    begin = time.perf_counter()
    model = CKA(X, Y, physics=physics)
    fit(model, method)
    return model, time.perf_counter() - begin


def _scores(model: CKA, test: Tensor) -> dict[str, float]:
    lower, upper = model.interval(test)
    held = (lower <= truth(test)) & (truth(test) <= upper)
    score = rmse(model.predict(test).mean, truth(test)).item()
    width = (upper - lower).mean().item()
    return {"rmse": score, "coverage": held.double().mean().item(), "width": width}


def _off(one: CKA, two: CKA, test: Tensor) -> float:
    """The largest difference of predictions and left-out observations, in the targets' sd."""
    answers = []
    for model in (one, two):
        prediction, loo = model.predict(test), leave_one_out(model)
        answers.append([prediction.mean, prediction.variance, loo.mean, loo.variance])
    off = [(a - b).abs().max() for a, b in zip(*answers, strict=True)]
    return float(max(off))


def _copies(experiment: Repeats, method: Any, seed: int) -> Run:
    """Rows of which some stand twice, once as they are and once by the warning's cure."""
    X, Y, test = rows_of(experiment, 80, seed)
    number = round(experiment.settings.copied * len(X))
    X2, Y2 = torch.cat([X, X[:number]]), torch.cat([Y, Y[:number]])
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        twice, _ = _fitted(X2, Y2, method)
    told = [str(each.message) for each in found if "to the last bit" in str(each.message)]
    with warnings.catch_warnings(record=True) as others:
        warnings.simplefilter("always")
        cured, seconds = _fitted(*_cured(X2, Y2), method)
    false = any("to the last bit" in str(each.message) for each in others)
    result = {"told": float(len(told) == 1), "told_falsely": float(false), "seconds": seconds}
    for name, model in (("", cured), ("_twice", twice)):
        result |= {f"{key}{name}": value for key, value in _scores(model, test).items()}
        noise = model.predict(test[:1], observation_noise=True).variance
        noise = noise - model.predict(test[:1]).variance
        result[f"noise{name}"] = noise.sqrt().item()
    return result


def _cured(X: Tensor, Y: Tensor) -> tuple[Tensor, Tensor]:
    """As the sentence says it."""
    rows = np.unique(np.hstack([X, Y]), axis=0, return_index=True)[1]
    return X[rows], Y[rows]


def tables(runs: Sequence[Run], experiment: Repeats) -> dict[str, Table]:
    """All tables, by name."""
    found, shown = frame(runs), {}
    labels = experiment.axes["rows"]
    repeated = found[found["rows"] != "copies"]
    if len(repeated):
        parts = groups(repeated, ("rows", "method"), lambda n, how: f"{labels[n]} rows, {how}")
        columns = {
            "cases": lambda part: str(len(part)),
            "seconds": of("seconds", "median"),
            "seconds, single rows": of("seconds_single", "median"),
            "ratio": lambda part: number(
                (part["seconds_single"] / part["seconds"]).median(), ".3g"
            ),
            "difference, same hyper-parameters": of("off_given", "max", ".1e"),
            "difference, fits of their own": of("off_fitted", "max", ".1e"),
            "RMSE": of("rmse"),
            "RMSE, single rows": of("rmse_single"),
            "coverage": of("coverage"),
        }
        shown["repeated"] = Table("Repeated rows", table(parts, columns))
        most = float(repeated["off_given"].max())
        verdict = [["R1", "the same to 1e-8 at the same hyper-parameters", f"{most:.1e}"]]
        verdict[0].append(str(met(most <= _SAME)))
        header = ["target", "asked", "measured", "verdict"]
        shown["targets"] = Table("Targets", markdown(header, verdict))
    copies = found[found["rows"] == "copies"]
    if len(copies):
        rows = []
        for method, own in groups(copies, "method").items():
            for name, label in (("_twice", "some rows twice"), ("", "by the warning's cure")):
                keys = (f"noise{name}", f"rmse{name}", f"width{name}", f"coverage{name}")
                told = own["told"] if name else own["told_falsely"]
                cells = [number(own[key].mean()) for key in keys]
                rows.append([method, label, *cells, number(told.mean(), ".2f")])
        header = ["method", "data", "noise sd (true 0.1)", "RMSE", "width", "coverage", "warned"]
        shown["copies"] = Table("Rows that stand twice", markdown(header, rows))
    return shown


def draw(runs: Sequence[Run], experiment: Repeats) -> list[Path]:
    """Draw seconds by the number of rows."""
    found = frame(runs)
    found = found[found["rows"] != "copies"]
    titles = [label for label in experiment.axes["method"].values() if label in {*found["method"]}]
    figure, axes = panels(titles, 2, (4.2, 3.0), share=False)
    for ax, method in zip(axes, titles, strict=True):
        own = found[found["method"] == method].groupby("rows")
        x = [int(rows) for rows, _ in own]
        for key, label, color in (
            ("seconds_single", "each row by itself", "0.45"),
            ("seconds", "rows of equal inputs together", "#D55E00"),
        ):
            ax.plot(x, own[key].median(), "o-", color=color, label=label)
        ax.set(xlabel="rows at 40 distinct inputs", ylabel="seconds of a fit", yscale="log")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return [save(figure, experiment.out / "repeats.png")]
