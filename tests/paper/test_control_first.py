"""The chapter of control: first trials, and decisions in time."""

import warnings

import pytest

from paper.control import First, FirstSettings, Ontime, OntimeSettings, first, ontime


@pytest.mark.slow
def test_first_trials_make_a_table():
    experiment = First(settings=FirstSettings(trials=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = first.run(experiment, "truth", 0)
    assert 0.1 < found["trials"]["cost"][0] < 0.42
    text = first.tables([{"model": "truth", "seed": 0, **found}], experiment)["trials"].text
    assert "the true system, trial 1" in text


@pytest.mark.slow
def test_decisions_in_time_make_a_table():
    experiment = Ontime(settings=OntimeSettings(random_trials=1, trials=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = [
            {"seconds": seconds, "seed": 0, **ontime.run(experiment, seconds, 0)}
            for seconds in ("none", "0.02")
        ]
    free, tight = (each["trials"]["median"][0] for each in runs)
    assert tight < free
    assert "0.02" in ontime.tables(runs, experiment)["times"].text
