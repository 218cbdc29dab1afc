"""The sampler on densities whose moments and integrals are known."""

import math

import pyro.distributions as dist
import pytest
import torch

from gpadjust.inference.annealing import Particles, raised, resampled, sample
from gpadjust.inference.proposals import Both, Mixture, Normal

DRAWS, PARTICLES, GRADIENTS = 512, 256, 64 * 256


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


class Potential:
    """Negative log densities of B problems, by a function of ``k x B x p``; it counts gradients."""

    def __init__(self, function):
        self.function, self.num_gradients = function, 0

    def __call__(self, vectors):
        return self.function(vectors)

    def value_and_gradient(self, vectors):
        self.num_gradients += len(vectors)
        leaf = vectors.clone().requires_grad_()
        value = self.function(leaf)
        finite = value.where(value.isfinite(), torch.zeros_like(value))
        (gradient,) = torch.autograd.grad(finite.sum(), leaf)
        return value.detach(), gradient


def gaussian(mean, precision, constant=0.0):
    """Of Gaussians without their factors, for means ``B x p`` and precisions ``B x p x p``."""

    def function(x):
        away = (x - mean).unsqueeze(-1)
        return 0.5 * (away.mT @ precision @ away).squeeze((-1, -2)) - constant

    return Potential(function)


def standard(x):
    return 0.5 * x.square().sum(-1)


def around(center, sd=1.0, p=2, problems=1):
    """One t distribution for each problem, round."""
    centers = torch.full((1, problems, p), float(center), dtype=torch.float64)
    root = (sd * torch.eye(p, dtype=torch.float64)).expand(1, problems, p, p)
    return Mixture(centers, torch.ones_like(centers[..., 0]), root)


def draw(density, proposal, num_gradients=GRADIENTS, seed=0):
    density = density if isinstance(density, Potential) else Potential(density)
    return sample(density, proposal, DRAWS, PARTICLES, num_gradients, generator(seed))


def is_one_on_average(ratios):
    """Whether estimates of the same number agree with it, by four standard errors."""
    return abs(ratios.mean() - 1) < 4 * ratios.std() / math.sqrt(len(ratios))


@pytest.fixture
def gaussians():
    """Means, covariances and roots of two problems of very different scales and correlations."""
    mean = torch.tensor([[1.0, -2.0, 0.0], [10.0, 0.0, 5.0]], dtype=torch.float64)
    root = torch.tensor([[1.0, 0, 0], [0.9, 0.3, 0], [-0.5, 0.2, 2.0]], dtype=torch.float64)
    covariance = torch.stack([root @ root.mT, 0.01 * root.mT @ root])
    return mean, covariance, covariance.diagonal(dim1=-2, dim2=-1).sqrt()


class TestMoments:
    @pytest.mark.parametrize("is_off", [False, True], ids=["alike", "off"])
    def test_of_gaussians_of_several_problems(self, gaussians, is_off):
        mean, covariance, sd = gaussians
        root = torch.linalg.cholesky(covariance)
        center = mean
        if is_off:  # in place and in shape, of one problem more than of the other
            center = mean + torch.tensor([[1.0], [4.0]]) * sd
            root = torch.diag_embed(sd * torch.tensor([[2.0], [0.4]]))
        proposal = Mixture(center[None], torch.ones(1, 2, dtype=torch.float64), root[None])
        found = draw(gaussian(mean, torch.linalg.inv(covariance)), proposal)
        assert found.positions.shape == (2 * PARTICLES, 2, 3)
        assert found.log_ratio.shape == (2 * PARTICLES, 2)
        assert (found.power == 1).all()
        error = (found.positions.mean(0) - mean) / sd
        assert error.abs().max() < 4 / math.sqrt(PARTICLES)
        for i in range(2):
            size = sd[i, :, None] * sd[i]
            error = (found.positions[:, i].mT.cov() - covariance[i]) / size
            expected = (1 + (covariance[i] / size).square()).sqrt() / math.sqrt(PARTICLES)
            assert (error.abs() < 4 * expected).all()

    def test_all_in_all_of_many_problems(self):
        found = draw(standard, around(0.0, problems=100))
        x = found.positions.flatten()
        assert x.mean().abs() < 4 / math.sqrt(len(x))
        assert (x.var() - 1).abs() < 4 * math.sqrt(2 / len(x))
        assert (x.pow(4).mean() - 3).abs() < 4 * math.sqrt(96 / len(x))

    def test_of_a_narrow_ridge(self):
        p, rest = 8, 1e-3
        covariance = (1 - rest) * torch.ones(p, p) + rest * torch.eye(p)
        precision = torch.linalg.inv(covariance.double())
        found = draw(gaussian(torch.zeros(1, p), precision), around(0.0, p=p))
        assert found.power == 1
        along = found.positions.mean(-1)
        across = found.positions - along.unsqueeze(-1)
        assert along.mean().abs() < 4 / math.sqrt(PARTICLES)
        assert (along.var() - 1).abs() < 4 * math.sqrt(2 / PARTICLES)
        ratio = across.square().sum(-1).mean() / (rest * (p - 1))
        assert (ratio - 1).abs() < 4 * math.sqrt(2 / (PARTICLES * (p - 1)))


