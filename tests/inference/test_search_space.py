"""Coordinates of the search: a change of variables, with bounds that hold the start."""

import math

import pytest
import torch
from gpytorch.constraints import GreaterThan, Interval
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import LogNormalPrior
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust import CKA, RRA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.gp import LogInterval
from gpadjust.inference.objective import Objective
from gpadjust.inference.search_space import SearchSpace

QUICK = {"num_screened": 16, "num_starts": 2}


def crude(X):
    return 2 + (3 * X).sin()


def with_prior(X, Y):
    base = RBFKernel(batch_shape=torch.Size([2]), lengthscale_prior=LogNormalPrior(0.0, 1.0))
    kernel = ScaleKernel(base, batch_shape=torch.Size([2])).double()
    return CKA(X, Y, physics=crude, delta_covar_module=kernel)


BUILD = {
    "CKA": lambda X, Y: CKA(X, Y, physics=crude),
    "PhysicsMeanGP": lambda X, Y: PhysicsMeanGP(X, Y, physics=crude),
    "ZeroMeanGP": ZeroMeanGP,
    "learnt means": lambda X, Y: CKA(
        X, Y, physics=crude, learn_rho_mean=True, learn_delta_mean=True
    ),
    "known noise": lambda X, Y: CKA(X, Y, torch.full_like(Y, 0.01), physics=crude),
    "prior": with_prior,
    "RRA": lambda X, Y: RRA(X, Y, physics=crude, num_features=8),
}


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    return X, 1.5 * crude(X) + X.flip(-1)


@pytest.fixture(params=list(BUILD))
def objective(request, XY):
    """That of each model of two outputs of two inputs."""
    return Objective(BUILD[request.param](*XY))


def near(objective, k=3, spread=0.7):
    current = objective.current()
    return current + spread * torch.randn(k, *current.shape[1:], dtype=torch.float64)


class TestCoordinates:
    def test_coordinates_are_kept(self, objective):
        space = SearchSpace(objective)
        coordinates = space.to_coordinates(near(objective))
        again = space.to_coordinates(space.to_settings(coordinates))
        torch.testing.assert_close(again, coordinates, rtol=1e-10, atol=1e-10)

    def test_settings_are_kept_up_to_the_concentrated_scale(self, objective):
        space, point = SearchSpace(objective), near(objective)
        change = space.to_settings(space.to_coordinates(point)) - point
        if objective.concentrated:  # the same shift of the logarithms of all variances
            free = objective.variances.bool().expand_as(change)
            shift = change[free].reshape(*change.shape[:2], -1)
            torch.testing.assert_close(shift, shift[..., :1].expand_as(shift))
            change = change[~free]
        torch.testing.assert_close(change, torch.zeros_like(change), rtol=0, atol=1e-10)

    def test_the_objective_stays(self, objective):
        space, point = SearchSpace(objective), near(objective)
        moved = space.to_settings(space.to_coordinates(point))
        torch.testing.assert_close(objective(moved), objective(point), rtol=1e-7, atol=1e-7)

    def test_pull_back_is_the_chain_rule(self, objective):
        space = SearchSpace(objective)
        coordinates = space.to_coordinates(near(objective))
        # Any function of the settings, but one that does not see the concentrated scale.
        weight = torch.randn(coordinates.shape[1:], dtype=torch.float64)

        def value(coordinates):
            return (weight * space.to_settings(coordinates)).sin()

        by_settings = weight * (weight * space.to_settings(coordinates)).cos()
        found = space.pull_back(coordinates, by_settings)
        for i in range(objective.num_parameters):
            step = torch.zeros_like(coordinates)
            step[..., i] = 1e-5
            difference = (value(coordinates + step) - value(coordinates - step)).sum(-1) / 2e-5
            torch.testing.assert_close(found[..., i], difference, rtol=1e-6, atol=1e-6)

    def test_units_are_undone(self, objective):
        space = SearchSpace(objective)
        coordinates = space.to_coordinates(near(objective))
        again = space.from_unit(space.to_unit(coordinates))
        torch.testing.assert_close(again, coordinates, rtol=1e-10, atol=1e-10)


class TestBounds:
    def test_they_hold_the_start(self, objective):
        with torch.no_grad():
            for parameter in objective.model.parameters():
                if parameter.requires_grad:
                    parameter += 30.0 * torch.randn_like(parameter)
        space = SearchSpace(objective)
        start = space.to_coordinates(objective.current())[0]
        assert (start >= space.lower).all()
        assert (start <= space.upper).all()

    def test_they_hold_the_random_starts(self, objective):
        space = SearchSpace(objective)
        drawn = space.draw(50, torch.Generator().manual_seed(0))
        assert drawn.isfinite().all()
        assert (drawn >= space.lower).all()
        assert (drawn <= space.upper).all()

    def test_they_are_the_same_for_all_problems_in_units(self, objective):
        space = SearchSpace(objective)
        drawn = space.to_unit(space.draw(50, torch.Generator().manual_seed(0)))
        lower, upper = torch.tensor(space.unit_bounds, dtype=torch.float64).T
        assert (drawn >= lower - 1e-12).all()
        assert (drawn <= upper + 1e-12).all()


