"""Scores of trajectories: windows of episodes, particles that follow their actions, and figures."""

import math

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.dynamics.plots import plot_trajectory_scores
from gpadjust.dynamics.trajectory_scores import energy_score
from gpadjust.models import Prediction
from gpadjust.physics import PhysicsError
from gpadjust.validation import crps

mpl.use("Agg")
SPEC = StateSpec(["x"], ["v"])


class Drift(Dynamics):
    """A state that moves by its action and a rate, N(bias, sd^2), that is each function's own."""

    is_fitted = True

    def __init__(self, sd, bias=0.0, noise=0.0, spec=SPEC):
        super().__init__(spec)
        self.sd, self.bias, self.noise = sd, bias, noise

    def predict(self, states, actions):
        mean = states + actions + self.bias
        return Prediction(mean, torch.full_like(mean, self.sd**2 + self.noise**2))

    def sample(self, states, actions):
        raise NotImplementedError

    def sample_functions(self, num_functions, seed=None):
        generator = torch.Generator().manual_seed(seed)
        rate = torch.randn(num_functions, 1, 1, generator=generator, dtype=torch.float64)
        return lambda states, actions: states + actions + self.bias + self.sd * rate

    def noise_variance(self, states, actions):
        return torch.full_like(states, self.noise**2)

    def update(self, states, actions, next_states):
        raise NotImplementedError

    describe = state_dict = load_state_dict = update


def episodes(uniform, *lengths, rate=0.0, noise=0.0):
    """Episodes of a point that moves by its action and a rate, measured with noise, joined."""
    parts = []
    for seed, length in enumerate(lengths):
        actions = uniform(length, 1, low=-1, seed=seed)
        path = torch.cat([torch.full((1, 1), 10.0 * seed), actions + rate]).cumsum(0)
        path = path + noise * uniform(length + 1, 1, low=-(3**0.5), high=3**0.5, seed=seed + 99)
        parts.append((path[:-1], actions, path[1:]))
    return [torch.cat(columns) for columns in zip(*parts, strict=True)]


def test_a_perfect_model_has_no_energy(cart_pole_system):
    system = cart_pole_system
    data = system.trial(0, num_steps=20)
    scores = PhysicsDynamics(system.spec, system.truth).score_trajectories(*data)
    assert scores.horizons == (1, 5, 15)
    assert scores.states == system.spec.states
    assert scores.num_windows.tolist() == [20, 16, 6]
    assert scores.energy.max() < 1e-9
    assert scores.rmse.max() < 1e-9
    assert scores.nlpd.isnan().all()
    assert scores.coverage.isnan().all()
    assert not scores.lost.any()


def test_without_doubt_the_energy_is_the_distance(uniform):
    data = episodes(uniform, 9, rate=0.3)
    scores = Drift(0.0).score_trajectories(*data, horizons=(2, 4), units=torch.tensor([0.1]))
    torch.testing.assert_close(scores.rmse[:, 0], torch.tensor([0.6, 1.2]).double())
    torch.testing.assert_close(scores.energy, torch.tensor([6.0, 12.0]).double())