def test_shares_of_two_modes():
    # Normals at -3 and 3 of weights 0.3 and 0.7, in the first of two coordinates; the proposal is
    # wide around one of them. Of so many problems, which are alike.
    def two(x):
        modes = (x[..., :1] - torch.tensor([-3.0, 3.0])) / 0.5
        first = torch.tensor([0.3, 0.7]).log() - 0.5 * modes.square()
        return -first.logsumexp(-1) + 0.5 * x[..., 1].square()

    found = draw(two, around(-3.0, 3.0, problems=30))
    share = (found.positions[..., 0] > 0).double().mean(0)
    assert share.mean() == pytest.approx(0.7, abs=0.04)
    assert share.std() < 0.12
    assert (found.positions[..., 0].abs() - 3).abs().max() < 5 * 0.5


class TestEvidence:
    def test_of_gaussians_of_several_problems(self, gaussians):
        mean, covariance, sd = (each.repeat(20, *[1] * (each.dim() - 1)) for each in gaussians)
        constant = torch.tensor([-40.0, 1000.0], dtype=torch.float64).repeat(20)
        root = torch.diag_embed(1.5 * sd).unsqueeze(0)
        proposal = Mixture((mean + 0.5 * sd)[None], torch.ones_like(constant)[None], root)
        found = draw(gaussian(mean, torch.linalg.inv(covariance), constant), proposal)
        expected = constant + 0.5 * torch.logdet(2 * math.pi * covariance)
        ratios = (found.log_evidence - expected).exp().unflatten(0, (20, 2))
        for i in range(2):
            assert is_one_on_average(ratios[:, i])
            assert ratios[:, i].std() < 0.5

    def test_where_half_of_it_is_zero_and_far_from_the_proposal(self):
        # A half space, and a normal three standard deviations away.
        def function(x):
            first = standard(x).where(x[..., 0] > 0, math.inf)
            return first.where(torch.arange(60) < 30, standard(x - 4))

        found = draw(function, around(0.5, problems=60))
        half, far = found.log_evidence.unflatten(0, (2, 30))
        assert is_one_on_average((half - math.log(math.pi)).exp())
        assert (far - math.log(2 * math.pi)).mean().abs() < 0.3

    def test_of_the_density_that_was_reached(self):
        proposal, narrow = around(1.0, p=1, problems=20), 1e-3
        steps = torch.linspace(-1, 1, 20_001, dtype=torch.float64).pow(3) * 10
        x = steps[:, None, None]
        log_t = -around(1.0, p=1).value_and_gradient(x)[0]
        for num_gradients in (0, 6 * PARTICLES):  # no move, and one
            density = Potential(lambda x: standard(x / narrow))
            found = draw(density, proposal, num_gradients)
            assert ((found.power > 0) & (found.power < 1)).all()
            log_reached = (1 - found.power) * log_t - found.power * standard(x / narrow)
            expected = torch.trapezoid(log_reached.exp(), steps, dim=0).log()
            assert is_one_on_average((found.log_evidence - expected).exp())


