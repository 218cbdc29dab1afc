"""The machines' chapter: real records, beyond the training, tanks, foresight and kinks."""

import pytest
import torch
from torch.testing import assert_close

from gpadjust.dynamics import PhysicsDynamics, Trajectories
from gpadjust.systems.swing_up import CART_POLE_SPEC
from paper.common.runner import main, runs_file
from paper.common.runs import rounded
from paper.machines import (
    CANDIDATES,
    CHOSEN,
    HORIZONS,
    KINKS,
    METHODS,
    NARX,
    NOISES,
    REAL_LEARNERS,
    SMOOTH,
    STRUCTURES,
    TENTH,
    UNTRAINED,
    Elsewhere,
    ElsewhereSettings,
    Foresight,
    ForesightSettings,
    Kinks,
    KinksSettings,
    Real,
    RealSettings,
    Tanks,
    TanksSettings,
)
from paper.machines.foresight import measured as noisy
from paper.machines.kinks import drawn
from paper.machines.kinks import tables as kinks_tables
from paper.machines.kinks_systems import SYSTEMS
from paper.machines.learners import train
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import DESIGN_C, DOUBLE_PENDULUM, PENDULUM, design_c, loaded_pendulum
from paper.machines.real import load
from paper.machines.records import DATA, ELSEWHERE, REAL
from paper.machines.tanks import Start, blocks, chosen, follow, without
from paper.machines.tanks import load as tanks_load
from paper.machines.tanks_systems import FIXED, UNKNOWNS, measured, narx_spec, physics, rates
from paper.machines.targets import ALONE

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
    names = {"targets", "paired", "pendulum-fit_seconds", "pendulum-score_seconds"}
    assert tables.keys() == names | {f"pendulum-sac-{score}" for score in scores}
    assert tables["pendulum-sac-rmse-20"].text.count("\n") == 1 + len(learners)
    assert "**not run**: no results of calibrated-delta" in tables["targets"].text
    assert [path.name for path in experiment.draw(runs)] == ["errors.png", "pendulum.png"]


def test_cases_are_the_sizes_that_there_are():
    cases = Real(runs=2).cases()
    assert len(cases) == len({*cases})
    taught = len(REAL_LEARNERS) - len(UNTRAINED)
    assert len(cases) == len(UNTRAINED) * 4 + taught * 2 * 4 * 5
    for name, system in REAL.items():
        most = max(n for own, n, *_ in cases if own == name)
        assert most == (300 if name.startswith("pendulum") else 400)
        assert len(system.drawn(most, 0).states) == most
    assert ALONE.keys() | {*ALONE.values()} <= REAL_LEARNERS.keys()
    assert Real.axes["system"].keys() == REAL.keys()
    assert Elsewhere.axes["training"].keys() == ELSEWHERE.keys()
    assert Kinks.axes["system"].keys() == SYSTEMS.keys()


@pytest.mark.parametrize("name", REAL)
def test_tests_are_of_other_records_in_which_the_machine_moves(name):
    known = REAL[name]
    for test, given in known.tests.items():
        assert not {*given.files} & {*known.train}
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
        assert (DATA / folder / "LICENSE").is_file()
    assert all(file.stat().st_size < 1e6 for file in DATA.rglob("*.csv"))


def test_systems_elsewhere_have_their_records():
    for system in ELSEWHERE.values():
        assert len(system.stretches(100, 0)) == 10
        for name, test in system.tests.items():
            windows = system.windows(name, HORIZONS[-1], 3)
            assert windows.measured.shape == (3, HORIZONS[-1], system.machine.spec.state_dim)
            if "load" in system.machine.spec.actions:
                assert (windows.actions[..., 1] == test.load).all()


def test_the_physics_of_another_mass_and_design():
    known = {name: torch.tensor(v).double() for name, v in PENDULUM.known["identified"].items()}
    state, action = torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[0.0, 0.68]]).double()
    heavy = loaded_pendulum(state, torch.tensor([[0.0, 1.36]]).double(), known)
    # Without torque and friction the mass is of no matter.
    torch.testing.assert_close(heavy, loaded_pendulum(state, action, known))
    crude = {name: torch.tensor(v).double() for name, v in DESIGN_C.known["crude"].items()}
    rest = design_c(torch.zeros(1, 4).double(), torch.zeros(1, 2).double(), crude)
    assert (rest == 0).all()


@pytest.mark.filterwarnings("ignore:The observations say next to nothing")
@pytest.mark.slow
def test_a_run_elsewhere_and_its_tables(tmp_path):
    settings = ElsewhereSettings(n=20, windows=2)
    experiment = Elsewhere(out=tmp_path, runs=1, only=("pendulum",), settings=settings)
    experiment.check()
    runs = recorded(experiment, experiment.cases())
    assert [*runs[2]["tests"]["1kg"]] == ["none", "found"]
    assert len(runs[2]["variation"]) == 4
    written = experiment.tables(runs)
    assert written["scores"].text.count("\n") == 1 + 4 * 4
    assert "beyond the training range: 95 % hold at least 0.85" in written["targets"].text


