"""What states and actions are said to be, and whether they are."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust.states import StateSpec
from tests.systems import normal, refused, uniform

INTEGRATED = {"integrated": {"q": "v"}, "step": 0.1}
ARM = StateSpec(["goal", "q", "v"], ["torque"], angles=["q"], exogenous=["goal"], **INTEGRATED)
MEMORY = StateSpec(["last", "x", "goal"], ["b", "a"], exogenous=["goal"], previous={"last": "a"})


def swing(num_steps, step=0.1, rate=2.0):
    """A pendulum's states at equal times: goal, angle and its velocity."""
    t = step * torch.arange(num_steps + 1, dtype=torch.float64)
    path = torch.stack([0.3 + 0 * t, 3 * (rate * t).sin(), 3 * rate * (rate * t).cos()], -1)
    return path[:-1], path[1:].clone()


def check(spec, states, following, actions=None):
    actions = torch.zeros(len(states), spec.action_dim) if actions is None else actions
    spec.check_transitions(states, actions, following)


@settings(derandomize=True)
@given(angle=st.floats(-50, 50), position=st.floats(-1e3, 1e3))
def test_observations_are_decoded(angle, position):
    spec = StateSpec(["x", "theta"], ["a"], angles=["theta"])
    state = torch.tensor([[position, angle]], dtype=torch.float64)
    seen = spec.observe(state)
    expected = torch.tensor([[position, math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    torch.testing.assert_close(seen, expected)
    decoded = spec.decode(seen)
    torch.testing.assert_close(spec.observe(decoded), seen)
    assert -math.pi <= decoded[0, 1] <= math.pi
    assert spec.change(state, decoded).abs().max() < 1e-9


def test_sine_and_cosine_that_are_elsewhere_are_found():
    """What CartPole-like environments show: x, its velocity, sine, cosine, angular velocity."""
    spec = StateSpec(["x", "theta", "v", "w"], ["force"], angles=["theta"])
    angles = torch.linspace(-3, 3, 7)
    noisy = torch.stack([0 * angles, 1.1 * angles.sin(), 1.1 * angles.cos(), angles, angles], -1)
    spec.check_observations(noisy)
    spec.check_observations(noisy[:0])
    swapped = noisy[:, [0, 3, 1, 2, 4]]
    with pytest.raises(ValueError, match=r"1 and 2 .*'theta', found -?\d"):
        spec.check_observations(swapped)
    ARM.check_observations(ARM.observe(torch.randn(5, 3)))


REFUSED = [
    ({"states": "xv"}, TypeError, "states must be a sequence of names; found 'xv'"),
    ({"states": []}, ValueError, "states must be one or more"),
    ({"states": ["x", "x"]}, ValueError, r"states must be different names; found \('x', 'x'\)"),
    ({"angles": ["y"]}, ValueError, "'y'"),
    ({"exogenous": ["x", "v"]}, ValueError, "No state is left to predict"),
    ({"integrated": ["x"]}, TypeError, r"such as {'x': 'x_dot'}; found \['x'\]"),
    ({"integrated": {"x": "v"}}, ValueError, "step must be the duration of a step"),
    ({"previous": {"y": "a"}}, ValueError, "There is no state 'y'"),
    ({"previous": {"x": "b"}}, ValueError, r"'b', which is neither: .* actions are \('a',\)"),
    ({"previous": {"x": "v"}, "actions": ["a", "v"]}, ValueError, "'v', which is both"),
    ({"previous": {"x": "v", "v": "x"}}, ValueError, "circular, x -> v -> x"),
    ({"previous": {"x": "v"}, "angles": ["v"]}, ValueError, "'v' is one .* and 'x' is not"),
    ({"previous": {"x": "a"}, "exogenous": ["x"]}, ValueError, "'x' has two roles"),
    ({"previous": {"x": "a"}, "angles": ["x"]}, ValueError, "'x' is one .* and 'a' is not"),
    ({"step": "fast"}, TypeError, "step must be a number; found 'fast'"),
]


def test_bad_declarations_are_refused():
    for options, error, words in REFUSED:
        refused(error, words, StateSpec, **{"states": ["x", "v"], "actions": ["a"], **options})


# Against transitions


def test_what_is_as_declared_passes():
    turn = torch.tensor([0, 2 * math.pi, 0], dtype=torch.float64)
    for num_steps in (1, 2, 25):
        states, following = swing(num_steps)
        check(ARM, states, following)
        check(ARM, states.float().double(), following.float().double())
        check(ARM, states, following - turn)
        following[-1, :2] = math.nan  # not measured
        check(ARM, states, following)
    still = torch.tensor([[0.3, 1.0, 0.0]], dtype=torch.float64).repeat(5, 1)
    check(ARM, still, still)


def test_an_exogenous_state_that_moves_is_named():
    states, following = swing(10)
    following[4, 0] += 0.01
    following[2] = math.nan
    refused(ValueError, r"'goal' .* 0\.31 where 0\.3 .* row 4", check, ARM, states, following)


def test_a_wrong_step_is_found():
    for factor in (0.5, 0.8, 1.25, 2.0, -1.0):
        states, following = swing(25, step=0.1 * abs(factor))
        following[7, 1] = math.nan
        turned = math.copysign(1.0, factor) * torch.tensor([0, 0, 1]) + torch.tensor([1, 1, 0])
        words = rf"step=0.1.* {factor:.2g}"
        refused(ValueError, words, check, ARM, turned * states, turned * following)


def test_the_velocity_of_another_state_is_warned_of():
    states, following = swing(25)
    other = swing(25, rate=5.0)
    states[:, 2], following[:, 2] = 0.3 * other[0][:, 2], 0.3 * other[1][:, 2]
    with pytest.warns(UserWarning, match="'q' is declared as integrated"):
        check(ARM, states, following)


def test_noise_in_motion_passes_and_at_rest_is_no_error():
    noise = 0.01 * normal(2, 25, 3)
    noise[..., 0] = 0
    states, following = swing(25)
    check(ARM, states + noise[0], following + noise[1])
    with pytest.warns(UserWarning, match="Noisy sensors have the same"):
        check(ARM, noise[0], noise[1])


# Previous actions


def test_previous_actions_are_neither_moved_nor_predicted():
    assert MEMORY.moving == MEMORY.predicted == [1]
    assert (ARM.moving, ARM.predicted, ARM.angle_columns) == ([1, 2], [2], [1])
    states, actions = torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[4.0, 5.0]])
    following = MEMORY.complete(states, actions, torch.tensor([[0.9]]))
    assert torch.equal(following, torch.tensor([[5.0, 0.9, 0.3]]))
    variance = MEMORY.complete_variance(torch.tensor([[0.5]]))
    assert torch.equal(variance, torch.tensor([[0.0, 0.5, 0.0]]))


def test_what_is_no_previous_action_is_named():
    states, actions = uniform(5, 3).float(), uniform(5, 2, seed=1).float()
    following = MEMORY.complete(states, actions, states[:, 1:2])
    check(MEMORY, states, following + 1e-7 * (following == actions[:, 1:]), actions)
    following[3, 0] += 0.1
    for scales in (torch.ones(2), torch.tensor([1e4, 1.0])):  # another action's does not matter
        words = r"'last' .*'a'.* row 3"
        refused(ValueError, words, check, MEMORY, states, following, scales * actions)


# Previous states


LAGS = {"y_2": "y_1", "y_1": "y", "u_2": "u_1", "u_1": "u", "q_1": "q"}
ANGLES = ["q", "q_1"]


@pytest.mark.parametrize("names", [[*LAGS], [*LAGS][::-1]])
def test_previous_values_are_those_before_the_step_in_any_order(names):
    previous = {name: LAGS[name] for name in names}
    states = [*names[:2], "y", *names[2:], "q"]
    spec = StateSpec(states, ["u"], angles=ANGLES, previous=previous)
    before = {"y": 1.0, "y_1": 2.0, "y_2": 3.0, "u_1": 4.0, "u_2": 5.0, "q": 6.0, "q_1": 7.0}
    row = torch.tensor([before[name] for name in states], requires_grad=True)
    action = torch.tensor([8.0], requires_grad=True)
    following = spec.complete(row, action, torch.tensor([[[-1.0, -2.0]], [[-3.0, -4.0]]]))
    expected = {"y_1": 1.0, "y_2": 2.0, "u_1": 8.0, "u_2": 4.0, "q_1": 6.0}
    for block, own in zip(following, ({"y": -1.0, "q": -2.0}, {"y": -3.0, "q": -4.0}), strict=True):
        assert block[0].tolist() == [{**expected, **own}[name] for name in states]
    assert [states[i] for i in spec.moving] == [states[i] for i in spec.predicted] == ["y", "q"]
    variance = dict(zip(states, spec.complete_variance(torch.tensor([0.5, 0.25])), strict=True))
    assert variance == {**dict.fromkeys(LAGS, 0.0), "y": 0.5, "q": 0.25}
    gradients = torch.autograd.grad(following.sum(), (row, action))
    read = dict(zip(states, (gradients[0] / 2).tolist(), strict=True))
    assert read == {"y": 1, "y_1": 1, "y_2": 0, "u_1": 1, "u_2": 0, "q": 1, "q_1": 0}
    assert gradients[1].item() == 2


def test_what_is_no_previous_state_is_named():
    previous = {"y_1": "y", "q_1": "q"}
    spec = StateSpec(["y", "y_1", "q", "q_1"], ["u"], angles=ANGLES, previous=previous)
    states = 300 + uniform(5, 4)
    following = spec.complete(states, torch.zeros(1), states[:, [0, 2]] + 0.1)
    following[:, 3] += 2 * math.pi  # the same angle
    following[1, 1] = math.nan  # which was not measured
    check(spec, states, following)
    check(spec, states, following.float().double())
    for column, name in ((1, "y"), (3, "q")):
        wrong = following.clone()
        wrong[3, column] += 0.01  # little beside the state, much beside its changes
        message = f"'{name}_1' is declared as the previous state '{name}', but is .* in row 3"
        refused(ValueError, message, check, spec, states, wrong)
