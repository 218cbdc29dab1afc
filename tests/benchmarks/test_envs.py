"""What an environment costs beside the integration that it wraps."""

import time

import numpy as np
import opensim
import pytest

from paper.arm.system import MuscleArmEnv
from paper.arm.system.opensim import build_muscle_arm, controls
from paper.arm.system.torque_arm import REAL_ARM

START = np.radians([35.0, 65.0, 0.0, 0.0])
ACCURACY = 1e-5
STEPS = 15  # of an episode
ROUNDS = 20
EXCITATIONS = {
    "held, moderate": np.tile([0.2, 0.1, 0.3, 0.1], (ROUNDS, STEPS, 1)),
    "U(0, 1) each step": np.random.default_rng(0).uniform(0, 1, (ROUNDS, STEPS, 4)),
    "U(0, 0.3) each step": np.random.default_rng(0).uniform(0, 0.3, (ROUNDS, STEPS, 4)),
}


@pytest.fixture
def bare_episode():
    """An episode by OpenSim alone: no observations, rewards or checks."""
    model = build_muscle_arm(REAL_ARM, strength=0.5)
    start = model.initSystem()
    for joint, angle in zip(("shoulder", "elbow"), START[:2], strict=True):
        model.getCoordinateSet().get(joint).setValue(start, angle)
    constants = controls(model)
    manager = opensim.Manager(model)
    manager.setWriteToStorage(False)
    manager.setPerformAnalyses(False)
    manager.setIntegratorMethod(opensim.Manager.IntegratorMethod_RungeKuttaMerson)
    manager.setIntegratorAccuracy(ACCURACY)

    def run(excitations, model=model):  # the manager does not keep the model alive
        state = opensim.State(start)
        for i, row in enumerate(excitations.tolist()):
            for constant, value in zip(constants, row, strict=True):
                constant.setValue(value)
            manager.initialize(state)
            state = opensim.State(manager.integrate(0.2 * (i + 1)))

    return run


@pytest.fixture
def env_episode():
    env = MuscleArmEnv(accuracy=ACCURACY)

    def run(excitations):
        env.reset(options={"state": START})
        for row in excitations:
            env.step(row)

    return run


def milliseconds(episodes, excitations):
    """Median times of a step by each, by turns; of the processor, which other processes share."""
    times = [[] for _ in episodes]
    for rows in excitations:
        for episode, record in zip(episodes, times, strict=True):
            start = time.process_time()
            episode(rows)
            record.append((time.process_time() - start) / len(rows))
    return 1e3 * np.median(times, axis=1)


@pytest.mark.parametrize("name", EXCITATIONS)
def test_muscle_arm_beside_opensim(benchmark, env_episode, bare_episode, name):
    benchmark.group = "Muscle arm, step of 0.2 s"
    episodes, excitations = (env_episode, bare_episode), EXCITATIONS[name]
    milliseconds(episodes, excitations[:1])
    ours, bare = benchmark.pedantic(milliseconds, args=(episodes, excitations), rounds=1)
    benchmark.extra_info |= {"ms a step": round(ours, 2), "beside OpenSim": round(ours / bare, 3)}
    print(f"{name}: {ours:.2f} ms a step, {ours / bare:.3f} times bare OpenSim ({bare:.2f} ms)")
