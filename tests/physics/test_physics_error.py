"""What a PhysicsError says and carries."""

import pickle

import torch

from gpadjust.physics import PhysicsError


def test_message_shows_the_first_five_rows():
    error = PhysicsError("It broke:", rows=range(10, 17))
    error.inputs = torch.arange(7.0).unsqueeze(-1)
    lines = str(error).splitlines()
    assert lines[:2] == ["It broke:", "  row 10: [0.0]"]
    assert lines[5:] == ["  row 14: [4.0]", "  and 2 more"]
    assert "more" not in str(PhysicsError("It broke:", rows=range(5)))
    assert str(PhysicsError("It broke.")) == "It broke."


def test_relocates_to_every_copy_of_a_row():
    error = PhysicsError("It broke:", rows=[1])
    error.relocate(torch.tensor([0, 1, -1, 1, 2]))
    assert error.rows == (1, 3)


def test_pickle_keeps_rows_and_inputs():
    error = PhysicsError("It broke:", rows=[3])
    error.inputs = torch.tensor([[1.5]])
    loaded = pickle.loads(pickle.dumps(error))
    assert loaded.rows == (3,)
    assert str(loaded) == str(error)
