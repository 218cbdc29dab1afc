"""Plans of episodes, and the search that makes them."""

import pickle
import time
from dataclasses import replace

import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.control import Objective, Planner, Return, Rollouts, Task
from gpadjust.control.rollouts import random_sequences
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import PhysicsError

pytestmark = pytest.mark.filterwarnings("ignore:L-BFGS did not converge")
BOUNDS = torch.tensor([[-1.0], [2.0]], dtype=torch.float64)
SPEC = StateSpec(["x"], ["v"])
QUICK = {"method": "map"}


@pytest.fixture
def known_left():
    """Dynamics of x' = x + v / 2 that were measured, often, where v is negative."""
    x = torch.linspace(-3, 3, 40, dtype=torch.float64).unsqueeze(-1)
    v = -torch.rand(40, 1, dtype=torch.float64)
    dynamics = LearnedDynamics(SPEC, model=ZeroMeanGP, fit_options=QUICK)
    dynamics.update(x, v, x + 0.5 * v + 0.01 * torch.randn_like(x))
    return dynamics


@pytest.fixture
def origin():
    return torch.zeros(1, dtype=torch.float64)


# Sequences


def test_random_sequences_hold_their_actions():
    sequences = random_sequences(200, 12, BOUNDS, max_hold=4)
    assert sequences.shape == (200, 12, 1)
    assert ((sequences >= BOUNDS[0]) & (sequences <= BOUNDS[1])).all()
    assert sequences.min() < -0.95
    assert sequences.max() > 1.95
    changes = (sequences.diff(dim=1) != 0).squeeze(-1)
    holds = {tuple(row.nonzero().flatten().tolist()) for row in changes}
    assert holds == {tuple(range(h - 1, 11, h)) for h in (1, 2, 3, 4)}


def test_the_cross_entropy_method_finds_an_optimum():
    best = torch.tensor([[0.5], [-1.0], [2.0], [0.0]], dtype=torch.float64)
    calls = []

    class Near(Objective):
        def of(self, task):
            def score(rollout):
                calls.append(rollout.actions[0])
                return -(rollout.actions[0] - best).square().sum((-2, -1))

            return score

    def planned(rounds, **options):
        calls.clear()
        torch.manual_seed(0)
        planner = Planner(
            Near(),
            rounds=rounds,
            num_elites=8,
            correlation=0.0,
            num_random=60,
            max_hold=1,
            spread=0.1,
        )
        return planner.plan(half_steps(), torch.zeros(1).double(), BOUNDS, 4, **options)

    plan = planned(12)
    assert [len(each) for each in calls] == [60] * 13
    assert plan.value == pytest.approx(-(plan.actions - best).square().sum().item())
    assert plan.value > -1e-2
    first = planned(0)
    assert (calls[0] == first.actions).flatten(1).all(1).any()
    assert first.value < plan.value
    # As good as can be, and never drawn again.
    kept = planned(3, earlier=first._replace(actions=best))
    assert kept.value == 0
    assert torch.equal(kept.actions, best)


# Trials in functions


def reward(states, actions, next_states):
    return -(next_states[:, 0] - 1).abs()


def task_of(dynamics, **parts):
    return Task(dynamics, reward, **parts)


def half_steps(fails_beyond=None, **parts):
    def physics(X):
        if fails_beyond is not None and (X[:, 0] > fails_beyond).any():
            bad = (X[:, 0] > fails_beyond).nonzero().flatten().tolist()
            raise PhysicsError("too far", rows=bad)
        return X[:, :1] + 0.5 * X[:, 1:]

    return task_of(PhysicsDynamics(SPEC, physics), **parts)


def test_sequences_are_followed(origin):
    sequences = torch.tensor([[[1.0], [2.0], [0.0]], [[0.0], [-1.0], [1.0]]], dtype=torch.float64)
    steps = Rollouts(half_steps(), 3).follow(origin, sequences)
    assert steps.made.all()
    assert torch.equal(steps.actions, sequences.expand(3, 2, 3, 1))
    expected = torch.tensor([[0, 0.5, 1.5], [0, 0, -0.5]], dtype=torch.float64)
    torch.testing.assert_close(steps.states.squeeze(-1), expected.expand(3, 2, 3))
    torch.testing.assert_close(steps.next_states[:, :, :-1], steps.states[:, :, 1:])
    torch.testing.assert_close(steps.rewards, -(steps.next_states.squeeze(-1) - 1).abs())