class TestZeroDensity:
    def test_no_particle_is_there_and_everywhere_is_an_error(self):
        def half_line(x):
            return standard(x).where(x[..., 0] > 0, math.inf)

        for num_gradients in (0, GRADIENTS):
            found = draw(half_line, around(0.5), num_gradients)
            assert (found.positions[..., 0] > 0).all()
            assert found.log_ratio.isfinite().all()
            sd = math.sqrt(1 - 2 / math.pi)
            error = found.positions[..., 0].mean() - math.sqrt(2 / math.pi)
            # Without moves a fourth of them counts, at least.
            assert abs(error) < 4 * sd / math.sqrt(PARTICLES / (1 if num_gradients else 4))

        def of_the_second(x):
            return standard(x).where(torch.arange(x.shape[1]) == 0, math.inf)

        with pytest.raises(FloatingPointError, match="zero at all draws"):
            draw(of_the_second, around(0.0, problems=2))

    def test_but_for_a_slab_that_few_draws_meet(self):
        def slab(x):
            return standard(x).where(x[..., 0].abs() < 0.05, math.inf)

        found = draw(slab, around(0.0, problems=30))
        assert (found.power == 1).all()
        assert (found.positions[..., 0].abs() < 0.05).all()
        sd = found.positions[..., 0].std()  # all but uniform
        assert sd == pytest.approx(0.05 / math.sqrt(3), rel=0.05)
        expected = math.log(2 * math.pi * math.erf(0.05 / math.sqrt(2)))
        assert is_one_on_average((found.log_evidence - expected).exp())


class TestFewGradients:
    def test_particles_are_of_the_tempered_density(self):
        # Of the proposal's density to the power 1 - a and the target's to the power a.
        proposal, narrow = around(1.0, p=1, problems=20), 1e-3
        density = Potential(lambda x: standard(x / narrow))
        found = draw(density, proposal, num_gradients=0)
        assert density.num_gradients == 0
        assert found.positions.shape == (PARTICLES, 20, 1)
        assert ((found.power > 0) & (found.power < 1)).all()
        x = torch.linspace(-1, 1, 20_001, dtype=torch.float64)[:, None]
        log_t = -around(1.0, p=1).value_and_gradient(x[..., None])[0]
        weight = ((1 - found.power) * log_t - found.power * standard(x[..., None] / narrow)).exp()
        square, mean = (
            (x**k * weight).sum(0) / weight.sum(0) / (narrow**k / found.power ** (k / 2))
            for k in (2, 1)
        )
        scaled = found.positions.squeeze(-1) * found.power.sqrt() / narrow
        for values, expected in ((scaled, mean), (scaled.square(), square)):
            error = values.mean(0) - expected
            assert error.mean().abs() < 4 * error.std() / math.sqrt(20)
        found = draw(lambda x: standard(x / 1.5), around(0.0, 2.0), num_gradients=0)
        assert found.power == 1

    @pytest.mark.parametrize("each", [0, 5, 6, 11, 40])
    def test_no_more_are_asked_for(self, each):
        density = Potential(lambda x: standard(x / 1e-2))
        found = draw(density, around(1.0), each * PARTICLES)
        assert density.num_gradients <= each * PARTICLES
        assert (found.power < 1) == (each < 40)


