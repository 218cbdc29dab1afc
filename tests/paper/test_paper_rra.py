"""PaperRRA: the closed form that the paper prints."""

import pytest
import torch

from gpadjust import fit
from paper.forrester.paper_rra import PaperRRA
from tests.systems import crude


@pytest.mark.parametrize("known_noise", [False, True])
def test_closed_form(data, close, uniform, known_noise):
    X, Y = data(num_outputs=2)
    Y = Y * torch.tensor([1.0, 300.0], dtype=torch.float64)
    physics = lambda X: crude(X) * torch.tensor([1.0, 300.0]).double()  # noqa: E731
    Yvar = torch.full_like(Y, 0.3) if known_noise else None
    model = PaperRRA(X, Y, Yvar, physics=physics, num_features=6)
    model.set_draws(0.3 * torch.randn_like(model.u))
    Z, values = uniform(5, 2, high=2.0, seed=3), model.values
    plain, noisy = model.posterior(Z), model.posterior(Z, observation_noise=True)
    with torch.no_grad():
        joint = model.mixture(Z, slice(None), False).gaussians[1]
    functions = model.sample_functions(1000, seed=0)(Z)
    for j in range(2):

        def phi(X, j=j):
            parts = []
            for term in model.terms:
                length = values[f"{term.name}.kernel.lengthscale"][0, j]
                angles = (X / length) @ term.kernel.frequencies
                parts.append(torch.cat([angles.cos(), angles.sin()], dim=-1) / 3**0.5)
            return torch.cat([physics(X)[:, [j]] * parts[0], parts[1]], dim=-1).detach()

        ridge = 0.3 if known_noise else model.likelihood.noise[j, 0].item()
        eye = torch.eye(12, dtype=torch.float64)
        gram = phi(X).mT @ phi(X)
        mean = phi(Z) @ torch.linalg.solve(gram + ridge * eye, phi(X).mT @ Y[:, j])
        covariance = phi(Z) @ torch.linalg.inv(gram + eye) @ phi(Z).mT
        close(plain.mean[:, j], mean, 1e-6)
        close(joint[0, j], covariance, 1e-6)
        close(plain.variance[:, j], covariance.diagonal(), 1e-6)
        close(noisy.variance[:, j], covariance.diagonal() + ridge, 1e-6)
        close(functions[..., j].mean(0), mean, 0.05)
        close(functions[..., j].mT.cov(), covariance, 0.2)


def test_it_falls_to_zero_far_away_and_is_fitted_to_the_most_likely_numbers_alone(data):
    model = PaperRRA(*data(), physics=lambda X: crude(X)[..., :1], num_features=24)
    with pytest.raises(ValueError, match="Take RRA"):
        fit(model)
    fit(model, "map")
    assert model.values["rho.kernel.outputscale"].item() == 1
    assert all(term.mean == 0 for term in model.terms)
