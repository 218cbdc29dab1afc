"""States of records: by a dense Gaussian, and by what was simulated."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal, norm

from gpadjust.dynamics import StateSpec
from gpadjust.physics import FunctionPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, smooth
from gpadjust.records.chain import Chain, Estimate
from gpadjust.records.kalman import (
    Link,
    Moments,
    Smoothed,
    draw_paths,
    expected_squares,
    smooth_chain,
)

STEP, LENGTH = 0.1, 150
SPEC = StateSpec(["x", "v"], ["force"])
TRUE = torch.tensor([2.25, 0.2]).double()  # stiffness and damping
NOISE, SCATTER = torch.tensor([0.02, 0.1]).double(), torch.tensor([0.002, 0.03]).double()


def rates(state, action, p):
    pull = -p["stiffness"] * state[:, 0] - p["damping"] * state[:, 1]
    return torch.stack([state[:, 1], pull + action[:, 0]], dim=-1)


def spring(law=rates, **unknowns):
    priors = {"stiffness": Unknown(1.5, factor=1.5), "damping": Unknown(0.5, factor=2.0)}
    return ODEPhysics(law, step=STEP, state_dim=2, unknowns={**priors, **unknowns})


def simulated(seed, length=LENGTH, scatter=SCATTER):
    """True states of a driven spring, and the actions."""
    generator = torch.Generator().manual_seed(seed)
    actions = torch.randn(length // 10, 1, generator=generator).repeat_interleave(10, 0).double()
    states = [torch.tensor([1.0, 0.0]).double()]
    for action in actions[:-1]:
        following = spring()(torch.cat([states[-1], action]).unsqueeze(0), TRUE)[0]
        states.append(following + scatter * torch.randn(2, generator=generator))
    return torch.stack(states), actions


def measured(states, actions, seed=0, noise=NOISE):
    generator = torch.Generator().manual_seed(seed + 1000)
    errors = noise * torch.randn(states.shape, generator=generator).double()
    return Record(STEP * torch.arange(len(states)).double(), states + errors, actions)


def covered(smoothed, truth=TRUE, level=0.95):
    """Return which parameters are in their intervals."""
    low, high = smoothed.physics_parameters.interval(level)
    return (low <= truth) & (truth <= high)


@pytest.fixture
def chain():
    """Two short stretches of two states and a constant; some of two outputs is not measured."""
    rng = np.random.default_rng(0)
    links = []
    for steps in (3, 2):
        matrices = np.tile(np.eye(3), (steps, 1, 1))
        matrices[:, :2] = rng.normal(size=(steps, 2, 3)) / 2
        offsets = np.concatenate([rng.normal(size=(steps, 2)), np.zeros((steps, 1))], axis=1)
        outputs = rng.normal(size=(steps + 1, 2, 3))
        links.append(Link(matrices, offsets, outputs, rng.normal(size=(steps + 1, 2))))
    links[0].measured[1, 0] = links[1].measured[0] = np.nan
    sizes = [rng.uniform(0.5, 2, size=3) for _ in links]
    starts = [(rng.normal(size=3), np.diag(size)) for size in sizes]
    for _, covariance in starts:
        covariance[0, 1] = covariance[1, 0] = 0.3
    return links, starts, np.array([0.3, 0.1]), np.array([0.2, 0.05])


def dense(links, starts, noise, scatter):
    """The joint distribution of all states given what was measured, by one linear system."""
    mean, roots = [], []  # states by independent standard normal numbers, the constant first
    size = 1 + 2 * sum(len(link.measured) for link in links)
    free, theta = iter(range(1, size)), np.zeros(size)
    theta[0] = math.sqrt(starts[0][1][2, 2])
    for link, (first, spread) in zip(links, starts, strict=True):
        mean.append(np.append(first[:2], starts[0][0][2]))
        roots.append(np.vstack([np.zeros((2, size)), theta]))
        roots[-1][:2, [next(free), next(free)]] = np.linalg.cholesky(spread[:2, :2])
        for matrix, offset in zip(link.matrices, link.offsets, strict=True):
            mean.append(matrix @ mean[-1] + offset)
            roots.append(matrix @ roots[-1])
            roots[-1][[0, 1], [next(free), next(free)]] += np.sqrt(scatter)
    mean, root = np.concatenate(mean), np.concatenate(roots)
    prior = root @ root.T
    values = np.concatenate([link.measured.ravel() for link in links])
    seen = np.flatnonzero(~np.isnan(values))
    outputs = block_diag(*(rows for link in links for rows in link.outputs))[seen]
    spread = outputs @ prior @ outputs.T + np.diag(np.tile(noise, len(mean) // 3)[seen])
    gain = np.linalg.solve(spread, outputs @ prior).T
    off = values[seen] - outputs @ mean
    log_density = multivariate_normal(cov=spread).logpdf(off)
    return mean + gain @ off, prior - gain @ outputs @ prior, log_density


def test_the_smoother_is_the_conditional_distribution_of_all_states(chain):
    """And what the steps add is expected over it."""
    mean, covariance, log_density = dense(*chain)
    smoothed, density = smooth_chain(*chain)
    assert density == pytest.approx(log_density, abs=1e-9)
    row, expected = 0, []
    for link, ((means, covariances), crossed) in zip(chain[0], smoothed, strict=True):
        for t in range(len(means)):
            rows = slice(row, row + 3)
            np.testing.assert_allclose(means[t], mean[rows], atol=1e-8)
            np.testing.assert_allclose(covariances[t], covariance[rows, rows], atol=1e-8)
            if t:
                before = covariance[rows, row - 3 : row]
                np.testing.assert_allclose(crossed[t - 1], before, atol=1e-8)
                both, step = slice(row - 3, row + 3), np.hstack([-link.matrices[t - 1], np.eye(3)])
                added = (step @ mean[both] - link.offsets[t - 1])[:2]
                spread = step @ covariance[both, both] @ step.T
                expected.append(added**2 + np.diag(spread)[:2])
            row += 3
    np.testing.assert_allclose(expected_squares(chain[0], smoothed, 2)[1], expected, atol=1e-8)
    path = np.concatenate(draw_paths(smoothed, 1, np.random.default_rng(0)))
    assert np.ptp(path[:, 2]) == 0  # one constant in all stretches


def test_a_long_chain_is_computed_in_blocks_side_by_side(monkeypatch):
    """A random walk of 2,500 rows, in a few solutions; density and last state by the textbook."""
    rng, noise, scatter = np.random.default_rng(0), 0.5, 0.1
    one, measured = np.ones((2500, 1, 1)), rng.normal(size=(2500, 1)).cumsum(0)
    mean, variance, density = 0.3, 2.0, 0.0
    for y in measured[:, 0]:
        density += norm.logpdf(y, mean, math.sqrt(variance + noise))
        gain = variance / (variance + noise)
        mean, last, variance = mean + gain * (y - mean), gain * noise, gain * noise + scatter
    solutions, solve = [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda *two: solutions.append(1) or solve(*two))
    link, starts = Link(one[1:], 0 * one[1:, 0], one, measured), [(np.array([0.3]), 2 * one[0])]
    (chain,), log_density = smooth_chain([link], starts, np.array([noise]), np.array([scatter]))
    assert len(solutions) < 100
    ends = [log_density, chain.states.means[-1, 0], chain.states.covariances[-1, 0, 0]]
    assert ends == pytest.approx([density, mean, last], rel=1e-12)


@pytest.mark.slow
def test_draws_have_the_moments_and_one_constant(chain):
    mean, covariance, _ = dense(*chain)
    found, rng = smooth_chain(*chain)[0], np.random.default_rng(0)
    draws = [np.concatenate(draw_paths(found, 1, rng)) for _ in range(4000)]
    assert all(np.ptp(path[:, 2]) == 0 for path in draws)
    paths = np.stack([path.ravel() for path in draws])
    np.testing.assert_allclose(paths.mean(0), mean, atol=0.05)
    np.testing.assert_allclose(np.cov(paths.T), covariance, atol=0.06)


@pytest.mark.slow
def test_noise_process_noise_parameters_and_states_are_found():
    """By what is known of the noise: that of the position."""
    runs = [simulated(seed) for seed in range(2)]
    records = Records([measured(*run, seed) for seed, run in enumerate(runs)], SPEC)
    smoothed = smooth(records, spring(), noise=torch.tensor([0.02, math.nan]))
    assert covered(smoothed, level=0.99).all()
    assert smoothed.noise[0] == pytest.approx(0.02)
    torch.testing.assert_close(smoothed.noise, NOISE, rtol=0.25, atol=0)
    assert 0.6 < smoothed.process_noise[1] / SCATTER[1] < 1.5
    rows = zip(runs, smoothed.records, records, smoothed.sd, strict=True)
    for (truth, _), record, raw, sd in rows:
        errors = record.states - truth
        assert (errors.square().mean(0) < 0.4 * (raw.states - truth).square().mean(0)).all()
        assert 0.85 < (errors.abs() < 1.96 * sd).double().mean() <= 1


@pytest.mark.slow
def test_a_hidden_state_and_rows_that_were_not_measured():
    truth, actions = simulated(0)
    record, physics = measured(truth, actions), spring()
    record.states[:, 1] = math.nan
    record.states[20:30, 0] = math.nan
    smoothed = smooth(Records(record, SPEC), physics, start={"v": (0.0, 1.0)}, num_starts=1)
    path = smoothed.records.records[0].states
    assert (path - truth)[:, 1].square().mean().sqrt() < 0.1 * truth[:, 1].std()
    assert smoothed.noise.isnan().tolist() == [False, True]
    assert smoothed.sd[0][25, 0] > 1.5 * smoothed.sd[0][60, 0]
    # What is left of f_p's steps along the states is no more than the process noise.
    rows = torch.cat([path[:-1], actions[:-1]], dim=-1)
    steps = path[1:] - physics(rows, smoothed.physics_parameters.mean)
    assert (steps.square().mean(0).sqrt() < 1.2 * smoothed.process_noise).all()
    assert covered(smoothed, level=0.99).all()


@pytest.mark.slow
def test_angles_may_come_wrapped_and_go_on_over_a_gap():
    """The physics wraps them, too; in the gap the angle goes round, and no parameter varies."""

    def turn(X, p):
        q = X[:, 0] + STEP * X[:, 1]
        speed = X[:, 1] * (1 - STEP * p.drag)
        return torch.stack([torch.atan2(q.sin(), q.cos()), speed], dim=-1)

    physics = FunctionPhysics(turn, unknowns={"drag": Unknown(0.02, factor=1.5)})
    spec = StateSpec(["q", "dq"], ["u"], angles=["q"])
    times, generator = STEP * torch.arange(80).double(), torch.Generator().manual_seed(0)
    still, runs = torch.zeros(80, 1).double(), []
    for speed in (12.0, 13.0):
        speeds = speed * (1 - STEP * 0.02) ** torch.arange(80).double()
        angles = torch.cat([torch.zeros(1).double(), STEP * speeds[:-1].cumsum(0)])
        runs.append(torch.stack([angles, speeds], dim=-1))
    noisy = [run + 0.01 * torch.randn(run.shape, generator=generator) for run in runs]
    paths = []
    for is_wrapped in (False, True):
        records = []
        for states in noisy:
            states = states.clone()
            if is_wrapped:
                states[:, 0] = torch.atan2(states[:, 0].sin(), states[:, 0].cos())
            states[30:37] = math.nan
            records.append(Record(times, states, still))
        smoothed = smooth(Records(records, spec), physics)
        assert smoothed.process_noise[0] < 0.02
        assert smoothed.variation < 0.1
        paths.append(torch.stack([record.states for record in smoothed.records]))
    torch.testing.assert_close(paths[0][..., 0], torch.stack(runs)[..., 0], atol=0.1, rtol=0)
    torch.testing.assert_close(*paths)


@pytest.mark.slow
def test_a_model_learns_from_draws_segment_by_segment():
    record = measured(*simulated(0))
    labels = [0] * 70 + [1] * 79 + [2]
    parts = Record(record.times, record.states, record.actions, labels, "spring")
    with pytest.warns(UserWarning, match="1 of 3 stretches, shorter than a step"):
        smoothed = smooth(Records(parts, SPEC), spring())
    assert [record.name for record in smoothed.records] == ["spring", "spring"]
    transitions = [smoothed.draw(seed).trajectories() for seed in (0, 0, 1)]
    assert len(transitions[0].states) == 69 + 78
    assert torch.equal(transitions[0].states, transitions[1].states)
    assert not torch.equal(transitions[0].states, transitions[2].states)

    def scatter(data):
        rows = torch.cat([data.states, data.actions], dim=-1)
        return (data.next_states - spring()(rows, TRUE)).std(0)

    drawn, likely = scatter(transitions[0]), scatter(smoothed.records.trajectories())
    torch.testing.assert_close(drawn[1], smoothed.process_noise[1], rtol=0.25, atol=0)
    assert likely[1] < 0.8 * drawn[1]


@pytest.mark.slow
def test_a_state_that_one_record_lacks_starts_about_where_it_is_in_others():
    level = torch.tensor([0.0, 300.0])  # far from zero
    runs = [simulated(seed) for seed in range(2)]
    records = [measured(states + level, forces, i) for i, (states, forces) in enumerate(runs)]
    records[1].states[:, 1] = math.nan
    physics = spring(lambda state, action, p: rates(state - level, action, p))
    smoothed = smooth(Records(records, SPEC), physics)
    error = smoothed.records.records[1].states[:, 1] - (runs[1][0] + level)[:, 1]
    assert error.square().mean().sqrt() < 0.15
    assert smoothed.process_noise[1] < 0.1


@pytest.mark.slow
def test_earlier_outputs_are_those_of_the_smoothed_states():
    spec = StateSpec(["x", "v", "x_1"], ["force"], previous={"x_1": "x"})
    record = measured(*simulated(0))
    lagged = torch.cat([record.states, torch.full((LENGTH, 1), math.nan).double()], dim=-1)
    smoothed = smooth(Records(Record(record.times, lagged, record.actions), spec), spring())
    states = smoothed.records.records[0].states
    assert torch.equal(states[1:, 2], states[:-1, 0])
    assert smoothed.noise[2] == smoothed.process_noise[2] == 0


@pytest.mark.slow
def test_a_step_that_goes_where_the_physics_fails_is_taken_in_part():
    def fragile(state, action, p):
        fails = (p["stiffness"] > 2.6) | (p["stiffness"] < 1.2)
        return torch.where(fails.unsqueeze(-1), math.nan, rates(state, action, p))

    physics = spring(fragile, stiffness=Unknown(1.3, factor=1.5))
    smoothed = smooth(Records(measured(*simulated(0)), SPEC), physics)
    assert smoothed.physics_parameters.mean[0] == pytest.approx(float(TRUE[0]), rel=0.05)


def test_a_path_that_explains_less_is_taken_in_part_or_not_at_all():
    records, unknown = Records(measured(*simulated(0)), SPEC), np.full((2, 2), math.nan)
    chain = Chain(spring(), records, unknown, unknown)
    path, noises = chain.first_path(np.zeros(2)), np.tile(NOISE.numpy() ** 2, (2, 1))
    before = chain.cost(path, noises)
    for size, some in ((0.3, True), (1e6, False)):
        away = size * chain.spread * np.random.default_rng(0).standard_normal(path.states.shape)
        means = np.concatenate([path.states + away, np.zeros((LENGTH, 2))], axis=1)
        found = Smoothed(Moments(means, np.zeros((LENGTH, 4, 4))), np.zeros((LENGTH - 1, 4, 4)))
        taken, share = chain.towards(path, Estimate([found], means, noises, 0.0))
        assert chain.cost(taken, noises) <= before + 0.02
        assert share < 1
        assert (share > 0) == (taken is not path)
        assert (taken is path) or some


@pytest.mark.slow
def test_small_process_noise_fits_free_runs_from_several_starts():
    """Of a spring that is too stiff by a priori factors, and only seen every fifth time."""
    record = measured(*simulated(3, scatter=torch.zeros(2)))
    record.states[:, 1] = math.nan
    record.states[torch.arange(LENGTH) % 5 > 0, 0] = math.nan
    records, physics = Records(record, SPEC), spring(stiffness=Unknown(12.0, factor=3.0))
    small = torch.tensor([1e-3, 1e-3])
    options = {"start": {"v": (0.0, 1.0)}, "process_noise": small}
    one, several = (smooth(records, physics, num_starts=k, **options) for k in (1, 4))
    assert several.log_density >= one.log_density - 0.1
    torch.testing.assert_close(several.physics_parameters.mean, TRUE, rtol=0.1, atol=0)
    torch.testing.assert_close(several.process_noise, small.double())


@pytest.mark.slow
def test_intervals_of_parameters_hold_as_often_as_they_say():
    shares = []
    for seed in range(40):
        run = simulated(seed, length=100)
        smoothed = smooth(Records(measured(*run, seed), SPEC), spring())
        shares.append(covered(smoothed).double().mean())
    assert 0.88 <= sum(shares) / 40 <= 1


def pendulum_log(seed, rows=499, step=0.01, noise=0.005):
    """Log of a pendulum, its angle alone, of mass 0.5 kg and little damping."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(rng.uniform(-1, 1, (rows // 25 + 1, 1)), 25, 0)[:rows]
    physics = swinging({"mass": Unknown(0.5, sd=1.0), "damping": Unknown(0.02, sd=1.0)})
    state, states = torch.tensor([*rng.uniform(-3, 3, 1), 0.0]).double(), []
    for u in torch.from_numpy(torque):
        states.append(state)
        (state,) = physics(torch.cat([state, u]).unsqueeze(0), torch.tensor([0.5, 0.02]).double())
    states = torch.stack(states)
    states[:, 0] += noise * torch.from_numpy(rng.normal(size=rows))
    states[:, 1] = math.nan
    times = step * torch.arange(rows).double()
    return Records(Record(times, states, torch.from_numpy(torque)), StateSpec(["q", "w"], ["u"]))


