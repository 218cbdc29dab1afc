"""The experiment on how well dynamics know what they do not know."""

import pytest
import torch
from paper.foresight import METHODS, NOISES, Foresight, Settings
from paper.foresight.run import measured

from gpadjust.dynamics import Trajectories
from gpadjust.envs import CART_POLE_SPEC
from paper.common.runner import rounded

TINY = Settings(
    trials=3,
    model_episodes=1,
    updates_per_model_step=0.04,
    horizons=(1, 2),
    max_windows=1,
)
pytestmark = pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")


@pytest.mark.slow
def test_a_run_and_its_tables(tmp_path, monkeypatch):
    for part in ("run", "tables"):  # the agent has the default all the same
        monkeypatch.setattr(f"paper.foresight.{part}.METHODS", {"map": METHODS["map"]})
    experiment = Foresight(out=tmp_path, runs=2, jobs=1, settings=TINY)
    assert len(experiment.tasks()) == 4
    found = rounded(experiment.run("cartpole", 0, unfinished=tmp_path / "x"))
    assert len(found["rewards"]) == 3
    for name in (f"{noise}-map" for noise in NOISES):
        scores = found[name]
        for share in ("coverage", "coverage_1", "coverage_2"):
            assert len(scores[share]) == 2
            assert all(0 <= each <= 1 for row in scores[share] for each in row)
        assert len(scores["fit_seconds"]) == 2
        assert len(scores["conditioned"]["coverage"]) == 4
    defaults = {f"{noise}-default": found[f"{noise}-map"] for noise in NOISES}
    record = {"system": "cartpole", "seed": 0, **found, **defaults}
    tables = experiment.tables([record, {**record, "seed": 1}])
    for name, table in tables.items():
        lines = table.text.splitlines()
        assert len(lines) == 2 + (4 if name == "targets" else len(NOISES))
        assert len({line.count("|") for line in lines}) == 1


def test_sensors_see_each_state_once():
    states = torch.zeros(4001, 4, dtype=torch.float64)
    trial = Trajectories(states[:-1], torch.ones(4000, 1, dtype=torch.float64), states[1:])
    (seen,) = measured(CART_POLE_SPEC, [trial], 0)
    assert seen.states[1:].equal(seen.next_states[:-1])
    assert seen.actions.equal(trial.actions)
    expected = torch.tensor([0.01, 0.01, 0.05, 0.05], dtype=torch.float64)
    assert torch.allclose(seen.states.std(0), expected, rtol=0.1)
    assert measured(CART_POLE_SPEC, [trial], 0)[0].states.equal(seen.states)


def test_options_out_of_range():
    with pytest.raises(ValueError, match="expected at least 3, got 2"):
        Foresight(settings=Settings(trials=2)).check()
