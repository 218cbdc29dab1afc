"""A physics that is known by its runs."""

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import (
    CKA,
    RRA,
    CalibratedPhysics,
    EmulatedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    Unknown,
    compare,
    fit,
    load,
    save,
)
from gpadjust.emulation.error_kernel import error_covariance, unresolved
from gpadjust.report import report
from gpadjust.sklearn import CKARegressor
from gpadjust.validation import leave_one_out
from tests.systems import line, refused

MAP = {"method": "map"}
W = {"w": Unknown(2.0, bounds=(1.0, 3.0))}


def wave(X):
    return torch.sin(3 * X[:, :1]) * X[:, :1]


def truth(X):
    return 1.3 * wave(X) + 0.3 * X


def simulated(x, w):
    return torch.sin(w * x) * x + 0.2 * w


@pytest.fixture(scope="module")
def crude():
    """Runs in the left half, so that little is known in the right one."""
    runs = 1.2 * line(9)
    return EmulatedPhysics(runs, wave(runs), fit_options={"method": "bayes"}, name="crude")


@pytest.fixture(scope="module")
def with_parameter():
    runs = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(40).double()
    runs = runs * torch.tensor([3.0, 2.0]) + torch.tensor([0.0, 1.0])
    return EmulatedPhysics(runs, simulated(*runs.split(1, dim=-1)), unknowns=W, fit_options=MAP)


def test_far_from_runs_the_emulators_variance_is_in_predictions_and_near_them_is_none(crude):
    X = 2.4 * line(4)
    for kind in (CKA, PhysicsMeanGP):
        model = kind(X, truth(X), physics=crude)
        fit(model)
        runs, far = 1.2 * line(9)[1::3], torch.tensor([[1.9], [2.2]], dtype=torch.float64)
        near, away = (model.term("error", x).variance.mean() for x in (runs, far))
        assert near < 1e-5 * away
        own = crude.emulator.predict(far).variance.mean()
        assert 0.05 * own < away < 1.5 * own
        assert model.predict(far).variance.min() > 0.1 * away


def test_values_and_their_errors_are_the_emulators(crude):
    X = (2 * line(5)).requires_grad_()
    torch.testing.assert_close(crude(X), crude.emulator.predict(X.detach()).mean)
    (slope,) = torch.autograd.grad(crude(X).sum(), X)
    step = 1e-5
    with torch.no_grad():
        numeric = (crude(X + step) - crude(X - step)) / (2 * step)
    torch.testing.assert_close(slope, numeric, rtol=1e-5, atol=1e-5)
    rows = 2 * line(6)
    mean, covariance = crude.emulator.joint_moments(rows, False)
    away = mean - mean.mean(0)
    expected = covariance.mean(0) + away.mT @ away / len(mean)
    found = error_covariance(crude.emulator, rows)[0]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(error_covariance(crude.emulator, rows[:2], rows)[0], found[:2])


