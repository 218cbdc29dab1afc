"""Free runs: particles that follow actions from given states, and their intervals."""

import math

import numpy as np
import pytest
import torch

from gpadjust.core import Prediction
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.dynamics.base import step_or_nan
from gpadjust.physics import FunctionPhysics, PhysicsError
from gpadjust.records import Record, Records
from tests.systems import normal, refused

SPEC = StateSpec(["x"], ["v"])
TURN = StateSpec(["theta"], ["omega"], angles=["theta"])


class Drift(Dynamics):
    """States that move by the action and a rate, N(0, sd^2), that is each function's own."""

    is_fitted = True

    def __init__(self, sd=0.0, noise=0.0, spec=SPEC, wraps=False):
        super().__init__(spec)
        self.sd, self.noise, self.wraps = sd, noise, wraps

    def predict(self, states, actions):
        return Prediction(states + actions, torch.full_like(states, self.sd**2 + self.noise**2))

    def sample_functions(self, num_functions, seed=None):
        generator = torch.Generator().manual_seed(seed)
        rate = self.sd * torch.randn(num_functions, 1, 1, generator=generator, dtype=torch.float64)

        def step(states, actions):
            following = states + actions + rate
            return torch.atan2(following.sin(), following.cos()) if self.wraps else following

        return step

    def noise_variance(self, states, actions):
        return torch.full_like(states, self.noise**2)

    def update(self, states, actions, next_states):
        raise NotImplementedError


def start(num_windows=2, num_steps=6):
    """Windows from 0, 1, ... with actions 0.1, 0.2, ..."""
    states = torch.arange(num_windows, dtype=torch.float64).unsqueeze(-1)
    actions = 0.1 * (1 + torch.arange(num_steps, dtype=torch.float64)).expand(num_windows, -1)
    return states, actions.unsqueeze(-1)


STATES, ACTIONS = start()
PATH = STATES.unsqueeze(1) + ACTIONS.cumsum(1)
ORIGIN = torch.zeros(1, 1).double()


def test_a_perfect_model_is_where_the_system_was(cart_pole_system):
    system = cart_pole_system
    states, actions, following = system.trial(0)
    record = Record(
        0.1 * torch.arange(26).double(),
        torch.cat([states, following[-1:]]),
        torch.cat([actions, actions[-1:]]),
    )
    windows = Records(record, system.spec).windows(8)
    run = PhysicsDynamics(system.spec, system.truth).free_run(*windows[:2])
    assert run.particles.shape == (39, 3, 8, 4)
    for found in (run.mean, run.lower, run.upper, run.particles[7]):
        torch.testing.assert_close(found, windows.measured)
    assert run.lost.shape == (3, 8)
    assert not run.lost.any()


def test_each_particle_keeps_its_function_and_noise_comes_once():
    """After k steps a rate of its own has moved a particle by k rates: sd^2 k^2, plus noise."""
    dynamics, k = Drift(0.2, 0.3), torch.arange(1, 7)
    run = dynamics.free_run(STATES, ACTIONS, num_functions=3999)
    torch.testing.assert_close(run.mean, PATH, rtol=0, atol=0.03)
    width = 1.96 * ((0.2 * k) ** 2 + 0.3**2).sqrt().double().expand(2, -1)
    for ends in (run.upper - run.mean, run.mean - run.lower):
        torch.testing.assert_close(ends[..., 0], width, rtol=0.08, atol=0)
    quiet = dynamics.free_run(STATES, ACTIONS, num_functions=3999, noise=False)
    assert torch.equal(quiet.mean, run.mean)
    steps = (quiet.particles - run.mean)[..., 0]
    torch.testing.assert_close(steps[..., 5], 6 * steps[..., 0])


