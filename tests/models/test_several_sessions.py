"""Records of several sessions in one fit: parameters in common, and zeros of their own."""

import torch
from botorch.models.transforms.input import FilterFeatures

from gpadjust import FunctionPhysics, PhysicsMeanGP, Unknown, fit
from tests.systems import normal

SESSIONS = 3
ZEROS = torch.tensor([0.05, -0.08, 0.02], dtype=torch.float64)  # m
GRAVITY = 9.81  # m/s²
UNKNOWNS = {
    "gravity": Unknown(9.0, sd=1.0, unit="m/s²"),
    **{f"zero_{i}": Unknown(0.0, sd=0.1, unit="m") for i in range(SESSIONS)},
}


def fall(X, p):
    """The height after a time, as the scale of a session shows it: columns time, session."""
    zeros = torch.stack([p[f"zero_{i}"] for i in range(SESSIONS)], dim=-1)
    zero = zeros.gather(1, X[:, 1:].long()).squeeze(-1)
    return 5 - 0.5 * p.gravity * X[:, 0].square() + zero


def sessions(length=8):
    times = torch.linspace(0, 1, length, dtype=torch.float64).repeat(SESSIONS)
    numbers = torch.arange(SESSIONS).repeat_interleave(length).double()
    X = torch.stack([times, numbers], dim=-1)
    truth = torch.cat([torch.tensor([GRAVITY], dtype=torch.float64), ZEROS])
    Y = FunctionPhysics(fall, unknowns=UNKNOWNS)(X, truth)
    return X, Y + 0.005 * normal(*Y.shape)


def test_a_fit_of_all_tells_each_zero_and_what_they_share():
    X, Y = sessions()
    only_time = FilterFeatures(torch.tensor([0]))  # delta is that of the falling ball
    physics = FunctionPhysics(fall, unknowns=UNKNOWNS)
    model = PhysicsMeanGP(X, Y, physics=physics, input_transform=only_time)
    fit(model)
    found = model.physics_parameters
    low, high = found.interval()
    assert low[0] < GRAVITY < high[0]
    differences = torch.tensor([found[f"zero_{i}"].mean() - found["zero_0"].mean() for i in (1, 2)])
    expected = (ZEROS[1:] - ZEROS[0]).to(differences)
    torch.testing.assert_close(differences, expected, rtol=0, atol=0.01)
    new = torch.tensor([[0.37, 1.0]], dtype=torch.float64)
    height = 5 - 0.5 * GRAVITY * 0.37**2 + ZEROS[1]
    assert abs(model.predict(new).mean.item() - height) < 0.01
