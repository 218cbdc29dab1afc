"""The machines' chapter: real records, and tanks."""

import pytest
import torch
from torch.testing import assert_close

from gpadjust.dynamics import PhysicsDynamics, Trajectories
from paper.common.runner import runs_file
from paper.common.runs import rounded
from paper.machines import (
    CANDIDATES,
    CHOSEN,
    HORIZONS,
    NARX,
    REAL_LEARNERS,
    STRUCTURES,
    TENTH,
    UNTRAINED,
    Real,
    RealSettings,
    Tanks,
    TanksSettings,
)
from paper.machines.learners import train
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import DOUBLE_PENDULUM, PENDULUM
from paper.machines.real import load
from paper.machines.records import DATA, REAL, folder_of
from paper.machines.tanks import Start, blocks, chosen, follow, without
from paper.machines.tanks import load as tanks_load
from paper.machines.tanks_systems import FIXED, UNKNOWNS, measured, physics, rates

MACHINES = {"double": DOUBLE_PENDULUM, "single": PENDULUM}
VALUES = {**{name: known.guess for name, known in UNKNOWNS.items()}, "power": 0.5}


def recorded(experiment, cases):
    """Runs of cases, as the file has them."""
    return [
        dict(zip(experiment.key, case, strict=True)) | rounded(experiment.run(*case))
        for case in cases
    ]


@pytest.mark.slow
def test_runs_and_their_tables(tmp_path):
    learners = ("phy", "fitted", "gp", "cka-identified")
    settings = RealSettings(windows=2, drawn=25)
    experiment = Real(
        out=tmp_path, runs=1, only=("pendulum", "0", "25", *learners), settings=settings
    )
    runs = recorded(experiment, experiment.cases())
    assert all(r["tests"]["sac"].keys() == {"rmse", "coverage", "nlpd", "lost"} for r in runs)
    assert len(runs[0]["tests"]["sac"]["rmse"]["20"]) == 2
    assert [(run["learner"], run["n"]) for run in runs] == [
        ("phy", 0), ("fitted", 25), ("gp", 25), ("cka-identified", 25)
    ]  # fmt: skip
    scored = load(runs)
    assert (scored["n"] == 25).all()  # f_p alone, too
    silent = scored.set_index("learner")["coverage-10"].isna()
    assert [name for name in silent.index if silent[name]] == ["phy"]
    tables = experiment.tables(runs)
    scores = {f"{s}-{k}" for s in ("rmse", "coverage", "nlpd") for k in (1, *HORIZONS)}
    names = {"paired"}
    assert tables.keys() == names | {f"pendulum-sac-{score}" for score in scores}
    assert tables["pendulum-sac-rmse-20"].text.count("\n") == 1 + len(learners)
    assert [path.name for path in experiment.draw(runs)] == []


def test_cases_are_the_sizes_that_there_are():
    cases = Real(runs=2).cases()
    assert len(cases) == len({*cases})
    taught = len(REAL_LEARNERS) - len(UNTRAINED)
    assert len(cases) == len(UNTRAINED) * 4 + taught * 2 * 4 * 5
    for name, system in REAL.items():
        most = max(n for own, n, *_ in cases if own == name)
        assert most == (300 if name.startswith("pendulum") else 400)
        assert len(system.drawn(most, 0).states) == most
    assert Real.axes["system"].keys() == REAL.keys()


@pytest.mark.parametrize("name", REAL)
def test_tests_are_of_other_records_in_which_the_machine_moves(name):
    known = REAL[name]
    for test, given in known.tests.items():
        assert not {*given} & {*known.train}
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


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_least_squares_finds_the_parameters(name):
    machine = MACHINES[name]
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(60, machine.spec.state_dim, generator=generator).double()
    actions = torch.randn(60, machine.spec.action_dim, generator=generator).double()
    real = PhysicsDynamics(machine.spec, machine.physics("identified"))
    following = real.sample(states, actions)
    noise = 1e-3 * torch.randn(following.shape, generator=generator).double()
    fitted = train("fitted", machine, Trajectories(states, actions, following + noise), 0).dynamics
    mean, variance = fitted.predict(states, actions)
    assert_close(mean, following, rtol=0, atol=2e-3)
    assert_close(variance.sqrt(), torch.full_like(mean, 1e-3), rtol=0.3, atol=0)


