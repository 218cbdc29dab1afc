"""What experiments are about: functions, laws, machines and records, by independent values."""

import pickle

import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torch.testing import assert_close

from gpadjust.dynamics import PhysicsDynamics
from paper.control.systems import MACHINES as KNOWN
from paper.functions import PROBLEMS as GROUPS
from paper.functions.functions import data_of
from paper.functions.problems import PROBLEMS
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import DOUBLE_PENDULUM, PENDULUM
from paper.machines.records import REAL, folder_of
from paper.machines.tanks_systems import FIXED, UNKNOWNS, rates
from paper.parameters import TEXTBOOK, Parameters
from paper.parameters.laws import PROBLEMS as LAWS
from paper.parameters.laws import case
from paper.published import TABLES, Emps
from paper.published.emps import measured, physics, spec_of
from paper.published.freeruns_systems import SYSTEMS as RECORDS
from paper.published.freeruns_systems import narx_spec, records
from paper.published.masses import drop, left_out, nuclides, shell
from paper.published.rivals import fitted_formula, smt
from paper.published.uci_tables import DATA as UCI
from paper.published.uci_tables import physics as formula
from paper.published.uci_tables import split


# By the package mf2, version 2022.6.0: name, bounds of inputs, inputs, high, low.
@pytest.mark.parametrize(
    ("name", "start", "size", "x", "high", "low"),
    [
        ("bohachevsky", -5, 10, [-3.7, -1.9], 21.7717101571, 9.30945988136),
        ("booth", -10, 20, [-7.4, -3.8], 1040.96, 572.636),
        ("branin", [-5, 0], 15, [-3.05, 4.65], -49.3385511481, 19.3951038769),
        ("currin", 0, 1, [0.13, 0.31], 10.1252792148, 9.56727815299),
        ("forrester", 0, 1, [0.13], -0.960665451521, -9.18033272576),
    ],
)
def test_pairs_have_the_values_of_another_package(name, start, size, x, high, low):
    X = torch.from_numpy((np.array([x]) - start) / size)
    assert PROBLEMS[name].truth(X).item() == pytest.approx(high, rel=1e-9)
    assert PROBLEMS[name].physics(X).item() == pytest.approx(low, rel=1e-9)


