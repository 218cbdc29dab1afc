"""Dynamics after an error: what was learnt stands, and what is wrong is said at once."""

import copy
import math
from functools import partial

import pytest
import torch
from botorch.models import SingleTaskGP

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics, PhysicsError
from tests.dynamics.conftest import FEW, push, pushed
from tests.dynamics.conftest import PUSHED as SPEC
from tests.point import assert_equal
from tests.systems import line, refused


def stronger(X):
    return push(X, 0.11)


def transitions(n=12, seed=0):
    states, actions, following = pushed(n, seed)
    return states, actions, following + 0.02 * states.sin()


def learnt(physics=push, *data):
    """Dynamics that have learnt from 12 transitions."""
    dynamics = LearnedDynamics(SPEC, physics, fit_options=FEW)
    dynamics.update(*(data or transitions()))
    return dynamics


def unchanged(dynamics, before, twin):
    """Whether dynamics are those of a state, and learn as a twin does."""
    assert_equal(dynamics.state_dict(), before)
    states, actions, _ = transitions(seed=5)
    for _ in range(2):
        assert_equal([*dynamics.predict(states, actions)], [*twin.predict(states, actions)])
        for each in (dynamics, twin):
            each.update(*transitions(6, seed=2))


# States


DAMAGES = [
    (lambda s: s.pop("fingerprint"), "from `state_dict`, with a 'fingerprint'"),
    (lambda s: s.pop("model"), "damaged: KeyError.*'model'"),
    (lambda s: s["transitions"]["actions"][3].fill_(math.nan), r"damaged.*\(row 3\)"),
    (lambda s: s["probes"][0][0].fill_(math.nan), "damaged.*'states' without NaN"),
    (lambda s: s["model"].pop("u"), "for CKA"),
    (lambda s: s["model"].update(u=torch.ones(2, 2, 3)), "size mismatch for u"),
    (lambda s: s["model"]["u"].fill_(math.nan), "damaged.*'u' without NaN"),
    (lambda s: s.update(draws=s["draws"][:1]), "or more draws"),
    (lambda s: s.update(probes=[]), "damaged"),
    (lambda s: s["probes"][0][2].mul_(1.1), "another physics than 'push' .* deterministic"),
]


@pytest.mark.slow
def test_a_state_that_cannot_be_loaded_changes_nothing():
    dynamics = learnt()
    before = dynamics.state_dict()
    other = learnt(push, *transitions(20, seed=3)).state_dict()
    refused(TypeError, "from `state_dict`, found None", dynamics.load_state_dict, None)
    for damage, message in DAMAGES:
        state = copy.deepcopy(other)
        damage(state)
        refused(RuntimeError, message, dynamics.load_state_dict, state)
    unchanged(dynamics, before, learnt())


@pytest.mark.parametrize("kind", [PhysicsDynamics, partial(LearnedDynamics, fit_options=FEW)])
def test_dynamics_of_another_physics_are_refused(kind):
    one, rows = kind(SPEC, push), []
    one.update(*transitions())
    other = kind(SPEC, stronger)
    words = r"physics than 'stronger'.* for 'v', this one"
    refused(RuntimeError, words, other.load_state_dict, one.state_dict())
    nearly = kind(SPEC, lambda X: push(X) * (1 + 1e-9))  # by rounding
    nearly.load_state_dict(one.state_dict())
    counted = kind(SPEC, lambda X: rows.append(len(X)) or push(X))
    rows.clear()
    counted.load_state_dict(one.state_dict())
    assert sum(rows) == 3 or kind is not PhysicsDynamics
    one.load_state_dict(other.state_dict())  # which has no transitions
    assert getattr(one, "num_transitions", 0) == 0


def test_a_physics_that_stays_where_it_is_is_itself_again():
    for kind in (PhysicsDynamics, partial(LearnedDynamics, model=PhysicsMeanGP, fit_options=FEW)):
        still, again = (kind(SPEC, lambda X: X[:, :2]) for _ in range(2))
        still.update(*transitions())
        again.load_state_dict(still.state_dict())
    assert again.num_transitions == 12


def test_a_whole_turn_is_no_difference():
    spec, states = StateSpec(["theta"], ["rate"], angles=["theta"]), line(9, 0.0, 6.0)

    def dynamics(sign):
        return PhysicsDynamics(spec, lambda X: X[:, :1] + sign * (torch.pi - 1e-12))

    seen = dynamics(1)
    seen.update(states, torch.full_like(states, torch.pi), states + torch.pi)
    dynamics(-1).load_state_dict(seen.state_dict())
    refused(RuntimeError, "another physics", dynamics(0.9).load_state_dict, seen.state_dict())


def test_a_loaded_state_is_a_copy():
    dynamics = learnt()
    state = dynamics.state_dict()
    before = copy.deepcopy(state)
    dynamics.load_state_dict(state)
    state["transitions"]["states"].zero_()
    state["probes"][0][0].zero_()
    assert_equal(dynamics.state_dict(), before)


# Transitions


@pytest.mark.slow
@pytest.mark.parametrize("where", ["physics", "fit"])
def test_an_error_while_learning_changes_nothing(monkeypatch, where):
    broken = False

    def physics(X):
        if broken and where == "physics":
            raise OSError("no licence")
        return push(X)

    def fail(*arguments, **options):
        raise RuntimeError("no licence")

    dynamics, twin = learnt(physics), learnt(physics)
    before, result = dynamics.state_dict(), dynamics.fit_result
    broken = True
    with monkeypatch.context() as patch:
        if where == "fit":
            patch.setattr("gpadjust.dynamics.learned_dynamics.fit", fail)
        refused(RuntimeError, "no licence", dynamics.update, *transitions(40, seed=7))
    broken = False
    assert dynamics.fit_result is result
    unchanged(dynamics, before, twin)


def test_rows_of_a_failing_physics_are_those_that_were_asked_for():
    limit = math.inf
    physics = FunctionPhysics(lambda X: push(X).where(X[:, 2:] < limit, torch.nan))
    dynamics = learnt(physics)
    states, actions, _ = transitions()
    states, actions = states.repeat(2, 1), actions.repeat(2, 1).clamp_max(1.1)
    actions[[8, 17]] = 1.9
    limit = 1.5
    with pytest.raises(PhysicsError, match=r"2 of 24 row\(s\)") as caught:
        dynamics.predict(states, actions)
    assert caught.value.rows == (8, 17)
    assert torch.equal(caught.value.inputs, torch.cat([states, actions], -1)[[8, 17]])


def test_an_integrated_state_hides_no_failure():
    """Nor where the physics fails in its column alone."""
    spec = StateSpec(["x", "v"], ["a"], integrated={"x": "v"}, step=0.1)
    states, actions, _ = transitions()
    velocity = states[:, 1:] + 0.1 * actions
    following = torch.cat([states[:, :1] + 0.05 * (states[:, 1:] + velocity), velocity], -1)
    actions[7] = 2.5
    for columns in ([True, True], [True, False]):
        broken = torch.tensor(columns)
        physics = FunctionPhysics(
            lambda X, broken=broken: push(X).masked_fill((X[:, 2:] >= 2.1) & broken, torch.nan)
        )
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
]


def test_bad_arguments_are_found_at_once():
    for options, error, words in REFUSED:
        refused(error, words, LearnedDynamics, **{"spec": SPEC, "physics": push, **options})