@pytest.mark.parametrize("start_noise", ["learnt", torch.tensor([0.3])])
def test_a_start_that_was_measured_with_noise_moves_all_that_follows(start_noise):
    noise = 0.3 * math.sqrt(2)  # of both ends of a transition
    run = Drift(noise=noise).free_run(
        STATES, ACTIONS, num_functions=3999, noise=False, start_noise=start_noise
    )
    torch.testing.assert_close(run.mean, PATH, rtol=0, atol=0.02)
    spread = run.particles.std(0)
    torch.testing.assert_close(spread, torch.full_like(spread, 0.3), rtol=0.05, atol=0)
    steps = run.particles.diff(dim=2)  # each goes on from where it started
    torch.testing.assert_close(steps, ACTIONS[:, 1:].expand_as(steps))


def test_the_ends_of_the_interval_are_draws_at_any_level():
    for level, number in ((0.95, 39), (0.8, 9), (0.5, 3)):
        run = Drift(1.0).free_run(STATES, ACTIONS, level=level, num_functions=number)
        torch.testing.assert_close(run.lower, run.particles.amin(0))
        torch.testing.assert_close(run.upper, run.particles.amax(0))
        options = {"level": level, "num_functions": number - 1}
        words = f"num_functions >= {number}, .* of {100 * level:g} %"
        refused(ValueError, words, Drift(1.0).free_run, STATES, ACTIONS, **options)
    inner = Drift(1.0).free_run(STATES, ACTIONS, level=0.5, num_functions=39)
    ordered = inner.particles.sort(0).values
    torch.testing.assert_close(inner.lower, ordered[9])
    torch.testing.assert_close(inner.upper, ordered[29])


def test_the_coverage_of_a_calibrated_model_is_nominal():
    """The rate of each of many seeds is one more draw of the rates of its functions."""
    inside = []
    for seed, rate in enumerate(normal(200)):
        run = Drift(0.1).free_run(*start(1, 3), seed=seed)
        measured = STATES[:1].unsqueeze(1) + (ACTIONS[:1, :3] + 0.1 * rate).cumsum(1)
        inside.append(run.score(measured, horizons=[3]).coverage.item())
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_states_that_are_integrated_share_the_noise_of_their_velocities(uniform):
    spec = StateSpec(["q", "v"], ["u"], integrated={"q": "v"}, step=0.5)
    states, actions = uniform(12, 2), uniform(12, 1, seed=1)
    v = states[:, 1:] + actions + 0.1 * uniform(12, 1, low=-1, seed=2)
    following = torch.cat([states[:, :1] + 0.25 * (states[:, 1:] + v), v], -1)
    dynamics = LearnedDynamics(spec, lambda X: torch.cat([X[:, :1], X[:, 1:2] + X[:, 2:]], -1))
    dynamics.update(states, actions, following)
    variance = dynamics.noise_variance(states, actions)
    noisy = dynamics.predict(states, actions).variance
    alone = dynamics.predict(states, actions, observation_noise=False).variance
    torch.testing.assert_close(variance, noisy - alone)
    torch.testing.assert_close(variance[:, 0], variance[:, 1] / 16)
    run, quiet = (
        dynamics.free_run(states, actions.unsqueeze(1), num_functions=199, noise=noise)
        for noise in (True, False)
    )
    added = (run.particles - quiet.particles)[:, :, 0]
    torch.testing.assert_close(added.var(0), variance, rtol=0.4, atol=0)
    torch.testing.assert_close(added[..., 0], 0.25 * added[..., 1])
    torch.testing.assert_close(run.particles.var(0)[:, 0], noisy, rtol=0.4, atol=0)
    # In units of the noise the pair is a line, whose energy score is that of v, sqrt(1 + 1) longer.
    both, one = (
        run.score(following.unsqueeze(1), units=torch.tensor([unit, 1.0])).energy
        for unit in (0.25, 1e9)
    )
    assert (both / one).item() == pytest.approx(2**0.5, rel=0.02)


