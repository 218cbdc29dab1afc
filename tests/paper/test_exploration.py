import json
from dataclasses import replace

import pandas as pd
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.dynamics import GPDynamics, PhysicsDynamics
from gpadjust.envs import CART_POLE_SPEC, cart_pole_cost, random_cart_pole_physics
from gpadjust.rl import InformativeTrials
from gpadjust.rl.random_state import RandomState
from paper import __main__ as command_line
from paper.cartpole.scenarios import true_dynamics
from paper.control.runs import result_path
from paper.exploration import summarise
from paper.exploration.held_out import (
    KINDS,
    NUM_STARTS,
    NUM_STEPS,
    PATH,
    errors,
    held_out,
)
from paper.exploration.make_held_out import make_trials
from paper.exploration.report import NAMES, fragments
from paper.exploration.results import MEASURES, load, tabulate
from paper.exploration.runs import EXPLORATION, run_one
from paper.exploration.scenarios import SCENARIOS, SETTINGS

TINY = replace(
    SETTINGS, num_trials=3, model_trials=1, model_until=3, model_updates=0.2, batch_size=16
)
TIMES = ("fit_seconds", "rollout_seconds", "sac_seconds", "plan_seconds", "cpu_seconds")


class Interrupts(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 60:
            raise KeyboardInterrupt
        return True


def trials_of(path):
    trials = json.loads(path.read_text())["trials"]
    return {name: values for name, values in trials.items() if name not in TIMES}


@pytest.fixture
def small_plans(monkeypatch):
    """Plans of few sequences."""
    few = InformativeTrials(num_random=3, num_policy=1, num_functions=1, rounds=1, num_elites=2)
    for name in ("cka-info", "gp-info", "gp-info-3"):
        monkeypatch.setitem(SCENARIOS, name, replace(SCENARIOS[name], exploration=few))


def test_the_test_trials_are_of_the_real_system():
    assert {*held_out()} == {*KINDS}
    real = true_dynamics(encode_angle=True)
    for data in held_out().values():
        assert len(data.states) == NUM_STARTS * NUM_STEPS
        following = real.sample(data.states, data.actions)
        assert real.spec.change(following, data.next_states).abs().max() < 1e-5
    cost = {
        kind: cart_pole_cost(data.next_states).reshape(NUM_STARTS, NUM_STEPS)
        for kind, data in held_out().items()
    }
    assert cost["swing-up"].amin(1).max() < 0.1  # all get there
    assert cost["swing-up"].mean() < 0.5
    assert cost["random"].mean(1).min() > 0.8


def test_test_trials_are_made_anew_alike():
    before = RandomState.capture()
    made = [make_trials(num_starts=2, rounds=1, num_sequences=3) for _ in range(2)]
    pd.testing.assert_frame_equal(*made)
    assert torch.equal(RandomState.capture().torch, before.torch)
    kept = pd.read_csv(PATH)
    assert list(made[0].columns) == list(kept.columns)
    starts = made[0].drop_duplicates("trial")[["x", "theta"]].to_numpy()
    assert starts[0] == pytest.approx(starts[1])


def test_errors_are_relative_to_no_change():
    assert max(errors(true_dynamics(encode_angle=True)).values()) < 1e-5
    still = PhysicsDynamics(CART_POLE_SPEC, lambda X: X[:, :4])
    assert errors(still) == pytest.approx(dict.fromkeys(KINDS, 1.0))
    crude = errors(PhysicsDynamics(CART_POLE_SPEC, random_cart_pole_physics(0)))
    assert all(0.01 < error < 0.5 for error in crude.values())


def test_a_run_records_the_errors_of_the_newest_model(tmp_path, small_plans):
    path = run_one("gp-info-3", 3, tmp_path, TINY)
    trials = trials_of(path)
    assert [*map(len, trials.values())] == [3] * len(trials)
    assert all(value > 0 for name in MEASURES for value in trials[name])
    result = json.loads(path.read_text())
    assert result["settings"]["exploration.trials"] == 3
    assert result["settings"]["exploration.num_random"] == 3
    assert result["trials"]["plan_seconds"][0] == 0 < result["trials"]["plan_seconds"][1]


def test_only_the_real_trials_differ(tmp_path, small_plans):
    settings = replace(TINY, num_trials=2)
    runs = {
        name: trials_of(run_one(f"gp-{name}", 0, tmp_path, settings))
        for name in ("random", "sac", "info")
    }
    first = {name: run["error"][0] for name, run in runs.items()}
    assert len({*first.values()}) == 1
    second = {name: run["error"][1] for name, run in runs.items()}
    assert len({*second.values()}) == 3


def test_an_interrupted_run_gives_the_numbers_of_one_that_was_not(tmp_path, small_plans):
    expected = trials_of(run_one("gp-info", 0, tmp_path / "whole", TINY))
    with pytest.raises(KeyboardInterrupt):
        run_one("gp-info", 0, tmp_path, TINY, [Interrupts()])
    assert not result_path(tmp_path, "gp-info", 0).exists()
    assert trials_of(run_one("gp-info", 0, tmp_path, TINY)) == expected


def test_results_of_other_plans_are_refused(tmp_path, small_plans, monkeypatch):
    settings = replace(TINY, num_trials=1)
    run_one("gp-info", 0, tmp_path, settings)
    other = replace(SCENARIOS["gp-info"], exploration=InformativeTrials(rounds=0))
    monkeypatch.setitem(SCENARIOS, "gp-info", other)
    with pytest.raises(ValueError, match=r"other settings: exploration\.num_random was 3"):
        run_one("gp-info", 0, tmp_path, settings)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs(tmp_path, name):
    assert len(trials_of(run_one(name, 0, tmp_path, replace(TINY, num_trials=2)))["cost"]) == 2


def write(out, curves, num_runs=2, num_trials=15):
    """Results of scenarios whose measures are a constant, plus the seed's hundredth."""
    (out / "runs").mkdir(parents=True)
    for name, value in curves.items():
        for seed in range(num_runs):
            trials = {
                **dict.fromkeys(("cost", *MEASURES), [value + seed / 100] * num_trials),
                **dict.fromkeys(("nlpd", "coverage", "rmse"), [None] * num_trials),
                **dict.fromkeys(TIMES, [2.0] * num_trials),
            }
            if name.endswith("sac"):
                del trials["plan_seconds"]
            result = {"scenario": name, "seed": seed, "trials": trials}
            result_path(out, name, seed).write_text(json.dumps(result))
    return out


def test_explorers_are_compared_with_sac_of_the_same_model(tmp_path):
    out = write(tmp_path, {"cka-sac": 0.2, "cka-info": 0.1, "gp-sac": 0.5, "gp-random": 0.9})
    table = tabulate(load(out)).set_index(["measure", "scenario"])
    assert len(table) == 3 * 4
    error = table.loc["error"]
    assert error["less_2_6"].to_dict() == pytest.approx(
        {"cka-sac": float("nan"), "cka-info": -0.1, "gp-random": 0.4, "gp-sac": float("nan")},
        nan_ok=True,
    )
    assert error["less_2_6_se"]["cka-info"] == pytest.approx(0)
    assert error["at_15"]["gp-sac"] == pytest.approx(0.505)


def test_an_explorer_that_nothing_can_be_compared_with(tmp_path):
    table = tabulate(load(write(tmp_path, {"cka-info": 0.1}, num_trials=4)))
    assert table["less_2_6"].isna().all()
    assert table["at_15"].isna().all()


def test_results_are_summarised_and_reported(tmp_path, capsys):
    summarise(write(tmp_path, {"cka-sac": 0.2, "cka-info": 0.1, "gp-sac": 0.5}))
    assert (tmp_path / "curves.png").stat().st_size > 5_000
    assert "Mean error on swing-ups, after trials:" in capsys.readouterr().out
    found = fragments(tmp_path)
    assert "| Dyna-CKA, informative trials | 2 | 0.105 |" in found["exploration:error"]
    assert "-0.100 ± 0.000" in found["exploration:error"]
    assert "| Dyna-GP, SAC's trials | 0 | 30 |" in found["exploration:seconds"]
    assert found.keys() == fragments(tmp_path / "nothing").keys()
    assert {f"exploration:{name}" for name in NAMES} < found.keys()


def test_the_command_line(tmp_path, monkeypatch):
    assert EXPLORATION.name == "exploration"
    write(tmp_path, {"cka-sac": 0.2})
    arguments = ["paper", "exploration", "--only-tables", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    command_line.main()
    assert (tmp_path / "table.csv").exists()


def test_the_gp_is_without_physics():
    made = EXPLORATION.make_dynamics(SCENARIOS["gp-info"], 0, SETTINGS)
    assert isinstance(made, GPDynamics)
    assert SETTINGS.model_until == SETTINGS.num_trials
