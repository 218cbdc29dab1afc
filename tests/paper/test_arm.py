import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.rl.random_state import RandomState
from paper import __main__ as command_line
from paper import report
from paper.arm import evaluation, summarise
from paper.arm.claims import claims, distance_from_start
from paper.arm.evaluation import hundred, reach, score
from paper.arm.figure import HELD
from paper.arm.results import load, load_evaluations, load_maps, tabulate, tabulate_memory
from paper.arm.runs import ARM, run_one
from paper.arm.scenarios import PAPER, SCENARIOS, SETTINGS, make_dynamics, make_env
from paper.arm.targets import targets
from paper.control.claims import judge
from paper.control.curves import Curves
from paper.result_file import result_path

TINY = replace(
    SETTINGS,
    num_trials=2,
    trial_length=5,
    model_trials=2,
    model_updates=1,
    model_until=2,
    batch_size=16,
    net_arch=(16,),
    evaluate_every=1,
)
TRIALS = (0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30)


class Interrupts(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


class Still:
    """Excites all muscles as much; remembers what it saw."""

    def __init__(self):
        self.seen = []

    def predict(self, observation, *, deterministic):
        assert deterministic
        self.seen.append(observation)
        return np.full((len(observation), 4), 0.25, dtype=np.float32), None


@pytest.fixture
def _few_targets(monkeypatch):
    """Evaluations of 4 targets, as OpenSim takes its time."""
    every = evaluation.arm_targets()[[0, 40, 60, 120]]
    monkeypatch.setattr(evaluation, "arm_targets", lambda: every)


def numbers_of(path):
    """All that a run found, but the seconds."""
    result = json.loads(path.read_text())
    for name in ("trials", "evaluations"):
        result[name] = {k: v for k, v in result[name].items() if not k.endswith("_seconds")}
    return {name: result[name] for name in ("trials", "evaluations", "maps")}


@pytest.mark.usefixtures("_few_targets")
def test_an_evaluation_is_that_of_the_environment():
    scenario, policy = replace(SCENARIOS["cka"], memory=True), Still()
    distances = reach(policy, TINY, memory=True)
    assert distances.shape == (4, 5)
    env = make_env(scenario, TINY)
    target = evaluation.arm_targets()[1].tolist()
    start = [*np.radians([35.0, 65.0]), 0.0, 0.0]
    seen, _ = env.reset(seed=0, options={"state": start, "target": target})
    for step in range(5):
        np.testing.assert_allclose(policy.seen[step][1], seen, rtol=0, atol=1e-6)
        seen, _, _, _, info = env.step(np.full(4, 0.25, dtype=np.float32))
        assert distances[1, step] == pytest.approx(info["hand_distance_cm"], abs=1e-6)


@pytest.mark.usefixtures("_few_targets")
def test_an_evaluation_draws_no_random_number():
    agent = ARM.make_agent(SCENARIOS["mf"], 0, TINY)
    before = RandomState.capture()
    first = reach(agent, TINY, memory=False)
    after = RandomState.capture()
    assert torch.equal(after.torch, before.torch)
    assert (after.numpy[1] == before.numpy[1]).all()
    assert (reach(agent, TINY, memory=False) == first).all()


def test_scores():
    distances = np.tile(np.arange(1.0, 8.0), (3, 1))
    scores = score(distances)
    assert scores["all_steps"] == pytest.approx(np.sqrt(20.0) * np.ones(3))
    assert scores["last_five"] == pytest.approx(np.sqrt(27.0) * np.ones(3))
    assert hundred().sum() == 100
    assert np.sqrt(np.square(distance_from_start()).mean()) == pytest.approx(HELD, abs=0.5)


@pytest.mark.usefixtures("_few_targets")
def test_an_interrupted_run_gives_the_numbers_of_one_that_was_not(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "MAP_TRIAL", 1)
    whole = run_one("cka-memory", 0, tmp_path / "whole", TINY)
    expected = numbers_of(whole)
    assert expected["evaluations"]["trial"] == [0, 1, 2]
    assert expected["trials"]["updates"] == [5 + 2 * 5] * 2
    assert len(expected["trials"]["rmse"][1]) == 4
    assert len(expected["maps"]["1"]["last_five"]) == 4
    assert all(0 < value < 100 for value in expected["evaluations"]["all_steps"])
    with pytest.raises(KeyboardInterrupt):
        run_one("cka-memory", 0, tmp_path, TINY, [Interrupts(7)])
    assert not result_path(tmp_path, "cka-memory", 0).exists()
    assert numbers_of(run_one("cka-memory", 0, tmp_path, TINY)) == expected
    with pytest.raises(ValueError, match=r"made with other settings: strength was 0\.5"):
        run_one("cka-memory", 0, tmp_path, replace(TINY, strength=0.3))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs(tmp_path, name):
    path = run_one(name, 0, tmp_path, replace(TINY, num_trials=3, evaluate_every=3))
    assert path.stat().st_size < 20_000
    assert numbers_of(path)["evaluations"]["trial"] == [0, 3]


def test_the_models_of_the_scenarios():
    for name, scenario in SCENARIOS.items():
        dynamics = make_dynamics(scenario, 0)
        assert dynamics.spec.state_dim == (10 if name.endswith("memory") else 6)
        assert ARM.functions(scenario)["initial_states"](3).shape == (3, dynamics.spec.state_dim)
    assert make_dynamics(SCENARIOS["cka-opensim"], 0).physics.name == "opensim_arm"


def test_unknown_scenarios(tmp_path, monkeypatch):
    arguments = ["paper", "arm", "--scenarios", "mf,ck", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="--scenarios: there is no scenario 'ck'"):
        command_line.main()


def write(out, curves, maps=None, spreads=None, num_runs=4, last=30):
    """Results of scenarios whose error over the trials is given, a constant or a function.

    The errors at each target are given as a function of the distance from the start.
    """
    (out / "runs").mkdir(parents=True)
    far = distance_from_start()
    for name, curve in curves.items():
        for seed in range(num_runs):
            noise = (spreads or {}).get(name, 0.5) * (seed - (num_runs - 1) / 2) / num_runs
            trials = [trial for trial in TRIALS if trial <= last]
            errors = [(curve(t) if callable(curve) else curve) + noise for t in trials]
            evaluations = {"trial": trials, "evaluation_seconds": [1.0] * len(trials)}
            for measure, less in (("all_steps", 0), ("last_five", 1)):
                for suffix in ("", "_100"):
                    evaluations[measure + suffix] = [error - less for error in errors]
            at_target = (maps or {}).get(name, lambda far: 5 + 0 * far)(far).tolist()
            nothing = [None] * last
            times = ("fit_seconds", "rollout_seconds", "sac_seconds", "cpu_seconds")
            result = {
                "scenario": name,
                "seed": seed,
                "evaluations": evaluations,
                "maps": {"9": {"all_steps": at_target, "last_five": at_target}},
                "trials": {
                    "cost": [0.5] * last,
                    "nlpd": nothing,
                    "coverage": nothing,
                    "rmse": nothing,
                    **dict.fromkeys(("left_bounds", "updates", *times), [1] * last),
                },
            }
            result_path(out, name, seed).write_text(json.dumps(result))
    return out


def verdicts(out, *args, measure="all_steps", **kwargs):
    write(out, *args, **kwargs)
    found = judge(claims(load_maps(out)), Curves(load_evaluations(out), measure), 30)
    return {claim.id: claim for claim in found}


def falls(start, end, until):
    """From one error to another, in a straight line until a trial, and then not."""
    return lambda t: start + (end - start) * min(t, until) / until


AS_PUBLISHED = {
    "mf": falls(40, 8, 30),
    "gp": falls(40, 11, 9),
    "phy": falls(40, 9.5, 12),
    "cka": lambda t: 40 if t == 0 else 7.5 - t / 20,
    "rra": lambda t: falls(40, 9.5, 12)(t) if t < 24 else 6.3 - (t - 24) / 20,
}


def test_verdicts_of_the_papers_curves(tmp_path):
    judged = verdicts(
        tmp_path,
        AS_PUBLISHED,
        maps={"mf": lambda far: 5 + far / 3},
        spreads={"cka": 0.2},
    )
    found = {name: claim.verdict for name, claim in judged.items()}
    assert found == dict.fromkeys(("A1", "A2", "A3", "A4", "A5", "A6"), "reproduced")
    assert "10 cm never" in judged["A2"].measured
    assert judged["A4"].measured.startswith(
        "4 runs: 10 cm at trial 3, 8 cm at trial 3, at 30 6.0 cm"
    )
    assert judged["A6"].measured.startswith(
        "4 runs: at most 10 cm at 121 of 121 targets by CKA, at "
    )


def test_verdicts_of_other_curves(tmp_path):
    judged = verdicts(
        tmp_path,
        {"mf": 6, "gp": falls(40, 6, 9), "phy": 20, "cka": 4, "rra": 20},
        maps={"cka": lambda far: 20 + 0 * far},
        spreads={"cka": 0.2},
    )
    found = {name: claim.verdict for name, claim in judged.items()}
    assert found["A1"] == found["A4"] == "beaten"
    assert {found[name] for name in ("A2", "A3", "A5", "A6")} == {"not reproduced"}


def test_claims_about_what_was_not_run(tmp_path):
    judged = verdicts(tmp_path, {"cka": 5, "mf": 9})
    assert judged["A4"].verdict == "not run"
    assert judged["A4"].measured == "no results of phy"
    assert judged["A1"].verdict == "reproduced"


def test_learning_nowhere_is_not_learning_near_the_start(tmp_path):
    judged = verdicts(tmp_path, AS_PUBLISHED, maps={"mf": lambda far: 20 + 0 * far})
    assert judged["A6"].verdict == "not reproduced"
    assert "at none by model-free" in judged["A6"].measured


def judged_targets(out, curves, **kwargs):
    write(out, curves, **kwargs)
    evaluations = load_evaluations(out)
    found = judge(targets(load(out), evaluations), Curves(evaluations, "all_steps"), 30)
    return {claim.id: claim for claim in found}


def test_targets(tmp_path):
    curves = {**AS_PUBLISHED, "cka-opensim": 6.5}
    found = judged_targets(tmp_path / "met", curves, spreads={"cka-opensim": 0})
    assert {claim.verdict for claim in found.values()} == {"met"}
    assert found["T1"].measured == "4 runs: at trial 3; at 6 7.2 cm"
    assert found["T2"].measured.startswith(
        "4 runs: 6.0 cm; the best of the others 6.0 cm (Dyna-RRA)"
    )
    assert found["T3"].measured.startswith("4 runs: 30 s; of wall time, fits 30, ")
    assert found["T4"].measured.startswith("4 runs: 6.5 cm at 30, 30 s; with the equation")
    found = judged_targets(tmp_path / "missed", dict.fromkeys(PAPER, 5) | {"cka": 9})
    assert found["T1"].verdict == found["T2"].verdict == "missed"
    assert found["T4"].verdict == "not run"


def test_tables(tmp_path):
    out = write(tmp_path, {"cka": 5, "mf": lambda t: 30 - t / 2})
    result_path(out, "mf", 3).unlink()
    table = tabulate(load_evaluations(out)).set_index(["steps", "scenario"])
    every = table.loc["all steps"]
    assert list(every.index) == ["mf", "cka"]
    assert list(every["runs"]) == [3, 4]
    assert every["at_6"]["mf"] == pytest.approx(27, abs=0.2)
    assert every["more_24_30"]["mf"] == pytest.approx(11.5)
    assert every["more_24_30_se"]["mf"] == pytest.approx(0, abs=1e-9)
    assert every["first_8"]["cka"] == 0
    assert table.loc["last five steps"]["hundred"]["cka"] == pytest.approx(4)


def test_what_the_previous_action_brings(tmp_path):
    out = write(tmp_path, {"cka": 9, "cka-memory": 7, "gp": 9}, spreads={"cka": 2})
    result_path(out, "cka-memory", 3).unlink()
    row = tabulate_memory(load_evaluations(out)).set_index("scenario").loc["cka"]
    assert row["runs"] == 3
    assert row["without_3_9"] == pytest.approx(8.75)
    assert row["more_3_9"] == pytest.approx(row["with_3_9"] - 8.75)
    assert row["more_24_30_se"] == pytest.approx(0.375 / np.sqrt(3))


def test_results_are_summarised_and_reported(tmp_path, capsys):
    summarise(write(tmp_path, {"cka": 5, "mf": 9}, num_runs=2, last=9))
    for name in ("curves", "iqm", "map", "time"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000
    assert "A4 not run" in capsys.readouterr().out
    fragments = report._arm(tmp_path)
    assert "| Dyna-CKA | 2 | 5.0 | 5.0 | 5.0 |  |" in fragments["arm:all"]
    assert "**not run**" in fragments["arm:claims"]
    assert fragments.keys() == report._arm(tmp_path / "nothing").keys()


def test_no_results(tmp_path):
    with pytest.raises(FileNotFoundError, match="There are no results"):
        load_evaluations(tmp_path)
