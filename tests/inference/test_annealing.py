"""The sampler on densities whose moments are known."""

import pyro.distributions as dist
import pytest
import torch

from gpadjust.inference.importance_sampling import Draws, Mixture, sample


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def gaussian(mean, covariance):
    """The potential of B Gaussians, for means ``B x p`` and covariances ``B x p x p``."""
    normal = torch.distributions.MultivariateNormal(mean, covariance)
    return lambda x: -normal.log_prob(x)


def bimodal(x):
    """Normals at -3 and 3 of weights 0.3 and 0.7, of sd 0.5, in the first of two coordinates."""
    means, weights = torch.tensor([-3.0, 3.0]).to(x), torch.tensor([0.3, 0.7]).to(x)
    first = weights.log() - 0.5 * ((x[..., :1] - means) / 0.5).square()
    return -first.logsumexp(-1) + 0.5 * x[..., 1].square()


def around(centre, sd=1.0, p=2):
    """One t distribution, round."""
    centres = torch.full((1, 1, p), centre, dtype=torch.float64)
    root = sd * torch.eye(p, dtype=torch.float64).unsqueeze(0)
    return Mixture(centres, torch.ones(1, 1, dtype=torch.float64), root)


@pytest.fixture
def gaussians():
    """Two problems in three dimensions, of very different scales and correlations."""
    mean = torch.tensor([[1.0, -2.0, 0.0], [10.0, 0.0, 5.0]], dtype=torch.float64)
    root = torch.tensor([[1.0, 0, 0], [0.9, 0.3, 0], [-0.5, 0.2, 2.0]], dtype=torch.float64)
    covariance = torch.stack([root @ root.mT, 0.01 * root.mT @ root])
    return mean, covariance


def moments(draws):
    weights = draws.weights.unsqueeze(-1)
    mean = (weights * draws.positions).sum(0)
    away = draws.positions - mean
    return mean, torch.einsum("kb,kbi,kbj->bij", draws.weights, away, away)


def test_moments_of_gaussians(gaussians):
    mean, covariance = gaussians
    sd = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    # From a place and a shape that are off.
    proposal = Mixture(
        (mean + sd).unsqueeze(0),
        torch.ones(1, 2, dtype=torch.float64),
        torch.linalg.cholesky(0.5 * covariance),
    )
    draws = sample(gaussian(mean, covariance), proposal, 1536, generator())
    assert draws.positions.shape == (1536, 2, 3)
    assert (draws.power == 1).all()
    found, spread = moments(draws)
    assert ((found - mean) / sd).abs().max() < 0.1
    for i in range(2):
        assert ((spread[i] - covariance[i]) / (sd[i, :, None] * sd[i])).abs().max() < 0.12
    equal = draws.resampled(2000, generator(1))[0]
    assert ((equal.mean(0) - found) / sd).abs().max() < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_weights_of_two_modes_of_which_one_is_known(seed):
    draws = sample(bimodal, around(-3.0, 3.0), 2048, generator(seed))
    right = draws.positions[..., 0] > 0
    assert (draws.weights * right).sum() == pytest.approx(0.7, abs=0.06)
    equal = draws.resampled(1000, generator(seed))[0]
    share = (equal[..., 0] > 0).double().mean()
    assert share == pytest.approx((draws.weights * right).sum().item(), abs=0.02)


def test_it_goes_to_where_the_density_is():
    draws = sample(lambda x: 0.5 * (x - 6).square().sum(-1), around(0.0, 2.0), 1024, generator())
    found, spread = moments(draws)
    assert (found - 6).abs().max() < 0.2
    assert spread.diagonal(dim1=-2, dim2=-1).sub(1).abs().max() < 0.3
    assert (draws.positions[-256:].mean(0) - 6).abs().max() < 0.5


def test_where_the_density_is_zero_no_draw_counts():
    def half_line(x):
        return (0.5 * x.square().sum(-1)).where(x[..., 0] > 0, torch.inf)

    draws = sample(half_line, around(0.5), 1024, generator())
    assert (draws.weights[draws.positions[..., 0] <= 0] == 0).all()
    assert (draws.resampled(100, generator())[0][..., 0] > 0).all()
    assert moments(draws)[0][0, 0] == pytest.approx((2 / torch.pi) ** 0.5, abs=0.06)
    with pytest.raises(FloatingPointError, match="zero at all draws"):
        sample(lambda x: torch.full_like(x[..., 0], torch.inf), around(0.0), 64, generator())


def test_weights_are_tempered_until_enough_draws_count():
    # A density that is far narrower than the few draws from elsewhere; and one that is not.
    draws = sample(lambda x: 5e3 * x.square().sum(-1), around(1.0, p=8), 256, generator())
    assert 0 < draws.power < 1
    assert draws.weights.square().sum().reciprocal() == pytest.approx(64, rel=0.1)
    assert draws.effective_size < 64
    order = draws.positions.square().sum(-1).flatten().argsort()
    likely = draws.weights.flatten()[order]
    assert likely[:64].sum() > 0.5  # the order is still that of the density
    wide = sample(lambda x: 0.1 * x.square().sum(-1), around(0.0, 2.0), 256, generator())
    assert wide.power == 1


def test_the_density_of_a_mixture():
    centres = torch.randn(3, 2, 4, generator=generator(), dtype=torch.float64)
    weights = torch.tensor([[0.2, 0.5], [0.3, 0.1], [0.5, 0.4]], dtype=torch.float64)
    root = torch.randn(2, 4, 4, generator=generator(1), dtype=torch.float64).tril()
    mixture = Mixture(centres, weights, root)
    x = mixture.sample(7, generator(2))
    sign = root.diagonal(dim1=-2, dim2=-1).sign()
    parts = dist.MultivariateStudentT(x.new_tensor(5.0), centres, root * sign.unsqueeze(-2))
    expected = (parts.log_prob(x.unsqueeze(1)) + weights.log()).logsumexp(1)
    actual = mixture.log_density(x)
    torch.testing.assert_close(actual - actual[0], expected - expected[0])
    other = around(0.0, 2.0, 4)
    one = dist.MultivariateStudentT(x.new_tensor(5.0), other.centres[0, 0], other.root[0])
    between = other.log_density(x[:, :1]) - actual[:, :1]
    torch.testing.assert_close(between, one.log_prob(x[:, :1]) - expected[:, :1])


def test_systematic_resampling_keeps_shares():
    weights = torch.tensor([[0.5], [0.25], [0.0], [0.25]], dtype=torch.float64)
    positions = torch.arange(4.0, dtype=torch.float64).reshape(4, 1, 1)
    one = torch.ones(1, dtype=torch.float64)
    draws = Draws(positions, weights.log(), weights, one, one)
    for seed in range(5):
        drawn = draws.resampled(8, generator(seed))[0].flatten()
        assert drawn.long().bincount(minlength=4).tolist() == [4, 2, 0, 2]