@pytest.mark.parametrize("wraps", [False, True])
def test_angles_go_on_without_jumps(wraps):
    """Three turns and more, from an angle that is itself beyond one."""
    states, actions = torch.tensor([[7.0], [-0.2]]).double(), torch.full((2, 30, 1), 0.7).double()
    actions[1] *= -1
    run = Drift(0.02, 0.05, TURN, wraps).free_run(states, actions, num_functions=199)
    expected = states + actions[..., 0].cumsum(1)
    torch.testing.assert_close(run.mean[..., 0], expected, rtol=0, atol=0.2)
    for path in (run.mean, run.lower, run.upper):
        assert path.diff(dim=1).abs().max() < 1.2
    assert ((run.lower < run.mean) & (run.mean < run.upper)).all()
    assert (run.upper - run.lower).max() < 5
    # Particles that went round different ways have their mean on the circle.
    still = torch.zeros(1, 1, 1).double()
    run = Drift(0.2, 0.0, TURN, wraps).free_run(ORIGIN + 3.1, still, num_functions=399)
    ends = [run.lower.item(), run.mean.item(), run.upper.item()]
    assert ends == pytest.approx([2.7, 3.1, 3.5], abs=0.1)


def test_lost_particles_stay_where_they_were():
    bounds = torch.tensor([[-1.0], [2.4]])
    run = Drift().free_run(*start(3), state_bounds=bounds)
    assert run.lost.tolist() == [[0] * 6, [0, 0, 0, 0, 1, 1], [0, 0, 1, 1, 1, 1]]
    np.testing.assert_allclose(run.mean[2, :, 0], [2.1, 2.3, 2.3, 2.3, 2.3, 2.3])
    there_and_back = torch.tensor([[[2.0], [1.0], [-1.0]]]).double()
    run = Drift().free_run(STATES[:1], there_and_back, state_bounds=bounds)
    assert run.mean.flatten().tolist() == [2, 2, 2]

    def fails(X):
        return torch.where(X[:, :1] > 1.5, torch.nan, X[:, :1] + X[:, 1:])

    for physics in (fails, FunctionPhysics(fails)):
        run = PhysicsDynamics(SPEC, physics).free_run(*start(3))
        assert run.lost.mean(1).tolist() == pytest.approx([0, 1 / 2, 1])
        assert run.mean.isfinite().all()


def test_without_the_noise_there_is_no_interval():
    class Fails(Drift):
        def noise_variance(self, states, actions):
            rows = (states[:, 0] > 1.25).nonzero().flatten().tolist()
            if rows:
                raise PhysicsError("It fails.", rows=rows)
            return super().noise_variance(states, actions)

    run = Fails(0.01, 0.1).free_run(STATES, ACTIONS)
    assert run.mean.isfinite().all()
    for ends in (run.lower, run.upper):
        assert ends.isfinite().sum(1).flatten().tolist() == [5, 2]


