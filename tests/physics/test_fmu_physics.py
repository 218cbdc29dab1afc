"""FMUs as physics: a heated tank with a wall, whose rates are linear, and a ball that bounces."""

import copy
import pickle
import shutil
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor

import joblib
import pytest
import torch
from scipy.integrate import solve_ivp

from gpadjust import CalibratedPhysics, FMUPhysics, PhysicsError, Unknown, load, save
from gpadjust.records import Record, Records, identify
from gpadjust.states import StateSpec
from tests.fmus import fmu
from tests.systems import normal, refused, same

STATES = ["tank.T", "wall[1].T"]
STEP = {"inputs": [*STATES, "heater"], "outputs": STATES, "times": 6.0}
G = {"wall[1].G": Unknown(50.0, factor=2.0)}
KINDS = [(fmi, kind) for fmi in (2, 3) for kind in ("CoSimulation", "ModelExchange")]
X = torch.tensor([[300.0, 310, 500], [320, 310, 0], [340, 330, 900]], dtype=torch.float64)
of_all_kinds = pytest.mark.parametrize(("fmi", "kind"), KINDS)


def close(found, expected, rtol=1e-7):
    same([found], [torch.as_tensor(expected).double()], rtol=rtol, atol=0)


def step(path=None, **options):
    """A step of the tank."""
    return FMUPhysics(path or fmu(), **{**STEP, **options})


def tank(state, heater, t, g=50.0, c=4000.0):
    """Temperatures of tank and wall at the times, by scipy."""

    def rates(_, s):
        flow = g * (s[0] - s[1])
        return (heater - flow) / c, (flow - 10 * (s[1] - 300)) / 1000

    return torch.tensor(
        solve_ivp(rates, (0, max(t)), state, "DOP853", t, rtol=1e-11, atol=1e-11).y.T
    )


def ball(h, t, e=0.7, g=9.81):
    """Height and speed at a time, from impact to impact."""
    v = 0.0
    while (fall := (v + (v * v + 2 * g * h) ** 0.5) / g) < t:
        t, h, v = t - fall, 0.0, -e * (v - g * fall)
    return h + v * t - g * t * t / 2, v - g * t


@of_all_kinds
def test_a_step_is_that_of_the_equation_and_each_row_has_its_parameters(fmi, kind):
    path, options = fmu("tank", fmi), {"kind": kind, "unknowns": G}
    found = step(path, **options)(X, torch.tensor([[50.0], [80.0]]).double())
    expected = [[tank(row[:2], row[2], [6.0], g)[0] for row in X.tolist()] for g in (50.0, 80.0)]
    close(found, torch.stack([torch.stack(rows) for rows in expected]))
    assert (found[0] - found[1]).abs().min() > 1e-3
    fresh = step(path, **options)
    single = torch.cat([fresh(X[[i]]) for i in (2, 0, 1)])
    assert torch.equal(single, found[0, [2, 0, 1]])  # an instance that is reset is a new one


@of_all_kinds
def test_events_of_state(fmi, kind):
    options = {"times": [0.3, 1.2], "kind": kind, "start_values": {"v": 0.0}}
    physics = FMUPhysics(fmu("ball", fmi), ["h", "e"], ["h", "v"], **options)
    rows = torch.tensor([[1.0, 0.7], [2.0, 0.5]]).double()
    expected = [[*ball(h, 0.3, e), *ball(h, 1.2, e)] for h, e in rows.tolist()]
    # Its own solver of co-simulation notices an impact up to 1 ms late.
    tolerance = {"atol": 0.1 if kind == "CoSimulation" else 1e-5, "rtol": 0}
    torch.testing.assert_close(physics(rows), torch.tensor(expected).double(), **tolerance)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_rows_that_differ_in_time_share_a_simulation(kind):
    options = {"kind": kind, "start_values": {"tank.T": 310.0}}
    physics = FMUPhysics(fmu(), ["heater", "time"], STATES, unknowns=G, **options)
    times = [6.0, 0.0, 2.0, 4.0]
    rows = torch.tensor([[h, t] for h in (0.0, 500.0) for t in times]).double()
    paths = [tank([310.0, 300.0], h, sorted(times))[[3, 0, 1, 2]] for h in (0.0, 500.0)]
    close(physics(rows), torch.cat(paths), 1e-6)
    fixed = FMUPhysics(fmu(), ["heater"], STATES, times=times, **options)
    close(fixed(rows[:1, :1]), paths[0].reshape(1, -1), 1e-6)


