"""Parameters that vary: found in stretches, carried by free runs, larger beyond the actions."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from gpadjust import CalibratedPhysics
from gpadjust.dynamics import LearnedDynamics
from gpadjust.dynamics.physics_dynamics import varying_parameters
from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import Record, Records, smooth
from gpadjust.records.variation import log_evidence
from tests.records.test_smoothing import SPEC, STEP, rates
from tests.systems import normal, refused

FACTOR = 1.5
NOISE = torch.tensor([0.005, 0.02]).double()
FEW = {"num_draws": 64}


def spring():
    unknowns = {"stiffness": Unknown(4.0, factor=FACTOR), "damping": Unknown(0.3, factor=FACTOR)}
    return ODEPhysics(rates, step=STEP, state_dim=2, substeps=2, unknowns=unknowns)


def strokes(number, sd, seed, steps=12, size=1.0):
    """Stretches of a driven spring, each with its own stiffness."""
    generator, records = torch.Generator().manual_seed(seed), []
    for _ in range(number):
        draw = torch.randn(3, generator=generator).double()
        stiffness = 4.0 * (math.log(FACTOR) * sd * draw[0]).exp()
        force = size * torch.randn(steps // 4, generator=generator).double().repeat_interleave(4)
        values = torch.stack([stiffness, torch.tensor(0.3).double()])
        states = [torch.stack([0.5 + 0.2 * draw[1], draw[2]])]
        for u in force:
            states.append(spring()(torch.cat([states[-1], u.view(1)]).unsqueeze(0), values)[0])
        actions = torch.cat([force, force[-1:]]).unsqueeze(-1)
        errors = NOISE * torch.randn(len(states), 2, generator=generator).double()
        times = STEP * torch.arange(steps + 1).double()
        records.append(Record(times, torch.stack(states) + errors, actions))
    return Records(records, SPEC)


def shares(smoothed, records):
    """Shares of positions in intervals of free runs, without and with the variation."""
    dynamics = LearnedDynamics(SPEC, spring(), model=CalibratedPhysics, fit_options=FEW)
    dynamics.update(*smoothed.draw(0).trajectories())
    windows = records.windows(12)
    options = dict.fromkeys(("noise", "start_noise"), smoothed.noise)
    options |= {"initial_states": windows.initial_states, "actions": windows.actions}
    for variation in (None, smoothed.variation):
        run = dynamics.free_run(process_noise="learnt", variation=variation, **options)
        assert not run.lost.any()
        yield float(run.score(windows.measured).coverage[4:, 0].mean())


@pytest.fixture(scope="module")
def varied():
    """The smoothed records of a stiffness that varies."""
    return smooth(strokes(10, 0.5, seed=0), spring())


def test_the_evidence_is_that_of_a_dense_gaussian():
    S, p = 3, 2
    root, places = normal(S, p, p), normal(S, p, seed=1)
    precision, v = root @ root.mT + 0.5 * torch.eye(p).double(), torch.tensor([0.3, 0.1]).double()
    pull = (precision @ places.unsqueeze(-1)).squeeze(-1)
    # Estimates: places with the stretches' own errors, and a shared standard normal one.
    covariance = torch.block_diag(*precision.inverse()) + torch.diag(v.square()).repeat(S, S) * (
        torch.eye(S).double().repeat_interleave(p, 0).repeat_interleave(p, 1)
    )
    covariance = covariance + torch.eye(p).double().repeat(S, S)
    mean = torch.zeros(S * p).double()
    density = MultivariateNormal(mean, covariance).log_prob(places.flatten())
    # Of each stretch, its own likelihood at its place
    alone = MultivariateNormal(places, precision_matrix=precision).log_prob(mean[:p]).sum()
    expected = float(density - alone)
    assert float(log_evidence(precision, pull, v)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_what_varies_is_found_and_what_does_not_is_small(varied):
    stiffness, damping = varied.variation.tolist()
    assert 0.3 < stiffness < 0.8
    assert damping < 0.2
    assert smooth(strokes(10, 0.0, seed=0), spring()).variation[0] < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, 4.0], ids=["", "beyond the actions"])
def test_intervals_hold_where_the_machine_varies(varied, size):
    without, with_it = shares(varied, strokes(25, 0.5, seed=1, size=size))
    assert without < 0.85 < 0.9 < with_it


@pytest.fixture
def vary():
    """Draws changes of v by a stiffness that varies, after actions were learnt from."""
    parameters = PhysicsParameters(spring().unknowns, torch.tensor([[4.0], [0.3]]).double())
    states = torch.tensor([[0.6, 0.0]]).double().expand(64, 1, 2)

    def vary(actions, action, variation=0.1):
        actions = torch.tensor(actions).double().unsqueeze(-1)
        sampler = varying_parameters(spring(), SPEC, parameters, actions, variation)
        return sampler(64, 0)(states, torch.full((1, 1), action).double())[..., 1]

    return vary


@pytest.mark.parametrize(("beyond", "factor"), [(0.0, 1.0), (0.5, 2.0), (1.0, 3.0), (4.0, 5.0)])
def test_parameters_vary_more_beyond_the_actions_but_no_more_than_half_of_the_prior(
    vary, beyond, factor
):
    """By halves of the range beyond it; 5 times 0.1 is half of the prior's."""
    variation = torch.tensor([0.1, 0.0]).double()
    for sign in (1.0, -1.0):
        far = vary([-1.0, 1.0], sign * (1 + beyond), variation)
        near = vary([-1.0, 1.0], sign, variation)
        assert float(far.std() / near.std()) == pytest.approx(factor, rel=0.1)


def test_an_action_that_was_always_the_same_counts_by_its_own_size(vary):
    near, far = (vary([2.0, 2.0], action) for action in (2.0, 3.0))
    assert float(far.std() / near.std()) == pytest.approx(2.0, rel=0.1)


def test_bad_variations(vary):
    for variation, error, words in (
        (-0.1, ValueError, "0 or more"),
        (math.nan, ValueError, "or"),
        (torch.ones(3), ValueError, "one for each of stiffness, damping"),
        ("much", TypeError, "variation to be real numbers"),
    ):
        refused(error, words, vary, [-1.0, 1.0], 0.0, variation)
