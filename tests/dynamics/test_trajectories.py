"""Trajectories: where episodes end, and windows within them."""

import torch

from gpadjust.dynamics import StateSpec, Trajectories
from tests.systems import refused

SPEC = StateSpec(["x"], ["u"])


def count(*lengths, start=0):
    """Episodes of these numbers of steps, through 0, 1, 2, ..., each from where the last ends."""
    x = torch.arange(start, start + sum(lengths), dtype=torch.float64).unsqueeze(-1)
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return Trajectories(x, 10 * x, x + 1, episode)


def starts(windows):
    return windows.initial_states.flatten().tolist()


def test_windows_do_not_cross_the_ends_of_episodes():
    data = count(6, 3, 8)
    assert data.longest == 8
    assert [len(data.windows(k, stride=1).actions) for k in (1, 4, 8)] == [17, 8, 1]
    assert starts(data.windows(4)) == [0, 9, 13]
    assert starts(data.windows(3, stride=2)) == [0, 2, 6, 9, 11, 13]
    windows = data.windows(3)
    assert torch.equal(windows.states[..., 0].diff(dim=1), torch.ones(5, 3).double())
    assert torch.equal(windows.actions[..., 0], 10 * windows.states[:, :-1, 0])
    refused(ValueError, r"stretches of 9 steps .* longest stretch has 8", data.windows, 9)


def test_a_row_that_is_left_out_ends_an_episode():
    data = count(6, 3)
    some = data.subset(torch.tensor([0, 1, 2, 4, 5, 6, 8]))
    assert some.episode.tolist() == [0, 0, 0, 1, 1, 2, 3]
    assert data.subset(data.states[:, 0] != 3).episode.tolist() == [0, 0, 0, 1, 1, 2, 2, 2]
    assert data.subset(slice(4, 7)).episode.tolist() == [0, 0, 1]
    assert data.subset(torch.tensor([2, 1, 0])).longest == 1
    assert data.subset(slice(0)).longest == 0


def test_no_episode_goes_on_in_what_is_appended():
    both = count(2, 2).append(count(3, 1, start=4))
    assert both.states.flatten().tolist() == [*range(8)]
    lengths = both.episode.unique_consecutive(return_counts=True)[1].tolist()
    assert lengths == [2, 2, 3, 1]


def test_without_episodes_each_row_is_one():
    x = torch.arange(4, dtype=torch.float64).unsqueeze(-1)
    data = Trajectories(x, x, x + 1)
    assert data.longest == 1
    assert len(data.windows(1).actions) == 4
    assert Trajectories.checked(SPEC, x, x, x + 1, [5, 5, 2, 2]).longest == 2


def test_windows_start_at_states_that_were_measured_in_full():
    data = count(7)
    data.states[2] = data.next_states[1] = torch.nan
    assert starts(data.windows(2)) == [0, 3, 5]
    assert data.windows(2).measured[0, 1].isnan().all()


def test_episodes_and_lengths_that_are_none():
    x = torch.zeros(3, 1, dtype=torch.float64)
    for episode, words in (
        ([0, 1, 0], "rows of another episode between"),
        ([0, 0], "3 of next_states, 2 of episode"),
        ([[0, 0, 0]] * 3, "equally many rows"),
        ([0.5, 0.75, 0.75], r"whole numbers, found \[0.5, 0.75"),
    ):
        refused(ValueError, words, Trajectories, x, x, x, episode)
    refused(ValueError, "length must be", count(5).windows, 0)
    refused(ValueError, "stride must be", count(5).windows, 2, stride=0)
