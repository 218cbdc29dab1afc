"""Kinds of data, as the command line and the page have them."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any

from gpadjust.files import LARGEST
from gpadjust.models import StackedGP, TermsGP
from gpadjust.report.inputs import pairs
from gpadjust.report.markup import listed, name_and_unit, number, with_unit
from gpadjust.validation.hints import told_of

RELATIVE = "relative"  # --noise


def options_of(
    arguments: Namespace,
    inputs: Sequence[str],
    levels: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """The options of a model that a command line says, for the columns as the file names them.

    Args:
        arguments: A command line as parsed by :func:`gpadjust.__main__.parser`.
        inputs: The names of the inputs there, in the order of the columns.
        levels: The levels of the categories among the columns, by the names that models have.

    Raises:
        ValueError: If one is no number, or names what is no input.
    """
    found: dict[str, Any] = {}
    noises = [RELATIVE] * (arguments.noise == RELATIVE) + ["heavy-tailed"] * arguments.outliers
    if noises:
        found["likelihood"] = noises if len(noises) > 1 else noises[0]
    if arguments.positive:
        found["outcome_transform"] = "log"
    if arguments.bounds is not None:
        found["outcome_transform"] = _bounds(arguments.bounds)
    if arguments.input_noise is not None:
        found["train_Xvar"] = _variances(arguments.input_noise, inputs)
    if levels:
        found["categorical"] = dict(levels)
    return found


def assumed(model: TermsGP | StackedGP) -> list[str]:
    """What a model takes its data for, in sentences."""
    told = told_of(model)
    outputs, found = listed(name_and_unit(name)[0] for name in model.output_names), []
    if RELATIVE in told:
        found.append("noise that grows with the physics, beside a constant one (relative)")
    if "heavy-tailed" in told:
        found.append("noise with heavy tails, so that outliers count for little")
    if "train_Yvar" in told:
        found.append("noise of known variance")
    if (variances := told.get("train_Xvar")) is not None:
        sds = variances.reshape(-1, len(model.input_names)).mean(0).sqrt().tolist()
        noisy = zip(model.input_names, sds, strict=True)
        each = [f"{name_and_unit(n)[0]} by {with_unit(number(sd), n)}" for n, sd in noisy if sd > 0]
        found.append(f"inputs that are noisy themselves: {listed(each)} (standard deviations)")
    if (link := told.get("link")) is not None:
        found.append(f"{outputs} {getattr(link, 'where', 'within bounds')}")
    if "categorical" in told:
        found.append(f"categories in {listed(map(str, told['categorical']))}")
    if not found:
        return ["Assumed: noise of one size, exact inputs, numbers that may be of any size."]
    return [f"Assumed: {'; '.join(found)}."]


def _bounds(text: str) -> tuple[float, float]:
    """The two numbers of ``"0,1"``."""
    ends = [_number(each) for each in text.split(",")]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"Expected --bounds as two numbers, the lower first: 0,1; found {text!r}.")
    return ends[0], ends[1]


def _variances(text: str, inputs: Sequence[str]) -> list[float]:
    """The variance of each input, of the standard deviations that a command line has."""
    given = pairs(text, "--input-noise")
    if unknown := [name for name in given if name not in inputs]:
        raise ValueError(f"--input-noise names {unknown[0]!r}, which is none of --inputs.")
    sds = [_number(given.get(name, "0")) for name in inputs]
    if not all(0 <= sd <= LARGEST for sd in sds):
        raise ValueError(
            "Expected --input-noise as standard deviations in the inputs' units, such as "
            f"{inputs[0]}=0.5, found {text!r}."
        )
    return [sd**2 for sd in sds]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
