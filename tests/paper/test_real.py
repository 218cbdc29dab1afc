"""The experiment on measured records of real machines."""

import pytest
import torch
from paper.real import HORIZONS, LARGEST, LEARNERS, SYSTEMS, UNTAUGHT, Real, Settings
from paper.real.figure import COLORS
from paper.real.learners import MAKERS
from paper.real.least_squares import LeastSquares
from paper.real.machines import DOUBLE_PENDULUM, PENDULUM
from paper.real.networks import NetworkDynamics
from paper.real.systems import DATA, system
from paper.real.tables import load
from paper.real.targets import CALIBRATED, OURS
from torch.testing import assert_close

from gpadjust.dynamics import PhysicsDynamics
from paper.common.runner import rounded

TINY = Settings(sizes=(12,), windows=2, drawn=12)
MACHINES = {"double": DOUBLE_PENDULUM, "single": PENDULUM}


def test_runs_and_their_tables(tmp_path):
    learners = ("phy", "fitted", "gp", "cka-identified")
    experiment = Real(out=tmp_path, runs=1, systems=("pendulum",), learners=learners, settings=TINY)
    experiment.check()
    records = []
    for task in experiment.tasks():
        found = rounded(experiment.run(*task, unfinished=tmp_path / "x"))
        assert found["tests"]["sac"].keys() == {"rmse", "coverage", "nlpd", "lost"}
        assert len(found["tests"]["sac"]["rmse"]["20"]) == 2
        records.append(dict(zip(experiment.key, task, strict=True)) | found)
    assert [record["n"] for record in records] == [0, 12, 12, 12]
    runs = load(records)
    assert (runs["n"] == 12).all()  # f_p alone, too
    silent = runs.set_index("learner")["coverage-10"].isna()
    assert [name for name in silent.index if silent[name]] == ["phy"]
    tables = experiment.tables(records)
    scores = {f"{s}-{k}" for s in ("rmse", "coverage", "nlpd") for k in (1, *HORIZONS)}
    seconds = {"pendulum-fit_seconds", "pendulum-score_seconds"}
    assert tables.keys() == {"targets"} | seconds | {f"pendulum-sac-{score}" for score in scores}
    assert tables["pendulum-sac-rmse-20"].text.count("\n") == 1 + len(learners)
    assert "**not run**: no results of calibrated-delta" in tables["targets"].text
    assert [path.name for path in experiment.draw(records)] == ["errors.png", "pendulum.png"]


def test_tasks_are_the_sizes_that_there_are():
    tasks = Real(runs=2).tasks()
    assert len(tasks) == len({*tasks})
    taught = len(LEARNERS) - len(UNTAUGHT)
    assert len(tasks) == len(UNTAUGHT) * 4 + taught * 2 * (5 + 5 + 5 + 5)
    for name, most in LARGEST.items():
        assert max(n for system, _, n, _ in tasks if system == name) == most
    for name in SYSTEMS:
        most = max(Real().sizes(name))
        assert len(system(name).drawn(most, 0).states) == most
        assert system(name).describe()["tests"].keys() == system(name).tests.keys()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"systems": ("moon",)}, "--systems: there is no 'moon', but there are double-pendulum"),
        ({"learners": ("moon",)}, "--learners: there is no 'moon', but there are phy"),
        ({"settings": Settings(sizes=(5,))}, "--sizes: expected at least 10, got 5"),
        ({"settings": Settings(windows=1)}, "--windows: expected at least 2, got 1"),
    ],
)
def test_unknown_names_and_numbers_out_of_range_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        Real(**options).check()


def test_each_learner_has_a_label_a_maker_and_a_colour():
    assert MAKERS.keys() == LEARNERS.keys() == COLORS.keys()
    assert {*OURS, *OURS.values()} <= LEARNERS.keys()
    assert not {*CALIBRATED} & OURS.keys()


@pytest.mark.parametrize("name", SYSTEMS)
def test_tests_are_of_other_records_in_which_the_machine_moves(name):
    known = system(name)
    for test, files in known.tests.items():
        assert not {*files} & {*known.train}
        windows = known.windows(test, 40, 7)
        assert windows.measured.shape == (7, 40, known.machine.spec.state_dim)
        states, _, following = known.steps(test)
        rates = [i for i in range(states.shape[1]) if i not in known.machine.spec.angle_columns]
        assert (states[:, rates].abs().amax(1) >= known.moves).all()
        assert len(states) == len(following) > 100


