import argparse
import math
from dataclasses import replace

import pandas as pd
import pytest

from paper.arm.runs import ARM
from paper.control import options
from paper.control.claims import Claim, judge, met, reproduced, signed
from paper.control.curves import Curves


def curves(**runs):
    """Of scenarios whose values are given by seed, each a list over the trials from 1."""
    rows = [
        {"scenario": name, "seed": seed, "trial": trial, "cost": value}
        for name, by_seed in runs.items()
        for seed, values in by_seed.items()
        for trial, value in enumerate(values, 1)
    ]
    return Curves(pd.DataFrame(rows), "cost")


def test_curves_over_the_trials():
    of = curves(cka={0: [4.0, 2.0, 1.0], 1: [6.0, 4.0]}, mf={1: [7.0]})
    assert of.names == ["cka", "mf"]
    assert of.mean("cka").tolist() == [5, 3, 1]
    assert of.spread("cka")[1] == pytest.approx(math.sqrt(2))
    assert of.at("cka", 2) == 3
    assert math.isnan(of.at("mf", 2))
    assert of.first("cka", 3) == 2
    assert of.first("cka", 0.5) is None
    assert of.window("cka", 1, 2).to_dict() == {0: 3, 1: 5}
    assert of.seeds("cka") == {0, 1}
    assert of.seeds("cka", last=3) == {0}
    assert of.restricted({1}).mean("cka").tolist() == [6, 4]


def test_differences_are_of_the_seeds_that_both_have():
    of = curves(cka={0: [1.0], 1: [2.0], 2: [9.0]}, mf={0: [2.0], 1: [5.0]}, gp={2: [10.0]})
    assert of.more("mf", 1, 1) == (2, pytest.approx(1))
    more, error = of.more("gp", 1, 1)
    assert more == 1
    assert math.isnan(error)
    assert math.isnan(of.more("gp", 1, 1, reference="mf")[0])
    assert of.more_columns("mf", [(1, 1)]) == {"more_1_1": 2, "more_1_1_se": pytest.approx(1)}
    assert math.isnan(of.more_columns("cka", [(1, 1)])["more_1_1"])


def test_claims_are_judged_by_the_seeds_that_all_their_scenarios_have():
    of = curves(
        cka={0: [1.0, 1.0], 1: [1.0, 1.0], 2: [9.0, 9.0]},
        mf={0: [2.0, 2.0], 1: [2.0, 2.0], 2: [2.0]},
    )

    def better(shared):
        return met(shared.at("cka", 2) < shared.at("mf", 2)), f"{shared.at('cka', 2):g}"

    claims = [
        Claim("T1", "CKA is better", ("cka", "mf"), better),
        Claim("T2", "all of three runs", ("cka", "mf"), better, fewest=3),
        Claim("T3", "GP is better", ("cka", "gp"), better),
    ]
    found = {claim.id: (claim.verdict, claim.measured) for claim in judge(claims, of, last=2)}
    assert found == {
        "T1": ("met", "2 runs: 1"),
        "T2": ("not run", "too few runs of mf"),
        "T3": ("not run", "no results of gp"),
    }


def test_words_of_verdicts():
    assert reproduced(False, beaten=True) == "not reproduced"
    assert [reproduced(True), reproduced(True, beaten=True)] == ["reproduced", "beaten"]
    assert signed(0.12345, math.nan) == "+0.123"
    assert signed(-1, 0.25, digits=1) == "-1.0 ± 0.2"


def test_what_an_experiment_needs_and_lacks(tmp_path, monkeypatch):
    def check():
        raise ImportError("It needs a simulator; install it.")

    monkeypatch.setattr(options, "run_all", lambda *args, **kwargs: pytest.fail("was run"))
    parser = argparse.ArgumentParser()
    options.add_arguments(parser, replace(ARM, check=check), pytest.fail)
    arguments = parser.parse_args(["--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="It needs a simulator"):
        arguments.run(arguments)
