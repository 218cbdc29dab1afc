"""The sampler on densities whose moments are known."""

import pytest
import torch

from gpadjust import CKA
from gpadjust.inference.full_bayes import potential_of
from gpadjust.inference.hmc import hmc
from gpadjust.inference.map_fit import Search, maximise
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def gaussian(mean, covariance):
    """The potential of B Gaussians, for means ``B x p`` and covariances ``B x p x p``."""
    precision = torch.linalg.inv(covariance)

    def potential(x):
        pull = (precision @ (x - mean).unsqueeze(-1)).squeeze(-1)
        return 0.5 * ((x - mean) * pull).sum(-1), pull

    return potential


def bimodal(x):
    """Normals at -3 and 3 of weights 0.3 and 0.7, of sd 0.5, in the first of two coordinates."""
    leaf = x.detach().requires_grad_()
    means = torch.tensor([-3.0, 3.0], dtype=x.dtype)
    weights = torch.tensor([0.3, 0.7], dtype=x.dtype)
    first = weights.log() - 0.5 * ((leaf[..., :1] - means) / 0.5).square()
    value = -first.logsumexp(-1) + 0.5 * leaf[..., 1].square()
    (gradient,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach(), gradient


@pytest.fixture
def gaussians():
    """Two problems in three dimensions, of very different scales and correlations."""
    mean = torch.tensor([[1.0, -2.0, 0.0], [10.0, 0.0, 5.0]], dtype=torch.float64)
    root = torch.tensor([[1.0, 0, 0], [0.9, 0.3, 0], [-0.5, 0.2, 2.0]], dtype=torch.float64)
    covariance = torch.stack([root @ root.mT, 0.01 * root.mT @ root])
    return mean, covariance


def test_moments_of_gaussians(gaussians):
    mean, covariance = gaussians
    start = mean + torch.randn(16, 2, 3, generator=generator(), dtype=torch.float64)
    draws = hmc(gaussian(mean, covariance), start, 100, 300, generator())
    assert draws.positions.shape == (300, 16, 2, 3)
    assert draws.acceptance.shape == (2,)
    assert (draws.acceptance > 0.6).all()
    flat = draws.positions.flatten(0, 1)
    sd = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((flat.mean(0) - mean) / sd).abs().max() < 0.1
    for i in range(2):
        relative = (flat[:, i].mT.cov() - covariance[i]) / (sd[i, :, None] * sd[i])
        assert relative.abs().max() < 0.12


def test_a_centre_and_a_root_that_are_given_keep_the_moments(gaussians):
    mean, covariance = gaussians
    root, sd = torch.linalg.cholesky(1.5 * covariance), covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    white = torch.randn(16, 2, 3, 1, generator=generator(), dtype=torch.float64)
    start = mean + (torch.linalg.cholesky(covariance) @ white).squeeze(-1)
    potential = gaussian(mean, covariance)
    draws = hmc(potential, start, 0, 400, generator(), centre=mean + 0.5 * sd, root=root)
    flat = draws.positions.flatten(0, 1)
    assert ((flat.mean(0) - mean) / sd).abs().max() < 0.1
    assert (flat.std(0) / sd - 1).abs().max() < 0.05
    torch.testing.assert_close(draws.values, potential(flat)[0].reshape(400, 16, 2))


@pytest.mark.parametrize("seed", [0, 1])
def test_weights_of_two_modes(seed):
    start = 3 * torch.randn(16, 1, 2, generator=generator(seed), dtype=torch.float64)
    draws = hmc(bimodal, start, 100, 500, generator(seed))
    right = draws.positions[..., 0] > 0
    assert right.double().mean() == pytest.approx(0.7, abs=0.06)
    assert draws.positions[..., 0][right].mean() == pytest.approx(3, abs=0.1)
    assert draws.positions[..., 1].std() == pytest.approx(1, abs=0.1)


def test_infinite_potentials_are_never_accepted():
    def half_line(x):
        value = 0.5 * x.square().sum(-1)
        return torch.where(x[..., 0] > 0, value, torch.inf), x

    start = torch.rand(8, 1, 2, generator=generator(), dtype=torch.float64)
    positions = hmc(half_line, start, 40, 200, generator()).positions
    assert (positions[..., 0] > 0).all()
    assert positions[..., 0].mean() == pytest.approx((2 / torch.pi) ** 0.5, abs=0.08)


class TestBadStarts:
    @pytest.fixture(scope="class")
    def objective(self):
        """That of the README's ten lines, at its optimum, where the noise is at its bound."""
        X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        model = CKA(X, 2 * (6 * X).sin() + X, physics=lambda X: (6 * X).sin())
        register_priors(model)
        objective = Objective(model, marginal=True, of_logs=True)
        maximise(objective, Search())
        return objective

    @pytest.mark.parametrize("where", ["at the bound", "below the bound", "around the bound"])
    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_all_chains_move(self, objective, where, seed):
        parameters = objective.parameters
        noise = parameters.noise > 0
        start = parameters.current().expand(16, -1, -1)
        start = start + 0.3 * torch.randn(start.shape, generator=generator(seed))
        offset = {"at the bound": 0.0, "below the bound": -0.3}.get(where)
        if offset is None:
            offset = 3 * torch.randn(16, 1, 1, generator=generator(seed))
        start = torch.where(noise, parameters.lower + offset, start)
        potential = potential_of(objective)
        if where == "below the bound":
            assert potential(start)[0].isinf().all()
        positions = hmc(potential, start, 40, 1, generator(seed)).positions
        moved = (positions[-1] != start).any(-1)
        assert int(moved.sum()) == 16
        assert parameters.is_allowed(positions[-1]).all()