def test_one_step_is_that_of_the_predictions(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude)
    dynamics.update(*system.trial(0))
    data = system.trial(1)
    one = dynamics.score(*data)
    dynamics.num_features = 64  # which will do; fewer functions leave 0.2 of the error to chance
    many = dynamics.score_trajectories(*data, horizons=[1], num_functions=800, max_windows=None)
    assert many.num_windows.tolist() == [25]
    torch.testing.assert_close(many.nlpd[0], one.nlpd, rtol=0.2, atol=0.2)
    torch.testing.assert_close(many.coverage[0], one.coverage, rtol=0, atol=0.13)
    torch.testing.assert_close(many.rmse[0], one.rmse, rtol=0.1, atol=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_each_particle_keeps_its_function_and_noise_comes_once(uniform, noise):
    """After k steps a rate of its own has moved a particle by k rates: sd^2 k^2, plus noise."""
    states, actions, following = episodes(uniform, 12)
    steps, sd = (1, 4, 8), 0.2
    dynamics = Drift(sd, noise=noise)
    options = {"num_functions": 799, "max_windows": 4, "units": torch.ones(1)}
    scores = dynamics.score_trajectories(states, actions, following, horizons=steps, **options)
    zero = torch.zeros(1, 1, dtype=torch.float64)
    for i, k in enumerate(steps):
        variance = zero + (sd * k) ** 2 + noise**2
        expected = 0.5 * (2 * math.pi * variance).log()
        assert scores.nlpd[i].item() == pytest.approx(expected.item(), abs=0.08)
        gaussian = crps(zero, variance, zero)  # the energy score of one state
        assert scores.energy[i].item() == pytest.approx(gaussian.item(), rel=0.1)


@pytest.mark.parametrize(
    "num_functions", [39, *(pytest.param(n, marks=pytest.mark.slow) for n in (50, 79))]
)
def test_the_coverage_of_a_calibrated_model_is_nominal(uniform, num_functions):
    """The rate of each of many seeds is one more draw of the rates of its functions."""
    rates = 0.1 * torch.randn(200, dtype=torch.float64)
    inside = []
    for seed, rate in enumerate(rates.tolist()):
        data = episodes(uniform, 3, rate=rate)
        options = {"horizons": (3,), "num_functions": num_functions, "seed": seed}
        inside.append(Drift(0.1).score_trajectories(*data, **options).coverage.item())
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_the_ends_of_the_interval_are_draws(uniform):
    data = episodes(uniform, 3)
    options = {"horizons": (3,), "num_functions": 39, "seed": 5}
    generator = torch.Generator().manual_seed(5)
    rates = torch.randn(39, 1, 1, generator=generator, dtype=torch.float64)
    for rate, inside in ((rates.min(), True), (rates.max(), True), (rates.max() + 0.01, False)):
        # The true rate is zero, and that of the functions is moved to where it is the extreme.
        dynamics = Drift(1.0, bias=-float(rate) + (1e-9 if rate == rates.max() else -1e-9))
        assert dynamics.score_trajectories(*data, **options).coverage.item() == inside


def test_the_energy_score_is_a_mean_over_pairs(uniform):
    sample, y = uniform(5, 3, 2), uniform(3, 2, seed=1)
    expected = []
    for w in range(3):
        error = np.mean([math.dist(x, y[w]) for x in sample[:, w].tolist()])
        pairs = [math.dist(a, b) for a in sample[:, w].tolist() for b in sample[:, w].tolist()]
        expected.append(error - sum(pairs) / (2 * 5 * 4))
    assert energy_score(sample, y).item() == pytest.approx(np.mean(expected))
    y[1, 0] = torch.nan
    assert energy_score(sample, y).item() == pytest.approx(np.mean(expected[::2]))


def test_windows_do_not_cross_the_ends_of_episodes(uniform):
    data = episodes(uniform, 6, 3, 8)
    score = Drift(0.1).score_trajectories
    assert score(*data, horizons=(1, 4, 8, 9)).num_windows.tolist() == [17, 8, 1, 0]
    rest = [t[[0, 1, 2, 4, 5]] for t in data]  # a row that is left out ends one, too
    assert score(*rest, horizons=(2, 3, 4)).num_windows.tolist() == [3, 1, 0]
    # Sensors of single precision.
    rounded = [t.float().double() for t in data]
    assert score(*rounded, horizons=(8,)).num_windows.tolist() == [1]


def test_episodes_that_are_too_short_are_not_scored(uniform):
    scores = Drift(0.1).score_trajectories(*episodes(uniform, 4, 2), horizons=(3, 5))
    assert scores.num_windows.tolist() == [2, 0]
    for values in (scores.nlpd, scores.coverage, scores.rmse, scores.energy, scores.lost):
        assert values[0].isfinite().all()
        assert values[1].isnan().all()


def test_windows_are_evenly_spread(uniform):
    states, actions, following = episodes(uniform, 21)
    following[-1] += 1.0  # which is the end of the last windows only
    scores = Drift(0.0).score_trajectories(
        states, actions, following, horizons=(1, 5), max_windows=3
    )
    assert scores.num_windows.tolist() == [3, 3]
    torch.testing.assert_close(scores.rmse[:, 0], torch.full((2,), (1 / 3) ** 0.5).double())


def test_angles_are_compared_the_shortest_way_round(uniform):
    spec = StateSpec(["x"], ["v"], angles=["x"])
    states, actions, following = episodes(uniform, 12)
    plain = Drift(0.2, bias=0.1, spec=spec).score_trajectories(states, actions, following)
    wrapped = [torch.atan2(t.sin(), t.cos()) for t in (states + 3, following + 3)]
    turned = Drift(0.2, bias=0.1, spec=spec).score_trajectories(wrapped[0], actions, wrapped[1])
    for one, other in zip(plain[2:], turned[2:], strict=True):
        torch.testing.assert_close(one, other, equal_nan=True)


def test_particles_that_went_round_meet_again(uniform):
    """Functions that end whole turns apart say the same."""

    class Turns(Drift):
        def sample_functions(self, num_functions, seed=None):
            turns = 2 * math.pi * torch.arange(num_functions).double().reshape(-1, 1, 1)
            inner = super().sample_functions(num_functions, seed)
            return lambda states, actions: inner(states, actions) + turns

    spec = StateSpec(["x"], ["v"], angles=["x"])
    data = episodes(uniform, 5)
    plain, turned = (kind(0.1, spec=spec).score_trajectories(*data) for kind in (Drift, Turns))
    torch.testing.assert_close(plain.nlpd, turned.nlpd, equal_nan=True)
    torch.testing.assert_close(plain.energy, turned.energy, equal_nan=True)


def test_what_does_not_move_is_not_scored(uniform):
    spec = StateSpec(["target", "x", "last"], ["v"], exogenous=["target"], previous={"last": "v"})
    x, v, following = episodes(uniform, 6)
    last = torch.cat([torch.zeros(1, 1), v])
    target = torch.ones_like(x)
    data = torch.cat([target, x, last[:-1]], -1), v, torch.cat([target, following, last[1:]], -1)
    dynamics = PhysicsDynamics(spec, lambda X: X[:, :1] + X[:, 1:] + 0.1)
    scores = dynamics.score_trajectories(*data, horizons=(1, 4))
    assert scores.states == ("x",)
    torch.testing.assert_close(scores.rmse, torch.tensor([[0.1], [0.4]]).double())


def test_states_that_are_integrated_share_the_noise_of_their_velocities(uniform):
    spec = StateSpec(["q", "v"], ["u"], integrated={"q": "v"}, step=0.5)
    states, actions = uniform(12, 2), uniform(12, 1, seed=1)
    v = states[:, 1:] + actions + 0.1 * uniform(12, 1, low=-1, seed=2)
    following = torch.cat([states[:, :1] + 0.25 * (states[:, 1:] + v), v], -1)
    dynamics = LearnedDynamics(spec, lambda X: torch.cat([X[:, :1], X[:, 1:2] + X[:, 2:]], -1))
    dynamics.update(states, actions, following)
    variance = dynamics.noise_variance(states, actions)
    noisy = dynamics.predict(states, actions).variance
    quiet = dynamics.predict(states, actions, observation_noise=False).variance
    torch.testing.assert_close(variance, noisy - quiet)
    torch.testing.assert_close(variance[:, 0], variance[:, 1] / 16)
    scores = dynamics.score_trajectories(states, actions, following, horizons=(1,))
    # In units of the noise the pair is a line, whose energy score is that of v, sqrt(1 + 1) longer.
    units = torch.tensor([0.25, 1.0])
    options = {"horizons": (1,), "num_functions": 199}
    both = dynamics.score_trajectories(states, actions, following, units=units, **options).energy
    units[0] = 1e9
    alone = dynamics.score_trajectories(states, actions, following, units=units, **options).energy
    assert (both / alone).item() == pytest.approx(2**0.5, rel=0.02)
    assert scores.coverage.shape == (1, 2)


def test_entries_that_were_not_measured(uniform):
    states, actions, following = episodes(uniform, 9)
    dynamics, options = Drift(0.1, bias=0.2), {"horizons": (2,), "max_windows": None}
    whole = dynamics.score_trajectories(states, actions, following, **options)
    spec = StateSpec(["x", "y"], ["v"])
    states, following = states.repeat(1, 2), following.repeat(1, 2)
    following[4:, 1] = torch.nan
    holed = Drift(0.1, bias=0.2, spec=spec).score_trajectories(
        states, actions, following, **options
    )
    assert holed.num_windows.tolist() == [8]
    torch.testing.assert_close(holed.rmse[0, 0], whole.rmse[0, 0])
    torch.testing.assert_close(holed.nlpd[0], whole.nlpd[0].expand(2))
    assert holed.energy.isfinite()


@pytest.mark.parametrize("how", ["bounds", "infinite", "error"])
def test_lost_particles_stay_where_they_were(uniform, how):
    """Of a runaway physics particles come to 1 or 2, and no further."""

    def runs(X):
        following = X[:, :1] + 1
        beyond = {"bounds": 9.0, "infinite": torch.inf, "error": torch.nan}  # PhysicsError
        return following.where(following < 2.5, beyond[how])

    x, v = torch.zeros(5, 1, dtype=torch.float64), torch.zeros(5, 1, dtype=torch.float64)
    dynamics = PhysicsDynamics(SPEC, runs)
    bounds = torch.tensor([[-5.0], [5.0]]) if how == "bounds" else None
    if how == "infinite":
        dynamics.sample_functions = lambda n, seed: lambda s, a: runs(s.flatten(0, 1)).view_as(s)
    scores = dynamics.score_trajectories(x, v, x, horizons=(1, 2, 3, 5), state_bounds=bounds)
    assert scores.lost.tolist() == [0, 0, 1, 1]
    assert scores.rmse.flatten().tolist() == [1, 2, 2, 2]


def test_windows_where_the_noise_is_unknown_are_left_out(uniform):
    class Fails(Drift):
        def noise_variance(self, states, actions):
            rows = (states[:, 0] == bad).nonzero().flatten().tolist()
            if rows:
                raise PhysicsError("It fails.", rows=rows)
            return super().noise_variance(states, actions)

    data, options = episodes(uniform, 9, noise=0.1), {"horizons": (1,), "max_windows": None}
    bad, rest = data[0][-1, 0], [t[:-1] for t in data]
    options["units"] = torch.ones(1)
    expected = Drift(0.1, noise=0.1).score_trajectories(*rest, **options)
    found = Fails(0.1, noise=0.1).score_trajectories(*data, **options)
    assert found.num_windows.tolist() == [8]
    torch.testing.assert_close(found[2:], expected[2:])


def test_scores_are_the_same_again_and_draw_from_no_generator(uniform):
    class Careless(Drift):
        def sample_functions(self, num_functions, seed=None):
            return super().sample_functions(num_functions, int(torch.randint(99, ())))

    data = episodes(uniform, 9)
    before = torch.get_rng_state()
    one, other = (Careless(0.1, noise=0.1).score_trajectories(*data) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    for value, again in zip(one[2:], other[2:], strict=True):
        torch.testing.assert_close(value, again, rtol=0, atol=0, equal_nan=True)
    changed = Careless(0.1, noise=0.1).score_trajectories(*data, seed=1)
    assert (changed.energy != one.energy)[:2].all()


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"horizons": ()}, ValueError, "different numbers of steps"),
        ({"horizons": 5}, ValueError, r"such as \(1, 5, 15\), got 5"),
        ({"horizons": (5, 5)}, ValueError, "different numbers"),
        ({"horizons": (0, 5)}, ValueError, "each horizon must be at least 1; found 0"),
        ({"horizons": (1.5,)}, TypeError, r"whole number; found 1\.5"),
        ({"num_functions": 38}, ValueError, "num_functions >= 39, .*got 38"),
        ({"max_windows": 0}, ValueError, "max_windows must be at least 1"),
        ({"units": torch.zeros(1)}, ValueError, "finite and positive"),
        ({"units": torch.ones(2)}, ValueError, "Expected units of shape 1, an entry for each"),
        ({"units": "metres"}, TypeError, "Expected units as a tensor of numbers"),
        ({"state_bounds": torch.ones(2)}, ValueError, "state_bounds of shape 2 x 1"),
    ],
)
def test_options_out_of_range(uniform, options, error, says):
    with pytest.raises(error, match=says):
        Drift(0.1).score_trajectories(*episodes(uniform, 5), **options)


