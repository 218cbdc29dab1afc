"""A MuJoCo model as physics, held against equations and against MJCFs compiled again."""

import copy
import pickle
import signal
import threading
import time
from _thread import interrupt_main

import numpy as np
import pytest
import torch

from gpadjust import ODEPhysics, PhysicsError, Unknown
from gpadjust.physics import MujocoPhysics
from gpadjust.records import Record, Records, identify
from tests.systems import normal, refused, same

mujoco = pytest.importorskip("mujoco", "3.5", reason="the extra `mujoco` is not installed")

M, RADIUS, LENGTH, G = 0.7, 0.05, 0.4, 9.81  # a ball on a massless rod
INERTIA = M * (LENGTH**2 + 0.4 * RADIUS**2)


def pendulum(mass=M, length=LENGTH, damping=0.0, dry=0.0, option='integrator="RK4"'):
    return f"""<mujoco><option timestep="0.002" {option}/><worldbody><body name="rod">
    <joint name="hinge" axis="0 1 0" damping="{damping}" frictionloss="{dry}"/>
    <geom name="ball" type="sphere" size="{RADIUS}" pos="0 0 {-length}" mass="{mass}"/>
    </body></worldbody><actuator><motor name="torque" joint="hinge"/></actuator></mujoco>"""


def arm(damping=0.05, size="0.2 0.1 0.05", mass=1.3, pos="0.2 0 0", gear=2.0, kp=3.0, tip=0.3):
    """Two links, a motor and a position servo with a lag, dry friction, a tendon, sensors."""
    return f"""<mujoco model="arm"><option timestep="0.002"/><worldbody>
    <body name="link1">
      <joint name="shoulder" axis="0 1 0" damping="{damping}" frictionloss="0.02"/>
      <geom type="box" size="{size}" pos="{pos}" mass="{mass}"/>
      <body name="link2" pos="0.4 0 0">
        <joint name="elbow" axis="0 0 1" range="-90 90" armature="0.001"/>
        <geom type="capsule" fromto="0 0 0 {tip} 0 0" size="0.02" mass="0.5"/>
        <site name="tip" pos="0.3 0 0"/>
    </body></body></worldbody>
    <tendon><fixed name="belt" stiffness="0.5"><joint joint="shoulder" coef="1"/>
      <joint joint="elbow" coef="-1"/></fixed></tendon>
    <actuator><motor name="motor" joint="shoulder" gear="{gear}"/>
      <position name="servo" joint="elbow" kp="{kp}" kv="0.2" timeconst="0.05"/></actuator>
    <sensor><jointpos name="encoder" joint="shoulder" noise="0.01"/>
      <framepos name="camera" objtype="site" objname="tip"/>
      <accelerometer name="imu" site="tip"/></sensor></mujoco>"""


def unknown(name, value):
    """A prior with this guess."""
    return Unknown(value, sd=1.0) if value <= 0 or "com" in name else Unknown(value, factor=2.0)


def test_a_pendulum_moves_as_its_equation():
    def rates(state, action):
        angle, rate = state.unbind(-1)
        torque = action[:, 0] - 0.1 * rate - M * G * LENGTH * angle.sin()
        return torch.stack([rate, torque / INERTIA], dim=-1)

    ours = MujocoPhysics(pendulum(damping=0.1), step=0.02)
    X = normal(9, 3)
    X.requires_grad_(True)
    exact = ODEPhysics(rates, 0.02, 2)
    same([ours(X)], [exact(X)], rtol=0, atol=1e-7)
    weights = normal(9, 2, seed=1)
    found = [torch.autograd.grad((weights * f(X)).sum(), X)[0] for f in (ours, exact)]
    same(found[:1], found[1:], rtol=0, atol=1e-6)


def sliding(spec, p):
    """Writes what no name of a parameter does."""
    spec.option.gravity = [0.0, 0.0, -p["planet.g"]]
    spec.geoms[1].fromto = [0.0, 0.0, 0.0, p["link2.length"], 0.0, 0.0]


