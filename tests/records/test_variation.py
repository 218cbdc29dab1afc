"""Parameters that vary: found in stretches, carried by free runs, larger beyond the actions."""

import math

import pytest
import torch

from gpadjust import CalibratedPhysics
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.dynamics.physics_dynamics import varying_parameters
from gpadjust.physics import FunctionPhysics, ODEPhysics, Unknown
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import Record, Records, smooth
from gpadjust.records.variation import log_evidence

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


def strokes(number, sd, seed, steps=12, size=1.0, friction=0.0):
    """Stretches of a driven spring, whose stiffness is of each its own; with Coulomb friction."""
    generator = torch.Generator().manual_seed(seed)

    def law(state, action):
        slip = friction * (state[:, 1] / 0.1).tanh()
        forces = torch.cat([action[:, :1] - slip.unsqueeze(-1), action[:, 1:]], dim=1)
        values = {"stiffness": action[:, 1], "damping": torch.full_like(slip, 0.3)}
        return rates(state, forces, values)

    truth, found = ODEPhysics(law, step=STEP, state_dim=2), []
    for _ in range(number):
        draw = torch.randn(3, generator=generator).double()
        stiffness = 4.0 * (math.log(FACTOR) * sd * draw[0]).exp()
        state, path = torch.stack([0.5 + 0.2 * draw[1], draw[2]]).unsqueeze(0), []
        force = size * torch.randn(steps // 4, generator=generator).double().repeat_interleave(4)
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


def held(found, dynamics, records, variation, steps=12):
    windows = records.windows(steps)
    run = dynamics.free_run(
        windows.initial_states,
        windows.actions,
        noise=found.noise,
        start_noise=found.noise,
        process_noise="learnt",
        variation=variation,
    )
    return float(run.score(windows.measured).coverage[4:, 0].mean()), run


@pytest.fixture(scope="module")
def varied():
    return learnt(strokes(10, 0.5, seed=0))


def test_the_evidence_is_that_of_a_dense_gaussian():
    generator = torch.Generator().manual_seed(0)
    S, p = 3, 2
    root = torch.randn(S, p, p, generator=generator).double()
    precision, v = root @ root.mT + 0.5 * torch.eye(p).double(), torch.tensor([0.3, 0.1]).double()
    places = torch.randn(S, p, generator=generator).double()
    pull = (precision @ places.unsqueeze(-1)).squeeze(-1)
    # What was seen: places with the stretches' own errors, and a shared standard normal one.
    covariance = torch.block_diag(*precision.inverse()) + torch.diag(v.square()).repeat(S, S) * (
        torch.eye(S).double().repeat_interleave(p, 0).repeat_interleave(p, 1)
    )
    covariance = covariance + torch.eye(p).double().repeat(S, S)
    mean = torch.zeros(S * p).double()
    density = torch.distributions.MultivariateNormal(mean, covariance).log_prob(places.flatten())
    constant = 0.0  # of a stretch, its own likelihood at its place
    for each, h, place in zip(precision, pull, places, strict=True):
        own = torch.distributions.MultivariateNormal(place, precision_matrix=each)
        constant += float(own.log_prob(torch.zeros(p).double()))
        assert torch.allclose(each @ place, h)
    found = log_evidence(precision, pull, v)
    assert float(found) == pytest.approx(float(density) - constant, abs=1e-9)


@pytest.mark.slow
def test_what_varies_is_found_and_what_does_not_is_small(varied):
    stiffness, damping = varied[0].variation.tolist()
    assert 0.3 < stiffness < 0.8
    assert damping < 0.2
    steady = smooth(strokes(10, 0.0, seed=0), spring()).variation
    assert steady[0] < 0.06


@pytest.mark.slow
def test_intervals_hold_where_the_machine_varies(varied):
    found, dynamics = varied
    others = strokes(25, 0.5, seed=1)
    without, _ = held(found, dynamics, others, None)
    with_it, run = held(found, dynamics, others, found.variation)
    assert without < 0.85 < 0.9 < with_it
    assert not run.lost.any()


@pytest.mark.slow
def test_another_friction_law_at_forces_that_were_not_learnt_from():
    """The equation lacks Coulomb friction; four times the forces, and so other rates."""
    found, dynamics = learnt(strokes(10, 0.0, seed=2, friction=0.3))
    others = strokes(20, 0.0, seed=3, size=4.0, friction=0.3)
    without, _ = held(found, dynamics, others, None)
    with_it, _ = held(found, dynamics, others, found.variation)
    assert with_it > max(0.85, without)


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


@pytest.mark.slow
def test_a_turn_in_a_gap_is_no_variation():
    def coasting(X, p):
        speed = X[:, 1] * (1 - STEP * p.drag)
        return torch.stack([X[:, 0] + STEP * X[:, 1], speed], dim=-1)

    physics = FunctionPhysics(coasting, unknowns={"drag": Unknown(0.02, factor=FACTOR)})
    spec = StateSpec(["q", "dq"], ["u"], angles=["q"])
    generator, found = torch.Generator().manual_seed(0), []
    for start in (12.0, 13.0):
        speeds = start * (1 - STEP * 0.02) ** torch.arange(80).double()
        angles = torch.cat([torch.zeros(1).double(), STEP * speeds[:-1].cumsum(0)])
        states = torch.stack([angles, speeds], dim=-1)
        states += 0.01 * torch.randn(states.shape, generator=generator)
        states[30:37] = math.nan
        times = STEP * torch.arange(80).double()
        found.append(Record(times, states, torch.zeros(80, 1).double()))
    smoothed = smooth(Records(found, spec), physics)
    assert smoothed.variation < 0.1


def test_known_parameters_do_not_vary():
    values = {"stiffness": torch.tensor(4.0), "damping": torch.tensor(0.3)}
    known = ODEPhysics(lambda s, a: rates(s, a, values), step=STEP, state_dim=2, substeps=2)
    with pytest.raises(ValueError, match="found no unknown parameters"):
        smooth(strokes(2, 0.0, seed=0), known).variation  # noqa: B018
