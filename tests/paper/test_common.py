"""Curves, statistics, verdicts and tables."""

import json
import math
from pkgutil import resolve_name

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from paper.__main__ import EXPERIMENTS
from paper.common.learners import LEARNERS
from paper.common.runner import runs_file, tables_of
from paper.common.runs import differences
from paper.common.tables import (
    across,
    claims_table,
    filled,
    fragments,
    frame,
    groups,
    mean_error,
    of,
    table,
)
from paper.common.verdicts import (
    Claim,
    Curves,
    Difference,
    Judged,
    all_of,
    judge,
    paired,
    reproduced,
    within,
)
from paper.pages import PAGES, PAPER, results


def curves(**runs):
    """Of scenarios whose values are given by seed, each a list over the episodes from 1."""
    rows = [
        {"learner": name, "seed": seed, "episode": episode, "cost": value}
        for name, by_seed in runs.items()
        for seed, values in by_seed.items()
        for episode, value in enumerate(values, 1)
    ]
    return Curves(pd.DataFrame(rows), "cost")


def test_curves_over_the_episodes():
    of = curves(cka={0: [4.0, 2.0, 1.0], 1: [6.0, 4.0]}, mf={1: [7.0]})
    assert of.names == ["cka", "mf"]
    assert of.mean("cka").tolist() == [5, 3, 1]
    assert of.spread("cka")[1] == pytest.approx(math.sqrt(2))
    assert of.mean_at("cka", 2) == 3
    assert math.isnan(of.mean_at("mf", 2))
    assert of.first_below("cka", 3) == 2
    assert of.first_below("cka", 0.5) is None
    assert of.window("cka", 1, 2).to_dict() == {0: 3, 1: 5}
    assert of.seeds("cka", last=3) == {0}
    assert of.restricted({1}).mean("cka").tolist() == [6, 4]


def test_differences_are_of_the_seeds_that_both_have():
    of = curves(cka={0: [1.0], 1: [2.0], 2: [9.0]}, mf={0: [2.0], 1: [5.0]}, gp={2: [10.0]})
    assert of.paired_difference("mf", 1, 1) == Difference(2, pytest.approx(1), 2)
    assert of.paired_difference("gp", 1, 1).text() == "+1.000"
    assert of.paired_difference("gp", 1, 1, reference="mf").text() == ""
    assert of.paired_difference("cka", 1, 1).n == 0


def test_intervals_are_students():
    values = np.random.default_rng(0).normal(size=10)
    found = Difference.of([*values, np.nan])
    low, high = stats.ttest_1samp(values, 0).confidence_interval()
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))
    assert found.half_width == pytest.approx(2.262 * found.error, rel=1e-3)
    assert (found / -2).error == found.error / 2
    assert Difference(0.12345, 0.0456, 4).text(".1%") == "+12.3% ± 4.6%"


def test_a_verdict_whose_bound_lies_in_the_interval_is_inconclusive():
    assert within(Difference(-1, 0.1, 10), high=0) == "reproduced"
    assert within(Difference(1, 0.1, 10), high=0) == "not reproduced"
    assert within(Difference(-0.1, 0.1, 10), high=0) == "inconclusive"
    assert within(Difference(-0.3, 0.1, 10), -0.4, -0.2) == "inconclusive"
    assert within(Difference(-0.3, 0.01, 10), -0.4, -0.2) == "reproduced"
    assert within(Difference(-1, math.nan, 1), high=0) == "reproduced"
    assert all_of("beaten", "inconclusive", "reproduced") == "inconclusive"
    assert [reproduced(True), reproduced(False)] == ["reproduced", "not reproduced"]


def test_claims_are_judged_by_the_seeds_that_all_their_scenarios_have():
    of = curves(
        cka={0: [1.0, 1.0], 1: [1.0, 1.0], 2: [9.0, 9.0]},
        mf={0: [2.0, 2.0], 1: [2.0, 2.0], 2: [2.0]},
        rra={0: [2.0, 2.0], 1: [2.0]},
    )

    def better(shared):
        held = shared.mean_at("cka", 2) < shared.mean_at("mf", 2)
        return reproduced(held), f"{shared.mean_at('cka', 2):g}"

    claims = [
        Claim("T1", "CKA is better", ("cka", "mf"), better),
        Claim("T2", "RRA is better", ("cka", "rra"), better),
        Claim("T3", "GP is better", ("cka", "gp"), better),
    ]
    found = {claim.id: (claim.verdict, claim.measured) for claim in judge(claims, of, last=2)}
    assert found == {
        "T1": ("inconclusive", "2 runs: 1"),
        "T2": ("not run", "too few runs of rra"),
        "T3": ("not run", "no results of gp"),
    }


def test_tables_of_claims():
    one, other = Judged("F1", "c", "beaten", "x"), Judged("F1", "c", "beaten", "y")
    assert "| **beaten**: x | **beaten**: y |" in claims_table({"p": [one], "q": [other]})
    assert "| **beaten**: x | the same |" in claims_table({"p": [one], "q": [one]})


