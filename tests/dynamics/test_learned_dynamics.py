"""What dynamics predict, in limiting cases, and how they go on learning and are stored."""

import math
import warnings
from functools import partial

import pytest
import torch

from gpadjust import CKA
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.physics import BlackBoxPhysics
from tests.point import assert_equal
from tests.systems import refused, same

POINT_FIT = {"method": "map"}

pytestmark = pytest.mark.filterwarnings(
    "ignore:f_p is nearly zero", "ignore::gpadjust.core.SamplingWarning"
)


@pytest.mark.slow
def test_physics_that_is_the_truth_is_left_alone(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.truth, target="absolute")
    dynamics.update(*system.trial(0))
    states, actions, next_states = system.trial(1)
    mean, _ = dynamics.predict(states, actions)
    torch.testing.assert_close(mean, next_states, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["CKA", "RRA"])
def test_learning_lowers_the_error_of_the_physics(cart_pole_system, make, kind):
    system = cart_pole_system
    dynamics = make(kind, system.spec, system.crude)
    assert not dynamics.is_fitted
    for seed in range(2):
        dynamics.update(*system.trial(seed))
    assert dynamics.num_transitions == 50
    states, actions, next_states = system.trial(7)
    scores = dynamics.score(states, actions, next_states)
    physics_error = system.crude(torch.cat([states, actions], -1)) - next_states
    ratio = (scores.rmse / physics_error.square().mean(0).sqrt())[2:].log()
    # Random features are seen through a few frequencies only.
    assert (ratio.mean() if kind == "RRA" else ratio.max()) < 0


