"""Tables of how well trials were foreseen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from paper.common.claims import FEWEST, Judged, Verdict, counted, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown
from paper.foresight import METHODS, NOISES, SYSTEMS, Foresight

# Shares that the default's intervals of 95 % are to hold.
SECOND, LATER, FAR = (0.85, 0.99), (0.90, 0.98), (0.85, 0.99)
CONDITIONED = 0.1  # the most that conditioning may change them


def tables(records: Sequence[Record], experiment: Foresight) -> dict[str, Table]:
    """All tables, by name."""
    settings = experiment.settings
    last, far = settings.trials, max(settings.horizons)
    rows, by_trial, conditioned = [], [], []
    for system, noise, method in _kinds():
        runs = [r[f"{noise}-{method}"] for r in records if r["system"] == system]
        if not runs:
            continue
        label = [SYSTEMS[system], NOISES[noise], METHODS[method], f"{len(runs)}"]

        def over(name: str, first: int, runs: Sequence[Record] = runs) -> str:
            return _spread([_mean(run[name][first - 2 :]) for run in runs])

        near = [_spread([_mean(run["coverage"][i]) for run in runs]) for i in range(last - 1)]
        rows.append(
            [
                *label,
                near[0],
                over("coverage", 3),
                over(f"coverage_{far}", 2),
                over("nlpd", 3),
                over(f"nlpd_{far}", 2),
            ]
        )
        seconds = np.median([run["fit_seconds"][-1] for run in runs])
        by_trial.append([*label, *near, f"{seconds:.1f}"])
        told = [_mean(run["conditioned"]["coverage"]) for run in runs]
        gaps = [t - _mean(run["coverage"][-1]) for t, run in zip(told, runs, strict=True)]
        conditioned.append([*label, _spread(told), near[-1], _spread(gaps, "+.2f")])
    start = ["system", "noise", "fit", "agents"]
    text = {
        "coverage": [
            *start,
            "next states: trial 2",
            f"trials 3-{last}",
            f"{far} steps: trials 2-{last}",
            f"NLPD, next states, 3-{last}",
            f"NLPD, {far} steps, 2-{last}",
        ],
        "trials": [*start, *(f"trial {i}" for i in range(2, last + 1)), "last fit, s"],
        "conditioned": [*start, "conditioned", "fitted again", "difference"],
    }
    titles = {
        "coverage": "Shares in the intervals of 95 %, and NLPD in nats",
        "trials": "Shares of the next states in the intervals of 95 %, by trial",
        "conditioned": f"Shares of the next states of trial {last}, conditioned or fitted again",
    }
    found = {"coverage": rows, "trials": by_trial, "conditioned": conditioned}
    judged = Table(
        "Targets of the default fit", claims_table("target", verdicts(records, experiment))
    )
    return {
        "targets": judged,
        **{name: Table(titles[name], markdown(text[name], found[name])) for name in found},
    }


def verdicts(records: Sequence[Record], experiment: Foresight) -> dict[str, list[Judged]]:
    """Those on the default fit, by system and noise; single trials are means over the agents."""
    last, far = experiment.settings.trials, max(experiment.settings.horizons)
    aims = (
        ("K1", "coverage", 2, 2, SECOND, "intervals of 95 % hold of the next states of trial 2"),
        ("K2", "coverage", 3, last, LATER, f"of those of trials 3-{last}, in the mean"),
        ("K3", f"coverage_{far}", 2, last, FAR, f"{far} steps ahead, of trials 2-{last}, mean"),
    )
    found = {}
    for system, noise in dict.fromkeys((s, n) for s, n, _ in _kinds()):
        runs = [r[f"{noise}-default"] for r in records if r["system"] == system]
        if not runs:
            continue
        judged = []
        for id, name, first, end, (low, high), text in aims:
            trials = {i: _mean([run[name][i - 2] for run in runs]) for i in range(first, end + 1)}
            mean = _mean([*trials.values()])
            said = f"{mean:.3f}"
            for which, beyond in (
                ("below", {i: value for i, value in trials.items() if value < low}),
                ("above", {i: value for i, value in trials.items() if value > high}),
            ):
                if beyond and len(trials) > 1:
                    said += f"; {which}: " + ", ".join(
                        f"trial {i} {value:.3f}" for i, value in beyond.items()
                    )
            judged.append((id, f"{text}: {low:.2f} to {high:.2f}", met(low <= mean <= high), said))
        gaps = [_mean(r["conditioned"]["coverage"]) - _mean(r["coverage"][-1]) for r in runs]
        text = f"conditioned on three times the data, mean: within {CONDITIONED} of fitting again"
        said = f"{_mean(gaps):+.3f}; agents " + ", ".join(f"{gap:+.2f}" for gap in gaps)
        judged.append(("K4", text, met(abs(_mean(gaps)) <= CONDITIONED), said))
        heading = SYSTEMS[system] + (f", {NOISES[noise]} noise" if noise != "none" else "")
        found[heading] = [_of(len(runs), *each) for each in judged]
    return found


def _of(runs: int, id: str, text: str, verdict: Verdict, measured: str) -> Judged:
    """A verdict, unless the runs are too few for one."""
    if runs < FEWEST:
        return Judged(id, text, "not run", "too few runs")
    return Judged(id, text, verdict, f"{counted(runs)}: {measured}")


def _kinds() -> Iterable[tuple[str, str, str]]:
    return ((s, n, m) for s in SYSTEMS for n in NOISES for m in METHODS)


def _mean(values: object) -> float:
    """Over states, trials or both, of what is known."""
    return float(np.nanmean(np.array(values, dtype=float)))


def _spread(values: Sequence[float], form: str = ".2f") -> str:
    """The mean and its standard error."""
    error = np.std(values, ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
    return f"{np.mean(values):{form}}" + ("" if np.isnan(error) else f" ± {error:.2f}")