@pytest.mark.parametrize(
    ("experiment", "said"),
    [
        (Elsewhere(settings=ElsewhereSettings(n=15)), "--n: expected 20, 30"),
        (
            Tanks(settings=TanksSettings(samples=66)),
            "--samples: expected at most 1024, and two",
        ),
        (Tanks(settings=TanksSettings(samples=2000)), "--samples: expected at most 1024"),
        (Foresight(settings=ForesightSettings(trials=2)), "expected at least 3, got 2"),
    ],
)
def test_numbers_out_of_range_are_refused(experiment, said):
    with pytest.raises(ValueError, match=said):
        experiment.check()


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
    assert tables.keys() == {"targets", "candidates", "learners", "parameters"}
    assert tables["targets"].text.count("\n") == 4
    unsettled = [{**run, "settled": False} for run in runs]
    assert "not settled" in experiment.tables(unsettled)["targets"].text
    assert [path.name for path in experiment.draw(runs)] == ["tanks.png"]


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


def test_states_without_physics():
    spec = narx_spec(3)
    assert spec.states == ("lower", "lower_1", "lower_2", "pump_1", "pump_2")
    assert narx_spec(1).states == ("lower",)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
def test_a_run_of_foresight_and_its_tables(tmp_path, monkeypatch):
    # The agent has the default all the same.
    monkeypatch.setattr("paper.machines.foresight.METHODS", {"map": METHODS["map"]})
    settings = ForesightSettings(
        trials=3, model_episodes=1, updates_per_model_step=0.04, horizons=(1, 2), max_windows=1
    )
    experiment = Foresight(out=tmp_path, runs=2, settings=settings)
    assert len(experiment.cases()) == 4
    found = rounded(experiment.run("cartpole", 0))
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
    (seen,) = noisy(CART_POLE_SPEC, [trial], 0)
    assert seen.states[1:].equal(seen.next_states[:-1])
    assert seen.actions.equal(trial.actions)
    expected = torch.tensor([0.01, 0.01, 0.05, 0.05], dtype=torch.float64)
    assert torch.allclose(seen.states.std(0), expected, rtol=0.1)
    assert noisy(CART_POLE_SPEC, [trial], 0)[0].states.equal(seen.states)


@pytest.mark.parametrize("name", [*KINKS, *SMOOTH])
def test_which_systems_have_kinks(name):
    """Second differences of a step, along a line of states, grow as the line gets finer, or not."""
    system, generator = SYSTEMS[name], torch.Generator().manual_seed(0)
    ends, actions = system.draw(60, generator)
    states = ends[:30].unsqueeze(1), ends[30:].unsqueeze(1)

    def roughest(points):
        way = torch.linspace(0, 1, points, dtype=torch.float64).reshape(1, -1, 1)
        line = states[0] + way * (states[1] - states[0])
        action = actions[:30].unsqueeze(1).expand(-1, points, -1)
        after = system.step(line.flatten(0, 1), action.flatten(0, 1)).unflatten(0, (30, points))
        second = after.diff(n=2, dim=1).abs().amax() * (points - 1) ** 2
        return float(second)

    growth = roughest(161) / roughest(41)
    assert growth > 2 if name in KINKS else growth < 1.2


@pytest.mark.slow
def test_physics_is_crude_and_data_are_as_told():
    settings = KinksSettings(held_out=10, steps=5)
    for system in SYSTEMS.values():
        for data in Kinks.axes["data"]:
            states, actions = drawn(system, data, 23, settings, 3)
            assert states.shape == (23, system.spec.state_dim)
            assert actions.shape == (23, 1)
            after = system.step(states, actions)
            crude = system.physics(torch.cat([states, actions], dim=-1))
            assert 0 < (after - crude).abs().max() < 20


def record(system, seed, held, width):
    return {
        "system": system,
        "data": "scattered",
        "n": 100,
        "seed": seed,
        "seconds": 1.0,
        "error": [0.1, 0.1],
        **{"held": [held, held], "held_alone": [0.8, 0.8]},
        **{f"{name}{alone}": [1.0, 1.0] for name in ("score", "nlpd") for alone in ("", "_alone")},
        **{"width": [width, width], "width_alone": [1.0, 1.0]},
    }


def test_targets_of_kinks(tmp_path):
    records = [
        record(system, seed, 0.89 if system == "backlash" else 0.96, 1.2)
        for system in KINKS
        for seed in range(2)
    ]
    records += [record(system, seed, 1.0, 1.05) for system in SMOOTH for seed in range(2)]
    found = kinks_tables(records, Kinks(out=tmp_path))
    lines = found["targets"].text.splitlines()[2:]
    verdicts = {line.split(" | ")[0].strip("| "): line.split("**")[1] for line in lines}
    assert verdicts == {"K1": "missed", "K2": "met"}
    row = "| gear with backlash | scattered | 100 | 2 | 0.1 | 0.800 | 0.890 | 1.20 | 1.00 |"
    assert row in found["intervals"].text


@pytest.mark.slow
def test_a_run_of_few_transitions(tmp_path, monkeypatch):
    monkeypatch.setitem(Kinks.axes, "n", {8: "8"})
    settings = KinksSettings(held_out=20, steps=4)
    main(Kinks(out=tmp_path, runs=2, jobs=1, only=("bouncing",), settings=settings))
    assert "bouncing ball" in (tmp_path / "tables.md").read_text()
