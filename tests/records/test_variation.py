"""Parameters that vary: carried by free runs, larger beyond the actions."""

import math

import pytest
import torch

from gpadjust import CalibratedPhysics
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.dynamics.physics_dynamics import varying_parameters
from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import Record, Records, smooth

STEP, FACTOR = 0.1, 1.5
SPEC = StateSpec(["x", "v"], ["force"])
NOISE = torch.tensor([0.005, 0.02]).double()
FEW = {"num_draws": 64}


def rates(state, action, p):
    pull = -p["stiffness"] * state[:, 0] - p["damping"] * state[:, 1]
    return torch.stack([state[:, 1], pull + action[:, 0]], dim=-1)


def spring():
    unknowns = {"stiffness": Unknown(4.0, factor=FACTOR), "damping": Unknown(0.3, factor=FACTOR)}
    return ODEPhysics(rates, step=STEP, state_dim=2, substeps=2, unknowns=unknowns)


def strokes(number, sd, seed, steps=12):
    """Stretches of a driven spring, each with another stiffness."""
    generator = torch.Generator().manual_seed(seed)

    def law(state, action):
        values = {"stiffness": action[:, 1], "damping": torch.full_like(action[:, 1], 0.3)}
        return rates(state, action, values)

    truth, found = ODEPhysics(law, step=STEP, state_dim=2), []
    for _ in range(number):
        draw = torch.randn(3, generator=generator).double()
        stiffness = 4.0 * (math.log(FACTOR) * sd * draw[0]).exp()
        state, path = torch.stack([0.5 + 0.2 * draw[1], draw[2]]).unsqueeze(0), []
        force = torch.randn(steps // 4, generator=generator).double().repeat_interleave(4)
        for u in force:
            path.append(state)
            state = truth(torch.cat([state, u.view(1, 1), stiffness.view(1, 1)], dim=1))
        states = torch.cat([*path, state])
        states = states + NOISE * torch.randn(states.shape, generator=generator).double()
        actions = torch.cat([force, force[-1:]]).unsqueeze(-1)
        found.append(Record(STEP * torch.arange(steps + 1).double(), states, actions))
    return Records(found, SPEC)


def learnt(records):
    found = smooth(records, spring())
    dynamics = LearnedDynamics(SPEC, spring(), model=CalibratedPhysics, fit_options=FEW)
    dynamics.update(*found.draw(0).trajectories())
    return found, dynamics


def held(found, dynamics, records, variation):
    windows = records.windows(12)
    run = dynamics.free_run(
        windows.initial_states,
        windows.actions,
        noise=found.noise,
        start_noise=found.noise,
        process_noise="learnt",
        variation=variation,
    )
    return float(run.score(windows.measured).coverage[4:, 0].mean()), run


@pytest.mark.slow
def test_intervals_cover_where_the_machine_varies():
    found, dynamics = learnt(strokes(10, 0.5, seed=0))
    others = strokes(25, 0.5, seed=1)
    without, _ = held(found, dynamics, others, None)
    with_it, run = held(found, dynamics, others, torch.tensor([0.5, 0.0]).double())
    assert without < 0.85 < 0.9 < with_it
    assert not run.lost.any()


@pytest.mark.parametrize(("beyond", "factor"), [(0.0, 1.0), (0.5, 2.0), (1.0, 3.0), (4.0, 5.0)])
def test_parameters_vary_more_beyond_the_actions_but_no_more_than_half_of_the_prior(beyond, factor):
    """By halves of the range beyond it; 5 times 0.1 is half of the prior's."""
    learnt, actions = (
        PhysicsParameters(spring().unknowns, torch.tensor([[4.0], [0.3]]).double()),
        (torch.tensor([[-1.0], [1.0]]).double()),
    )
    vary = varying_parameters(spring(), SPEC, learnt, actions, torch.tensor([0.1, 0.0]).double())
    states = torch.tensor([[0.6, 0.0]]).double().expand(64, 1, 2)
    for force in (1 + beyond, -1 - beyond):
        u = torch.full((1, 1), force).double()
        change = vary(64, 0)(states, u)[..., 1]
        near = vary(64, 0)(states, torch.sign(u))[..., 1]
        assert float(change.std() / near.std()) == pytest.approx(factor, rel=0.1)
    # An action that was always the same: by its own size.
    still = varying_parameters(spring(), SPEC, learnt, 2 * actions.abs(), 0.1)
    near, far = (still(64, 0)(states, torch.full((1, 1), u).double())[..., 1] for u in (2.0, 3.0))
    assert float(far.std() / near.std()) == pytest.approx(2.0, rel=0.1)


def test_bad_variations():
    dynamics = LearnedDynamics(SPEC, spring(), model=CalibratedPhysics, fit_options=FEW)
    dynamics.update(*strokes(1, 0.0, seed=0).trajectories())
    states, actions = torch.zeros(1, 2).double(), torch.zeros(1, 2, 1).double()
    for variation, error, words in (
        (-0.1, ValueError, "0 or more"),
        (math.nan, ValueError, "or"),
        (torch.ones(3), ValueError, "one for each of stiffness, damping"),
        ("much", TypeError, "variation to be real numbers"),
    ):
        with pytest.raises(error, match=words):
            dynamics.free_run(states, actions, variation=variation)
