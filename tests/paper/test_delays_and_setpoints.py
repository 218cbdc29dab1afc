"""The chapter of control: delays, and set-points that move."""

import warnings

import numpy as np
import pytest
import torch

from paper.control import Delays, DelaysSettings, Setpoints, SetpointsSettings, delays, setpoints
from paper.control.systems import tanks


def runs_of(module, experiment, kinds):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [
            dict(zip(experiment.key, (*kind, 0), strict=True)) | module.run(experiment, *kind, 0)
            for kind in kinds
        ]


@pytest.mark.slow
def test_set_points_make_tables():
    light = SetpointsSettings(trials=2, sequences=8, first_sequences=8, first_rounds=0)
    experiment = Setpoints(settings=light)
    kinds = [("between", "seen"), ("within", "constant"), ("within", "oracle")]
    found = setpoints.tables(runs_of(setpoints, experiment, kinds), experiment)
    assert "bounds by what was seen alone" in found["between"].text
    assert "reference given" in found["within"].text


@pytest.mark.slow
def test_delays_make_tables(tmp_path):
    light = DelaysSettings(trials=1, sequences=8, first_sequences=8, first_rounds=0)
    experiment = Delays(settings=light, out=tmp_path)
    assert len(experiment.seeds_of("hint_late")) == 4 * len(experiment.seeds_of("not"))
    runs = runs_of(delays, experiment, [("physics",), ("hint_late",), ("hint_noisy",)])
    assert runs[1]["found_after"] == 1
    assert runs[2]["found_after"] is None
    found = delays.tables(runs, experiment)
    assert "told to f_p" in found["costs"].text
    assert delays.draw(runs, experiment)[0].exists()


@pytest.mark.parametrize("step", [1, 7])
def test_the_sine_is_what_the_tanks_show(step):
    env = setpoints.Moving(tanks().make(), within=True)
    observation, _ = env.reset(seed=0)
    for _ in range(step):
        observation, *_ = env.step(np.array([3.0], dtype=np.float32))
    expected = setpoints.sine(torch.zeros(1, 3), torch.tensor([step]))
    assert observation[2] == pytest.approx(expected.item())
