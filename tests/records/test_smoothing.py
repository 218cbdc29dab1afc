"""States of records: by a dense Gaussian, and by what was simulated."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag

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
STIFFNESS, DAMPING = 2.25, 0.2
NOISE, SCATTER = torch.tensor([0.02, 0.1]).double(), torch.tensor([0.002, 0.03]).double()


def rates(state, action, p):
    pull = -p["stiffness"] * state[:, 0] - p["damping"] * state[:, 1]
    return torch.stack([state[:, 1], pull + action[:, 0]], dim=-1)


def spring(**given):
    unknowns = {"stiffness": Unknown(1.5, factor=1.5), "damping": Unknown(0.5, factor=2.0)}
    return ODEPhysics(rates, step=STEP, state_dim=2, unknowns=unknowns, **given)


def simulated(seed, length=LENGTH, scatter=SCATTER):
    """True states of a driven spring, and the actions."""
    generator = torch.Generator().manual_seed(seed)
    physics, truth = spring(), torch.tensor([STIFFNESS, DAMPING]).double()
    actions = torch.randn(length // 10, 1, generator=generator).repeat_interleave(10, 0).double()
    states = [torch.tensor([1.0, 0.0]).double()]
    for action in actions[:-1]:
        following = physics(torch.cat([states[-1], action]).unsqueeze(0), truth)[0]
        states.append(following + scatter * torch.randn(2, generator=generator))
    return torch.stack(states), actions


def measured(states, actions, seed=0, noise=NOISE):
    generator = torch.Generator().manual_seed(seed + 1000)
    errors = noise * torch.randn(states.shape, generator=generator).double()
    return Record(STEP * torch.arange(len(states)).double(), states + errors, actions)


def inside(truth, interval):
    low, high = interval
    return bool(((low <= truth) & (truth <= high)).all())


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
    rows = [3 * sum(len(link.measured) for link in links[:i]) for i in range(len(links) + 1)]
    mean, shape = np.zeros(rows[-1]), (rows[-1], rows[-1])
    root = np.zeros((rows[-1], 1 + 2 * rows[-1]))  # states by independent standard normal ones
    constant = np.zeros(root.shape[1])
    constant[0] = math.sqrt(starts[0][1][2, 2])
    free = iter(range(1, root.shape[1]))
    for row, link, (first, spread) in zip(rows, links, starts, strict=False):
        mean[row : row + 3] = [*first[:2], starts[0][0][2]]
        own = [next(free) for _ in range(2)]
        root[row : row + 2, own] = np.linalg.cholesky(spread[:2, :2])
        root[row + 2] = constant
        for t, matrix in enumerate(link.matrices):
            here, there = slice(row + 3 * t, row + 3 * t + 3), row + 3 * t + 3
            mean[there : there + 3] = matrix @ mean[here] + link.offsets[t]
            root[there : there + 3] = matrix @ root[here]
            for i in range(2):
                root[there + i, next(free)] += math.sqrt(scatter[i])
    prior = root @ root.T
    assert prior.shape == shape
    values = np.concatenate([link.measured.ravel() for link in links])
    seen = np.flatnonzero(~np.isnan(values))
    outputs = block_diag(*(each for link in links for each in link.outputs))[seen]
    errors = np.tile(noise, rows[-1] // 3)[seen]
    spread = outputs @ prior @ outputs.T + np.diag(errors)
    gain = np.linalg.solve(spread, outputs @ prior).T
    off = values[seen] - outputs @ mean
    normal = torch.distributions.MultivariateNormal(torch.zeros(len(seen)).double(),
                                                    torch.from_numpy(spread))  # fmt: skip
    log_density = float(normal.log_prob(torch.tensor(off)))
    return mean + gain @ off, prior - gain @ outputs @ prior, log_density


def test_the_smoother_is_the_conditional_distribution_of_all_states(chain):
    mean, covariance, log_density = dense(*chain)
    found, density = smooth_chain(*chain)
    assert density == pytest.approx(log_density, abs=1e-9)
    row = 0
    for (means, covariances), crossed in found:
        for t in range(len(means)):
            own = slice(row, row + 3)
            np.testing.assert_allclose(means[t], mean[own], atol=1e-8)
            np.testing.assert_allclose(covariances[t], covariance[own, own], atol=1e-8)
            if t:
                before = covariance[own, row - 3 : row]
                np.testing.assert_allclose(crossed[t - 1], before, atol=1e-8)
            row += 3
    path = np.concatenate(draw_paths(found, 1, np.random.default_rng(0)))
    assert np.ptp(path[:, 2]) == 0


def test_what_steps_add_is_expected_over_all_states(chain):
    mean, covariance, _ = dense(*chain)
    links, expected, row = chain[0], [], 0
    for link in links:
        for matrix, offset in zip(link.matrices, link.offsets, strict=True):
            both, step = slice(row, row + 6), np.hstack([-matrix, np.eye(3)])[:2]
            added = step @ mean[both] - offset[:2]
            expected.append(added**2 + np.diag(step @ covariance[both, both] @ step.T))
            row += 3
        row += 3
    _, found = expected_squares(links, smooth_chain(*chain)[0], 2)
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_a_long_chain_is_computed_in_blocks_side_by_side(monkeypatch):
    """A random walk of 2,500 rows: density and last state by the textbook, in a few solutions."""
    rng = np.random.default_rng(0)
    rows, noise, scatter = 2500, np.array([0.5]), np.array([0.1])
    one = np.ones((rows, 1, 1))
    measured = rng.normal(size=(rows, 1)).cumsum(0)
    link = Link(one[1:], np.zeros((rows - 1, 1)), one, measured)
    mean, variance, density = 0.3, 2.0, 0.0
    for y in measured[:, 0]:
        error, total = y - mean, variance + noise[0]
        density -= 0.5 * (error**2 / total + math.log(2 * math.pi * total))
        mean += variance / total * error
        last, variance = variance * noise[0] / total, variance * noise[0] / total + scatter[0]
    solutions, solve = [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda *two: solutions.append(1) or solve(*two))
    (found,), log_density = smooth_chain([link], [(np.array([0.3]), 2 * one[0])], noise, scatter)
    assert log_density == pytest.approx(density, rel=1e-12)
    assert found.states.means[-1, 0] == pytest.approx(mean, rel=1e-12)
    assert found.states.covariances[-1, 0, 0] == pytest.approx(last, rel=1e-12)
    assert len(solutions) < 100


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
    runs = [simulated(seed) for seed in range(2)]
    records = Records([measured(*run, seed) for seed, run in enumerate(runs)], SPEC)
    found = smooth(records, spring())
    assert inside(torch.tensor([STIFFNESS, DAMPING]), found.physics_parameters.interval(0.99))
    torch.testing.assert_close(found.noise, NOISE, rtol=0.25, atol=0)
    assert 0.6 < found.process_noise[1] / SCATTER[1] < 1.5
    for (truth, _), record, seen, sd in zip(
        runs, found.records.records, records.records, found.sd, strict=True
    ):
        errors = record.states - truth
        assert (errors.square().mean(0) < 0.4 * (seen.states - truth).square().mean(0)).all()
        assert 0.85 < (errors.abs() < 1.96 * sd).double().mean() <= 1


@pytest.mark.slow
def test_parameters_are_not_biased_by_noise_in_the_inputs():
    """Single steps from noisy states find less decay in more noise; free runs do not."""
    decay = FunctionPhysics(lambda X, p: p.a * X[:, 0] + X[:, 1],
                            unknowns={"a": Unknown(0.5, sd=0.5)})  # fmt: skip
    spec, generator = StateSpec(["x"], ["u"]), torch.Generator().manual_seed(0)
    actions = torch.randn(400, 1, generator=generator).double()
    states = [torch.zeros(1).double()]
    for action in actions[:-1]:
        states.append(0.9 * states[-1] + action)
    states = torch.stack(states)
    noisy = states + 1.5 * torch.randn(states.shape, generator=generator)
    records = Records(Record(torch.arange(400.0).double(), noisy, actions), spec)
    before, u, after = records.trajectories()
    by_steps = float(before.mT @ (after - u) / before.square().sum())
    found = smooth(records, decay)
    assert by_steps < 0.75
    assert found.physics_parameters.mean == pytest.approx(0.9, abs=0.02)
    assert float(found.noise) == pytest.approx(1.5, rel=0.1)


@pytest.mark.slow
def test_a_hidden_state_and_rows_that_were_not_measured():
    truth, actions = simulated(0)
    states = measured(truth, actions).states
    states[:, 1] = math.nan
    states[20:30, 0] = math.nan
    record = Record(STEP * torch.arange(LENGTH).double(), states, actions)
    physics = spring()
    found = smooth(Records(record, SPEC), physics, start={"v": (0.0, 1.0)}, num_starts=1)
    velocities = found.records.records[0].states[:, 1]
    assert (velocities - truth[:, 1]).square().mean().sqrt() < 0.1 * truth[:, 1].std()
    assert found.noise.isnan().tolist() == [False, True]
    assert found.sd[0][25, 0] > 1.5 * found.sd[0][60, 0]
    # What is left of f_p's steps along the states is no more than the process noise.
    path = found.records.records[0].states
    rows = torch.cat([path[:-1], actions[:-1]], dim=-1)
    steps = path[1:] - physics(rows, found.physics_parameters.mean)
    assert (steps.square().mean(0).sqrt() < 1.2 * found.process_noise).all()
    assert inside(torch.tensor([STIFFNESS, DAMPING]), found.physics_parameters.interval(0.99))


@pytest.mark.slow
def test_what_is_known_of_the_errors_is_kept():
    truth, actions = simulated(0)
    noise = torch.tensor([0.02, math.nan])
    found = smooth(Records(measured(truth, actions), SPEC), spring(), noise=noise)
    assert found.noise[0] == pytest.approx(0.02)
    assert found.noise[1] == pytest.approx(0.1, rel=0.25)


@pytest.mark.slow
def test_angles_may_come_wrapped_and_go_on_over_a_gap():
    """The physics wraps them, too; in the gap the angle goes round."""

    def turn(X):
        q = X[:, 0] + STEP * X[:, 1]
        return torch.stack([torch.atan2(q.sin(), q.cos()), X[:, 1] + STEP * X[:, 2]], dim=-1)

    spec = StateSpec(["q", "dq"], ["u"], angles=["q"])
    times = STEP * torch.arange(80).double()
    generator = torch.Generator().manual_seed(0)
    turned = torch.stack([12 * times, torch.full_like(times, 12.0)], dim=-1)
    turned += 0.01 * torch.randn(turned.shape, generator=generator)
    turned[30:37] = math.nan
    wrapped = turned.clone()
    wrapped[:, 0] = torch.atan2(turned[:, 0].sin(), turned[:, 0].cos())
    still, paths = torch.zeros(80, 1).double(), []
    for states in (turned, wrapped):
        found = smooth(Records(Record(times, states, still), spec), turn)
        assert found.process_noise[0] < 0.02
        paths.append(found.records.records[0].states)
    torch.testing.assert_close(paths[0][:, 0], 12 * times, atol=0.1, rtol=0)
    torch.testing.assert_close(*paths)


@pytest.mark.slow
def test_a_model_learns_from_draws_segment_by_segment():
    truth, actions = simulated(0)
    record = measured(truth, actions)
    labels = [0] * 70 + [1] * 79 + [2]
    parts = Record(record.times, record.states, record.actions, labels, "spring")
    with pytest.warns(UserWarning, match="1 of 3 stretches, shorter than a step"):
        found = smooth(Records(parts, SPEC), spring())
    assert [record.name for record in found.records] == ["spring", "spring"]
    transitions = [found.draw(seed).trajectories() for seed in (0, 0, 1)]
    assert len(transitions[0].states) == 69 + 78
    assert torch.equal(transitions[0].states, transitions[1].states)
    assert not torch.equal(transitions[0].states, transitions[2].states)
    known = torch.tensor([STIFFNESS, DAMPING]).double()

    def scatter(data):
        rows = torch.cat([data.states, data.actions], dim=-1)
        return (data.next_states - spring()(rows, known)).std(0)

    drawn, likely = scatter(transitions[0]), scatter(found.records.trajectories())
    torch.testing.assert_close(drawn[1], found.process_noise[1], rtol=0.25, atol=0)
    assert likely[1] < 0.8 * drawn[1]


@pytest.mark.slow
def test_a_state_that_one_record_lacks_starts_about_where_it_is_in_others():
    truth, actions = simulated(0)
    level = torch.tensor([0.0, 300.0])  # far from zero

    def shifted(state, action, p):
        return rates(state - level, action, p)

    physics = ODEPhysics(shifted, step=STEP, state_dim=2, unknowns=dict(spring().unknowns))
    other = simulated(1)
    records = [measured(truth + level, actions), measured(other[0] + level, other[1], seed=1)]
    records[1].states[:, 1] = math.nan
    found = smooth(Records(records, SPEC), physics)
    error = found.records.records[1].states[:, 1] - (other[0] + level)[:, 1]
    assert error.square().mean().sqrt() < 0.15
    assert found.process_noise[1] < 0.1


@pytest.mark.slow
def test_earlier_outputs_are_those_of_the_smoothed_states():
    truth, actions = simulated(0)
    spec = StateSpec(["x", "v", "x_1"], ["force"], previous={"x_1": "x"})
    record = measured(truth, actions)
    lagged = torch.cat([record.states, torch.full((LENGTH, 1), math.nan).double()], dim=-1)
    found = smooth(Records(Record(record.times, lagged, actions), spec), spring())
    states, noise = found.records.records[0].states, found.noise
    assert torch.equal(states[1:, 2], states[:-1, 0])
    assert noise[2] == found.process_noise[2] == 0


@pytest.mark.slow
def test_a_step_that_goes_where_the_physics_fails_is_taken_in_part():
    truth, actions = simulated(0)

    def fragile(state, action, p):
        fails = (p["stiffness"] > 2.6) | (p["stiffness"] < 1.2)
        return torch.where(fails.unsqueeze(-1), math.nan, rates(state, action, p))

    unknowns = {"stiffness": Unknown(1.3, factor=1.5), "damping": Unknown(0.5, factor=2.0)}
    physics = ODEPhysics(fragile, step=STEP, state_dim=2, unknowns=unknowns)
    found = smooth(Records(measured(truth, actions), SPEC), physics)
    assert found.physics_parameters.mean[0] == pytest.approx(STIFFNESS, rel=0.05)


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
    truth, actions = simulated(3, scatter=torch.zeros(2))
    states = measured(truth, actions).states
    states[:, 1] = math.nan
    states[torch.arange(LENGTH) % 5 > 0, 0] = math.nan
    record = Record(STEP * torch.arange(LENGTH).double(), states, actions)
    unknowns = {"stiffness": Unknown(12.0, factor=3.0), "damping": Unknown(0.5, factor=2.0)}
    physics = ODEPhysics(rates, step=STEP, state_dim=2, unknowns=unknowns)
    small, start = torch.tensor([1e-3, 1e-3]), {"v": (0.0, 1.0)}
    given = {"start": start, "process_noise": small}
    one, several = (smooth(Records(record, SPEC), physics, num_starts=k, **given) for k in (1, 4))
    assert several.log_density >= one.log_density - 0.1
    found = several.physics_parameters.mean
    torch.testing.assert_close(found, torch.tensor([STIFFNESS, DAMPING]).double(), rtol=0.1, atol=0)
    torch.testing.assert_close(several.process_noise, small.double())


@pytest.mark.slow
def test_intervals_of_parameters_hold_as_often_as_they_say():
    truth, held = torch.tensor([STIFFNESS, DAMPING]), 0
    for seed in range(40):
        run = simulated(seed, length=100)
        found = smooth(Records(measured(*run, seed), SPEC), spring())
        low, high = found.physics_parameters.interval()
        held += int(((low <= truth) & (truth <= high)).sum())
    assert 0.88 <= held / 80 <= 1


def pendulum_log(seed, rows=499, step=0.01, noise=0.005):
    """Log of a pendulum, its angle alone, of mass 0.5 kg and little damping."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(rng.uniform(-1, 1, (rows // 25 + 1, 1)), 25, 0)[:rows]
    physics = swinging({"mass": Unknown(0.5, sd=1.0), "damping": Unknown(0.02, sd=1.0)})
    row = torch.tensor([[*rng.uniform(-3, 3, 1), 0.0, 0.0]]).double()
    states = []
    for u in torch.from_numpy(torque):
        row[0, 2] = u
        states.append(row[0, :2].clone())
        row[:, :2] = physics(row, torch.tensor([0.5, 0.02]).double())
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
@pytest.mark.parametrize("seed", [1000, 1001])
def test_noise_of_the_sensor_is_not_taken_for_process_noise(seed):
    """One of six starts ends where process noise of the angle explains all that is measured."""
    unknowns = {"mass": Unknown(0.3, factor=2.0), "damping": Unknown(0.2, factor=3.0)}
    records, physics = pendulum_log(seed), swinging(unknowns)
    found = smooth(records, physics, start={"w": (0.0, 5.0)}, num_starts=6)
    assert found.noise[0] == pytest.approx(0.005, rel=0.15)
    assert found.process_noise[0] < 1e-4
    assert inside(torch.tensor([0.5, 0.02]), found.physics_parameters.interval(0.999))


@pytest.fixture
def ticked(monkeypatch):
    """Positions of a bar of progress."""
    import gpadjust.records.smoothing as smoothing

    positions = []

    def tick(unit, to=None):
        positions.append((positions[-1] if positions else 0) + 1 if to is None else to)

    monkeypatch.setattr(smoothing, "tick", tick)
    return positions


def test_a_right_physics_settles_in_few_rounds_and_progress_never_goes_back(ticked):
    """Where process noise is none, expectation maximisation would creep for 100 rounds."""
    records = pendulum_log(0, rows=200)
    unknowns = {"mass": Unknown(0.4, factor=1.5), "damping": Unknown(0.03, factor=2.0)}
    found = smooth(records, swinging(unknowns), start={"w": (0.0, 5.0)}, num_starts=2)
    assert found.process_noise[0] < 1e-4
    assert ticked == sorted(ticked)
    assert ticked[1] == 1
    assert max(position for position in ticked if position < 100) < 60
