"""FMUs say what the models and dynamics predict."""

import shutil
import zipfile

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, FMUPhysics, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export import export_fmu
from gpadjust.export import fmu as module
from gpadjust.states import StateSpec
from tests.export.conftest import MODELS, fitted
from tests.export.test_dynamics import SPEC, learnt, pushed
from tests.export.test_equations import SPRING
from tests.export.test_equations import dynamics as identified
from tests.export.test_models import POINTS, arguments
from tests.systems import normal, refused, same, uniform

if shutil.which("cc") is None:
    pytest.skip("there is no C compiler", allow_module_level=True)
fmpy = pytest.importorskip("fmpy")

# The next angle, x, rate and speed of tests/export/test_dynamics.py.
PUSHED = """
const double rate = x[2] - 0.9 * sin(x[0]) + 0.1 * x[3], speed = x[3] + 0.1 * x[4];
f_p[0] = x[0] + 0.1 * rate;
f_p[1] = x[1] + 0.1 * speed;
f_p[2] = rate;
f_p[3] = speed;
"""


def names(path, causality):
    variables = fmpy.read_model_description(path).modelVariables
    return [variable.name for variable in variables if variable.causality == causality]


def without_step():
    dynamics = LearnedDynamics(StateSpec(["x"], ["u"]), model=ZeroMeanGP)
    states, actions = normal(8, 1), normal(8, 1, seed=1)
    dynamics.update(states, actions, states + actions)
    return dynamics


def with_equal_names():
    data = pd.DataFrame(uniform(6, 2).numpy(), columns=["T [K]", "p [bar]"])
    return CKA(data[["T [K]"]], data[["T [K]"]], physics=lambda X: X)


def simulated(path, rows, step, outputs, **start):
    """Outputs of a valid FMU at the steps, whose inputs are these rows."""
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(path)) == []
    kinds = [("time", float), *((each, float) for each in names(path, "input"))]
    signal = np.array([(step * k, *row) for k, row in enumerate(rows.tolist())], dtype=kinds)
    duration = {"stop_time": step * (len(rows) - 1), "output_interval": step}
    options = {"output": outputs, "start_values": start, **duration}
    found = fmpy.simulate_fmu(str(path), input=signal, **options)[outputs]
    return torch.tensor(found.tolist(), dtype=torch.float64)