class TestConcentration:
    @settings(max_examples=10, deadline=None, derandomize=True)
    @given(
        name=st.sampled_from(["CKA", "PhysicsMeanGP", "ZeroMeanGP", "learnt means"]),
        seed=st.integers(0, 2**31),
        factor=st.floats(1e-6, 1e6),
    )
    def test_a_common_factor_of_the_variances_makes_no_difference(self, name, seed, factor):
        generator = torch.Generator().manual_seed(seed)
        X = torch.rand(9, 2, generator=generator, dtype=torch.float64)
        objective = Objective(BUILD[name](X, 1.5 * crude(X) + X.flip(-1)))
        assert objective.concentrated
        point = objective.current()
        moved = point + math.log(factor) * objective.variances
        torch.testing.assert_close(objective(moved), objective(point), rtol=1e-8, atol=1e-8)
        _, gradient = objective.value_and_gradient(point)
        along = (gradient * objective.variances).sum(-1)
        torch.testing.assert_close(along, torch.zeros_like(along), rtol=0, atol=1e-6)
        ratio = objective.best_scale(point) / objective.best_scale(moved)
        torch.testing.assert_close(ratio, torch.full_like(ratio, factor), rtol=1e-6, atol=0)

    @pytest.mark.parametrize("name", ["known noise", "prior"])
    def test_it_is_not_for_models_with_a_scale_of_their_own(self, XY, name):
        assert not Objective(BUILD[name](*XY)).concentrated

    def test_it_is_the_marginal_likelihood_at_the_best_scale(self, XY):
        model = BUILD["CKA"](*XY)
        concentrated, marginal = Objective(model), Objective(model, marginal=True)
        point = concentrated.current()
        shift = concentrated.best_scale(point).log().unsqueeze(-1)
        best = point + concentrated.variances * shift
        torch.testing.assert_close(marginal(best), concentrated(point), rtol=1e-9, atol=1e-9)
        for other in (-0.1, 0.1):
            assert (marginal(best + other * concentrated.variances) > marginal(best)).all()


class TestUsersConstraints:
    @pytest.mark.parametrize("bound", [1e-4, 0.3])
    def test_noise_above_a_bound(self, XY, bound):
        batch = torch.Size([2])
        likelihood = GaussianLikelihood(batch_shape=batch, noise_constraint=GreaterThan(bound))
        model = CKA(*XY, physics=crude, likelihood=likelihood.double())
        fit(model, **QUICK)
        assert (likelihood.noise >= bound).all()

    @pytest.mark.parametrize("constraint", [Interval, LogInterval])
    @pytest.mark.parametrize(("lower", "upper"), [(1e-3, 2e-3), (0.4, 0.5), (1e3, 2e3)])
    def test_lengthscale_in_an_interval(self, XY, constraint, lower, upper):
        base = MaternKernel(
            ard_num_dims=2,
            batch_shape=torch.Size([2]),
            lengthscale_constraint=constraint(lower, upper),
        ).double()
        base.lengthscale = (lower + upper) / 2
        kernel = ScaleKernel(base, batch_shape=torch.Size([2])).double()
        model = CKA(*XY, physics=crude, rho_covar_module=kernel)
        result = fit(model, **QUICK)
        assert result.log_likelihood.isfinite().all()
        # GPyTorch keeps the bounds in float32.
        assert (base.lengthscale >= lower * (1 - 1e-6)).all()
        assert (base.lengthscale <= upper * (1 + 1e-6)).all()

    @pytest.mark.parametrize("constraint", [Interval, LogInterval])
    def test_outputscale_in_an_interval(self, XY, constraint):
        kernel = ScaleKernel(
            RBFKernel(batch_shape=torch.Size([2])),
            batch_shape=torch.Size([2]),
            outputscale_constraint=constraint(0.01, 0.02),
        ).double()
        kernel.outputscale = 0.015
        model = CKA(*XY, physics=crude, delta_covar_module=kernel)
        assert not Objective(model).concentrated
        fit(model, **QUICK)
        assert ((kernel.outputscale >= 0.01 - 1e-9) & (kernel.outputscale <= 0.02 + 1e-9)).all()
