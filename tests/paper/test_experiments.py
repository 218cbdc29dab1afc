"""A small run of each experiment, and the data that they read."""

import pytest

from paper.__main__ import EXPERIMENTS
from paper.published import Uci
from paper.published.steels import ELEMENTS, TRACE
from paper.published.steels import split as steels_split
from tests.systems import refused

SMALL = {  # options, the number of runs, and a word of the tables
    "forrester": ("--only B paper --steps 2", 2, "F7"),
    "functions": ("--only wave 5 --num-test 20", 8, "CKA / formula fitted"),
    "kinds": ("--only relative", 4, "`noise=RelativeNoise()`"),
    "misled": ("--only unrelated --trials 2 --mc-samples 8", 8, "median regret"),
    "parameters": ("--only smooth focus physics free", 6, "free delta, slope"),
    "steels": ("--only formula", 2, "TPOT-Mat, published"),
    "uci": ("--only yacht 0.1 feature boosting", 4, "WGBoost"),
    "nist": ("--only DanWood 1", 2, "| within both limits | 1 |"),
    "masses": ("--only fold drop none alone gp --stride 12 --num-rows 60", 4, "valence"),
    "emps": ("--rows 600 --every 20 --rounds 5", 8, "dynoNet"),
    "freeruns": ("--only furnace fitted cka --transitions 20 --rounds 5", 3, "PR-SSM, published"),
    "real": ("--only pendulum 100 phy fitted gp --windows 2", 5, "sac"),
    "tanks": ("--only kink fitted delta --samples 80 --rounds 3 --starts 1", 3, "CT-SUBNET"),
    "known": ("--only tanks phy gp --trials 2 --sequences 8 --elites 2", 4, "two tanks (2 runs)"),
    "first": ("--only truth --trials 1", 2, "the true system, trial 1"),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SMALL)
def test_a_small_run(name, ran):
    options, number, word = SMALL[name]
    runs, tables = ran(name, *options.split())
    assert len(runs) == number
    assert word in tables
    assert "*Runs: " in tables


def test_each_experiment_has_a_small_run():
    """The others have one beside their own tests."""
    assert EXPERIMENTS.keys() - SMALL == {"arm", "cartpole", "nuts", "simulators"}


def test_steels_are_in_five_folds():
    sizes = []
    for fold in range(5):
        X, Y, test, _ = steels_split(fold)
        sizes.append(len(test))
        assert len(X) + len(test) == 312
        assert X.shape[1] == len(ELEMENTS)
        assert ((X.exp() - TRACE).sum(1) < 0.5).all()  # iron is the rest
        assert 1000 < Y.median() < 2000
    assert max(sizes) - min(sizes) <= 1


def test_splits_that_there_are_not():
    refused(ValueError, "20 splits", Uci(runs=2, seed=19).check)
