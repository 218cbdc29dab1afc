"""What real episodes add to a task, and how dynamics learn them."""

import math
from types import SimpleNamespace

import gymnasium
import pytest
import torch
from gymnasium import spaces

import gpadjust.systems  # noqa: F401 - registers the environment
from gpadjust.control.episodes import completed, episode_length, far_bounds
from gpadjust.control.learning import check_functions, learn_dynamics, learnable, warn_of_bounds
from gpadjust.core import Prediction
from gpadjust.dynamics import Dynamics, PhysicsDynamics, StateSpec, Trajectories
from gpadjust.physics import PhysicsError
from tests.control.conftest import Task, fails_beyond, point_of
from tests.point import POINT_SPEC

ENV = SimpleNamespace(
    action_space=spaces.Box(-1.0, 1.0, (1,)), get_wrapper_attr=lambda name: {"spec": None}[name]
)
SPEC = StateSpec(["x", "angle"], ["force"], angles=["angle"])


def recorded(num_steps, terminal=False):
    """Steps 0, 1, ... of episodes of three; `x` is the step."""
    x = torch.arange(float(num_steps)).double()
    states, ends = torch.stack([x, x], -1), x % 3 == 2
    force = torch.ones(num_steps, 1).double()
    return Trajectories(states, force, states + 0.5, (x // 3).long(), -x, ends & terminal)


@pytest.fixture
def moved():
    """Ten steps of the point, which moves by half the action, in two episodes."""
    x = torch.tensor([1.0, 0.5, 0.2, 0.4, 0.9, 1.2, 0.7, 0.6, 0.1, 0.3]).double().unsqueeze(-1)
    v = torch.cat([x[1:] - x[:-1], x[:1]]) * 2
    v[4] = -0.3  # the first episode ends there
    number = torch.arange(10) // 5
    return Trajectories(x, v, x + 0.5 * v, number, -x[:, 0], torch.zeros(10).bool())


def reward(states, actions, next_states):
    return -states[:, 0]


def task(episode_length=5, reward=reward, **parts):
    dynamics = PhysicsDynamics(SPEC, lambda X: X[:, :2])
    return Task(dynamics, reward, episode_length=episode_length, **parts)


def bounds_of(physics, data):
    return completed(point_of(physics, reward, episode_length=5), data, ENV).state_bounds


def test_a_task_is_completed_where_it_says_nothing():
    low, high = far_bounds(SPEC, recorded(3))
    assert (low[0].item(), high[0].item()) == (1.25 - 12.5, 1.25 + 12.5)
    assert (low[1], high[1]) == (-math.inf, math.inf)
    whole = completed(task(3), recorded(8), ENV)
    assert whole.episode_length == 3
    assert torch.equal(whole.state_bounds, far_bounds(SPEC, recorded(8)))  # f_p stays where it is
    starts = whole.initial_states(200)
    assert starts.shape == (200, 2)
    assert {*starts[:, 0].tolist()} == {0, 3, 6}
    assert completed(task(3), recorded(0), ENV).initial_states is None
    assert episode_length(task(None), gymnasium.make("gpadjust/CartPoleSwingUp-v0")) == 25


def test_bounds_leave_room_for_what_the_physics_reaches(moved):
    low, high = bounds_of(lambda X: X[:, :1] + 4 * X[:, 1:], moved)
    # Two starts, at 1.0 and 1.2, go 20 either way in five steps; half of that range beside it.
    middle, half = 1.1, 0.1 + 20.0
    assert low.item() == pytest.approx(middle - 2 * half, abs=0.5)
    assert high.item() == pytest.approx(middle + 2 * half, abs=0.5)
    close, wide = far_bounds(POINT_SPEC, moved), bounds_of(lambda X: 1e6 * X[:, :1], moved)
    assert (wide[1] - wide[0]).item() == pytest.approx(10 * (close[1] - close[0]).item())
    for still in (lambda X: X[:, :1], fails_beyond(-1)):
        assert torch.equal(bounds_of(still, moved), close)


def test_an_episode_that_a_bound_may_have_held_is_told(moved):
    with pytest.warns(UserWarning, match=r"came to x = 1\.3, .*beyond 1\.31: .*state_bounds"):
        warn_of_bounds(POINT_SPEC, moved, torch.tensor([[-1.0], [1.31]]))
    warn_of_bounds(POINT_SPEC, moved, torch.tensor([[-3.0], [3.0]]))


def test_the_environments_functions_pass():
    ends = task(terminated=lambda states: states[:, 0] % 3 > 2)
    check_functions(ends, recorded(6, terminal=True))


@pytest.mark.parametrize(
    ("terminal", "known", "message"),
    [
        (False, {"reward": lambda s, a, n: torch.where(s[:, 0] == 2, 5.0, -s[:, 0])},
         r"transition 2 gave -2, but the function returns 5.* actions\[2\] = \[1.0\]"),
        (False, {"reward": lambda s, a, n: s}, r"one value per row, shape \(4,\)"),
        (True, {}, r"transition 2 .*terminated=True, but the task has False"),
        (False, {"terminated": lambda s: s[:, 0] == 1.5},
         r"transition 1 .*terminated=False, but the task has True"),
    ],
)  # fmt: skip
def test_other_functions_are_refused_by_their_worst_transition(terminal, known, message):
    with pytest.raises(ValueError, match=message):
        check_functions(task(**known), recorded(4, terminal))


def test_transitions_at_which_the_physics_fails_are_left_out(moved):
    with pytest.warns(UserWarning, match="fails at 3 of 10 new transitions"):
        kept = learnable(PhysicsDynamics(POINT_SPEC, fails_beyond(0.8)), moved)
    assert torch.equal(kept.states, moved.states[moved.states[:, 0] <= 0.8])
    with pytest.raises(PhysicsError, match="too far"):
        learnable(PhysicsDynamics(POINT_SPEC, fails_beyond(-1)), moved)


class Own(Dynamics):
    """Dynamics of a user's, that know the point but for a shift."""

    is_fitted = True

    def predict(self, states, actions):
        mean = states + 0.5 * actions + 0.1
        return Prediction(mean, torch.full_like(mean, 0.2**2))

    def sample_functions(self, num_functions, seed=None):
        raise NotImplementedError("No features of this kernel.")

    def update(self, states, actions, next_states):
        self.learnt = states


def scores(dynamics, moved, horizons=()):
    known = completed(Task(dynamics, reward, episode_length=5), moved, ENV)
    return learn_dynamics(known, moved, moved, horizons)


def test_scores_are_of_what_was_predicted_before_of_trajectories_if_there_are_functions(moved):
    dynamics = Own(POINT_SPEC)
    found = scores(dynamics, moved)
    assert found["rmse/x"] == pytest.approx(0.1)
    assert found["coverage"] == 1
    nlpd = 0.5 * math.log(2 * math.pi * 0.2**2) + 0.1**2 / (2 * 0.2**2)
    assert found["nlpd"] == pytest.approx(nlpd)
    assert torch.equal(dynamics.learnt, moved.states)
    assert found.keys() >= {"fit_seconds", "score_seconds"}
    with pytest.warns(UserWarning, match=r"No features of this kernel\. Pass score_horizons"):
        again = scores(Own(POINT_SPEC), moved, (1, 5))
    assert again.keys() == found.keys()


def test_trajectories_are_scored_as_far_as_episodes_go(moved, learnt_dynamics):
    dynamics, state = learnt_dynamics(), torch.get_rng_state()
    assert {*scores(dynamics, moved, (2, 4, 9))} == {"fit_seconds"}  # it knew nothing
    found = scores(dynamics, moved, (2, 4, 9))
    names = {name for name in found if name[-1].isdigit()}
    assert names == {f"{name}_{k}" for name in ("nlpd", "coverage", "energy") for k in (2, 4)}
    assert 0 <= found["coverage_4"] <= 1
    assert torch.equal(torch.get_rng_state(), state)
    exact = scores(point_of().dynamics, moved, (1, 5))  # without doubt
    assert {name for name in exact if name[-1].isdigit()} == {"energy_1", "energy_5"}
