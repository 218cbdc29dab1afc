"""Options of a fit: what is refused, seeds, and the threads it takes."""

import pytest
import torch
from botorch.exceptions.warnings import OptimizationWarning

from gpadjust import CKA, compare, fit
from gpadjust.inference import FitResult, fitting
from gpadjust.inference.targets import LogLikelihood
from tests.systems import refused, ripple

QUICK = {"num_screened": 16, "num_starts": 2}


@pytest.fixture
def model(uniform):
    X = uniform(9, 2)
    return CKA(X, 1.5 * ripple(X) + X.flip(-1) + 0.1 * uniform(9, 2, seed=5), physics=ripple)


BAD = [
    ("num_starts", 0, ValueError, "num_starts must be at least 1; found 0"),
    ("num_starts", 1.5, TypeError, r"num_starts must be a whole number; found 1\.5"),
    ("num_screened", -1, ValueError, "num_screened must be at least 0; found -1"),
    ("max_iterations", 0, ValueError, "max_iterations must be at least 1; found 0"),
    ("seed", -1, ValueError, "seed must be at least 0; found -1"),
    ("nmu_starts", 2, ValueError, "no option 'nmu_starts'; expected num_starts, "),
]


def test_bad_values_and_models(model):
    for method in ("map", "bayes"):
        for option, value, error, says in BAD:
            refused(error, says, fit, model, method, **{option: value})
    for option in ("num_samples", "num_draws"):
        says = f"'map' has no option '{option}'; .* method 'bayes'"
        refused(ValueError, says, fit, model, "map", **{option: 64})
    refused(ValueError, "num_samples must be at least 1", fit, model, "bayes", num_samples=0)
    refused(ValueError, "num_draws must be at least 16", fit, model, "bayes", num_draws=15)
    refused(ValueError, "expected 'bayes' or 'map'", fit, model, "gibbs", seed=0)
    refused(TypeError, r"model of gpadjust.*Linear", fit, torch.nn.Linear(2, 1))
    raw = model.terms[0].kernel.raw_outputscale
    with torch.no_grad():
        raw.fill_(float("nan"))
    raw.requires_grad_(False)
    before = [p.clone() for p in model.parameters() if p.requires_grad]
    for method in ("bayes", "map"):
        refused(RuntimeError, "not be evaluated", fit, model, method, **QUICK)
    after = [p for p in model.parameters() if p.requires_grad]
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))
    assert not model.training
    refused(ValueError, "no learnable parameter", fit, model.requires_grad_(False), "bayes")


class TestMethodsOfOnesOwn:
    """A method is an entry of a table: a function of a model and its options."""

    @pytest.fixture(autouse=True)
    def nudge(self, monkeypatch):
        def nudge(model, search, steps=1):
            target = LogLikelihood(model)
            vectors, reached = target.parameters.current(), []
            for _ in range(steps or 1):
                value, gradient = target.value_and_gradient(vectors)
                reached.append(-value[0])
                vectors = target.parameters.clipped(vectors - 1e-3 * gradient)
            target.assign(vectors[0])
            return FitResult(-target(vectors)[0], torch.stack(reached).isfinite().all(0))

        monkeypatch.setitem(fitting.METHODS, "nudge", fitting.Method(nudge, {"steps": 1}))

    def test_it_is_called(self, model):
        start = -LogLikelihood(model)(LogLikelihood(model).parameters.current())[0]
        result = fit(model, "nudge", steps=3)
        assert (result.log_likelihood > start).all()
        assert not model.training
        assert model.is_fitted
        refused(ValueError, "steps must be at least 1; found 0", fit, model, "nudge", steps=0)
        refused(ValueError, r"no option 'steps'.*'nudge'", fit, model, "map", steps=2)


def test_a_seed_decides_and_leaves_the_users_alone(model):
    before, fitted = {name: value.clone() for name, value in model.state_dict().items()}, []
    for seed in (3, 3, 2):
        torch.rand(3)
        state = torch.get_rng_state()
        model.load_state_dict(before)
        with pytest.warns(OptimizationWarning):
            fit(model, "map", seed=seed, num_screened=64, num_starts=1, max_iterations=1)
        assert torch.equal(torch.get_rng_state(), state)
        fitted.append(torch.cat([p.detach().flatten() for p in model.parameters()]))
    assert torch.equal(fitted[0], fitted[1])
    assert not torch.equal(fitted[0], fitted[2])


class TestThreads:
    @pytest.fixture(autouse=True)
    def seen(self, monkeypatch):
        """The numbers of threads at each Cholesky factorisation; the user's setting is 2."""
        before, factorise, seen = torch.get_num_threads(), torch.linalg.cholesky_ex, []

        def recorded(*args, **options):
            seen.append(torch.get_num_threads())
            return factorise(*args, **options)

        monkeypatch.setattr(torch.linalg, "cholesky_ex", recorded)
        torch.set_num_threads(2)
        yield seen
        torch.set_num_threads(before)

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
    def test_a_small_problem_takes_one(self, model, seen):
        X, Y = model.train_inputs[0][0, :, :2], model.train_targets.mT
        fit(model, "map", **QUICK)
        compare(X, Y, ripple, structures=["physics mean", "CKA"], **QUICK)
        fit(model, num_draws=64, **QUICK)
        assert set(seen) == {1}
        assert torch.get_num_threads() == 2

    @pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.OptimizationWarning")
    def test_a_large_fit_takes_the_users(self, seen, uniform):
        X = uniform(300, 1)
        fit(CKA(X, 2 * ripple(X), physics=ripple), "map", num_screened=0, max_iterations=1)
        assert set(seen) == {2}