def test_runs_are_the_same_again_and_draw_from_no_generator(monkeypatch):
    class Careless(Drift):
        def sample_functions(self, num_functions, seed=None):
            return super().sample_functions(num_functions, int(torch.randint(99, ())))

    before, seeds_of_gpus = torch.get_rng_state(), []
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeds_of_gpus.append)
    one, other = (Careless(0.1, 0.1).free_run(*start()) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    assert seeds_of_gpus == []
    for value, again in zip(one[:5], other[:5], strict=True):
        assert torch.equal(value, again)
    assert not torch.equal(Careless(0.1, 0.1).free_run(*start(), seed=1).lower, one.lower)


REFUSED = [
    ((STATES[0], ACTIONS[0]), {}, ValueError, r"\(1,\) and \(6, 1\); for a single run, use `in"),
    ((STATES, ACTIONS[:1]), {}, ValueError, r"got \(2, 1\) and \(1, 6, 1\)"),
    ((STATES, ACTIONS[:, :0]), {}, ValueError, "one or more actions for each state"),
    ((STATES.repeat(1, 2), ACTIONS), {}, ValueError, r"initial_states of shape \.\.\. x 1"),
    ((STATES / 0, ACTIONS), {}, ValueError, "initial_states to be finite"),
    ((STATES, ACTIONS), {"start_noise": "known"}, ValueError, "as .learnt. or a tensor"),
    ((STATES, ACTIONS), {"start_noise": -torch.ones(1)}, ValueError, "start_noise of 0 or"),
    ((STATES, ACTIONS), {"process_noise": STATES[:1, 0] / 0}, ValueError, "process_.*nan_to_num"),
    ((STATES, ACTIONS), {"process_noise": "learnt"}, ValueError, "give noise=smoothed.noise"),
    ((STATES, ACTIONS), {"noise": "learnt"}, ValueError, "noise as True or False or a tensor"),
    ((STATES, ACTIONS), {"state_bounds": torch.ones(2)}, ValueError, "state_bounds of shape 2 x 1"),
]


def test_arguments_out_of_range():
    for arguments, options, error, words in REFUSED:
        refused(error, words, Drift(0.1).free_run, *arguments, **options)
    unfitted = LearnedDynamics(SPEC, lambda X: X[:, :1])
    refused(RuntimeError, "call `update`", unfitted.free_run, STATES, ACTIONS)


@pytest.mark.parametrize("noise", [torch.tensor([0.3]), "learnt"])
def test_process_noise_is_carried_on_and_noise_of_sensors_is_not(noise):
    still, variance = torch.zeros(1, 30, 1).double(), 0.09 * torch.arange(1, 31).double()
    options = {"num_functions": 2000, "process_noise": noise}
    walk = Drift(noise=0.3).free_run(ORIGIN, still, noise=False, **options).particles[:, 0, :, 0]
    torch.testing.assert_close(walk.var(0), variance, rtol=0.15, atol=0)
    sizes = walk.diff(dim=1).std(0)
    torch.testing.assert_close(sizes, torch.full_like(sizes, 0.3), rtol=0.1, atol=0)
    run = Drift(noise=0.3).free_run(ORIGIN, still, noise=torch.tensor([2.0]), **options)
    measured = run.particles[:, 0, :, 0].var(0)
    torch.testing.assert_close(measured, 4 + variance, rtol=0.15, atol=0)


def test_process_noise_leads_out_of_bounds_where_particles_stay():
    for action, sd, limit in ((1.0, 0.01, 2.5), (0.0, 0.5, 1.0)):
        options = {"noise": False, "num_functions": 200, "process_noise": torch.tensor([sd])}
        bounds, actions = torch.tensor([[-limit], [limit]]), torch.full((1, 20, 1), action).double()
        run = Drift().free_run(ORIGIN, actions, state_bounds=bounds, **options)
        assert run.particles.abs().max() <= limit
        assert run.lost[0, -1] > 0.5


def test_lags_have_the_noise_of_their_origins():
    spec = StateSpec(["x", "x_1", "v_1"], ["v"], previous={"x_1": "x", "v_1": "v"})
    start, still = torch.zeros(1, 3).double(), torch.zeros(1, 20, 1).double()
    dynamics = PhysicsDynamics(spec, physics=lambda X: X[:, :1] + X[:, 1:])
    noises = {"process_noise": torch.full((3,), 0.5), "noise": False}
    walk = dynamics.free_run(start, still, **noises).particles
    torch.testing.assert_close(walk[:, :, 1:, 1], walk[:, :, :-1, 0])
    dynamics.noise_variance = lambda x, v: torch.tensor([0.09, 0.0, 0.0]).double().expand_as(x)
    run = dynamics.free_run(start, still[:, :3], num_functions=2000)
    assert run.particles[:, 0, 2].std(0).tolist() == pytest.approx([0.3, 0.3, 0], rel=0.1)


def test_rows_where_the_physics_fails_are_nan_and_inputs_stay():
    def move(states, actions):
        rows = (states[:, 0] < 0).nonzero().flatten().tolist()
        if rows:
            raise PhysicsError("It fails.", rows=rows)
        return states + actions

    for bad in ([2], [0, 3]):
        states = torch.arange(1, 5).double().unsqueeze(-1)
        states[bad] *= -1
        before = states.clone()
        expected = (states + 0.5).where(states > 0, torch.nan)
        found = step_or_nan(move, states, torch.full_like(states, 0.5))
        torch.testing.assert_close(found, expected, equal_nan=True)
        assert states.equal(before)