@pytest.mark.parametrize(
    ("options", "made"),
    [
        ({"terminated": lambda states: states[:, 0] > 1.2}, 3),
        ({"state_bounds": torch.tensor([[-9.0], [1.2]])}, 2),
        ({"fails_beyond": 0.9}, 2),
    ],
)
def test_episodes_end_in_the_model(origin, options, made):
    sequences = torch.stack([torch.ones(5, 1), -torch.ones(5, 1)]).double()
    steps = Rollouts(half_steps(**options), 2).follow(origin, sequences)
    assert steps.made.tolist() == [[[t < made for t in range(5)], [True] * 5]] * 2
    assert steps.left_bounds.any(-1).tolist() == [["terminated" not in options, False]] * 2
    if "fails_beyond" in options:
        assert steps.states[steps.made].max() <= 0.9


def test_all_episodes_may_end_at_once_but_not_at_the_start(origin):
    sequences = torch.ones(2, 5, 1).double()
    steps = Rollouts(half_steps(fails_beyond=0.9), 2).follow(origin, sequences)
    assert steps.made.tolist() == [[[True, True, False, False, False]] * 2] * 2
    with pytest.raises(PhysicsError, match="too far"):
        Rollouts(half_steps(fails_beyond=-1), 2).follow(origin, sequences)


# Plans


def test_a_known_sequence_is_kept_if_nothing_is_better(origin):
    task = half_steps()
    options = Planner(Return(), rounds=2, num_elites=2, num_random=4)
    known = torch.tensor([[2.0], [0.0], [0.0], [0.0]], dtype=torch.float64)  # at 1, and stays
    earlier = options.plan(task, origin, BOUNDS, 4)._replace(actions=known)
    assert torch.equal(options.plan(task, origin, BOUNDS, 4, earlier=earlier).actions, known)


def test_plans_are_those_of_the_generator(known_left, origin):
    options = pickle.loads(pickle.dumps(Planner(Return(), rounds=1, num_random=8)))
    plans = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        plans.append(options.plan(task_of(known_left), origin, BOUNDS, 3).actions)
    assert torch.equal(plans[0], plans[1])
    assert not torch.equal(plans[0], plans[2])


def test_bounds_give_way_to_where_an_episode_is(origin):
    task = half_steps(state_bounds=torch.tensor([[5.0], [6.0]]))
    steps = Rollouts(task, 1).follow(origin, torch.zeros(1, 3, 1).double())
    assert steps.made.all()