@pytest.mark.parametrize("group", GROUPS)
def test_data_of_functions(group):
    """Formulas are right or not as their group says, and the noise is what it says."""
    for name in GROUPS[group]:
        data = data_of(name, 400, 300, 3)
        assert data.X.shape[1] <= 3
        assert data.truth.isfinite().all()
        if group == "law":
            continue
        problem = PROBLEMS[name]
        f_p, off = problem.physics(data.points), data.Y - problem.truth(data.X)
        together = torch.corrcoef(torch.cat([f_p, data.truth], -1).T)[0, 1].abs()
        assert (together > 0.9999) == (group in ("right", "scaled"))
        assert group != "useless" or together < 0.6
        expected = problem.noise * data.truth.std()
        assert off.std().item() == pytest.approx(expected.item(), rel=0.15, abs=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_cases_are_of_their_law(name):
    known = case(name, 7)
    assert name in Parameters.axes["problem"]
    assert name not in TEXTBOOK
    true = torch.tensor([*known.true.values()], dtype=torch.float64)
    assert_close(known.system, known.physics(known.X, true))
    misfit = (known.Y - known.system).square().mean().sqrt()
    assert 0.4 < misfit / known.noise < 1.8


class Textbook:
    """Coefficients in MeV."""

    volume, surface, coulomb, asymmetry, pairing = 15.8, 18.3, 0.714, 23.2, 12.0
    valence, promiscuity = -0.2, 0.1


def test_liquid_drop_and_what_is_left_out():
    both = torch.tensor([[82.0, 126.0], [50.0, 70.0]]).double()  # lead and tin
    assert torch.allclose(shell(both, Textbook)[0], drop(both, Textbook)[0])  # doubly magic
    assert abs(drop(both, Textbook)[0] - 1636.4) < 15  # MeV, as measured
    assert shell(both, Textbook)[1] == drop(both, Textbook)[1] - 0.2 * 12
    known = nuclides()
    assert len(known) == 2457
    folds = np.stack([left_out(known, "fold", 0, seed) for seed in range(10)])
    assert (folds.sum(0) == 1).all()
    ends, tin = left_out(known, "outer2", 0, 0), sorted(known[known.Z == 50].N)
    assert sorted(known[ends & (known.Z == 50)].N) == [*tin[:2], *tin[-2:]]


@pytest.mark.filterwarnings("ignore:.*equal an earlier row")  # the table of concrete is so
@pytest.mark.parametrize("table", TABLES)
def test_splits_are_the_usual_ones_and_formulas_explain_most(table):
    rows, test = (pd.read_csv(UCI / f"{table}{end}.csv") for end in ("", "_test"))
    full, few = split(table, 0.9, 19), split(table, 0.1, 19)
    held = test["split_19"] == 1
    assert len(full.points) == held.sum() == len(rows) - len(full.X)
    assert len(few.X) == round(0.1 * len(rows))
    with torch.no_grad():
        mean = fitted_formula(few.X, few.Y, formula(table)).predict(full.points).mean
    errors = (mean - full.expected).square().mean()
    assert errors < 0.5 * (full.expected - few.Y.mean()).square().mean()


@pytest.mark.slow
def test_mfk_predicts_in_the_units_of_the_data():
    problem = PROBLEMS["booth"]
    X, low = problem.points(10, 0), problem.points(40, 1)
    low = torch.cat([X, low])
    posterior = smt(low, problem.physics(low), X, problem.truth(X))(X)
    assert_close(posterior.mean, problem.truth(X), rtol=1e-2, atol=1e-2)


def test_the_servo_is_in_metres_and_newtons_and_dry_friction_holds_it():
    q, force = measured("estimation", Emps())
    assert (q.min(), q.max()) == pytest.approx((0.0, 0.25), abs=0.005)
    assert (spec_of(Emps()).step, len(q), len(force)) == (0.025, 993, 993)
    rest = torch.tensor([[0.1, 0.0, 15.0], [0.1, 0.0, 40.0]], dtype=torch.float64)
    following = physics(0.025, [95.0, 200.0, 20.0, 0.0])(rest)
    assert_close(following[0], rest[0, :2])
    assert following[1, 1] > 0


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("record", RECORDS)
def test_physics_of_records_returns_next_states(record):
    system = RECORDS[record]
    spec, values = system.spec(5), [known.guess for known in system.unknowns.values()]
    states = torch.zeros(3, spec.state_dim, dtype=torch.float64)
    step = PhysicsDynamics(spec, system.physics(values)).mean_function()
    actions = system.column(system.action)[:10]
    assert step(states[None], actions[:3].view(1, 3, 1)).isfinite().all()
    output = system.column(system.output)[:10]
    data = records(output[:, None], actions, narx_spec(2, 3)).trajectories()
    assert_close(data.states[0], torch.stack([output[2], output[1], actions[1], actions[0]]))


@pytest.mark.parametrize("name", REAL)
def test_tests_are_of_other_records_in_which_the_machine_moves(name):
    known = REAL[name]
    assert (folder_of(known.folder) / "LICENSE").is_file()
    for test, given in known.tests.items():
        assert not {*given} & {*known.train}
        windows = known.windows(test, 40, 7)
        assert windows.measured.shape == (7, 40, known.machine.spec.state_dim)
        states, _, following = known.steps(test)
        rates = [i for i in range(states.shape[1]) if i not in known.machine.spec.angle_columns]
        assert (states[:, rates].abs().amax(1) >= known.moves).all()
        assert len(states) == len(following) > 100


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


@pytest.mark.parametrize("machine", [DOUBLE_PENDULUM, PENDULUM], ids=["double", "single"])
def test_friction_takes_what_the_drives_do_not_give(machine):
    """Without friction and torque, energy stays."""
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


def test_networks_learn_and_stop_early():
    known = REAL["pendulum"]
    states, actions, following = known.steps("sac")
    crude = known.machine.physics("crude")
    dynamics = NetworkDynamics(known.machine.spec, crude, number=3, steps=200)
    dynamics.update(*known.drawn(60, 0))
    mean, variance = dynamics.predict(states, actions)
    each = dynamics.sample_functions(3, seed=0)(states.expand(3, -1, -1), actions)
    assert_close(each.mean(0), mean)
    assert (variance >= dynamics.noise_variance(states, actions)).all()
    error = dynamics.score(states, actions, following).rmse[1]
    alone = PhysicsDynamics(known.machine.spec, crude).score(states, actions, following).rmse[1]
    still = (states[:, 1] - following[:, 1]).square().mean().sqrt()
    assert error < 0.8 * alone
    assert error < still / 2


def test_sensor_without_bend_is_torricelli():
    state = torch.tensor([[4.0, 9.0], [12.0, 4.0]]).double()
    values = {name: known.guess for name, known in UNKNOWNS.items()}
    found = rates(state, torch.full((2, 1), 3.0).double(), {**values, **FIXED["overflow"]})
    over = torch.tensor([0.0, 1.5 * 3.0]).double()
    outflow = 0.04 * state.sqrt()
    assert_close(found[:, 0], 0.12 - outflow[:, 0] - over)
    assert_close(found[:, 1], outflow[:, 0] + 0.5 * over - outflow[:, 1])


@pytest.mark.filterwarnings("ignore:.*WARN.*")
@pytest.mark.parametrize("name", KNOWN)
def test_true_physics_is_the_environment_and_the_crude_one_is_not(name):
    true, crude = (KNOWN[name].system(kind) for kind in ("true", "crude"))
    env, spec = true.make(), true.spec
    check_env(crude.make(), skip_render_check=True)
    assert pickle.loads(pickle.dumps(true)).spec == spec
    env.action_space.seed(0)
    observation, _ = env.reset(seed=1)
    rows = []
    for _ in range(12):
        action = env.action_space.sample()
        before = spec.decode(torch.as_tensor(observation).double())
        observation, reward, *_ = env.step(action)
        after = spec.decode(torch.as_tensor(observation).double())
        rows.append((before, torch.as_tensor(action).double(), after, torch.tensor(reward)))
    states, actions, following, rewards = (torch.stack(part) for part in zip(*rows, strict=True))

    def errors(system):
        predicted = following.clone()
        moving = system.physics(torch.cat([states[:, spec.moving], actions], -1))
        predicted[:, spec.moving] = moving
        return spec.change(following, predicted).abs().amax(0)[spec.moving]

    tolerance = {"pendulum": 0.02}.get(name, 1e-9)  # Gymnasium's Euler steps err
    assert errors(true).max() < tolerance
    assert errors(crude).max() > 5 * tolerance
    assert_close(true.reward(states, actions, following), rewards.double(), rtol=0, atol=2e-3)
    assert rewards.min() >= -1