class TestMixture:
    @pytest.fixture
    def mixture(self):
        """Three components of two problems in four dimensions, each with a root of its own."""
        centers = torch.randn(3, 2, 4, generator=generator(), dtype=torch.float64)
        weights = torch.tensor([[0.2, 0.5], [0.3, 0.1], [0.5, 0.4]], dtype=torch.float64)
        root = torch.randn(3, 2, 4, 4, generator=generator(1), dtype=torch.float64).tril()
        return Mixture(centers, weights, root)

    def test_density_gradient_and_moments(self, mixture):
        sign = mixture.root.diagonal(dim1=-2, dim2=-1).sign()
        root = mixture.root * sign.unsqueeze(-2)
        parts = dist.MultivariateStudentT(root.new_tensor(5.0), mixture.centers, root)
        x = mixture.sample(7, generator(2)).requires_grad_()
        expected = -(parts.log_prob(x.unsqueeze(1)) + mixture.weights.log()).logsumexp(1)
        value, gradient = mixture.value_and_gradient(x.detach())
        torch.testing.assert_close(value, expected.detach())
        torch.testing.assert_close(gradient, torch.autograd.grad(expected.sum(), x)[0])
        number = 20_000
        x = mixture.sample(number, generator())
        assert x.shape == (number, 2, 4)
        weights = mixture.weights[..., None]
        mean = (weights * mixture.centers).sum(0)
        away = mixture.centers - mean
        covariance = 5 / 3 * mixture.root @ mixture.root.mT + away[..., None] * away[..., None, :]
        covariance = (weights[..., None] * covariance).sum(0)
        sd = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert ((x.mean(0) - mean) / sd).abs().max() < 4 / math.sqrt(number)
        for i in range(2):
            error = (x[:, i].mT.cov() - covariance[i]) / (sd[i, :, None] * sd[i])
            assert error.abs().max() < 4 * math.sqrt(8 / number)  # of a t of five degrees

    def test_one_component_is_a_t(self):
        x = around(0.0, p=1).sample(4000, generator()).flatten().sort().values
        inside = dist.StudentT(5.0).log_prob(x).exp()
        below = torch.cat([torch.zeros(1), torch.cumulative_trapezoid(inside, x)])
        off = below - below[-1] * torch.linspace(0, 1, 4000)
        assert off.abs().max() < 1.95 / math.sqrt(4000)  # Kolmogorov and Smirnov, one in thousand

    def test_its_first_center_is_among_the_draws(self):
        # The only place where there is any density.
        def point(x):
            return standard(x).where((x == 3.0).all(-1), math.inf)

        found = draw(point, around(3.0), num_gradients=0)
        assert (found.positions[0::2] == 3.0).all()


class TestResampling:
    def test_shares_are_kept_in_each_half(self):
        weights = torch.rand(10, 3, generator=generator(), dtype=torch.float64)
        weights[[2, 3, 8], [0, 1, 2]] = 0.0
        weights = weights / weights.sum(0)
        halves = weights.unflatten(0, (5, 2))  # even rows, odd rows
        expected = 20 * halves / halves.sum(0)
        for seed in range(10):
            rows = resampled(weights, 40, generator(seed))
            assert rows.shape == (40, 3)
            assert (rows[0::2] % 2 == 0).all()
            assert (rows[1::2] % 2 == 1).all()
            count = torch.stack([(rows == i).sum(0) for i in range(10)]).unflatten(0, (5, 2))
            assert ((count >= expected.floor()) & (count <= expected.ceil())).all()
            assert (count[halves == 0] == 0).all()
        weights = torch.tensor([[0.25], [0.3], [0.125], [0.0], [0.125], [0.2]]).double()
        count = resampled(weights, 20, generator()).flatten().bincount(minlength=6).tolist()
        assert count in ([5, 6, 2, 0, 3, 4], [5, 6, 3, 0, 2, 4])  # whole numbers are met


class TestPower:
    def test_so_many_draws_count(self):
        log_ratio = 30 * torch.randn(400, 3, generator=generator(), dtype=torch.float64)
        log_ratio[:, 2] /= 100  # of which all count
        log_ratio[5, 0] = -math.inf
        power = torch.tensor([0.0, 0.01, 0.7], dtype=torch.float64)
        reached, weights, log_mean = raised(log_ratio, power, 100.0)
        assert (reached[:2] < 1).all()
        assert (reached[:2] > power[:2]).all()
        assert reached[2] == 1.0
        size = weights.square().sum(0).reciprocal()
        assert (size >= 100 - 1e-9).all()
        assert (size[:2] < 101).all()  # no less than they could be
        ratio = ((reached - power) * log_ratio).exp()
        torch.testing.assert_close(weights, ratio / ratio.sum(0))
        torch.testing.assert_close(log_mean, ratio.mean(0).log())
        one = torch.ones(1, dtype=torch.float64)  # once it is one, all is done
        reached, weights, log_mean = raised(1e3 * log_ratio[:8, 1:2], one, 4.0)
        assert reached == 1.0
        assert (weights == 1 / 8).all()
        assert log_mean == pytest.approx(0.0, abs=1e-12)