@pytest.mark.parametrize("name", MACHINES)
def test_friction_takes_what_the_drives_do_not_give(name):
    """Without friction and torque, energy stays; numbers per row are as good as one for all."""
    machine = MACHINES[name]
    known = {k: torch.tensor(v).double() for k, v in machine.known["identified"].items()}
    without = {k: 0 * v if k.startswith(("viscous", "coulomb")) else v for k, v in known.items()}
    states = torch.randn(20, machine.spec.state_dim, generator=torch.Generator().manual_seed(0))
    states = states.double().requires_grad_(True)
    nothing = torch.zeros(20, machine.spec.action_dim, dtype=torch.float64)

    def power(parameters):
        (slope,) = torch.autograd.grad(energy(machine, states, known).sum(), states)
        return (slope * machine.rates(states, nothing, parameters)).sum(-1)

    assert_close(power(without), torch.zeros(20).double(), rtol=0, atol=1e-9)
    assert (power(known) < 0).all()
    rows = {k: v.expand(20) for k, v in known.items()}
    assert_close(machine.rates(states, nothing, rows), machine.rates(states, nothing, known))


def energy(machine, states, p):
    """Of the links and rotors, by another way than the equation of motion: from the velocities."""
    if machine is PENDULUM:
        q, dq = states.unbind(-1)
        return p["inertia"] * dq**2 / 2 - 9.81 * p["moment"] * q.cos()
    q1, q2, dq1, dq2 = states.unbind(-1)
    both = dq1 + dq2
    links = p["inertia_1"] * dq1**2 + p["inertia_2"] * both**2
    links = links + 2 * 0.3 * p["moment_2"] * q2.cos() * dq1 * both
    rotors = p["rotor"] * ((6 * dq1) ** 2 + (6 * dq2 - dq1) ** 2)
    heights = p["moment_1"] * q1.cos() + p["moment_2"] * (q1 + q2).cos()
    return (links + rotors) / 2 - 9.81 * heights


@pytest.mark.parametrize("name", MACHINES)
def test_least_squares_finds_the_parameters(name):
    machine = MACHINES[name]
    real, generator = machine.known["identified"], torch.Generator().manual_seed(0)
    states = torch.randn(60, machine.spec.state_dim, generator=generator).double()
    actions = torch.randn(60, machine.spec.action_dim, generator=generator).double()
    following = PhysicsDynamics(machine.spec, machine.physics(real)).sample(states, actions)
    fitted = LeastSquares(machine, machine.known["crude"])
    noise = 1e-3 * torch.randn(following.shape, generator=generator).double()
    fitted.update(states, actions, following + noise)
    for parameter, value in real.items():
        assert fitted.parameters[parameter] == pytest.approx(value, rel=0.05, abs=1e-3)
    noise = fitted.predict(states, actions).variance.sqrt()
    assert_close(noise, torch.full_like(noise, 1e-3), rtol=0.3, atol=0)
    assert_close(fitted.noise_variance(states, actions), noise**2)


def test_networks_learn_and_stop_early():
    known = system("pendulum")
    machine, data = known.machine, known.drawn(60, 0)
    physics = machine.physics(machine.known["crude"])
    states, actions, following = known.steps("sac")

    def error(dynamics):
        return dynamics.score(states, actions, following).rmse[1]

    alone = NetworkDynamics(machine.spec, folds=3, steps=200)
    beside = NetworkDynamics(machine.spec, physics, folds=3, steps=200)
    for dynamics in (alone, beside):
        dynamics.update(*data)
        mean, variance = dynamics.predict(states, actions)
        blocks = dynamics.sample_functions(3, seed=0)(states.expand(3, -1, -1), actions)
        assert_close(blocks.mean(0), mean)
        assert (variance >= dynamics.noise_variance(states, actions)).all()
        assert dynamics.sample(states, actions).shape == states.shape
    still = (states[:, 1] - following[:, 1]).square().mean().sqrt()
    assert error(beside) < error(alone) < still / 2
    again = NetworkDynamics(machine.spec, folds=3, steps=200)
    again.update(*data)
    assert_close(again.predict(states, actions).mean, alone.predict(states, actions).mean)


def test_data_are_small_and_have_their_licences():
    for folder in ("double_pendulum", "pendulum", "tanks"):
        assert (DATA / folder / "LICENSE").is_file()
    assert all(file.stat().st_size < 1e6 for file in DATA.rglob("*.csv"))
