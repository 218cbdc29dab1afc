"""Joint samples have the moments of their posterior, whatever its size, and gradients."""

import pytest
import torch
from botorch.acquisition.objective import ScalarizedPosteriorTransform

DRAWS = 20_000
KINDS = ["CKA", "RRA", "PhysicsMeanGP", "ScaleGP", "ZeroMeanGP", "AR1"]


def agree(make, Z):
    """Standard deviations to 3 %, correlations to 0.05, and finite gradients in Z."""
    with torch.no_grad():
        posterior = make(Z)
        samples = posterior.rsample(torch.Size([DRAWS])).flatten(1)
        covariance = posterior.distribution.covariance_matrix
    sd = covariance.diagonal().sqrt()
    assert (sd > 0).all()
    torch.testing.assert_close(sd, posterior.variance.mT.flatten().sqrt())
    standard = (samples - posterior.mean.flatten()) / sd
    assert (standard.mean(0).abs() < 0.04).all()
    assert ((standard.std(0) - 1).abs() < 0.03).all()
    correlation = covariance / sd.outer(sd)
    assert ((standard.mT @ standard / DRAWS - correlation).abs() < 0.05).all()
    leaf = Z.clone().requires_grad_()
    make(leaf).rsample(torch.Size([3])).sum().backward()
    assert leaf.grad.isfinite().all()


@pytest.fixture
def model_of(data, build, crude_physics):
    def model_of(kind, noisy, size, num_outputs=1):
        X, Y = data(n=12, num_outputs=num_outputs)
        options = {}
        if kind != "ZeroMeanGP":
            options["physics"] = lambda X: size * crude_physics(X)[..., :num_outputs]
        model = build(kind, X, size * Y, **options).eval()
        noise = model.likelihood.noise_covar
        with torch.no_grad():
            if not noisy:
                noise.raw_noise.fill_(1.0001 * noise.raw_noise_constraint.lower_bound.log())
            for term in model.terms:
                if term.kernel is not None:
                    term.kernel.base_kernel.raw_lengthscale.fill_(0.4)
        return model, X

    return model_of


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("q", [1, 20, pytest.param(200, marks=pytest.mark.slow)])
def test_one_output(model_of, uniform, kind, noisy, size, q):
    model, X = model_of(kind, noisy, size)
    Z = torch.cat([X[: q // 4], uniform(q - len(X[: q // 4]), 2, high=2.0, seed=1)])
    agree(model.posterior, Z)
    for name in model.term_names:
        agree(lambda Z, name=name: model.term(name, Z), Z)


@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
@pytest.mark.parametrize("kind", ["CKA", "RRA"])
def test_scalarized_outputs(model_of, uniform, kind, noisy):
    model, _ = model_of(kind, noisy, 1e-3, num_outputs=2)
    weigh = ScalarizedPosteriorTransform(torch.tensor([1.0, -3.0], dtype=torch.float64))
    Z = uniform(20, 2, high=2.0, seed=1)
    agree(lambda Z: model.posterior(Z, posterior_transform=weigh), Z)
    samples = model.posterior(Z).rsample(torch.Size([DRAWS]))
    sd = model.posterior(Z).variance.sqrt()
    assert ((samples.std(0) / sd - 1).abs() < 0.03).all()


@pytest.mark.parametrize("kind", ["CKA", "RRA"])
@pytest.mark.parametrize("noisy", [True, False], ids=["noisy", "exact"])
def test_a_mixture_over_hyper_parameters(model_of, uniform, kind, noisy):
    model, X = model_of(kind, noisy, 1e3)
    learnt = {n: p.detach() for n, p in model.named_parameters() if p.requires_grad}
    spread = 0.3 * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    model.hold_samples({n: torch.stack([p + s for s in spread]) for n, p in learnt.items()})
    Z = torch.cat([X[:3], uniform(9, 2, high=2.0, seed=1)])
    for method in (model.posterior, model.rho, model.delta):
        with torch.no_grad():
            posterior = method(Z)
            samples = posterior.rsample(torch.Size([DRAWS]))
        assert samples.shape == (DRAWS, 3, 12, 1)
        for draws, variance in (
            (samples, posterior.variance),
            (samples.flatten(0, 1), posterior.mixture_variance),
        ):
            assert ((draws.std(0) / variance.sqrt() - 1).abs() < 0.03).all()
