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
from tests.export.conftest import fitted
from tests.export.test_dynamics import SPEC, learnt, pushed
from tests.export.test_equations import SPRING
from tests.export.test_equations import dynamics as identified
from tests.export.test_models import POINTS, arguments
from tests.systems import normal, uniform

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


@pytest.mark.parametrize("name", ["CKA", "CKA, nested", "CKA, two physics", "RRA", "ZeroMeanGP"])
def test_a_model_is_simulated_beside_torch(name, tmp_path):
    from fmpy.validation import validate_fmu

    model = fitted(name)
    path = export_fmu(model, tmp_path / "model.fmu", observation_noise=True)
    assert validate_fmu(str(path)) == []
    given = torch.cat(arguments(model, POINTS), dim=-1)
    mean, variance = model.predict(POINTS, observation_noise=True)
    columns = [*names(path, "input"), *names(path, "output")]
    assert len(columns) == given.shape[1] + 2 * mean.shape[1]
    signal = np.array(
        [(t, *row) for t, row in enumerate(given.tolist())],
        dtype=[("time", float), *((each, float) for each in names(path, "input"))],
    )
    found = fmpy.simulate_fmu(
        str(path), input=signal, stop_time=len(given) - 1, output_interval=1.0, output=columns
    )
    found = np.stack([found[each] for each in names(path, "output")], axis=-1)
    # At each point in time the outputs are those before the next inputs.
    expected = torch.cat([mean, variance.sqrt()], dim=-1)[:-1].numpy()
    np.testing.assert_allclose(found[1:], expected, rtol=1e-10, atol=1e-10)


def test_dynamics_are_simulated_beside_torch_with_the_physics_in_c(tmp_path):
    from fmpy.validation import validate_fmu

    dynamics = learnt()
    path = export_fmu(dynamics, tmp_path / "cart.fmu", physics=PUSHED)
    assert validate_fmu(str(path)) == []
    state, forces = uniform(6, low=-1.0, high=1.0), normal(5, 1)
    signal = np.array(
        [(0.1 * k, u) for k, (u,) in enumerate(forces.tolist())],
        dtype=[("time", float), ("force", float)],
    )
    outputs = [*SPEC.states, *(f"{each}_sd" for each in SPEC.states)]
    found = fmpy.simulate_fmu(
        str(path),
        start_values=dict(zip(SPEC.states, state.tolist(), strict=True)),
        input=signal,
        stop_time=0.5,
        output=outputs,
    )
    for k, force in enumerate(forces):
        state, variance = dynamics.predict(state, force, observation_noise=False)
        row = torch.tensor([*found[k + 1]])[1:]
        torch.testing.assert_close(row, torch.cat([state, variance.sqrt()]), rtol=1e-10, atol=1e-10)


def test_dynamics_come_back_as_physics(tmp_path):
    dynamics = learnt()
    path = export_fmu(dynamics, tmp_path / "cart.fmu", variance=False)
    f_p = ["f_p_angle", "f_p_x", "f_p_rate", "f_p_speed"]
    assert names(path, "input") == ["force", *f_p]
    physics = FMUPhysics(path, [*SPEC.states, "force", *f_p], SPEC.states, times=0.1)
    states, actions = 2 * uniform(5, 6, low=-2.0, high=2.0, seed=3), uniform(5, 1, seed=4)
    values = pushed(SPEC.physics_inputs(states, actions))
    expected = dynamics.predict(states, actions).mean
    torch.testing.assert_close(
        physics(torch.cat([states, actions, values], -1)), expected, rtol=1e-9, atol=1e-11
    )


def test_two_fmus_of_one_name_are_in_one_process(tmp_path):
    both = []
    for name in ("CKA", "RRA"):
        model = fitted(name)
        (tmp_path / name).mkdir()
        path = export_fmu(model, tmp_path / name / "model.fmu")
        physics = FMUPhysics(path, names(path, "input"), ["y1", "y2"], times=0.0)
        both.append((physics, torch.cat(arguments(model, POINTS), -1), model.predict(POINTS).mean))
    for i in (0, 1, 0):
        physics, given, expected = both[i]
        physics.forget()
        torch.testing.assert_close(physics(given), expected, rtol=1e-10, atol=1e-10)


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
    made = [export_fmu(fitted("CKA"), tmp_path / "pump.fmu").read_bytes() for _ in range(2)]
    assert made[0] == made[1]
    with zipfile.ZipFile(tmp_path / "pump.fmu") as file:
        assert {"modelDescription.xml", "sources/pump.c"} < {*file.namelist()}


REFUSED = [
    (lambda: fitted("CKA"), {}, "a b.fmu", ValueError, "one of C"),
    (without_step, {}, "x.fmu", ValueError, r"StateSpec\(..., step=0.1\)"),
    (lambda: fitted("ZeroMeanGP"), {"physics": ""}, "x.fmu", ValueError, "leave physics= out"),
    (with_equal_names, {}, "x.fmu", ValueError, "two 'T'"),
    (
        lambda: fitted("CKA"),
        {"physics": "f_p[0] = head(x);"},
        "x.fmu",
        ValueError,
        "cannot compile the program: .*head",
    ),
    (lambda: SPRING, {}, "x.fmu", TypeError, "no names of outputs.*PhysicsDynamics"),
    (lambda: None, {}, "x.fmu", TypeError, "or what identify returns; found"),
]


@pytest.mark.parametrize(("make", "options", "file", "error", "words"), REFUSED)
def test_what_is_refused(make, options, file, error, words, tmp_path):
    with pytest.raises(error, match=f"(?s){words}"):
        export_fmu(make(), tmp_path / file, **options)


def test_without_a_compiler_there_is_a_way_out(tmp_path, monkeypatch):
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    with pytest.raises(OSError, match=r"no C compiler was found.*or take c_source"):
        export_fmu(fitted("CKA"), tmp_path / "pump.fmu")


def test_identified_dynamics_are_simulated_beside_torch(tmp_path):
    from fmpy.validation import validate_fmu

    own = identified("curves")
    path = export_fmu(own, tmp_path / "arm.fmu")
    assert validate_fmu(str(path)) == []
    state, pushes = uniform(4, low=-1.0, high=1.0), normal(5, 1)
    signal = np.array(
        [(0.1 * k, u) for k, (u,) in enumerate(pushes.tolist())],
        dtype=[("time", float), ("u", float)],
    )
    found = fmpy.simulate_fmu(
        str(path),
        start_values=dict(zip(own.spec.states, state.tolist(), strict=True)),
        input=signal,
        stop_time=0.4,
        output_interval=0.1,
        output=[*own.spec.states],
    )
    for k in range(4):
        state = own.predict(state[None], pushes[k][None]).mean[0]
        row = [found[each][k + 1] for each in own.spec.states]
        np.testing.assert_allclose(row, state.numpy(), rtol=1e-10, atol=1e-10)