CHANGES = {  # parameters, and the MJCF with these numbers
    "mass": ({"link1.mass": 2.1}, arm(mass=2.1)),
    "damping": ({"shoulder.damping": 0.3}, arm(damping=0.3)),
    "friction": (
        {"shoulder.frictionloss": 0.2, "elbow.armature": 0.01},
        arm().replace('frictionloss="0.02"', 'frictionloss="0.2"').replace("0.001", "0.01"),
    ),
    "drives": ({"motor.gear": -1.5, "servo.kp": 7.0}, arm(gear=-1.5, kp=7.0)),
    "servo": ({"servo.kv": 0.5}, arm().replace('kv="0.2"', 'kv="0.5"')),
    "tendon": ({"belt.stiffness": 2.0}, arm().replace('stiffness="0.5"', 'stiffness="2"')),
    "spring": (
        {"elbow.stiffness": 2.0},
        arm().replace('armature="0.001"', 'armature="0.001" stiffness="2"'),
    ),
    "shape": (
        {"link1.stretch_x": 1.2, "link1.stretch_z": 0.5, "link1.com_y": 0.04, "link1.mass": 2.1},
        arm(size="0.24 0.1 0.025", pos="0.2 0.04 0", mass=2.1),
    ),
    "edit": (
        {"planet.g": 1.62, "link2.length": 0.2, "shoulder.damping": 0.3},
        arm(tip=0.2, damping=0.3).replace("<option", '<option gravity="0 0 -1.62"'),
    ),
}


@pytest.mark.parametrize("case", CHANGES)
def test_parameters_are_those_of_an_mjcf_that_is_compiled_again(case):
    values, xml = CHANGES[case]
    unknowns = {name: unknown(name, value) for name, value in values.items()}
    edit = sliding if case == "edit" else None
    ours = MujocoPhysics(arm(), step=0.01, unknowns=unknowns, edit=edit)
    X = normal(5, 7)
    again = MujocoPhysics(xml, step=0.01)(X)
    same([ours(X)], [again], rtol=0, atol=1e-9)
    assert (again - MujocoPhysics(arm(), step=0.01)(X)).abs().max() > 1e-5
    other = ours(X, 1.1 * ours.unknowns.guess)
    assert (other - again).abs().max() > 1e-6
    both = ours(X[:1], torch.stack([ours.unknowns.guess, 1.1 * ours.unknowns.guess]))
    same([both[:, 0]], [torch.stack([again[0], other[0]])])


