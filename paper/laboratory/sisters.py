"""A pump of which few points are measured, with and without what others taught."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from gpadjust import CKA, fit
from gpadjust.validation import rmse
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, number, table
from paper.laboratory import Sisters
from paper.laboratory.pumps import OtherMachine, Pump, catalogue, inputs, measured


def run(experiment: Sisters, prior: str, n: int, seed: int) -> Run:
    """Errors of pump B without and with a prior, on the function itself."""
    settings, generator = experiment.settings, torch.Generator().manual_seed(seed // 10)
    pumps = [Pump.drawn(generator) for _ in range(10)]
    generator.manual_seed(1_000 + seed)
    B, A, *more = ([*pumps, *pumps][seed % 10 + k] for k in range(4))
    X = inputs(n, generator)
    Y = measured(B.head(X), generator)
    teachers = {
        "one": [A],
        "three": [A, *more],
        "unrelated": [OtherMachine(generator)],
        "three-unrelated": [OtherMachine(generator) for _ in range(3)],
    }[prior]
    others = []
    for machine in teachers:
        own = inputs(settings.known, generator)
        others.append(CKA(own, measured(machine.head(own), generator), physics=catalogue))
        fit(others[-1])
    test = inputs(settings.tests, generator)
    found: Run = {}
    for name, given in {"without": {}, "with": {"prior": others}}.items():
        model = CKA(X, Y, physics=catalogue)
        result = fit(model, **given)  # type: ignore[call-overload]
        mean, _ = model.predict(test)
        found[f"rmse_{name}"] = rmse(mean, B.head(test)).item()
        low, high = model.interval(test)
        held = (low <= B.head(test)) & (B.head(test) <= high)
        found[f"coverage_{name}"] = held.double().mean().item()
    taught = others[0].predict(test).mean
    found["probability"] = float(result.sisters)
    found["rmse_of_other"] = rmse(taught, B.head(test)).item()
    found["rmse_of_physics"] = rmse(catalogue(test), B.head(test)).item()
    return found