def test_tables_of_runs():
    """Rows and columns in the order of their labels; means do not depend on the order of runs."""
    made = [
        {"kind": kind, "learner": name, "seed": seed, "error": error, "settings": {}}
        for kind, name, seed, error in (
            ("b", "gp", 0, 0.121), ("b", "cka", 0, 0.1), ("b", "cka", 1, 0.3), ("a", "gp", 0, 0.5)
        )
    ]  # fmt: skip
    runs = frame(made)
    assert [*runs] == ["kind", "learner", "seed", "error"]
    rows = groups(runs, "kind", {"a": "A", "b": "B", "c": "C"})
    columns = across(runs, "learner", {"cka": "CKA", "gp": "GP"}, of("error", "mean", ".2g"))
    shown = table(rows, columns, "error", [["C", "9"]])
    assert shown.splitlines()[0] == "| error | CKA | GP |"
    assert shown.splitlines()[2:] == ["| A |  | 0.5 |", "| B | 0.2 | 0.12 |", "| C | 9 |  |"]
    assert of("error", "max", ".1f", learner="cka")(runs) == "0.3"
    assert mean_error("error", ".2f", ".1g", counted=True, learner="cka")(runs) == "0.20 ± 0.1 (2)"
    assert mean_error("error", ".2f", kind="a")(runs) == "0.50"
    assert [*groups(runs, ["kind", "learner"], "{} by {}".format)] == [
        "b by gp",
        "b by cka",
        "a by gp",
    ]
    trials = frame([{"seed": 3, "trials": {"cost": [1.0, 2.0]}, "commit": "x"}], "trials")
    assert trials.to_dict("list") == {"seed": [3, 3], "episode": [1, 2], "cost": [1.0, 2.0]}


def test_paired_differences_and_ratios():
    runs = pd.DataFrame(
        [{"learner": n, "seed": s, "error": (1 + s) * (2.0 if n == "gp" else 1.0)}
         for n in ("cka", "gp") for s in range(3)] + [{"learner": "gp", "seed": 9, "error": 1.0}]
    )  # fmt: skip
    assert paired(runs, "error", "learner", "gp", "cka").text(".1f") == "+2.0 ± 0.6"
    assert paired(runs, "error", "learner", "cka", "gp", ratio=True).ratio() == "0.50 [0.50, 0.50]"
    assert paired(runs, "error", "learner", "cka", "rra").n == 0


def test_learners_are_made_with_or_without_the_physics():
    X = torch.rand(4, 1, dtype=torch.float64)
    assert LEARNERS["literal"].make(X, X, physics=torch.sin).num_outputs == 1
    assert type(LEARNERS["gp"].make(X, X, physics=torch.sin)).__name__ == "ZeroMeanGP"
    with pytest.raises(ValueError, match="chapter makes"):
        _ = LEARNERS["oracle"].make


def test_pages_show_the_committed_results():
    found = results(PAPER / "results")
    assert [path for path in PAGES if filled(path.read_text(), found) != path.read_text()] == []


def committed(name):
    """An experiment, and its runs that are committed."""
    kind = resolve_name(EXPERIMENTS[name])
    experiment = kind(out=PAPER / "results")
    return experiment, runs_file(experiment).read()


def test_committed_runs_have_the_settings_of_today():
    """If this fails, a default has changed: run them again, or say in a setting what it was."""
    for name in EXPERIMENTS:
        experiment, runs = committed(name)
        for kind in {case[:-1] for case in runs}:
            today = json.loads(json.dumps(experiment.describe(*kind)))
            for run in (run for case, run in runs.items() if case[:-1] == kind):
                assert not differences(run["settings"], today), (name, kind)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_tables_are_those_of_the_committed_runs(name):
    experiment, runs = committed(name)
    if not runs:
        pytest.skip("it was not run yet")
    shown = results(PAPER / "results")
    for marker, found in tables_of(experiment, [*runs.values()]).items():
        assert shown[marker] == found.text


def test_markers_keep_what_is_between_them():
    text = "a\n<!-- one:x -->\n<!-- end -->\nprose\n<!-- two:y -->\nold\n<!-- end -->\nb\n"
    found = {"one:x": "| 1 |", "two:y": "| 2 |"}
    whole = filled(text, found)
    assert whole == (
        "a\n<!-- one:x -->\n| 1 |\n<!-- end -->\nprose\n<!-- two:y -->\n| 2 |\n<!-- end -->\nb\n"
    )
    assert fragments(whole) == found
    with pytest.raises(ValueError, match="No result is called 'two:y'"):
        filled(text, {"one:x": "| 1 |", "two:z": ""})
    assert "<!-- two:y -->\n*Not run yet.*\n<!-- end -->" in filled(text, {"one:x": "| 1 |"})
    with pytest.raises(ValueError, match="<!-- one:x --> has no <!-- end -->"):
        filled("<!-- one:x -->\nprose\n<!-- two:y -->\n<!-- end -->\n", found)