def test_data_are_checked_and_learnt_first(uniform):
    states, actions, following = episodes(uniform, 5)
    with pytest.raises(ValueError, match="as many rows"):
        Drift(0.1).score_trajectories(states, actions[1:], following)
    with pytest.raises(RuntimeError, match="call `update`"):
        LearnedDynamics(SPEC, lambda X: X[:, :1]).score_trajectories(states, actions, following)


def test_horizons_come_in_order(uniform):
    scores = Drift(0.0, bias=0.1).score_trajectories(*episodes(uniform, 9), horizons=[5, 1])
    assert scores.horizons == (1, 5)
    torch.testing.assert_close(scores.rmse, torch.tensor([[0.1], [0.5]]).double())


def test_the_figure_shows_coverage_and_energy(uniform):
    spec = StateSpec(["x", "y"], ["v"])
    states, actions, following = (t.repeat(1, 2) for t in episodes(uniform, 9))
    scores = Drift(0.1, bias=0.1, spec=spec).score_trajectories(
        states, actions[:, :1], following, horizons=(1, 4, 20)
    )
    axes = plot_trajectory_scores(scores)
    lines = {line.get_label(): line for line in axes[0].lines}
    assert lines.keys() >= {"x", "y"}
    np.testing.assert_allclose(lines["y"].get_xdata(), [1, 4])
    assert axes[1].get_ylim()[1] > 1.05 * scores.energy[:2].max()
    np.testing.assert_allclose(lines["y"].get_ydata(), scores.coverage[:2, 1])
    np.testing.assert_allclose(axes[1].lines[0].get_ydata(), scores.energy[:2])
    silent = Drift(0.0, spec=spec).score_trajectories(states, actions[:, :1], following)
    assert "x" not in {line.get_label() for line in plot_trajectory_scores(silent)[0].lines}
    with pytest.raises(TypeError, match="got Drift; pass `dynamics"):
        plot_trajectory_scores(Drift(0.1))
    with pytest.raises(ValueError, match="any of the horizons"):
        plot_trajectory_scores(scores._replace(num_windows=0 * scores.num_windows))
    plt.close("all")
