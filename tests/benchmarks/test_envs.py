"""What an environment costs beside the integration that it wraps."""

import numpy as np
import opensim
import pytest

from gpadjust.envs import REAL_ARM, MuscleArmEnv
from gpadjust.envs.opensim_model import build_muscle_arm, controls

START = np.radians([35.0, 65.0, 0.0, 0.0])
ACCURACY = 1e-5


@pytest.fixture
def excitations():
    """Of the 15 steps of a trial."""
    return np.random.default_rng(0).uniform(size=(15, 4))


@pytest.fixture
def bare_trial(excitations):
    """A trial by OpenSim alone: no observations, rewards or checks."""
    model, controller = build_muscle_arm(REAL_ARM, strength=0.5)
    start = model.initSystem()
    for joint, angle in zip(("shoulder", "elbow"), START[:2], strict=True):
        model.getCoordinateSet().get(joint).setValue(start, angle)
    constants = controls(controller)
    manager = opensim.Manager(model)
    manager.setWriteToStorage(False)
    manager.setPerformAnalyses(False)
    manager.setIntegratorMethod(opensim.Manager.IntegratorMethod_RungeKuttaMerson)
    manager.setIntegratorAccuracy(ACCURACY)

    def run(model=model):  # the manager does not keep the model alive
        state = opensim.State(start)
        for i, row in enumerate(excitations.tolist()):
            for constant, value in zip(constants, row, strict=True):
                constant.setValue(value)
            manager.initialize(state)
            state = opensim.State(manager.integrate(0.2 * (i + 1)))

    return run


@pytest.fixture
def env_trial(excitations):
    env = MuscleArmEnv(accuracy=ACCURACY)

    def run():
        env.reset(options={"state": START})
        for row in excitations:
            env.step(row)

    return run


def test_muscle_arm_beside_opensim(benchmark, record_ratio, env_trial, bare_trial):
    benchmark.group = "Muscle arm, trial of 15 steps"
    record_ratio("time of environment / bare OpenSim", env_trial, bare_trial, rounds=20)


def test_step_of_the_muscle_arm(benchmark, env_trial):
    benchmark.group = "Muscle arm, trial of 15 steps"
    benchmark.pedantic(env_trial, rounds=20, warmup_rounds=1)
    milliseconds = 1e3 * benchmark.stats.stats.median / 15
    benchmark.extra_info["ms a step"] = round(milliseconds, 2)
    print(f"ms a step: {milliseconds:.2f}")
