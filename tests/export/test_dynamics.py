"""Programs of dynamics say what the dynamics predict."""

import ctypes
import functools
from dataclasses import replace
from functools import partial

import pytest
import torch

from gpadjust import CKA, RRA, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export import c_source, casadi_function
from gpadjust.states import StateSpec
from tests.export.apart import apart
from tests.export.conftest import called, compiled, in_casadi
from tests.systems import normal, same, uniform

SPEC = StateSpec(
    ["goal", "angle", "x", "rate", "speed", "last"],
    ["force"],
    angles=["angle"],
    exogenous=["goal"],
    integrated={"x": "speed"},
    step=0.1,
    previous={"last": "force"},
)


def pushed(X):
    """The next angle, x, rate and speed."""
    angle, x, rate, speed, force = X.unbind(-1)
    rate_, speed_ = rate - 0.9 * angle.sin() + 0.1 * speed, speed + 0.1 * force
    return torch.stack([angle + 0.1 * rate_, x + 0.1 * speed_, rate_, speed_], dim=-1)


def pushed_in_casadi(read):
    import casadi as ca

    angle, x, rate, speed, force = ca.vertsplit(read)
    rate_, speed_ = rate - 0.9 * ca.sin(angle) + 0.1 * speed, speed + 0.1 * force
    return ca.vertcat(angle + 0.1 * rate_, x + 0.1 * speed_, rate_, speed_)


STILL = {"pushed": pushed, "still": lambda X: X[:, :4]}


def transitions():
    states, actions = 3 * normal(40, 6), normal(40, 1, seed=1)
    states[:, 1] = torch.atan2(states[:, 1].sin(), states[:, 1].cos())
    read = torch.cat([states[:, 1:5], actions], dim=-1)
    moved = 1.1 * pushed(read) - 0.1 * read[:, :4] + 0.02 * normal(40, 4, seed=2)
    moved[:, 1] = states[:, 2] + 0.05 * (states[:, 4] + moved[:, 3])
    return states, actions, torch.cat([states[:, :1], moved, actions], dim=-1)


@functools.cache
def learnt(target="difference", model=CKA, physics=pushed, reads=()):
    dynamics = LearnedDynamics(
        replace(SPEC, physics_reads=reads),
        STILL if physics is None else physics,
        model=model,
        target=target,
        fit_options={"method": "map"},
    )
    dynamics.update(*transitions())
    return dynamics


RRA20 = partial(RRA, num_features=20)
CASES = {
    "difference": learnt,
    "absolute": partial(learnt, "absolute", RRA20),
    "two physics": partial(learnt, physics=None),
    "late": partial(learnt, reads=("angle", "x", "rate", "speed", "last")),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@apart
def test_programs_say_the_next_state_and_its_variance(case, tmp_path):
    dynamics = CASES[case]()
    states, actions = 2 * uniform(5, 6, low=-2.0, high=2.0, seed=3), uniform(5, 1, seed=4)
    read = dynamics.spec.physics_inputs(states, actions)
    parts = STILL.values() if case == "two physics" else [dynamics.physics]
    f_p = torch.cat([part(read) for part in parts], dim=-1)
    expected = dynamics.predict(states, actions, observation_noise=False)
    program = compiled(c_source(dynamics, "cart"), tmp_path)
    function = casadi_function(dynamics)
    assert function.name_in() == ["state", "action", "f_p"]
    for *given, mean, variance in zip(states, actions, f_p, *expected, strict=True):
        in_c = called(program.cart_step, (6, 6), *given)
        for found in (in_c, in_casadi(function, *given)):
            same(found[:1], [mean], rtol=1e-9, atol=1e-12)
            same(found[1:], [variance], rtol=1e-8, atol=1e-14)


STATE, ACTION = normal(6, seed=5), normal(1, seed=6)
F_P = pushed(torch.cat([STATE[1:5], ACTION])[None])[0]


@pytest.mark.parametrize("case", ["difference", "late"])
@apart
def test_a_physics_in_casadi_takes_the_place_of_its_values(case):
    dynamics = CASES[case]()
    step = casadi_function(dynamics, "step", physics=pushed_in_casadi, observation_noise=True)
    assert (step.name_in(), step.name_out()) == (["state", "action"], ["mean", "variance"])
    expected = dynamics.predict(STATE, ACTION)
    same(in_casadi(step, STATE, ACTION), expected, rtol=1e-9, atol=1e-14)


@apart
def test_casadi_has_the_slopes_of_the_mean():
    dynamics = learnt()
    step = casadi_function(dynamics, physics=pushed_in_casadi, variance=False)
    found = step.jacobian()(STATE.numpy(), ACTION.numpy(), 0)[0].full()

    def mean(state):
        return dynamics.mean_function()(state[None, None], ACTION[None, None])[0, 0]

    expected = torch.autograd.functional.jacobian(mean, STATE)
    torch.testing.assert_close(torch.tensor(found), expected, rtol=1e-8, atol=1e-10)


def test_a_step_in_place_is_that_into_another_array(tmp_path):
    """Each entry but the first is made of one that is written before it."""
    spec = StateSpec(
        ["v", "x", "last"], ["f"], integrated={"x": "v"}, step=0.1, previous={"last": "v"}
    )
    states, actions = normal(20, 3), normal(20, 1, seed=1)
    v = states[:, :1] + 0.5 * actions
    moved = torch.cat([v, states[:, 1:2] + 0.05 * (states[:, :1] + v), states[:, :1]], dim=-1)
    options = {"method": "map"}
    dynamics = LearnedDynamics(spec, model=ZeroMeanGP, fit_options=options)
    dynamics.update(states, actions, moved)
    program = compiled(c_source(dynamics, "cart", variance=False), tmp_path)
    (expected,) = called(program.cart_step, (3,), states[0], actions[0])
    numbers = [(ctypes.c_double * len(each))(*each) for each in (states[0], actions[0])]
    program.cart_step(*numbers, numbers[0])
    assert [*numbers[0]] == expected.tolist()
    torch.testing.assert_close(expected, dynamics.predict(states[0], actions[0]).mean)