def test_networks_learn_and_stop_early():
    known = REAL["pendulum"]
    machine, data = known.machine, known.drawn(60, 0)
    physics = machine.physics("crude")
    states, actions, following = known.steps("sac")

    def error(dynamics):
        return dynamics.score(states, actions, following).rmse[1]

    alone = NetworkDynamics(machine.spec, number=3, steps=200)
    beside = NetworkDynamics(machine.spec, physics, number=3, steps=200)
    for dynamics in (alone, beside):
        dynamics.update(*data)
        mean, variance = dynamics.predict(states, actions)
        blocks = dynamics.sample_functions(3, seed=0)(states.expand(3, -1, -1), actions)
        assert_close(blocks.mean(0), mean)
        assert (variance >= dynamics.noise_variance(states, actions)).all()
        assert dynamics.sample(states, actions).shape == states.shape
    still = (states[:, 1] - following[:, 1]).square().mean().sqrt()
    assert error(beside) < error(alone) < still / 2
    again = NetworkDynamics(machine.spec, number=3, steps=200)
    again.update(*data)
    assert_close(again.predict(states, actions).mean, alone.predict(states, actions).mean)


def test_data_are_small_and_have_their_licences():
    for folder in ("double_pendulum", "pendulum", "tanks"):
        assert (folder_of(folder) / "LICENSE").is_file()
    assert all(file.stat().st_size < 1e6 for file in DATA.rglob("*.csv"))


@pytest.mark.slow
def test_tanks_runs_and_their_tables(tmp_path, monkeypatch):
    monkeypatch.setitem(CHOSEN, "", "overflow-small")
    monkeypatch.setitem(CHOSEN, "overflow", "overflow-small")
    settings = TanksSettings(samples=64, head=40, blocks=2, starts=1, rounds=3)
    names = ("overflow-small", "sensor-middle", "narx-2", TENTH, "overflow-delta")
    experiment = Tanks(out=tmp_path, runs=1, only=names, settings=settings)
    runs = recorded(experiment, experiment.cases())
    assert all(0 < run["rmse"] < 10 and 0 <= run["coverage"] <= 1 for run in runs)
    assert {run["learner"] for run in runs if "cv" in run} == {*names[:3]}
    assert {run["by"] for run in runs[3:] if "by" in run} == {"overflow-small"}
    tables = experiment.tables(runs)
    assert tables.keys() == {"candidates", "learners"}


def test_learners_of_tanks_go_beside_what_the_committed_runs_choose():
    experiment = Tanks(out=DATA.parents[1] / "results" / "tanks")
    scored = tanks_load(list(runs_file(experiment).read().values()))
    assert CHOSEN[""] == chosen(scored, CANDIDATES)
    linear = [name for name in CANDIDATES if name.startswith("overflow")]
    assert CHOSEN["overflow"] == chosen(scored, linear)
    cases = Tanks().cases()
    assert len(cases) == len({*cases}) == len(CANDIDATES) + 10 + 4 * 2 * 3 + len(NARX) * 3
    assert {n for n, *_ in cases[: len(CANDIDATES)]} == {1024}
    assert FIXED.keys() == STRUCTURES.keys()


def test_blocks_are_all_samples_but_the_head():
    settings = TanksSettings()
    rows = [row for block in blocks(settings) for row in range(1024)[block]]
    assert rows == [*range(settings.head, 1024)]
    _, lower = measured("Est", 1024)
    left = without(lower, blocks(settings)[1])
    assert left.isnan().sum() == 241
    assert not lower.isnan().any()


def test_sensor_without_bend_is_torricelli():
    state, action = (
        torch.tensor([[4.0, 9.0], [12.0, 4.0]]).double(),
        torch.full((2, 1), 3.0).double(),
    )
    values = {**VALUES, **FIXED["overflow"]}
    found = rates(state, action, values)
    over = torch.tensor([0.0, 1.5 * 3.0]).double()
    inflow = torch.full((2,), 0.12).double()
    outflow = 0.04 * state.sqrt()
    assert_close(found[:, 0], inflow - outflow[:, 0] - over)
    assert_close(found[:, 1], outflow[:, 0] + 0.5 * over - outflow[:, 1])


def test_sensor_of_a_root_slows_where_it_is_flat():
    """The level that the sensor's rate implies changes as Torricelli says."""
    state, action = torch.tensor([[4.0, 7.0]]).double(), torch.zeros(1, 1).double()
    values = {**VALUES, **FIXED["sensor"]}
    state.requires_grad_(True)
    level = 5 * ((state[:, 1] - 2.2) / 2.8).sqrt()
    (slope,) = torch.autograd.grad(level.sum(), state)
    change = slope[:, 1] * rates(state, action, values)[:, 1]
    assert_close(change, 0.04 * (2.0 - level.sqrt()))


@pytest.mark.slow
def test_free_run_ends_where_inflow_is_outflow():
    lower = torch.full((800,), 5.0).double()
    actions = torch.full((800,), 2.0).double()
    path = follow(physics("overflow", VALUES), Start(5.0, 1.0), actions, lower)
    assert path[0] == 5.0
    assert float(path[-1]) == pytest.approx(4.0, abs=0.01)  # 2 = sqrt(level)
