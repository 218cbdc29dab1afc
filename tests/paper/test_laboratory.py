"""Smoke runs of the experiments on data as laboratories have them."""

import pytest

# Options, number of runs, what the tables say, and entries that are above zero.
SMALL = {
    "emulated": (["--only", "booth", "--num-test", "50"], 6, "RMSE over exact", "error"),
    "balldrop": (["--only", "softball", "mean", "--num-runs", "8", "--heights", "20", "60"], 4,
                 "held by 95 %", "seconds"),
    "noisyinputs": (["--only", "wave", "decay", "--observations", "12",
                     "--observations-of-law", "12"], 8, "RMSE over that of ignoring it", "rmse"),
    "links": (["--only", "rate", "pump", "linked", "default"], 8, "coverage of 95 %", "rmse"),
    "categories": (["--only", "each", "ours"], 4, "coverage of 95 %", "rmse"),
    "drift": (["--steps", "60", "--first", "24", "--num-features", "8", "--refit-every", "24"], 10,
              "coverage of observations", "rmse"),
    "relative": (["--only", "rate", "CKA"], 4, "observations held", "seconds"),
    "outliers": (["--only", "good", "20"], 2, "outliers found", "gaussian_clean"),
    "vanishing": (["--only", "ball", "misplaced"], 10, "true value held", "rmse"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
@pytest.mark.filterwarnings("ignore")
def test_it_runs(name, ran, tmp_path):
    given, number, said, entry = SMALL[name]
    runs, tables = ran(name, *given)
    assert len(runs) == number
    values = [run[entry]["rmse"] if entry == "gaussian_clean" else run[entry] for run in runs]
    assert all(value > 0 for value in values)
    assert said in tables
    assert (tmp_path / f"{name}.png").exists() == (name not in ("emulated", "links"))