@pytest.mark.parametrize("seed", range(6))
def test_staying_is_better_than_leaving_however_few_the_sequences(origin, seed):
    """The first ones may all leave at once, so that there is nothing to compare them with."""
    torch.manual_seed(seed)
    dynamics = PhysicsDynamics(SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    task = Task(
        dynamics,
        lambda s, a, n: -10 - n[:, 0].abs(),
        state_bounds=torch.tensor([[-0.2], [0.2]]),
    )
    bounds = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    planner = Planner(Return(), rounds=3, num_random=2)
    earlier = planner.plan(task, origin, bounds, 3)
    earlier = earlier._replace(actions=torch.zeros(3, 1, dtype=torch.float64))
    assert planner.plan(task, origin, bounds, 3, earlier=earlier).value >= -30.6


# Returns


def test_a_plan_of_the_greatest_return(origin):
    """From x = 0 the way to x = 1 and to stay there, by steps of v / 2 with v at most 2."""
    planner = Planner(
        Return(), rounds=12, num_elites=8, correlation=0.0, num_random=200, max_hold=1
    )
    plan = planner.plan(half_steps(), origin, BOUNDS, 4)
    assert plan.value > -0.1
    reached = (plan.actions[:, 0] / 2).cumsum(0)
    torch.testing.assert_close(reached, torch.ones(4).double(), atol=0.05, rtol=0)


def test_a_return_is_the_sum_of_the_rewards_that_are_made(origin):
    sequences = torch.tensor([[[1.0], [2.0], [0.0]], [[0.0], [-1.0], [1.0]]], dtype=torch.float64)
    beyond = (1.5 - 1.2) / 5.1  # in halves of the width
    worst = -0.5 - 1.5 * (2e6 + 40 * beyond)
    for parts, expected in [
        ({}, [-0.5 - 0.5 - 0.5, -1.0 - 1.5 - 1.0]),
        ({"terminated": lambda states: states[:, 0] > 1.2}, [-0.5 - 0.5, -1.0 - 1.5 - 1.0]),
        ({"state_bounds": torch.tensor([[-9.0], [1.2]])}, [worst, -1.0 - 1.5 - 1.0]),
    ]:
        task = half_steps(**parts)
        score = Return().of(task)(Rollouts(task, 2).follow(origin, sequences))
        torch.testing.assert_close(score, torch.tensor(expected, dtype=torch.float64))


def test_a_search_keeps_within_bounds(origin):
    """Most random sequences leave, and rewards are negative: to end early would cost least."""
    torch.manual_seed(0)
    task = half_steps(state_bounds=torch.tensor([[-0.8], [0.8]]))
    plan = Planner(Return(), rounds=6, num_random=64).plan(task, origin, BOUNDS, 6)
    assert plan.left_bounds == 0
    assert plan.value > -3  # to stay costs 6


def test_leaving_does_not_pay_where_rewards_are_none(origin):
    task = replace(
        half_steps(state_bounds=torch.tensor([[-0.8], [0.8]])),
        reward=lambda states, actions, next_states: 0 * next_states[:, 0],
    )
    plan = Planner(num_random=64).plan(task, origin, BOUNDS, 3)
    assert plan.left_bounds == 0
    assert plan.value == 0


class Wrong(Objective):
    def of(self, task):
        return lambda rollout: rollout.rewards.sum(-1)  # k x n


@pytest.mark.parametrize(
    ("options", "arguments", "message"),
    [
        ({}, {"state": torch.zeros(2)}, r"state of shape 1, found \(2,\)"),
        ({}, {"action_bounds": BOUNDS * torch.inf}, r"finite action_bounds, .*inf"),
        ({}, {"action_bounds": [[1.0], [-1.0]]}, "action_bounds, each lower one below its upper"),
        ({}, {"num_steps": None}, "a number of steps >= 1 to plan, found None"),
        ({"objective": Wrong()}, {}, r"Wrong must return one score per seq.* shape \(1, 128\)"),
    ],
)
def test_what_gives_no_plan_is_refused(origin, options, arguments, message):
    given = {"task": half_steps(), "state": origin, "action_bounds": BOUNDS, "num_steps": 3}
    with pytest.raises(ValueError, match=message):
        Planner(**options).plan(**{**given, **arguments})


def test_a_plan_needs_dynamics_that_have_learnt_and_takes_bounds_as_lists(origin):
    nothing = task_of(LearnedDynamics(SPEC, model=ZeroMeanGP))
    with pytest.raises(RuntimeError, match="has not learnt"):
        Planner().plan(nothing, origin, BOUNDS, 3)
    assert len(Planner().plan(half_steps(), origin, [[-1.0], [1.0]], 2).actions) == 2


@pytest.fixture
def clock(monkeypatch):
    """A clock that shows 1 s more after each step of the model of :func:`slow_steps`."""
    shown = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: shown[0])
    return shown


def slow_steps(clock):
    def slow(states, actions, next_states):
        clock[0] += 1.0
        return reward(states, actions, next_states)

    return replace(half_steps(), reward=slow)


@pytest.mark.parametrize(
    ("seconds", "rounds", "taken", "planned"),
    [
        (0.5, 3, 1, 1),  # a step of the model at least
        (3.5, 3, 3, 3),  # no further step would end in time
        (9.5, 3, 8, 4),  # two rounds of four steps
        (99.0, 1, 8, 4),  # all there is to do
    ],
)
def test_plans_are_made_in_time(origin, clock, seconds, rounds, taken, planned):
    planner = Planner(rounds=rounds, seconds=seconds, num_random=8)
    plan = planner.plan(slow_steps(clock), origin, BOUNDS, 4)
    assert clock[0] == taken
    assert len(plan.actions) == len(plan.rewards) == len(plan.next_states) == planned
    assert plan.value == pytest.approx(float(plan.rewards.sum()))


def test_a_plan_that_has_time_is_that_without_a_limit(known_left, origin):
    plans = []
    for seconds in (None, 1e3):
        torch.manual_seed(0)
        planner = Planner(seconds=seconds, num_random=8)
        plans.append(planner.plan(task_of(known_left), origin, BOUNDS, 3))
    assert torch.equal(plans[0].actions, plans[1].actions)
    assert plans[0].value == plans[1].value


def test_horizons_are_in_the_time_unit_of_the_step(origin):
    spec = replace(SPEC, step=0.1)
    task = task_of(PhysicsDynamics(spec, lambda X: X[:, :1] + 0.5 * X[:, 1:]), episode_length=9)
    for horizon, planned in ((0.3, 3), (0.1, 1), (5, 9)):
        assert len(Planner(horizon=horizon).plan(task, origin, BOUNDS).actions) == planned
    with pytest.raises(ValueError, match=r"horizon must be one step at least, .* 0\.1 in the time"):
        Planner(horizon=0.05).plan(task, origin, BOUNDS)
