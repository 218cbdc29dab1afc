"""Plans of episodes, and the search that makes them."""

import pickle
from dataclasses import replace

import pytest
import torch

from gpadjust.control import Objective, Planner, Return, Rollouts
from gpadjust.control.rollouts import random_sequences
from gpadjust.physics import PhysicsError
from tests.control.conftest import BOUNDS, EVEN, ZERO, fails_beyond, point_of, to_one
from tests.point import POINT_SPEC
from tests.systems import normal

pytestmark = pytest.mark.filterwarnings("ignore:L-BFGS did not converge")


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
        def make_score(self, task):
            def score(rollout):
                calls.append(rollout.actions[0])
                return -(rollout.actions[0] - best).square().sum((-2, -1))

            return score

    def planned(rounds, **options):
        calls.clear()
        torch.manual_seed(0)
        search = {"num_elites": 8, "correlation": 0.0, "num_random": 60, "max_hold": 1}
        planner = Planner(Near(), rounds=rounds, spread=0.1, **search)
        return planner.plan(point_of(), ZERO, BOUNDS, 4, **options)

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


def test_the_best_sequences_of_earlier_rounds_stay():
    """Here all later ones are worse, and of these the largest actions best."""
    calls = []

    class First(Objective):
        def make_score(self, task):
            def score(rollout):
                calls.append(rollout.actions[0])
                size = rollout.actions[0].sum((-2, -1))
                return -size.abs() if len(calls) == 1 else size - 100

            return score

    Planner(First(), rounds=3, num_elites=8, num_random=60).plan(point_of(), ZERO, BOUNDS, 4)
    means = [actions.mean().item() for actions in calls[1:]]
    assert means == pytest.approx([means[0]] * 3, abs=0.3)


# Trials in functions


SEQUENCES = torch.tensor([[[1.0], [2.0], [0.0]], [[0.0], [-1.0], [1.0]]], dtype=torch.float64)


def test_sequences_are_followed():
    steps = Rollouts(point_of(), 3).follow(ZERO, SEQUENCES)
    assert steps.made.all()
    assert torch.equal(steps.actions, SEQUENCES.expand(3, 2, 3, 1))
    expected = torch.tensor([[0, 0.5, 1.5], [0, 0, -0.5]], dtype=torch.float64)
    torch.testing.assert_close(steps.states.squeeze(-1), expected.expand(3, 2, 3))
    torch.testing.assert_close(steps.next_states[:, :, :-1], steps.states[:, :, 1:])
    torch.testing.assert_close(steps.rewards, -(steps.next_states.squeeze(-1) - 1).abs())


@pytest.mark.parametrize(
    ("options", "made"),
    [
        ({"terminated": lambda states: states[:, 0] > 1.2}, 3),
        ({"state_bounds": torch.tensor([[-9.0], [1.2]])}, 2),
        ({"state_bounds": torch.tensor([[5.0], [6.0]])}, 5),  # they give way to the start
        ({"physics": fails_beyond(0.9)}, 2),
    ],
)
def test_episodes_end_in_the_model(options, made):
    sequences = torch.stack([torch.ones(5, 1), torch.zeros(5, 1)]).double()
    steps = Rollouts(point_of(**options), 2).follow(ZERO, sequences)
    assert steps.made.tolist() == [[[t < made for t in range(5)], [True] * 5]] * 2
    has_left = "terminated" not in options and made < 5
    assert steps.left_bounds.any(-1).tolist() == [[has_left, False]] * 2


def test_the_physics_may_fail_for_all_episodes_but_not_at_the_start():
    sequences = torch.ones(2, 5, 1).double()
    steps = Rollouts(point_of(fails_beyond(0.9)), 2).follow(ZERO, sequences)
    assert steps.made.tolist() == [[[True, True, False, False, False]] * 2] * 2
    assert steps.states[steps.made].max() <= 0.9
    with pytest.raises(PhysicsError, match="too far"):
        Rollouts(point_of(fails_beyond(-1)), 2).follow(ZERO, sequences)


# Plans


