"""Dynamics after an error: what was learnt stands, and what is wrong is said at once."""

import copy
import math
from functools import partial

import pytest
import torch
from botorch.models import SingleTaskGP

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics, ODEPhysics, PhysicsError
from tests.dynamics.conftest import FEW, push, pushed
from tests.dynamics.conftest import PUSHED as SPEC


def stronger(X):
    return push(X, 0.11)


def transitions(n=12, seed=0):
    states, actions, following = pushed(n, seed)
    return states, actions, following + 0.02 * states.sin()


def learning(physics=push):
    """Dynamics that have learnt from 12 transitions."""
    dynamics = LearnedDynamics(SPEC, physics, fit_options=FEW)
    dynamics.update(*transitions())
    return dynamics


@pytest.fixture(scope="module")
def learnt():
    """Makes such dynamics; those of `push` learn once, and are loaded."""
    state = learning().state_dict()

    def learnt(physics=push):
        if physics is not push:
            return learning(physics)
        dynamics = LearnedDynamics(SPEC, push, fit_options=FEW)
        dynamics.load_state_dict(state)
        return dynamics

    return learnt


def equal(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(equal, one, other))
    return torch.equal(one, other) if torch.is_tensor(one) else one == other


def unchanged(dynamics, before, twin):
    """Whether dynamics are those of a state, and learn as a twin does."""
    assert equal(dynamics.state_dict(), before)
    states, actions, _ = transitions(seed=5)
    for _ in range(2):
        pairs = zip(dynamics.predict(states, actions), twin.predict(states, actions), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
        for each in (dynamics, twin):
            each.update(*transitions(6, seed=2))


# States


def damaged(change):
    def damage(state):
        change(state)
        return state

    return damage


DAMAGES = [
    (lambda state: None, TypeError, "dictionary from `state_dict`, found None"),
    (lambda state: {"weights": 1}, RuntimeError, "from `state_dict`, with a 'fingerprint'"),
    *(
        (damaged(change), RuntimeError, words)
        for change, words in (
            (lambda s: s.pop("model"), "damaged: KeyError.*'model'"),
            (lambda s: s["transitions"]["actions"][3].fill_(math.nan), r"damaged.*\(row 3\)"),
            (lambda s: s["probes"][0][0].fill_(math.nan), "damaged.*'states' without NaN"),
            (lambda s: s["model"].pop("u"), "for CKA"),
            (lambda s: s["model"].update(u=torch.ones(2, 2, 3)), "size mismatch for u"),
            (lambda s: s["model"]["u"].fill_(math.nan), "damaged.*'u' without NaN"),
            (lambda s: s.update(draws=s["draws"][:1]), "or more draws"),
            (lambda s: s.update(probes=[]), "damaged"),
            (
                lambda s: s["probes"][0][2].mul_(1.1),
                "another physics than .push. .* a deterministic",
            ),
        )
    ),
]


@pytest.mark.slow
def test_a_state_that_cannot_be_loaded_changes_nothing(learnt):
    dynamics = learnt()
    before = dynamics.state_dict()
    other = LearnedDynamics(SPEC, push, fit_options=FEW)
    other.update(*transitions(20, seed=3))
    for change, error, message in DAMAGES:
        with pytest.raises(error, match=message):
            dynamics.load_state_dict(change(copy.deepcopy(other.state_dict())))
    unchanged(dynamics, before, learnt())


def test_dynamics_of_another_physics_are_refused(learnt):
    seen = PhysicsDynamics(SPEC, push)
    seen.update(*transitions())
    for one in (learnt(), seen):
        known = {"fit_options": FEW} if isinstance(one, LearnedDynamics) else {}
        other = type(one)(SPEC, stronger, **known)
        with pytest.raises(
            RuntimeError, match=r"another physics than 'stronger'.* for 'v', this one"
        ):
            other.load_state_dict(one.state_dict())
        type(one)(SPEC, push, **known).load_state_dict(one.state_dict())
        one.load_state_dict(type(one)(SPEC, stronger, **known).state_dict())  # it has seen nothing
        assert getattr(one, "num_transitions", 0) == 0


def test_loading_asks_a_physics_alone_at_three_rows():
    rows = []

    def counted(X):
        rows.append(len(X))
        return push(X)

    seen = PhysicsDynamics(SPEC, push)
    seen.update(*transitions())
    PhysicsDynamics(SPEC, counted).load_state_dict(seen.state_dict())
    assert sum(rows) == 3


def test_a_physics_may_differ_by_rounding(learnt):
    state = learnt().state_dict()
    nearly = LearnedDynamics(SPEC, lambda X: push(X) * (1 + 1e-9), fit_options=FEW)
    nearly.load_state_dict(state)

    def still(X):
        return X[:, :2]

    dynamics = LearnedDynamics(SPEC, still, model=PhysicsMeanGP, fit_options=FEW)
    dynamics.update(*transitions())
    again = LearnedDynamics(SPEC, still, model=PhysicsMeanGP, fit_options=FEW)
    again.load_state_dict(dynamics.state_dict())
    assert again.num_transitions == 12


def test_a_whole_turn_is_no_difference():
    spec = StateSpec(["theta"], ["rate"], angles=["theta"])
    states = torch.linspace(0, 6, 9, dtype=torch.float64).unsqueeze(-1)
    turn = torch.full_like(states, torch.pi)

    def physics(sign):
        return lambda X: X[:, :1] + sign * (torch.pi - 1e-12)

    seen = PhysicsDynamics(spec, physics(1))
    seen.update(states, turn, states + turn)
    PhysicsDynamics(spec, physics(-1)).load_state_dict(seen.state_dict())
    with pytest.raises(RuntimeError, match="another physics"):
        PhysicsDynamics(spec, physics(0.9)).load_state_dict(seen.state_dict())


def test_a_loaded_state_is_a_copy(learnt):
    state = learnt().state_dict()
    dynamics = LearnedDynamics(SPEC, push, fit_options=FEW)
    dynamics.load_state_dict(state)
    before = copy.deepcopy(state)
    state["transitions"]["states"].zero_()
    state["probes"][0][0].zero_()
    assert equal(dynamics.state_dict(), before)


# Transitions


@pytest.mark.slow
@pytest.mark.parametrize("where", [pytest.param("physics", marks=pytest.mark.slow), "model", "fit"])
def test_an_error_while_learning_changes_nothing(learnt, monkeypatch, where):
    broken = False

    def physics(X):
        if broken and where == "physics":
            raise OSError("no licence")
        return push(X)

    def fail(*arguments, **options):
        raise RuntimeError("no licence")

    dynamics, twin = learnt(physics), learnt(physics)
    before, result = dynamics.state_dict(), dynamics.fit_result
    rows = transitions(40, seed=7)
    broken = True
    with monkeypatch.context() as patch:
        if where == "model":
            patch.setattr(CKA, "__init__", fail)
        if where != "physics":
            patch.setattr("gpadjust.dynamics.learned_dynamics.fit", fail)
        with pytest.raises(RuntimeError, match="no licence"):
            dynamics.update(*rows)
    broken = False
    assert dynamics.fit_result is result
    unchanged(dynamics, before, twin)


def test_rows_of_a_failing_physics_are_those_that_were_asked_for(learnt):
    broken = False

    def physics(X):
        return push(X).where(X[:, 2:] < 1.5, torch.nan) if broken else push(X)

    physics = FunctionPhysics(physics)
    dynamics = learnt(physics)
    states, actions, _ = transitions()
    states, actions = states.repeat(2, 1), actions.repeat(2, 1).clamp_max(1.1)
    actions[[8, 17]] = 1.9
    broken = True
    with pytest.raises(PhysicsError, match=r"2 of 24 row\(s\)") as caught:
        dynamics.predict(states, actions)
    assert caught.value.rows == (8, 17)
    expected = torch.cat([states, actions], -1)[[8, 17]]
    assert torch.equal(caught.value.inputs, expected)


def test_an_integrated_state_hides_no_failure():
    spec = StateSpec(["x", "v"], ["a"], integrated={"x": "v"}, step=0.1)
    physics = FunctionPhysics(lambda X: push(X).where(X[:, 2:] < 2.1, torch.nan))
    states, actions, _ = transitions()
    velocity = states[:, 1:] + 0.1 * actions
    following = torch.cat([states[:, :1] + 0.05 * (states[:, 1:] + velocity), velocity], -1)
    actions[7] = 2.5
    with pytest.raises(PhysicsError, match=r"NaN or inf in 1 of 12 row") as caught:
        LearnedDynamics(spec, physics).update(states, actions, following)
    assert caught.value.rows == (7,)


# Arguments


REFUSED = [
    ({"physics": None}, TypeError, "ZeroMeanGP, .*found CKA: missing .*'physics'"),
    ({"model": ZeroMeanGP}, TypeError, "found ZeroMeanGP: it takes no physics.*model=CKA"),
    ({"model": "CKA"}, TypeError, "class of gpadjust,.*found 'CKA'"),
    ({"model": SingleTaskGP}, TypeError, "found SingleTaskGP: .*'physics'"),
    ({"model": lambda X, Y: None}, TypeError, r"a factory of \(X, Y, physics=...\).*'physics'"),
    ({"model": partial(CKA, physics=None)}, TypeError, "physics comes from the dynamics"),
    ({"model": partial(CKA, train_Yvar=1)}, TypeError, "train_Yvar comes from the dynamics"),
    ({"fit_options": {"method": "gibbs"}}, ValueError, "Unknown method 'gibbs'"),
    ({"fit_options": {"num_starts": 8}}, ValueError, "Unknown fit_option 'num_starts'"),
    ({"target": 3}, ValueError, "Unknown target 3"),
    ({"spec": ["x", "v"]}, TypeError, "spec must be a StateSpec"),
    ({"physics": ODEPhysics(lambda s, a: s, 0.1, 2, difference=True)}, ValueError, "=False"),
    ({"physics": [push, ODEPhysics(lambda s, a: s, 0.1, 2, difference=True)]}, ValueError, "=Fal"),
]


def test_bad_arguments_are_found_at_once():
    for options, error, words in REFUSED:
        with pytest.raises(error, match=words):
            LearnedDynamics(**{"spec": SPEC, "physics": push, **options})