@pytest.mark.parametrize("name", ["CKA", "CKA, nested", "CKA, two physics", "RRA", "ZeroMeanGP"])
def test_a_model_is_simulated_beside_torch(name, tmp_path):
    model = fitted(name)
    path = export_fmu(model, tmp_path / "model.fmu", observation_noise=True)
    given = torch.cat(arguments(model, POINTS), dim=-1)
    mean, variance = model.predict(POINTS, observation_noise=True)
    outputs = names(path, "output")
    assert len(names(path, "input")) + len(outputs) == given.shape[1] + 2 * mean.shape[1]
    # At each point in time the outputs are those before the next inputs.
    expected = torch.cat([mean, variance.sqrt()], dim=-1)[:-1]
    same([simulated(path, given, 1.0, outputs)[1:]], [expected], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("make", [learnt, lambda: identified("curves")])
def test_dynamics_are_simulated_beside_torch(make, tmp_path):
    """The physics is in C, given or of formulas."""
    dynamics, forces = make(), normal(6, 1)
    is_learnt = make is learnt
    path = export_fmu(dynamics, tmp_path / "cart.fmu", physics=PUSHED if is_learnt else None)
    states = dynamics.spec.states
    state = uniform(len(states), low=-1.0, high=1.0)
    start = dict(zip(states, state.tolist(), strict=True))
    outputs = [*states, *(f"{each}_sd" for each in states if is_learnt)]
    found = simulated(path, forces, 0.1, outputs, **start)
    noise = {"observation_noise": False} if is_learnt else {}
    for row, force in zip(found[1:], forces[:-1], strict=True):
        state, variance = (part[0] for part in dynamics.predict(state[None], force[None], **noise))
        expected = torch.cat([state, variance.sqrt()])[: len(outputs)]
        torch.testing.assert_close(row, expected, rtol=1e-10, atol=1e-10)


def test_dynamics_come_back_as_physics(tmp_path):
    dynamics = learnt()
    path = export_fmu(dynamics, tmp_path / "cart.fmu", variance=False)
    f_p = ["f_p_angle", "f_p_x", "f_p_rate", "f_p_speed"]
    assert names(path, "input") == ["force", *f_p]
    physics = FMUPhysics(path, [*SPEC.states, "force", *f_p], SPEC.states, times=0.1)
    states, actions = 2 * uniform(5, 6, low=-2.0, high=2.0, seed=3), uniform(5, 1, seed=4)
    values = pushed(SPEC.physics_inputs(states, actions))
    expected = dynamics.predict(states, actions).mean
    given = torch.cat([states, actions, values], -1)
    same([physics(given)], [expected], rtol=1e-9, atol=1e-11)


def test_two_fmus_of_one_name_are_in_one_process(tmp_path):
    both = []
    for name in ("CKA", "RRA"):
        (tmp_path / name).mkdir()
        path = export_fmu(fitted(name), tmp_path / name / "model.fmu")
        both.append(FMUPhysics(path, names(path, "input"), ["y1", "y2"], times=0.0))
    for name, physics in (("CKA", both[0]), ("RRA", both[1]), ("CKA", both[0])):
        physics.forget()
        given = torch.cat(arguments(fitted(name), POINTS), -1)
        same([physics(given)], [fitted(name).predict(POINTS).mean], rtol=1e-10, atol=1e-10)


def test_a_state_is_kept_and_comes_back(tmp_path):
    path = export_fmu(learnt(), tmp_path / "cart.fmu", physics=PUSHED)
    description = fmpy.read_model_description(path)
    fmu = fmpy.instantiate_fmu(fmpy.extract(path), description, "CoSimulation")
    places = [v.valueReference for v in description.modelVariables if v.name in SPEC.states]
    fmu.setupExperiment()
    fmu.enterInitializationMode()
    fmu.setReal(places, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    fmu.exitInitializationMode()
    kept = fmu.getFMUState()
    ends = []
    for _ in range(2):
        fmu.doStep(0.0, 0.1)
        ends.append(fmu.getReal(places))
        fmu.setFMUState(kept)
    assert ends[0] == ends[1]
    assert fmu.getReal(places) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    with pytest.raises(Exception, match="fmi2DoStep failed with status 3"):
        fmu.doStep(0.0, 0.2)
    with pytest.raises(Exception, match="fmi2SetReal failed with status 3"):
        fmu.setReal([places[-1] + 1], [1.0])
    fmu.freeInstance()


def test_names_and_units_are_those_of_the_data(tmp_path):
    data = pd.DataFrame(uniform(6, 2).numpy(), columns=["flow [l/s]", "speed"])
    head = pd.DataFrame({"head [m]": data["speed"] ** 2})
    model = CKA(data, head, physics=lambda X: X[:, 1:] ** 2)
    path = export_fmu(model, tmp_path / "pump.fmu", physics="f_p[0] = x[1] * x[1];")
    units = {v.name: v.unit for v in fmpy.read_model_description(path).modelVariables}
    assert units == {"flow": "l/s", "speed": None, "f_p_head": "m", "head": "m", "head_sd": "m"}
    physics = FMUPhysics(path, ["flow", "speed"], ["head", "head_sd"], times=0.0)
    X = uniform(3, 2, seed=5)
    expected = model.predict(X)
    torch.testing.assert_close(physics(X)[:, :1], expected.mean, rtol=1e-10, atol=1e-10)


def test_the_same_model_makes_the_same_file(tmp_path):
    path = tmp_path / "pump.fmu"
    once, again = (export_fmu(MODELS["CKA"](), path).read_bytes() for _ in range(2))
    assert once == again
    with zipfile.ZipFile(path) as file:
        assert {"modelDescription.xml", "sources/pump.c"} < {*file.namelist()}


NO_CODE = {"physics": "f_p[0] = head(x);"}
REFUSED = [
    (lambda: fitted("CKA"), {}, "a b.fmu", ValueError, "one of C"),
    (without_step, {}, "x.fmu", ValueError, r"StateSpec\(..., step=0.1\)"),
    (lambda: fitted("ZeroMeanGP"), {"physics": ""}, "x.fmu", ValueError, "leave physics= out"),
    (with_equal_names, {}, "x.fmu", ValueError, "two 'T'"),
    (lambda: fitted("CKA"), NO_CODE, "x.fmu", ValueError, "(?s)cannot compile the program: .*head"),
    (lambda: SPRING, {}, "x.fmu", TypeError, "no names of outputs.*PhysicsDynamics"),
    (lambda: None, {}, "x.fmu", TypeError, "or what identify returns; found"),
]


@pytest.mark.parametrize(("make", "options", "file", "error", "words"), REFUSED)
def test_what_is_refused(make, options, file, error, words, tmp_path):
    refused(error, words, export_fmu, make(), tmp_path / file, **options)


def test_without_a_compiler_there_is_a_way_out(tmp_path, monkeypatch):
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    with pytest.raises(OSError, match=r"no C compiler was found.*or take c_source"):
        export_fmu(fitted("CKA"), tmp_path / "pump.fmu")