class TestHalves:
    def test_each_comes_from_its_own_draws(self):
        proposal = around(0.0)
        drawn = proposal.sample(DRAWS, generator())
        drawn[0] = 0.0
        found = draw(lambda x: standard((x - 1) / 0.3), proposal, num_gradients=0)
        same = (found.positions[:, None, 0] == drawn[None, :, 0]).all(-1)  # N x draws
        assert same.any(1).all()
        assert not same[0::2, 1::2].any()
        assert not same[1::2, 0::2].any()
        found = draw(lambda x: standard(x - 1), around(0.0, 0.7, problems=100))
        means = torch.stack([found.positions[i::2].mean(0).flatten() for i in range(2)])
        assert means.corrcoef()[0, 1].abs() < 4 / math.sqrt(200)

    def test_how_many_draws_count(self):
        def size(positions):
            nothing = torch.zeros(2, dtype=torch.float64)
            return Particles(positions, positions[..., 0], nothing, nothing).effective_size()

        x = torch.randn(256, 2, 400, generator=generator(), dtype=torch.float64)
        # 256 over the mean of 400 squares of normal numbers.
        assert (size(x) > 256 / (1 + 4 * math.sqrt(2 / 400))).all()
        assert (size(x) <= 256).all()
        x[0::2, 1] += 2.0  # two standard deviations apart: four times the variance of the mean
        few = size(x)
        assert few[0] > 200
        assert few[1] == pytest.approx(2.0, rel=0.1)


def test_the_generator_decides():
    first, second, third = (
        draw(lambda x: standard(x - 1), around(0.0, problems=2), seed=seed) for seed in (3, 3, 4)
    )
    for ours, theirs in zip(first, second, strict=True):
        assert torch.equal(ours, theirs)
    assert not torch.equal(first.positions, third.positions)


class TestProposals:
    @pytest.fixture
    def parts(self):
        options = {"generator": generator(), "dtype": torch.float64}
        normal = Normal(torch.randn(2, 3, **options), 0.5 + torch.rand(2, 3, **options))
        return normal, around(1.0, 0.7, p=3, problems=2)

    def test_density_gradient_and_draws(self, parts):
        x = torch.randn(7, 2, 3, generator=generator(1), dtype=torch.float64).requires_grad_()
        normal = dist.Normal(parts[0].mean, parts[0].sd).log_prob(x).sum(-1)
        torch.testing.assert_close(parts[0].value_and_gradient(x.detach())[0], -normal.detach())
        wide = -parts[1].value_and_gradient(x)[0]
        expected = (0.5 * normal.exp() + 0.5 * wide.exp()).log()
        value, gradient = Both(*parts).value_and_gradient(x.detach())
        torch.testing.assert_close(value, -expected.detach())
        torch.testing.assert_close(gradient, -torch.autograd.grad(expected.sum(), x)[0])
        far = Normal(parts[0].mean + 100, parts[0].sd)
        x = Both(far, parts[1]).sample(200, generator())
        assert x.shape == (200, 2, 3)
        is_far = (x > 50).all(-1)
        assert (is_far.sum(0) == 100).all()
        for half in (is_far[0::2], is_far[1::2]):  # and by turns of both
            assert (half.sum(0) > 30).all()

    def test_of_what_one_of_them_would_miss(self, parts):
        density = Potential(lambda x: standard((x - 8) / 0.05))
        wide = Normal(torch.zeros(20, 2).double(), torch.ones(20, 2).double())
        found = draw(density, Both(wide, around(8.0, 0.1, problems=20)))
        assert (found.power == 1).all()
        expected = math.log(2 * math.pi * 0.05**2)
        assert is_one_on_average((found.log_evidence - expected).exp())


def test_it_ends_where_no_more_can_be_reached():
    def count(enough):
        density = Potential(lambda x: standard((x - 4) / 0.1))
        enough = None if enough is None else torch.tensor([enough], dtype=torch.float64)
        args = (DRAWS, PARTICLES, GRADIENTS, generator())
        found = sample(density, around(0.0), *args, enough)
        return density.num_gradients, found.power

    whole, power = count(None)
    assert power == 1
    assert count(-1e3) == (whole, power)  # it may be as much
    few, power = count(1e3)
    assert few < whole
    assert power < 1
