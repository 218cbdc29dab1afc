"""The runs of this experiment."""

from __future__ import annotations

from functools import partial

from paper.cartpole.runs import details
from paper.cartpole.scenarios import functions, make_dynamics, make_env
from paper.control import runs
from paper.control.experiment import Experiment
from paper.exploration.recorder import ExplorationRecorder
from paper.exploration.scenarios import SCENARIOS, SETTINGS

EXPLORATION = Experiment(
    name="exploration",
    scenarios=SCENARIOS,
    settings=SETTINGS,
    make_env=make_env,
    make_dynamics=make_dynamics,
    functions=functions,
    make_recorder=ExplorationRecorder,
    details=details,
)
run_one = partial(runs.run_one, EXPLORATION)
run_all = partial(runs.run_all, EXPLORATION)