@of_all_kinds
def test_a_signal_holds_until_its_next_value(fmi, kind):
    signals = {"time": [0.0, 2.0, 3.5], "heater": [500.0, 0.0, 900.0]}
    physics = FMUPhysics(fmu("tank", fmi), ["tank.T", "time"], STATES, kind=kind, signals=signals)
    state, expected = [305.0, 300.0], []
    for heater, duration in ((500.0, 2.0), (0.0, 1.5), (900.0, 1.5)):
        state = tank(state, heater, [duration])[0].tolist()
        expected.append(state)
    close(physics(torch.tensor([[305.0, 2.0], [305.0, 3.5], [305.0, 5.0]]).double()), expected)


def test_gradients_are_those_of_the_equation():
    rows = X[:1].clone().requires_grad_()
    (slope,) = torch.autograd.grad(step(kind="ModelExchange")(rows)[0, 0], rows)
    moved = [tank([300.0 + h, 310.0], 500.0, [6.0])[0, 0] for h in (1.0, -1.0)]
    assert slope[0, 0].item() == pytest.approx((moved[0] - moved[1]).item() / 2, rel=1e-4)


@of_all_kinds
def test_rows_that_fail_are_named_with_the_words_of_the_fmu(fmi, kind):
    options = {"inputs": [*STEP["inputs"], "tank.C"], "kind": kind}
    physics = step(fmu("tank", fmi), **options)
    rows = torch.cat([X, torch.tensor([[4000.0], [0.0], [2000.0]])], dim=-1)
    with pytest.raises(PhysicsError, match=r"SetReal|SetFloat64") as caught:
        physics(rows)
    assert caught.value.rows == (1,)
    assert "tank.C is not above 0" in str(caught.value)
    assert physics.or_nan(rows).isnan().any(-1).tolist() == [False, True, False]
    assert torch.equal(step(fmu("tank", fmi), **options)(rows[2:]), physics(rows[2:]))
    rows[0, 2] = torch.nan  # which is refused before a simulation
    words = r"finite numbers for 'heater', found \[nan\].*2 failed row"
    refused(PhysicsError, f"(?s){words}", physics, rows)


@of_all_kinds
def test_a_simulation_that_breaks_off_fails_in_all_its_rows(fmi, kind):
    options = {"communication_step": 1.0, "kind": kind}
    physics = FMUPhysics(fmu("tank", fmi), ["heater", "time"], ["tank.T"], **options)
    rows = torch.tensor([[40000.0, 9.0], [0.0, 9.0], [40000.0, 5.0]]).double()
    with pytest.raises(PhysicsError, match="the tank boils") as caught:
        physics(rows)
    assert caught.value.rows == (0, 2)
    assert physics.or_nan(rows).isnan().flatten().tolist() == [True, False, True]
    assert physics(rows[2:]).isfinite().all()


@pytest.mark.parametrize("only_one", [False, True])
def test_threads_and_processes_have_instances_of_their_own(only_one):
    def made():
        return step(fmu("tank", 3, only_one=only_one))

    rows = X.repeat(4, 1) + torch.arange(12)[:, None]
    expected = made()(rows)
    with ThreadPoolExecutor(4) as pool:
        found = [*pool.map(lambda _: made()(rows), range(4))]
    with joblib.parallel_config(backend="threading", n_jobs=3):
        found.append(made()(rows))
    boiling = torch.tensor([[373.0, 373.0, 90000.0]]).double()
    refused(PhysicsError, "the tank boils", made(), boiling)  # and the next row has an instance
    again = pickle.loads(pickle.dumps(made()))
    assert all(torch.equal(Y, expected) for Y in [*found, again(rows)])
    assert copy.deepcopy(again) is again


def test_a_value_that_the_fmu_overrules_is_noticed_or_set_again():
    """By model exchange alone states can be set, also such that are computed."""
    computed, start = fmu("tank", 2, of="wall[1].T", initial="calculated"), {"wall_start": 350.0}
    words = r"'wall\[1\].T' is {} after its start value was set to 310.*take model exchange"
    refused(PhysicsError, words.format(300), step(computed), X[:1])
    refused(PhysicsError, words.format(350), step(start_values=start), X[:1])
    expected = step(kind="ModelExchange")(X)
    assert torch.equal(step(computed, kind="ModelExchange")(X), expected)
    assert torch.equal(step(start_values=start, kind="ModelExchange")(X), expected)


def test_a_model_has_the_unit_of_a_parameter_and_is_saved(tmp_path):
    physics = step(unknowns=G)
    model = CalibratedPhysics(X, X[:, :2], physics=physics)
    assert "W/K" in repr(model.physics_parameters)
    with pytest.warns(UserWarning, match="Other programs cannot import the physics"):
        save(model, tmp_path / "tank.pt")
    again = load(tmp_path / "tank.pt", physics=step(unknowns=G))
    same([again.predict(X).mean], [model.predict(X).mean])


