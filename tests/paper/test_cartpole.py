import json
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.rl.random_state import RandomState
from paper import __main__ as command_line
from paper import report
from paper.cartpole import summarise
from paper.cartpole.claims import CLAIMS
from paper.cartpole.recorder import evaluate, fixed_starts
from paper.cartpole.results import holds_from, load, tabulate
from paper.cartpole.runs import make_agent, make_tasks, run_all, run_one
from paper.cartpole.scenarios import (
    SCENARIOS,
    SETTINGS,
    SUBSET,
    make_dynamics,
)
from paper.cartpole.targets import TARGETS
from paper.control.claims import judge
from paper.control.curves import Curves
from paper.control.results import iqm
from paper.control.scenario import updates_on_trial
from paper.result_file import result_path

TINY = replace(
    SETTINGS, num_trials=3, model_trials=2, model_until=2, later_updates=5, batch_size=16
)
TIMES = ("fit_seconds", "rollout_seconds", "sac_seconds", "cpu_seconds")


class Interrupts(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


def trials_of(path):
    trials = json.loads(path.read_text())["trials"]
    return {name: values for name, values in trials.items() if name not in TIMES}


def test_a_run_records_its_trials_and_is_not_run_twice(tmp_path):
    path = run_one("phy", 3, tmp_path, TINY)
    assert path == result_path(tmp_path, "phy", 3)
    assert path.stat().st_size < 20_000
    trials = trials_of(path)
    assert trials["updates"] == [25 + 2 * 25 * 2, 25 + 2 * 25 * 2, 5]
    assert all(0 < cost <= 1 for cost in [*trials["cost"], *trials["evaluation"]])
    assert trials["nlpd"] == [None] * 3
    assert len(trials["rmse"][0]) == 4
    assert not list((tmp_path / "unfinished").iterdir())
    before = path.stat().st_mtime_ns
    assert run_one("phy", 3, tmp_path, TINY) == path
    assert path.stat().st_mtime_ns == before


def test_results_of_other_settings_are_refused(tmp_path):
    run_one("mf", 0, tmp_path, replace(TINY, num_trials=1, model_updates=0.1))
    with pytest.raises(ValueError, match=r"mf-0\.json was made with other settings: num_trials"):
        run_one("mf", 0, tmp_path, TINY)


@pytest.mark.parametrize("name", ["mf", "gp"])
@pytest.mark.parametrize("step", [25, 60])
def test_an_interrupted_run_gives_the_numbers_of_one_that_was_not(tmp_path, name, step):
    expected = trials_of(run_one(name, 0, tmp_path / "whole", TINY))
    with pytest.raises(KeyboardInterrupt):
        run_one(name, 0, tmp_path, TINY, [Interrupts(step)])
    assert not result_path(tmp_path, name, 0).exists()
    assert [path.name for path in (tmp_path / "unfinished").iterdir()] == [f"{name}-0.ckpt"]
    assert trials_of(run_one(name, 0, tmp_path, TINY)) == expected


def test_the_model_is_scored_before_it_learns(tmp_path):
    trials = trials_of(run_one("gp", 0, tmp_path, TINY))
    assert [value is None for value in trials["nlpd"]] == [True, False, True]
    assert 0 <= trials["coverage"][1] <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs(tmp_path, name):
    assert len(trials_of(run_one(name, 0, tmp_path, TINY))["cost"]) == 3


def test_an_evaluation_draws_no_random_number():
    agent = make_agent(SCENARIOS["gp-paper"], 0, TINY)
    before = RandomState.capture()
    first = evaluate(agent, False, 25)
    after = RandomState.capture()
    assert torch.equal(after.torch, before.torch)
    assert (after.numpy[1] == before.numpy[1]).all()
    assert evaluate(agent, False, 25) == first
    assert 0.8 < first <= 1
    assert torch.equal(fixed_starts(3), fixed_starts(20)[:3])


def test_scenarios_of_a_seed_share_physics_and_updates():
    first, second = (make_dynamics(SCENARIOS[name], 4).physics.rhs for name in ("phy", "cka"))
    assert first == second
    for trial in (1, 25, 26, 50):
        in_model = 0 if trial > 25 else SETTINGS.model_updates * 500
        assert updates_on_trial(SCENARIOS["mf"], SETTINGS, trial) == in_model + updates_on_trial(
            SCENARIOS["cka"], SETTINGS, trial
        )


def test_tasks_go_seed_by_seed():
    tasks = make_tasks(("mf", "cka-4"), SUBSET + 1, 7)
    assert tasks[:4] == [("mf", 7), ("cka-4", 7), ("mf", 8), ("cka-4", 8)]
    assert tasks[-1] == ("mf", 7 + SUBSET)
    assert len(tasks) == 2 * SUBSET + 1


def test_tasks_that_are_done_are_left_out(tmp_path, monkeypatch):
    settings = replace(TINY, num_trials=1, model_updates=0.1)
    run_all([("mf", 0)], tmp_path, num_jobs=1, settings=settings)
    monkeypatch.setattr("joblib.Parallel.__call__", lambda self, calls: iter([*calls]))
    monkeypatch.setattr("joblib.delayed", lambda function: pytest.fail)
    run_all([("mf", 0)], tmp_path, num_jobs=1, settings=settings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray
def test_runs_on_ray(tmp_path):
    ray = pytest.importorskip("ray")
    settings = replace(TINY, num_trials=2)
    tasks = [("mf", 0), ("phy", 0)]
    try:
        run_all(tasks, tmp_path, num_jobs=2, backend="ray", settings=settings)
    finally:
        ray.shutdown()
    for name, seed in tasks:
        here = run_one(name, seed, tmp_path / "here", settings)
        assert trials_of(result_path(tmp_path, name, seed)) == trials_of(here)


def test_ray_that_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray.util.joblib", None)
    with pytest.raises(SystemExit, match=r"pip install gpadjust\[ray\]"):
        run_all([("mf", 0)], tmp_path, num_jobs=1, backend="ray", settings=TINY)


def test_unknown_scenarios(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="There is no scenario 'ck'; there are mf, "):
        run_one("ck", 0, tmp_path)
    arguments = ["paper", "cartpole", "--scenarios", "mf,ck", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="--scenarios: there is no scenario 'ck'"):
        command_line.main()


def write(out, curves, num_runs=4, num_trials=50):
    """Results of scenarios whose cost over the trials is given, a constant or a function."""
    (out / "runs").mkdir(parents=True)
    for name, curve in curves.items():
        for seed in range(num_runs):
            noise = 1e-3 * np.random.default_rng(seed).standard_normal(num_trials)
            cost = [curve(t) if callable(curve) else curve for t in range(1, num_trials + 1)]
            cost = (np.array(cost) + noise).tolist()
            nothing = [None] * num_trials
            trials = {
                "cost": cost,
                "evaluation": [value - 0.05 for value in cost],
                "nlpd": nothing,
                "coverage": nothing,
                "rmse": nothing,
                **dict.fromkeys(("left_bounds", "updates", *TIMES), [1] * num_trials),
            }
            result = {"scenario": name, "seed": seed, "trials": trials}
            result_path(out, name, seed).write_text(json.dumps(result))
    return out


def verdicts(out, **curves):
    named = {name.replace("_", "-"): curve for name, curve in curves.items()}
    curves = Curves(load(write(out, named)), "cost")
    return {claim.id: claim for claim in judge(CLAIMS, curves, 50)}


def test_verdicts_of_the_papers_curves(tmp_path):
    claims = verdicts(
        tmp_path,
        mf=lambda t: 0.9 if t < 30 else 0.45 if t < 45 else 0.38,
        phy=lambda t: 0.9 if t < 6 else 0.45 if t < 13 else 0.6,
        gp_paper=0.9,
        gp=0.3,
        cka=lambda t: 0.9 if t < 6 else 0.45 if t < 12 else 0.38,
        rra_paper=lambda t: 0.9 if t <= 25 else 0.38,
    )
    assert {name: claim.verdict for name, claim in claims.items()} == dict.fromkeys(
        ("P1", "P2", "P3", "P4", "P5"), "reproduced"
    )
    assert "Dyna-GP, 4 runs: 0.5 at trial 1" in claims["P3"].measured


def test_verdicts_of_other_curves(tmp_path):
    claims = verdicts(
        tmp_path,
        mf=lambda t: 0.9 if t < 10 else 0.38,
        phy=0.4,
        gp_paper=lambda t: 0.9 if t < 40 else 0.45,
        cka=lambda t: 0.9 if t < 4 else 0.35,
        rra_paper=lambda t: 0.9 if t <= 25 else 0.38,
    )
    found = {name: claim.verdict for name, claim in claims.items()}
    assert found["P1"] == found["P4"] == "beaten"
    assert found["P2"] == found["P3"] == found["P5"] == "not reproduced"


def test_claims_about_what_was_not_run(tmp_path):
    claims = verdicts(tmp_path, cka=0.3)
    assert claims["P5"].verdict == "not run"
    assert claims["P5"].measured == "no results of rra-paper"
    assert claims["P4"].verdict == "beaten"


def test_tables_of_incomplete_runs(tmp_path):
    out = write(tmp_path, {"phy": lambda t: 1 - t / 100, "mf": 0.9})
    result_path(out, "mf", 3).unlink()
    trials = load(out)
    table = tabulate(trials).set_index(["actions", "scenario"])
    sampled = table.loc["sampled"]
    assert list(sampled.index) == ["mf", "phy"]
    assert list(sampled["runs"]) == [3, 4]
    assert sampled["cost_13_25"]["phy"] == pytest.approx(0.81, abs=1e-3)
    assert sampled["iqm_low"]["phy"] <= sampled["iqm"]["phy"] <= sampled["iqm_high"]["phy"]
    assert sampled["iqm"]["phy"] == pytest.approx(0.545, abs=1e-3)
    assert pd.isna(sampled["first_0.5"]["mf"])
    assert table.loc["deterministic"]["first_0.5"]["phy"] in (44, 45, 46)
    assert len(Curves(trials, "cost").window("mf", 41, 50)) == 3


def targets(out, measure="cost", **curves):
    named = {name.replace("_", "-"): curve for name, curve in curves.items()}
    curves = Curves(load(write(out, named)), measure)
    return {claim.id: claim for claim in judge(TARGETS, curves, 50)}


def test_targets_that_are_met(tmp_path):
    found = targets(
        tmp_path,
        cka=lambda t: 0.9 if t < 6 else 0.39,
        cka_1=0.6,
        cka_4=lambda t: 0.9 if t < 4 else 0.3,
    )
    met = {name: claim.verdict for name, claim in found.items()}
    assert met == {
        "T1": "met",
        "T2": "met",
        "T3": "met",
        "T4": "missed",
        "T5": "missed",
        "T6": "met",
    }
    assert found["T1"].measured.startswith("4 runs: at trial 6; at 6 0.39")
    assert found["T4"].measured.startswith(
        "4 runs: 2.00 of it (fits 50 s, model steps 50 s, updates 50 s)"
    )
    assert found["T5"].measured == "4 runs: 150 s"
    assert "Dyna-CKA, 4 updates a step: from trial 4 (10.0 s)" in found["T6"].measured
    assert "Dyna-CKA, 1 update a step: never" in found["T6"].measured


def test_targets_that_are_missed(tmp_path):
    found = targets(
        tmp_path,
        cka=lambda t: 0.9 if t < 7 else 0.45,
        cka_1=0.6,
        cka_4=lambda t: 0.4 if t < 20 else 0.6,
    )
    assert {found[name].verdict for name in ("T1", "T2", "T3")} == {"missed"}
    assert found["T6"].verdict == "met"  # by the 2 updates a step, from trial 7
    found = targets(tmp_path / "later", cka=lambda t: 0.9 if t < 8 else 0.3, cka_1=0.6, cka_4=0.6)
    assert found["T6"].verdict == "missed"


def test_targets_of_what_was_not_run(tmp_path):
    found = targets(tmp_path, cka=0.3)
    assert found["T1"].verdict == "met"
    assert found["T5"].verdict == found["T6"].verdict == "not run"
    assert found["T6"].measured == "no results of cka-1"


def test_trial_from_which_a_threshold_holds():
    lucky = pd.Series([0.9, 0.3, 0.9, 0.9, 0.4, 0.5, 0.4, 0.55, 0.3], index=range(1, 10))
    assert holds_from(lucky, 0.5, 9) == 7
    assert holds_from(lucky, 0.5, 10) is None
    assert holds_from(lucky, 0.3, 9) is None


def test_intervals_are_the_same_each_time():
    scores = {"mf": np.random.default_rng(0).normal(size=7)}
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = (iqm(scores)[1]["mf"] for _ in range(2))
    assert first[0] < first[1]
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_results_are_summarised_and_reported(tmp_path, capsys):
    summarise(write(tmp_path, {"cka": 0.4, "mf": 0.9}, num_runs=2, num_trials=3))
    for name in ("curves", "iqm", "time"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000
    assert "P4 not run" in capsys.readouterr().out
    fragments = report._cartpole(tmp_path)
    assert "| Dyna-CKA | 2 | 0.40 |  |  |  |  |  |  | 1 | " in fragments["cartpole:sampled"]
    assert "**not run**" in fragments["cartpole:claims"]
    assert fragments.keys() == report._cartpole(tmp_path / "nothing").keys()


def test_no_results(tmp_path):
    with pytest.raises(FileNotFoundError, match="There are no results"):
        load(tmp_path)