def test_sheared_mass_is_that_of_moved_points():
    points = np.random.default_rng(0).normal(scale=0.2, size=(6, 3))
    A = np.array([[1.3, 0.4, -0.2], [0.0, 0.8, 0.3], [0.0, 0.0, 1.1]])
    weights = 0.1 + 0.1 * np.arange(6)

    def cloud(places, fixed=""):
        balls = "".join(
            f'<geom type="sphere" size="1e-4" mass="{mass}" pos="{x} {y} {z}"/>'
            for mass, (x, y, z) in zip(weights, places.tolist(), strict=True)
        )
        joints = "".join(f'<joint name="j{a}" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1"))
        body = f'<body name="b">{joints}{balls}</body>'
        return f"<mujoco>{fixed}<worldbody>{body}</worldbody></mujoco>"

    center = weights @ points / weights.sum()
    moved = center + (points - center) @ A.T
    names = ("stretch_x", "shear_xy", "shear_xz", "stretch_y", "shear_yz", "stretch_z")
    numbers = zip(names, A[np.triu_indices(3)].tolist(), strict=True)
    unknowns = {f"b.{name}": unknown(name, value) for name, value in numbers}
    ours = MujocoPhysics(cloud(points, '<compiler inertiafromgeom="true"/>'), unknowns=unknowns)
    X = normal(5, 6)
    same([ours(X)], [MujocoPhysics(cloud(moved))(X)], rtol=0, atol=1e-6)
    # Any numbers are of a body: MuJoCo's compiler refuses others.
    wild = 3 * normal(200, 6).abs()
    wild[:, [1, 2, 4]] *= normal(200, 3, seed=1).sign()
    assert ours(X[:1], wild).isfinite().all()


def test_a_row_is_a_loop_of_mujocos_steps_alone_or_beside_others_in_threads():
    one, two = (MujocoPhysics(arm(), step=0.02, threads=n) for n in (1, 2))
    X = normal(400, 7)
    order = torch.randperm(400)
    Y = one(X)
    assert torch.equal(two(X[order]), Y[order])
    assert len(two._data) == 2
    for row, y in zip(X[:20].numpy(), Y, strict=False):
        data = mujoco.MjData(one.model)
        data.qpos, data.qvel, data.act, data.ctrl = np.split(row, [2, 4, 5])
        mujoco.mj_step(one.model, data, 10)
        assert y.tolist() == [*data.qpos, *data.qvel, *data.act]


def test_names_of_states_actions_and_sensors():
    ours = MujocoPhysics(arm(), step=0.01)
    spec = ours.spec
    assert spec.states == ("shoulder", "elbow", "shoulder_dot", "elbow_dot", "servo_act")
    assert (spec.actions, spec.angles, spec.step) == (("motor", "servo"), ("shoulder",), 0.01)
    sensors, states = ours.sensors(), normal(4, 5)
    assert sensors.outputs == ("encoder", "camera_0", "camera_1", "camera_2")
    assert sensors.noise == {"encoder": 0.01}
    seen = sensors.measure(spec, states)
    assert torch.equal(seen[:, 0], states[:, 0])  # now, not a step late
    a, b = states[:, 0], states[:, 1]
    # Along the links, which turn about y and, within the first, about z.
    x = 0.4 + 0.3 * b.cos()
    tip = torch.stack([x * a.cos(), 0.3 * b.sin(), -x * a.sin()], -1)
    same([seen[:, 1:]], [tip])
    assert ours.sensors(["camera"]).measure(spec, states).shape == (4, 3)
    slide = pendulum().replace("<joint", '<joint type="slide"')
    assert MujocoPhysics(slide).spec.angles == ()
    few = MujocoPhysics(arm(), actions=["servo"])
    assert few.spec.actions == ("servo",)
    X = normal(3, 7)
    X[:, 5] = 0.0
    assert torch.equal(few(X[:, [0, 1, 2, 3, 4, 6]]), MujocoPhysics(arm())(X))


def test_pickles_and_copies(tmp_path):
    text, X = arm(), normal(6, 7)
    (tmp_path / "arm.xml").write_text(text)
    unknowns = {"link1.mass": Unknown(1.3, factor=2.0)}
    Y = MujocoPhysics(text, step=0.01)(X)
    spec = mujoco.MjSpec.from_string(text)
    paths = [tmp_path / "arm.xml", str(tmp_path / "arm.xml")]
    for source in [*paths, text, mujoco.MjModel.from_xml_string(text), spec]:
        ours = MujocoPhysics(source, step=0.01, unknowns=unknowns)
        same([ours(X)], [Y])
        assert copy.deepcopy(ours) is ours
        if source is spec:
            refused(TypeError, r"MjSpec cannot be pickled.*to_xml\(\)", pickle.dumps, ours)
        else:
            assert torch.equal(pickle.loads(pickle.dumps(ours))(X), ours(X))


def test_unstable_rows_are_named_and_nothing_is_printed(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    said = []
    mujoco.set_mju_user_warning(said.append)
    try:
        for step in (0.002, 0.02):  # MuJoCo resets at the first step, or later
            ours, X = MujocoPhysics(arm(), step=step, threads=2), normal(5, 7)
            good = ours(X)
            X[1, 2], X[3, 0] = 1e11, torch.nan
            with pytest.raises(PhysicsError, match=r"unstable.*in 2 of.*time step") as error:
                ours(X)
            assert error.value.rows == (1, 3)
            found = ours.or_nan(X)
            assert found[[1, 3]].isnan().all()
            assert torch.equal(found[[0, 2, 4]], good[[0, 2, 4]])
        stiff = pendulum(option="").replace("0.002", "0.5")
        stiff = MujocoPhysics(stiff.replace('damping="0.0"', 'stiffness="1e4"'), step=50.0)
        refused(PhysicsError, "unstable", stiff, normal(1, 3))
        refused(ValueError, "cannot read the model", MujocoPhysics, "no_file")
        heavy = MujocoPhysics(arm(), unknowns={"link1.mass": Unknown(1.0, factor=2.0)})
        for physics in (WITH_ONE, heavy):
            physics.mj_model([torch.nan])  # singular
        assert not said
        assert mujoco.get_mju_user_warning() == said.append
    finally:
        mujoco.set_mju_user_warning(None)
    assert capfd.readouterr() == ("", "")
    assert not [*tmp_path.iterdir()]


def test_a_model_that_the_caller_changes_later_is_a_copy():
    X, changed = normal(2, 7), torch.tensor([[1.1]]).double()
    model, spec = mujoco.MjModel.from_xml_string(arm()), mujoco.MjSpec.from_string(arm())
    ours = [MujocoPhysics(source, unknowns=WITH_ONE.unknowns) for source in (model, spec)]
    before = [physics(X) for physics in ours]
    model.opt.gravity[2] = spec.option.gravity[2] = 0.0
    for physics, Y in zip(ours, before, strict=True):
        physics.forget()
        same([physics(X), physics(X, changed)], [Y, WITH_ONE(X, changed)])


def test_an_interrupt_ends_a_long_call():
    ours, X = MujocoPhysics(arm(), step=1.0), normal(20_000, 7)  # minutes
    # A shell lets tests in the background ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Timer(0.3, interrupt_main).start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        ours(X)
    signal.signal(signal.SIGINT, before)
    assert time.monotonic() - began < 10
    assert mujoco.get_mju_user_warning() is None
    assert ours(X[:2]).isfinite().all()


BALL = """<mujoco><worldbody><body><joint name="b" type="ball"/><geom size="1"/></body>
</worldbody></mujoco>"""
LATE = arm().replace('gear="2.0"', 'delay="0.01" nsample="6"')
EMPTY = pendulum().partition("<actuator>")[0] + "</mujoco>"
TWO = arm().replace("belt", "elbow")  # a joint and a tendon of this name


def slower(spec, p):
    spec.option.timestep *= 1 + p["a.b"]


def longer(spec, p):
    spec.bodies[int(p["a.b"])].add_joint()


def fuller(spec, p):
    spec.bodies[1].add_geom(size=[p["a.b"], 0, 0])


def made(model=None, **options):
    return lambda: MujocoPhysics(model or arm(), **options)


def of(name, model=None, edit=None, **prior):
    prior = Unknown(1.0, **(prior or {"factor": 2.0}))
    return lambda: MujocoPhysics(model or arm(), unknowns={name: prior}, edit=edit)


OF = {"factor": 2.0, "function_of": "v", "between": (0.0, 1.0)}
WITH_ONE = MujocoPhysics(arm(), unknowns={"elbow.damping": Unknown(1.0, factor=2.0)})
COMPILED = mujoco.MjModel.from_xml_string(arm())
REFUSED = {
    "kind": (TypeError, "model must be the path.*found 3", made(3)),
    "file": (ValueError, "cannot read the model.*none.xml", made("none.xml")),
    "text": (ValueError, "cannot read the model: ValueError: XML", made("<a>")),
    "ball": (ValueError, "'b' is a ball or free joint.*hinges", made(BALL)),
    "delay": (ValueError, "state besides qpos.*previous=", made(LATE)),
    "step": (ValueError, "multiple of.*0.002 s; found 0.003", made(step=3e-3)),
    "short": (ValueError, "multiple of", made(step=1e-4)),
    "actions": (ValueError, r"no actuator 'm'.*'motor', 'servo'", made(actions=["m"])),
    "actuator": (ValueError, "no actuator.*<motor>", lambda: MujocoPhysics(EMPTY).spec),
    "threads": (ValueError, "threads must be at least 1", made(threads=0)),
    "sensor": (ValueError, r"'camera'\]; found 'imu'", lambda: made()().sensors(["imu"])),
    "name": (ValueError, "'mass'; expected 'element.parameter'", of("mass")),
    "field": (ValueError, "'link1.weight'; expected 'element.*armature", of("link1.weight")),
    "element": (ValueError, "'link3.mass' to name one body, of link1, link2", of("link3.mass")),
    "both": (ValueError, "one joint or tendon.*found 2", of("elbow.damping", TWO)),
    "sign": (ValueError, "negative.*sd=1.0.*factor, or bounds", of("elbow.damping", sd=1.0)),
    "servo": (ValueError, "'motor.kp': the actuator is not a servo", of("motor.kp")),
    "geoms": (ValueError, "edit has changed.*ngeom", of("a.b", edit=fuller)),
    "massless": (ValueError, "body has no mass", of("world.mass")),
    "compiled": (ValueError, "needs the MJCF", of("link1.stretch_x", COMPILED)),
    "edited": (ValueError, "not an MjModel", made(COMPILED, edit=print)),
    "unread": (ValueError, "not read 'link1.weight'", of("link1.weight", edit=lambda spec, p: 0)),
    "time": (ValueError, "edit has changed the time step;", of("a.b", edit=slower)),
    "joints": (ValueError, "edit has changed.*njnt.*nq", of("a.b", edit=longer)),
    "function": (ValueError, "'elbow.damping' is a function. A.*number", of("elbow.damping", **OF)),
    "values": (ValueError, r"expected.* shape \(1,\)", lambda: WITH_ONE.mj_model(torch.zeros(3))),
    "columns": (PhysicsError, "'motor', 'servo'.*found 3 c", lambda: made()()(normal(2, 3))),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_the_way_out(case):
    refused(*REFUSED[case])


def log_of(machine, sd, num_rows=400):
    """A log of random torques, each held for 25 rows; the rate is not measured."""
    actions = 0.8 * normal(num_rows // 25, 1).repeat_interleave(25, 0)
    states = [torch.tensor([[0.5, 0.0]]).double()]
    for action in actions[:-1, None]:
        states.append(machine(torch.cat([states[-1], action], -1)))
    measured = torch.cat(states) + sd * normal(num_rows, 2, seed=1)
    times = machine.step * torch.arange(num_rows, dtype=torch.float64)
    return Records(Record(times, measured, actions), machine.spec)


MASS_AND_DAMPING = {
    "rod.mass": Unknown(1.0, factor=1.5, unit="kg"),
    "hinge.damping": Unknown(0.1, factor=2.0, unit="N m s"),
}


@pytest.mark.slow
def test_a_log_identifies_mass_and_damping():
    machine = MujocoPhysics(pendulum(damping=0.05, option=""), step=0.01)
    ours = MujocoPhysics(pendulum(mass=1.0, option=""), step=0.01, unknowns=MASS_AND_DAMPING)
    found = identify(log_of(machine, torch.tensor([0.005, 0.02]).double()), ours)
    truth = torch.tensor([M, 0.05]).double()
    mean, sd = found.parameters.mean, found.parameters.sd
    assert ((mean - truth).abs() < 4 * sd).all()
    assert (sd < 0.005 * truth).all()
    assert found.errors["identified"][0] < 0.007 < found.errors["guesses"][0]
    wrong = MujocoPhysics(pendulum(), step=0.02)
    refused(ValueError, "steps of 0.02.*spec has 0.01", identify, log_of(machine, 0.01), wrong)