@pytest.mark.slow
def test_a_log_identifies_the_parameter_of_an_fmu():
    """The temperature of the wall is not measured."""
    heater = 400 * (torch.arange(41) % 10 < 5).double()
    states = torch.full((41, 2), 300.0).double()
    for k, power in enumerate(heater[:-1].tolist()):
        states[k + 1] = tank(states[k].tolist(), power, [6.0], g=70.0)[0]
    states[:, 0] += 0.02 * normal(41)
    states[:, 1] = torch.nan
    log = Records(
        Record(6.0 * torch.arange(41).double(), states, heater[:, None]),
        StateSpec(["tank", "wall"], ["heater"]),
    )
    physics = FMUPhysics(fmu(), **STEP, kind="ModelExchange", unknowns=G)
    found = identify(log, physics, start={"wall": (300.0, 1.0)}, num_starts=1)
    low, high = found.parameters.interval()
    assert low.item() < 70 < high.item() < low.item() + 40


def of_another_platform(tmp_path):
    """An FMU that is not there for this platform."""
    path = tmp_path / "other.fmu"
    with zipfile.ZipFile(fmu()) as old, zipfile.ZipFile(path, "w") as new:
        new.writestr("modelDescription.xml", old.read("modelDescription.xml"))
        new.writestr("binaries/win64/tank.dll", b"")
    return path


STATE = {"inputs": ["tank.T"], "outputs": ["tank.T"], "times": 1.0}
OF_T = Unknown(1.0, sd=1.0, function_of="T", between=(0.0, 1.0))
LOSS = {"inputs": ["loss"], "unknowns": {"loss": Unknown(10.0, sd=1.0)}}
REFUSED = [
    ({"inputs": ["tank.TT"]}, ValueError, "no variable 'tank.TT'; expected one such as tank.T"),
    ({"inputs": "tank.T"}, TypeError, "lists of names of variables; found 'tank.T'"),
    (LOSS, ValueError, "'loss' is given twice"),
    ({"unknowns": {"C": OF_T}}, ValueError, "'C' is a function. A parameter here is a number"),
    ({"times": None}, ValueError, "times at which outputs are read"),
    ({"times": -1.0}, ValueError, "times must be finite and at least 0"),
    ({"inputs": ["time"]}, ValueError, "and not both"),
    ({}, ValueError, r"wall\[1\].T of tank.fmu would begin each step at its start value"),
    ({"kind": "ScheduledExecution"}, ValueError, "Unknown kind"),
    ({"signals": {"time": [0.0, 1.0]}}, ValueError, "signals as columns of one length"),
    ({"signals": {"time": [0.0], "loss": [1.0]}}, ValueError, "signals of inputs of"),
    ({"tolerance": 0.0}, ValueError, "tolerance must be"),
    ({"communication_step": -1.0}, ValueError, "communication_step must be"),
]


@pytest.mark.parametrize(("options", "error", "words"), REFUSED)
def test_what_is_refused(options, error, words):
    refused(error, words, FMUPhysics, fmu(), **{**STATE, **options})


def test_files_that_are_refused(tmp_path, monkeypatch):
    shutil.copy(fmu(), tmp_path / "copy.fmu")
    refused(FileNotFoundError, "tank2", FMUPhysics, "tank2.fmu", **STATE)
    (tmp_path / "text.fmu").write_text("no zip")
    refused(ValueError, "as an FMU; it cannot be read", FMUPhysics, tmp_path / "text.fmu", **STATE)
    refused(ValueError, "found win64.*compile", FMUPhysics, of_another_platform(tmp_path), **STATE)
    monkeypatch.setitem(sys.modules, "fmpy", None)
    refused(ImportError, r"gpadjust\[fmu\]", FMUPhysics, tmp_path / "copy.fmu", **STATE)


def test_steps_of_one_length_and_columns():
    path = fmu("tank", 2, any_step=False)
    physics = FMUPhysics(path, ["heater", "time"], STATES, communication_step=2.0)
    even, odd, before = (torch.tensor([[0.0, t]]).double() for t in (6.0, 5.0, -1.0))
    assert physics(even).isfinite().all()
    refused(PhysicsError, "no step ends at t = 5.*steps of one length", physics, odd)
    refused(PhysicsError, "times of 0 or later, found -1", physics, before)
    refused(PhysicsError, r"a column of X for each of the inputs.*columns=; found 3", physics, X)
    refused(ValueError, "in the order of the data", physics.check_names, ["time", "heater"])
    chosen = FMUPhysics(path, ["heater"], STATES, times=6.0, columns=[2])
    assert torch.equal(chosen(X[1:2]), physics(even))