def test_the_model_is_a_gaussian_process_with_that_covariance(crude):
    r"""The likelihood by K = (1 + k_rho) k_e + f k_rho f + k_delta, in plain linear algebra."""
    X = 2.4 * line(5)
    model = CKA(X, truth(X), physics=crude, center=0.0, outcome_transform=None)
    rho, delta = (t for t in model.eval().terms if t.name != "error")
    inputs, f = model.train_inputs[0], crude(X).squeeze(-1)
    k_rho, k_delta = (t.kernel(X).to_dense() for t in (rho, delta))
    white = unresolved(crude.emulator)
    k_e, noise = error_covariance(crude.emulator, X, white=white)[0], model.likelihood.noise
    K = (1 + k_rho) * k_e + f[:, None] * k_rho * f + k_delta
    K = K + noise * torch.eye(5)
    torch.testing.assert_close(
        model.at(inputs).covariance() + noise * torch.eye(5), K, check_dtype=False
    )
    y = truth(X).squeeze(-1) - f
    expected = torch.distributions.MultivariateNormal(torch.zeros(5).double(), K).log_prob(y)
    torch.testing.assert_close(model.log_evidence()[1], expected, rtol=1e-6, atol=1e-6)
    # The fit has the same in closed form, with gradients.
    from gpadjust.inference.distributions import StationaryTerms
    from gpadjust.inference.targets import Target

    for each in (model, CKA(X, truth(X), physics=crude)):
        target = Target(each)
        assert isinstance(target.distribution, StationaryTerms)
        vector = target.parameters.current()
        value, slope = target.value_and_gradient(vector)
        for i in range(vector.shape[-1]):
            step = torch.zeros_like(vector)
            step[..., i] = 1e-5
            numeric = (target(vector + step) - target(vector - step)) / 2e-5
            torch.testing.assert_close(slope[..., i], numeric, rtol=1e-4, atol=1e-5)
        if each is model:
            torch.testing.assert_close(-value.squeeze(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_where_the_emulator_is_certain_results_are_those_of_the_physics():
    runs, X = 1.5 * line(40), 1.2 * line(6) + 0.1
    known = EmulatedPhysics(runs, wave(runs))
    test_X = 1.4 * line(9)
    found, exact = (CKA(X, truth(X) + 0.1 * X**2, physics=p) for p in (known, wave))
    for model in (found, exact):
        fit(model, "map")
    for a, b in zip(found.interval(test_X), exact.interval(test_X), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_unknown_parameters_are_inputs_of_the_runs(with_parameter):
    exact = FunctionPhysics(lambda X, p: simulated(X[:, 0], p.w), unknowns=W)
    X = 0.1 + 2.8 * line(12)
    noise = 0.02 * torch.randn(X.shape, generator=torch.Generator().manual_seed(0)).double()
    Y = simulated(X, 1.6) + 0.1 * X.cos() + noise
    found = {}
    for name, physics in (("emulated", with_parameter), ("exact", exact)):
        model = PhysicsMeanGP(X, Y, physics=physics)
        fit(model)
        found[name] = model.physics_parameters
    one, two = (each.draws.flatten() for each in found.values())
    assert abs(one.mean() - two.mean()) < one.std()
    assert 0.7 < one.std() / two.std() < 2
    calibrated = CalibratedPhysics(X, simulated(X, 1.6) + noise, physics=with_parameter)
    fit(calibrated)
    assert abs(calibrated.physics_parameters.mean - 1.6) < 0.05


def test_columns_of_a_frame_are_unknown_parameters_by_their_names():
    runs = pd.DataFrame({"w": 1 + 2 * np.linspace(0, 1, 9), "x": 3 * np.linspace(0, 1, 9) ** 2})
    Y = np.sin(runs.w * runs.x).to_frame("y")
    Y.iloc[3, 0] = np.nan  # a run that failed
    physics = EmulatedPhysics(runs, Y, unknowns=W, fit_options=MAP)
    x, w = torch.tensor([[3.0]]).double(), torch.tensor([3.0]).double()
    assert len(physics.emulator.data()["train_X"]) == 8
    assert abs(physics(x, w) - np.sin(9)) < 0.05
    with_units = runs.rename(columns={"w": "w [1/s]", "x": "x [s]"})
    again = EmulatedPhysics(with_units, Y, unknowns=W, fit_options=MAP)
    assert torch.equal(again(x, w), physics(x, w))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The draws of")
def test_it_works_through_the_whole_house(crude, tmp_path):
    X, test_X = 2.4 * line(7), 2 * line(3)
    two = EmulatedPhysics(1.2 * line(9), wave(1.2 * line(9)).repeat(1, 2), fit_options=MAP)
    for physics, m in ((crude, 1), (two, 2)):
        Y = truth(X).repeat(1, m)
        model = CKA(X, Y, physics=physics)
        fit(model, num_samples=4)
        assert "error of the emulated physics" in model.summary()
        assert model.posterior(test_X).variance.isfinite().all()
        assert leave_one_out(model).log_density.isfinite().all()
        more = model.condition_on_observations(test_X, truth(test_X).repeat(1, m))
        assert (more.posterior(test_X).variance < model.posterior(test_X).variance).all()
        draws = model.sample_functions(400)(test_X)
        sd = model.predict(test_X).variance.sqrt()
        torch.testing.assert_close(draws.std(0), sd, rtol=0.3, atol=1e-3)
        save_to = tmp_path / "model.pt"
        with pytest.warns(UserWarning, match="Pass it again"):
            save(model, save_to)
        again = load(save_to, physics=physics)
        torch.testing.assert_close(again.predict(test_X).mean, model.predict(test_X).mean)
    subset = model.subset_output([1])
    torch.testing.assert_close(
        subset.predict(test_X).variance, model.predict(test_X).variance[:, 1:]
    )
    given = {"structures": ["CKA", "physics mean"], "num_starts": 1, "num_screened": 4}
    comparison = compare(X, Y[:, :1], crude, **given)
    page = report(comparison, tmp_path / "page.html")
    assert "error of the emulated physics" in page.read_text()
    regressor = CKARegressor(physics=crude, fit_method="map").fit(X.numpy(), Y[:, 0].numpy())
    assert np.isfinite(regressor.predict(X.numpy())).all()


def test_details_that_the_emulator_takes_for_noise_are_errors_of_a_certain_simulator():
    runs, X = 4 * line(60), 4 * line(5) + 0.01
    ripples = runs.sin() + 0.1 * torch.sin(397 * runs)
    found = []
    for is_random in (False, True):
        physics = EmulatedPhysics(runs, ripples, is_random=is_random, fit_options=MAP)
        model = PhysicsMeanGP(X, X.sin(), physics=physics)
        found.append(model.term("error", X[:4] + 0.3).variance)
    more = found[0] - found[1]
    assert ((more > 0.03**2) & (more < 0.15**2)).all()


def test_bad_input():
    X = line(5)
    refused(ValueError, r"inputs=.* names 2 columns", EmulatedPhysics, X, X, inputs=[0, 1])
    with pytest.raises(ValueError, match="none named w"):
        EmulatedPhysics(pd.DataFrame({"x": [0.0, 1.0]}), np.zeros(2), unknowns=W)
    refused(ValueError, "and then 1 unknown parameter", EmulatedPhysics, X, X, unknowns=W)
    crude = EmulatedPhysics(X, X.sin(), fit_options=MAP)
    refused(ValueError, r"inputs=\[...\]", crude, torch.zeros(3, 2).double())
    refused(ValueError, "FunctionPhysics", RRA, X, X, physics=crude)