def test_scores_are_those_of_the_predictions(cart_pole_system, learnt_cart_pole):
    dynamics = learnt_cart_pole
    states, actions, next_states = cart_pole_system.trial(0)
    mean, variance = dynamics.predict(states, actions)
    scores = dynamics.score(states, actions, next_states)
    density = torch.distributions.Normal(mean, variance.sqrt()).log_prob(next_states)
    torch.testing.assert_close(scores.nlpd, -density.mean(0))
    torch.testing.assert_close(scores.rmse, (mean - next_states).square().mean(0).sqrt())
    turn = dynamics.score(states, actions, next_states + torch.tensor([0, 2 * math.pi, 0, 0]))
    pairs = ((turn.rmse, turn.nlpd, turn.coverage), (scores.rmse, scores.nlpd, scores.coverage))
    same(*pairs, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_whole_turns_of_an_angle_change_nothing(cart_pole_system, make):
    system = cart_pole_system
    turn = torch.tensor([0, 2 * math.pi, 0, 0], dtype=torch.float64)
    states, actions, next_states = system.trial(0)
    first, second = (make("CKA", system.spec, system.crude) for _ in range(2))
    first.update(states, actions, next_states)
    second.update(states + turn, actions, next_states - turn)  # a step across -pi and pi
    # What rounding errors make of two fits is another matter.
    second.load_state_dict({**second.state_dict(), "model": first.state_dict()["model"]})
    states, actions, _ = system.trial(1)
    mean, variance = first.predict(states, actions)
    turned_mean, turned_variance = second.predict(states - 3 * turn, actions)
    torch.testing.assert_close(turned_mean + 3 * turn, mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(turned_variance, variance, rtol=1e-3, atol=1e-8)


def test_absolute_targets_of_an_angle_go_on_across_the_seam(uniform):
    spec = StateSpec(["theta"], ["rate"], angles=["theta"])
    states, actions = uniform(20, 1, low=2.8, high=3.4), uniform(20, 1, high=0.3, seed=1)
    wrapped = torch.atan2((states + actions).sin(), (states + actions).cos())

    def physics(X):
        return torch.atan2((X[:, :1] + 0.9 * X[:, 1:]).sin(), (X[:, :1]).cos())

    dynamics = LearnedDynamics(spec, physics, target="absolute")
    dynamics.update(states, actions, wrapped)
    mean, _ = dynamics.predict(states, actions)
    torch.testing.assert_close(mean, states + actions, rtol=0, atol=1e-2)


def test_exogenous_and_integrated_states(uniform):
    spec = StateSpec(["goal", "x", "v"], ["a"], exogenous=["goal"], integrated={"x": "v"}, step=0.1)
    states, actions = uniform(30, 3, low=-1), uniform(30, 1, low=-1, seed=1)

    def follow(states, actions):
        goal, x, v = states.split(1, -1)
        faster = v + 0.1 * (actions - 0.5 * v)
        return torch.cat([goal, x + 0.05 * (v + faster), faster], -1)

    def physics(X):
        assert X.shape[-1] == 3
        return torch.cat([X[:, :1] + 0.1 * X[:, 1:2], X[:, 1:2] + 0.08 * X[:, 2:]], -1)

    dynamics = LearnedDynamics(spec, physics)
    dynamics.update(states, actions, follow(states, actions))
    assert dynamics.model.num_outputs == 1
    new, pushes = uniform(10, 3, low=-1, seed=2), uniform(10, 1, low=-1, seed=3)
    mean, variance = dynamics.predict(new, pushes)
    torch.testing.assert_close(mean, follow(new, pushes), rtol=0, atol=1e-3)
    assert (variance[:, 0] == 0).all()
    torch.testing.assert_close(variance[:, 1], 0.05**2 * variance[:, 2])
    functions = dynamics.sample_functions(1)
    for drawn in (dynamics.sample(new, pushes), functions(new[None], pushes[None])[0]):
        torch.testing.assert_close(drawn[:, 1], new[:, 1] + 0.05 * (new[:, 2] + drawn[:, 2]))
        torch.testing.assert_close(drawn[:, 0], new[:, 0])


def test_a_function_or_a_partial_makes_the_model(cart_pole_system):
    system, names = cart_pole_system, []

    def made(X, Y, **physics):
        names.append(sorted(physics))
        return CKA(X, Y, **physics, center=0.0)

    def dynamics(model):
        return LearnedDynamics(system.spec, system.crude, model=model, fit_options=POINT_FIT)

    both = [dynamics(model) for model in (made, partial(CKA, center=0.0))]
    for one in both:
        one.update(*system.trial(0, 10))
    states, actions, _ = system.trial(2)
    assert torch.equal(*(one.predict(states, actions).mean for one in both))
    assert names == [["input_transform", "physics"]]
    assert [one.describe()["model"] for one in both] == ["made", "CKA"]
    with pytest.raises(RuntimeError, match=r"model_options is .*center.* in the state"):
        dynamics(CKA).load_state_dict(both[1].state_dict())
    with pytest.raises(TypeError, match=r"Unknown option 'wave' of CKA"):
        dynamics(partial(CKA, wave=2)).update(*system.trial(0, 10))
    with pytest.raises(TypeError, match="make a gpadjust GP; found NoneType"):
        dynamics(lambda X, Y, **given: None).update(*system.trial(0))


@pytest.mark.slow
def test_each_transition_costs_one_row_of_a_physics_that_remembers(uniform):
    rows = []

    def physics(X):
        rows.append(len(X))
        return X[:, :1] + 0.1 * X[:, 1:]

    dynamics = LearnedDynamics(StateSpec(["x"], ["v"]), BlackBoxPhysics(physics))
    for seed in range(3):
        x, v = uniform(6, 1, seed=seed), uniform(6, 1, seed=seed + 10)
        dynamics.update(x, v, x + 0.12 * v)
    dynamics.predict(x, v)
    assert sum(rows) == 18


def test_samples_scatter_as_predicted(cart_pole_system, learnt_cart_pole):
    dynamics = learnt_cart_pole
    state, action = (t[:1].expand(4000, -1) for t in cart_pole_system.trial(1)[:2])
    mean, variance = dynamics.predict(state, action)
    drawn = dynamics.sample(state, action)
    torch.manual_seed(0)
    assert torch.equal(drawn, dynamics.sample(state, action))
    torch.testing.assert_close(drawn.var(0), variance[0], rtol=0.1, atol=0)
    error = (drawn.mean(0) - mean[0]) / variance[0].sqrt()
    assert (error.abs() < 4 / math.sqrt(4000)).all()
    noise_free = dynamics.predict(state, action, observation_noise=False).variance
    assert (noise_free < variance).all()


def test_each_block_follows_a_function_of_its_own(cart_pole_system, make, costly_kind):
    system = cart_pole_system
    dynamics = make(costly_kind, system.spec, system.crude)
    dynamics.update(*system.trial(0, 12))
    functions = dynamics.model.sample_functions(3, seed=0)
    states, actions = (t[:6].reshape(3, 2, -1) for t in system.trial(1)[:2])
    drawn = dynamics.sample_functions(3, seed=0)(states, actions)
    for i in range(3):
        change = functions(torch.cat([states[i], actions[i]], -1))[i]
        torch.testing.assert_close(drawn[i], states[i] + change, rtol=0, atol=1e-8)


def test_predictions_take_leading_dimensions_and_have_no_gradients(
    cart_pole_system, learnt_cart_pole
):
    states, actions, _ = cart_pole_system.trial(2)
    states.requires_grad_()
    dynamics = learnt_cart_pole
    assert dynamics.physics is dynamics.model.physics[0].physics
    flat = dynamics.predict(states, actions)
    blocks = dynamics.predict(states.reshape(5, 5, 4), actions.reshape(5, 5, 1))
    same(blocks, (part.reshape(5, 5, 4) for part in flat))
    assert not any(part.requires_grad for part in (*flat, dynamics.sample(states, actions)))
    mean = dynamics.mean_function()(states[None], actions[None])
    (slopes,) = torch.autograd.grad(mean.sum(), states)
    assert slopes[:, 2:].abs().max() > 0


def test_bad_data_are_refused_and_what_was_learnt_stands(cart_pole_system, make):
    system = cart_pole_system
    states, actions, following = system.trial(0, 6)
    dynamics = make("CKA", system.spec, system.crude)
    words = "at least 2 transitions to learn from, got 1"
    refused(ValueError, words, dynamics.update, states[:1], actions[:1], following[:1])
    for call in (dynamics.predict, dynamics.sample):
        refused(RuntimeError, "call `update`", call, states, actions)
    dynamics.update(states, actions, following)
    before = dynamics.predict(states, actions).mean
    broken = following.clone()
    broken[4, 2] = math.inf
    for rows, error, words in (
        ((states, actions, broken), ValueError, r"next_states to be finite.*row 4"),
        ((broken, actions, following), ValueError, r"states to be finite.*row 4"),
        ((states, actions.float(), following), TypeError, r"actions in float64, got torch\.float3"),
        ((states, actions[:3], following), ValueError, "equally many rows"),
    ):
        refused(error, words, dynamics.update, *rows)
    refused(ValueError, "states of shape", dynamics.predict, states[:, :3], actions)
    assert torch.equal(dynamics.predict(states, actions).mean, before)


@pytest.mark.slow
def test_loaded_dynamics_go_on_bit_by_bit(cart_pole_system, make, costly_kind, tmp_path):
    system, kind = cart_pole_system, costly_kind
    dynamics, other = (make(kind, system.spec, system.crude) for _ in range(2))
    for seed in (0, 1):
        dynamics.update(*system.trial(seed, 12))
    torch.save(dynamics.state_dict(), tmp_path / "state.pt")
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert_equal(*([*each.predict(*system.trial(9)[:2])] for each in (dynamics, other)))
    for each in (dynamics, other):
        each.update(*system.trial(3, 12))
    assert_equal(dynamics.state_dict(), other.state_dict())


@pytest.mark.slow
def test_refits_are_quiet_and_leave_the_generator_alone(cart_pole_system, make):
    system, state = cart_pole_system, torch.get_rng_state()
    dynamics = make("CKA", system.spec, system.crude, fit_options=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(2):
            dynamics.update(*system.trial(seed))
    assert torch.equal(torch.get_rng_state(), state)
