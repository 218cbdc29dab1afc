"""What the READMEs show of any control experiment."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import pandas as pd

from paper.control.experiment import Experiment
from paper.control.scenario import Scenario, updates_on_trial
from paper.markdown import markdown

Row = Mapping[Hashable, Any]


def describe_settings(experiment: Experiment) -> str:
    """The settings as they stand."""
    rows = [[f"`{name}`", f"{value}"] for name, value in vars(experiment.settings).items()]
    return markdown(["setting", "value"], rows)


def describe_updates(experiment: Experiment) -> str:
    """How many gradient steps each scenario makes after a trial."""
    settings = experiment.settings
    until = settings.model_until
    starts = [1, until + 1] if until < settings.num_trials else [1]

    def steps(scenario: Scenario, trial: int) -> str:
        real = updates_on_trial(scenario, settings, trial)
        if scenario.dynamics is None or trial > until:
            return f"{real}"
        chosen = scenario.model_updates
        per_step = settings.model_updates if chosen is None else chosen
        in_model = per_step * settings.model_trials * settings.trial_length
        return f"{real} + {in_model:.0f}"

    headings = [f"updates, trials 1-{until}", f"{until + 1}-"][: len(starts)]
    rows = [
        [
            f"`{name}`",
            scenario.label,
            *(steps(scenario, trial) for trial in starts),
            f"{scenario.max_runs or 'all'}",
        ]
        for name, scenario in experiment.scenarios.items()
    ]
    return markdown(["`--scenarios`", "", *headings, "seeds"], rows)


def claims_table(claims: pd.DataFrame, kind: str, column: str, parts: Mapping[str, str]) -> str:
    """Verdicts, side by side.

    Args:
        claims: A row for each claim and part.
        kind: What they are.
        column: The column that names the part.
        parts: The parts that are shown, and their headings.
    """
    rows = []
    for (name, claim), part in claims.groupby(["id", "claim"]):
        by_part = part.set_index(column)
        found = [f"**{by_part['verdict'][p]}**: {by_part['measured'][p]}" for p in parts]
        if len(found) == 2 and found[0] == found[1]:
            found[1] = "the same"
        rows.append([str(name), str(claim), *found])
    return markdown(["", kind, *parts.values()], rows)


def model_table(times: pd.DataFrame, rmses: Sequence[str], errors: Sequence[str]) -> str:
    """How well the models foresaw trials.

    Args:
        times: A row for each scenario, its label as the index.
        rmses: The columns of the errors.
        errors: What they are errors of, with units.
    """
    scores = times[["nlpd_median", "coverage", *rmses, "left_bounds"]]
    scores = scores[scores[rmses[0]].notna()]
    header = ["", "NLPD", "coverage of 95 %", *(f"RMSE of {e}" for e in errors), "particles lost"]
    return numbers(scores, header, "{:.2g}")


def interval(row: Row, digits: int = 2) -> str:
    """An interquartile mean, with its interval if there are runs enough."""
    if pd.isna(row["iqm_low"]):
        return f"{row['iqm']:.{digits}f}"
    return f"{row['iqm']:.{digits}f} ({row['iqm_low']:.{digits}f}, {row['iqm_high']:.{digits}f})"


def paired(row: Row, column: str, digits: int = 2) -> str:
    """A mean difference over shared seeds, with its standard error if there are two."""
    mean, error = row[column], row[f"{column}_se"]
    if pd.isna(mean):
        return ""
    return f"{mean:+.{digits}f}" if pd.isna(error) else f"{mean:+.{digits}f} ± {error:.{digits}f}"


def numbers(table: pd.DataFrame, header: Sequence[str], form: str) -> str:
    """A table of numbers, its index first."""
    rows = [
        [str(label), *("" if pd.isna(value) else form.format(value) for value in values)]
        for label, values in zip(table.index, table.to_numpy(), strict=True)
    ]
    return markdown(header, rows)