def swinging(unknowns):
    def rates(state, action, p):
        angle, rate = state.unbind(-1)
        torque = action[:, 0] - 0.5 * 9.81 * p.mass * angle.sin() - p.damping * rate
        return torch.stack([rate, torque / (0.25 * p.mass)], dim=-1)

    return ODEPhysics(rates, step=0.01, state_dim=2, substeps=2, unknowns=unknowns)


@pytest.mark.slow
def test_noise_of_the_sensor_is_not_taken_for_process_noise():
    """One of six starts ends where process noise of the angle explains all that is measured."""
    unknowns = {"mass": Unknown(0.3, factor=2.0), "damping": Unknown(0.2, factor=3.0)}
    records, physics = pendulum_log(1000), swinging(unknowns)
    smoothed = smooth(records, physics, start={"w": (0.0, 5.0)}, num_starts=6)
    assert smoothed.noise[0] == pytest.approx(0.005, rel=0.15)
    assert smoothed.process_noise[0] < 1e-4
    assert covered(smoothed, torch.tensor([0.5, 0.02]), 0.999).all()


def test_a_right_physics_settles_in_few_rounds_and_progress_never_goes_back(monkeypatch):
    """Where process noise is none, expectation maximisation would creep for 100 rounds."""
    ticked = [0]  # positions of a bar of progress

    def tick(unit, to=None):
        ticked.append(ticked[-1] + 1 if to is None else to)

    monkeypatch.setattr("gpadjust.records.smoothing.tick", tick)
    records = pendulum_log(0, rows=200)
    unknowns = {"mass": Unknown(0.4, factor=1.5), "damping": Unknown(0.03, factor=2.0)}
    smoothed = smooth(records, swinging(unknowns), start={"w": (0.0, 5.0)}, num_starts=2)
    assert smoothed.process_noise[0] < 1e-4
    assert ticked == sorted(ticked)
    assert ticked[2] == 1
    assert max(position for position in ticked if position < 100) < 60