def test_plans_are_those_of_the_generator_with_a_limit_of_time_or_without():
    plans = []
    for seed, seconds in ((0, None), (0, 1e3), (1, None)):
        options = pickle.loads(pickle.dumps(Planner(num_random=8, seconds=seconds)))
        torch.manual_seed(seed)
        plans.append(options.plan(point_of(), ZERO, BOUNDS, 3))
    assert torch.equal(plans[0].actions, plans[1].actions)
    assert plans[0].value == plans[1].value
    assert not torch.equal(plans[0].actions, plans[2].actions)


@pytest.mark.parametrize("seed", range(3))
def test_staying_is_better_than_leaving_however_few_the_sequences(seed):
    """The first ones may all leave at once, so that there is nothing to compare them with."""
    torch.manual_seed(seed)
    bounds = torch.tensor([[-0.2], [0.2]])
    task = point_of(reward=lambda s, a, n: -10 - n[:, 0].abs(), state_bounds=bounds)
    planner = Planner(Return(), rounds=3, num_random=2)
    earlier = planner.plan(task, ZERO, EVEN, 3)
    earlier = earlier._replace(actions=torch.zeros(3, 1, dtype=torch.float64))
    assert planner.plan(task, ZERO, EVEN, 3, earlier=earlier).value >= -30.6


# Returns


def test_a_return_is_the_sum_of_the_rewards_that_are_made_or_a_quantile():
    beyond = (1.5 - 1.2) / 5.1  # in halves of the width
    worst = -0.5 - 1.5 * (2e6 + 40 * beyond)
    for parts, expected in [
        ({}, [-0.5 - 0.5 - 0.5, -1.0 - 1.5 - 1.0]),
        ({"terminated": lambda states: states[:, 0] > 1.2}, [-0.5 - 0.5, -1.0 - 1.5 - 1.0]),
        ({"state_bounds": torch.tensor([[-9.0], [1.2]])}, [worst, -1.0 - 1.5 - 1.0]),
    ]:
        task = point_of(**parts)
        score = Return().make_score(task)(Rollouts(task, 2).follow(ZERO, SEQUENCES))
        torch.testing.assert_close(score, torch.tensor(expected, dtype=torch.float64))
    rollout = Rollouts(point_of(), 11).follow(ZERO, SEQUENCES)
    rewards = normal(11, 2, 3)
    careful = Return(quantile=0.2).make_score(point_of())(rollout._replace(rewards=rewards))
    torch.testing.assert_close(careful, rewards.sum(-1).sort(0).values[2])  # the third of 11


@pytest.mark.parametrize(
    ("reward", "steps", "rounds", "least"),
    [(to_one, 6, 6, -3), (lambda s, a, n: 0 * n[:, 0], 3, 1, 0)],
)
def test_a_search_keeps_within_bounds(reward, steps, rounds, least):
    """Most random sequences leave; to end early would cost least, and to stay costs 6."""
    task = point_of(reward=reward, state_bounds=torch.tensor([[-0.8], [0.8]]))
    plan = Planner(Return(), rounds=rounds, num_random=64).plan(task, ZERO, BOUNDS, steps)
    assert plan.left_bounds == 0
    assert plan.value >= least


# Time


@pytest.mark.parametrize(
    ("seconds", "rounds", "taken", "planned"),
    [
        (0.5, 3, 1, 1),  # a step of the model at least
        (3.5, 3, 3, 3),  # no further step would end in time
        (9.5, 3, 8, 4),  # two rounds of four steps
        (99.0, 1, 8, 4),  # all there is to do
    ],
)
def test_plans_are_made_in_time(seconds, rounds, taken, planned, slow_reward):
    reward, clock = slow_reward
    planner = Planner(rounds=rounds, seconds=seconds, num_random=8)
    plan = planner.plan(point_of(reward=reward), ZERO, BOUNDS, 4)
    assert clock[0] == taken
    assert len(plan.actions) == len(plan.rewards) == len(plan.next_states) == planned
    assert plan.value == pytest.approx(float(plan.rewards.sum()))


def test_horizons_are_in_the_time_unit_of_the_step():
    task = point_of(spec=replace(POINT_SPEC, step=0.1), episode_length=9)
    for horizon, planned in ((0.3, 3), (0.1, 1), (5, 9)):
        assert len(Planner(horizon=horizon).plan(task, ZERO, BOUNDS).actions) == planned
