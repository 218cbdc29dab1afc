"""PaperRRA: the closed form that the paper prints."""

import pytest
import torch

from gpadjust import fit
from paper.forrester.paper_rra import PaperRRA
from tests.systems import crude


def first(X):
    return crude(X)[..., :1]


@pytest.mark.parametrize("known_noise", [False, True])
def test_closed_form(data, shuffle, close, uniform, known_noise):
    X, Y = data(num_outputs=2)
    Yvar = torch.full_like(Y, 0.3) if known_noise else None
    model = shuffle(PaperRRA(X, Y, Yvar, physics=crude, num_features=6))
    Z = uniform(5, 2, high=2.0, seed=3)
    posterior, noisy = model.posterior(Z), model.posterior(Z, observation_noise=True)
    weights = model.weights()
    for j in range(2):
        kernels = [term.kernel.base_kernel for term in model.terms]

        def phi(X, j=j, kernels=kernels):
            parts = []
            for kernel in kernels:
                angles = (X / kernel.lengthscale[j].detach()) @ kernel.randn_weights[j]
                parts.append(torch.cat([angles.cos(), angles.sin()], dim=-1) / 3**0.5)
            return torch.cat([crude(X)[:, [j]] * parts[0], parts[1]], dim=-1)

        ridge = 0.3 if known_noise else model.likelihood.noise[j].item()
        eye = torch.eye(12, dtype=torch.float64)
        gram = phi(X).mT @ phi(X)
        beta = torch.linalg.solve(gram + ridge * eye, phi(X).mT @ Y[:, j])
        covariance = torch.linalg.inv(gram + eye)
        close(weights.mean[j].detach(), beta)
        close(weights.covariance_matrix[j].detach(), covariance)
        variance = (phi(Z) @ covariance @ phi(Z).mT).diagonal()
        close(posterior.mean[:, j].detach(), phi(Z) @ beta)
        close(posterior.variance[:, j].detach(), variance)
        close(noisy.mean[:, j].detach(), phi(Z) @ beta)
        close(noisy.variance[:, j].detach(), variance + ridge)


def test_the_prior_falls_to_zero_without_data(data, uniform):
    X, Y = data()
    model = PaperRRA(X, Y, physics=first, num_features=24).eval()
    assert (model.weights().variance <= 1).all()
    assert not any(term.kernel.raw_outputscale.requires_grad for term in model.terms)
    functions = model.functions(torch.zeros(1, 48, dtype=torch.float64))
    assert (functions(uniform(4, 2)) == 0).all()


def test_rho_times_physics_plus_delta(data, shuffle, close, uniform):
    model = shuffle(PaperRRA(*data(), physics=first, center="mean"))
    Z = uniform(5, 2, high=2.0, seed=3)
    parts = model.rho(Z).mean * model.physics(Z) + model.delta(Z).mean
    close(parts.detach(), model.posterior(Z).mean.detach())


def test_it_cannot_be_fully_bayesian(data):
    with pytest.raises(ValueError, match="Take RRA"):
        fit(PaperRRA(*data(), physics=first), "bayes")
