"""CKARegressor in scikit-learn's own checks, in its tools, and against the library's models."""

import pickle
from dataclasses import dataclass
from functools import partial

import cloudpickle
import numpy as np
import pandas as pd
import pytest
import sklearn
import torch
from sklearn.base import clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from gpadjust import (
    CKA,
    BlackBoxPhysics,
    PhysicsMeanGP,
    PhysicsWarning,
    Unknown,
    VariationalCKA,
    ZeroMeanGP,
    fit,
)
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.links import LinkedCKA
from gpadjust.sklearn import CKARegressor
from tests.systems import refused, same


def wave(X):
    return np.sin(6 * X[:, 0])


def waves(X):
    return np.column_stack([wave(X), wave(X) ** 2])


def torch_wave(X):
    return torch.sin(6 * X[:, 0])


def fast(physics=wave, **parameters):
    options = {"fit_method": "map", "random_state": 0, **parameters}
    return CKARegressor(physics, **options)


@pytest.fixture
def data():
    X = np.linspace(0, 1, 10).reshape(-1, 1)
    noise = 0.05 * np.random.RandomState(0).randn(10)
    return X, 2 * wave(X) + X[:, 0] + noise


Z = np.linspace(-0.2, 1.2, 7).reshape(-1, 1)


@dataclass
class Wave:
    """A function whose repr, and so the names of tests, is the same in all processes."""

    def __call__(self, X):
        return wave(X)


def expected_failures(regressor):
    """A physics has as many outputs as it has, and the check has its own number of them."""
    if regressor.physics is None:
        return {}
    return {"check_regressor_multioutput": "y has five columns, the physics has one"}


@pytest.mark.filterwarnings("ignore:.*equal an earlier row")  # the irises are so
@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
@pytest.mark.filterwarnings("ignore:Predictions depend on the seed")  # in data of noise alone
@pytest.mark.slow
@parametrize_with_checks(
    [CKARegressor(), fast(Wave())],
    legacy=True,
    expected_failed_checks=expected_failures,
)
def test_scikit_learn_accepts_it(estimator, check):
    check(estimator)


OPTIONS = {"constants": False, "train_Yvar": 0.05**2}
MODELS = {
    "cka": (fast(), CKA, {"physics": BlackBoxPhysics(wave)}),
    "class": (
        fast(model=partial(PhysicsMeanGP, **OPTIONS)),
        PhysicsMeanGP,
        {"physics": BlackBoxPhysics(wave), **OPTIONS},
    ),
    "no physics": (fast(None), ZeroMeanGP, {}),
    "zero mean": (fast(model="zero_mean"), ZeroMeanGP, {}),
}


@pytest.mark.parametrize(
    ("name", "method"),
    [*((n, "map") for n in MODELS), pytest.param("cka", "bayes", marks=pytest.mark.slow)],
)
def test_it_says_what_the_model_says(data, name, method):
    regressor, structure, options = MODELS[name]
    regressor = clone(regressor).set_params(fit_method=method).fit(*data)
    model = structure(data[0], data[1].reshape(-1, 1), **options)
    assert type(regressor.model_) is structure
    assert type(regressor.fit_result_) is type(fit(model, method, seed=0))
    for noise in (False, True):
        mean, variance = (values[:, 0] for values in model.predict(Z, noise))
        ours, std = regressor.predict(Z, return_std=True, observation_noise=noise)
        np.testing.assert_array_equal(ours, mean)
        np.testing.assert_allclose(std**2, variance, rtol=1e-12)
        np.testing.assert_array_equal(regressor.predict(Z), model.predict(Z).mean[:, 0])
        ours, covariance = regressor.predict(Z, return_cov=True, observation_noise=noise)
        np.testing.assert_array_equal(ours, mean)
        np.testing.assert_allclose(np.diag(covariance), variance, rtol=1e-6)
    assert OPTIONS == {"constants": False, "train_Yvar": 0.05**2}


def test_numpy_and_torch_are_one(data):
    by_numpy, by_torch = (fast(f).fit(*data).predict(Z) for f in (wave, torch_wave))
    np.testing.assert_allclose(by_numpy, by_torch, rtol=1e-6)
    regressor = fast({"coarse": lambda X: X[:, 0], "fine": torch_wave}).fit(*data)
    assert [t.name for t in regressor.model_.terms] == ["rho_coarse", "rho_fine", "delta"]
    assert regressor.score(*data) > 0.9


@pytest.mark.parametrize("columns", [1, 2])
def test_shapes_are_those_of_a_gaussian_process_regressor(data, columns):
    X, y = data
    Y = y if columns == 1 else np.column_stack([y, y])
    ours, expected = (
        (
            regressor.predict(Z),
            *regressor.predict(Z, return_std=True),
            *regressor.predict(Z, return_cov=True),
            regressor.sample_y(Z),
            regressor.sample_y(Z, 3),
        )
        for regressor in (fast(None).fit(X, Y), GaussianProcessRegressor(optimizer=None).fit(X, Y))
    )
    assert [each.shape for each in ours] == [each.shape for each in expected]


def test_covariances_of_two_outputs(data):
    X, y = data
    Y = np.column_stack([y, y**2 + X[:, 0]])
    regressor = fast(waves, fit_method="bayes").fit(X, Y)
    _, std = regressor.predict(Z, return_std=True)
    _, covariance = regressor.predict(Z, return_cov=True)
    np.testing.assert_allclose(np.einsum("iij->ij", covariance), std**2, rtol=1e-4)
    assert regressor.score(X, Y) > 0.9


@pytest.mark.parametrize(("method", "noise"), [("bayes", True), ("map", False)])
def test_moments_of_draws(data, method, noise):
    regressor = fast(fit_method=method).fit(*data)
    draws = regressor.sample_y(Z, 20_000, random_state=1, observation_noise=noise)
    mean, covariance = regressor.predict(Z, return_cov=True, observation_noise=noise)
    sd = np.sqrt(np.diag(covariance))
    assert draws.shape == (7, 20_000)
    assert (np.abs(draws.mean(1) - mean) < 0.03 * sd).all()
    np.testing.assert_allclose(
        np.cov(draws) / np.outer(sd, sd), covariance / np.outer(sd, sd), atol=0.06
    )
    first = regressor.sample_y(Z, 3)  # a seed makes them
    np.testing.assert_array_equal(first, regressor.sample_y(Z, 3, random_state=0))
    assert (first != regressor.sample_y(Z, 3, random_state=1)).all()
    state = np.random.RandomState(0)
    assert (regressor.sample_y(Z, 1, state) != regressor.sample_y(Z, 1, state)).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Predictions depend on the seed")
def test_the_seed_of_the_fit(data):
    def scales(state):
        regressor = CKARegressor(wave, random_state=state, num_draws=16)
        return [p.detach().flatten() for p in regressor.fit(*data).model_.parameters()]

    fits = [scales(5), scales(5), scales(np.random.RandomState(0))]
    same(fits[0], fits[1], rtol=0, atol=0)
    same(fits[2], scales(np.random.RandomState(0)), rtol=0, atol=0)
    assert not torch.equal(torch.cat(fits[0]), torch.cat(scales(6)))


def test_parameters_are_left_as_they_are(data):
    linear, model = torch.nn.Linear(1, 1).double(), partial(CKA, center=0.0)
    before = linear.weight.item()
    parameters = fast(linear, model=model).fit(*data).get_params()
    assert linear.weight.item() == before
    assert (parameters["physics"], parameters["model"]) == (linear, model)


def test_unknown_parameters(data):
    X = data[0]
    law = BlackBoxPhysics(
        lambda X, p: np.sin(p.rate * X[:, 0]), unknowns={"rate": Unknown(5.0, sd=1.0)}
    )
    regressor = fast(law, fit_method="bayes", model="calibrated_physics")
    regressor.fit(X, data[1] - X[:, 0] - wave(X))
    assert regressor.physics_parameters_["rate"].mean().item() == pytest.approx(6, abs=0.2)
    regressor.set_params(physics=wave, model="cka").fit(*data)
    assert not hasattr(regressor, "physics_parameters_")


def test_the_physics_sees_what_the_regressor_is_given(data):
    X, y = data
    seen = []

    def records(X):
        seen.append(X.copy())
        return wave(X)

    pipeline = make_pipeline(StandardScaler(), fast(records))
    with pytest.warns(PhysicsWarning, match=r"inputs scaled\?") as warned:
        pipeline.fit(X, y)
    assert len(warned) == 1
    scaled = StandardScaler().fit_transform(X)
    assert any(len(rows) == 10 and np.allclose(rows, scaled) for rows in seen)
    assert all(np.isin(rows.round(9), scaled.round(9)).all() for rows in seen)
    mean, std = pipeline.predict(Z, return_std=True)
    assert mean.shape == std.shape == (7,)


def test_a_physics_that_is_off_is_said_to_be(data):
    X, y = data
    with pytest.warns(PhysicsWarning, match="times too large") as caught:
        fast(lambda X: 1000 * wave(X), fit_method="bayes").fit(X, y)
    assert [each.filename for each in caught] == [__file__]
    assert "is scaled" not in str(caught[0].message)
    large = fast(lambda X: 1000 * wave(X), fit_method="bayes")
    scaled = TransformedTargetRegressor(large, transformer=StandardScaler())
    with pytest.warns(PhysicsWarning, match="The observations were standardised"):
        scaled.fit(X, y)


@pytest.mark.slow
def test_grid_search_over_models_and_physics(data):
    X, y = data
    rows = np.random.RandomState(0).permutation(len(X))
    grid = [
        {"model": ["cka", "physics_mean"], "physics": [wave, torch_wave]},
        {"physics": [None]},
    ]
    search = GridSearchCV(fast(), grid, cv=2).fit(X[rows], y[rows])
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    assert search.best_params_["physics"] is not None
    assert search.best_estimator_.predict(Z).shape == (7,)
    models = {"model": ["cka", "physics_mean"]}  # in processes, which take a lambda
    search = GridSearchCV(fast(lambda X: np.sin(6 * X[:, 0])), models, cv=2, n_jobs=2)
    assert np.isfinite(search.fit(X, y).cv_results_["mean_test_score"]).all()


def test_a_frame_gives_names(data):
    X, y = data
    frame = pd.DataFrame({"time": X[:, 0], "load": X[:, 0] ** 2})
    regressor = fast().fit(frame, pd.Series(y, name="height"))
    assert [*regressor.feature_names_in_] == ["time", "load"]
    assert regressor.n_features_in_ == 2
    assert regressor.model_.data.input_names == ("time", "load")
    assert regressor.model_.data.output_names == ("height",)
    assert regressor.predict(frame).shape == (10,)
    assert regressor.sample_y(frame).shape == (10, 1)
    refused(ValueError, "feature names", regressor.predict, frame[["load", "time"]])
    with pytest.warns(UserWarning, match="feature names"):
        regressor.predict(frame.to_numpy())


def test_kinds_of_data(data):
    X, y = data
    for options, kind in (({"link": (-5.0, 5.0)}, LinkedCKA), ({"noise": HeavyTails()}, CKA)):
        regressor = fast(model_options=options).fit(X, y)
        _, std = regressor.predict(Z, return_std=True)
        _, covariance = regressor.predict(Z, return_cov=True)
        assert type(regressor.model_) is kind
        assert regressor.score(X, y) > 0.9
        assert (std > 0).all()
        assert np.allclose(np.diag(covariance), std**2)
        assert np.linalg.eigvalsh(covariance).min() > -1e-9 * covariance.max()
        assert regressor.sample_y(Z, 2).shape == (7, 2)


def test_known_variances_are_taken_apart_with_the_rows(data):
    X, y = data
    variances = np.full(10, 0.05**2)
    with sklearn.config_context(enable_metadata_routing=True):
        regressor = fast().set_fit_request(train_Yvar=True)
        scores = cross_val_score(regressor, X, y, cv=2, params={"train_Yvar": variances})
    assert np.isfinite(scores).all()
    known = fast().fit(X, y, train_Yvar=variances).model_.data.Yvar
    np.testing.assert_array_equal(known, variances.reshape(-1, 1))


def test_kinds_of_arrays(data):
    X, y = data
    expected = fast().fit(X, y).predict(Z)
    np.testing.assert_array_equal(clone(fast()).fit(X, y.reshape(-1, 1)).predict(Z), expected)
    X.setflags(write=False)
    for made in (np.ndarray.tolist, np.float32, torch.tensor, np.asarray):
        found = fast().fit(made(X.copy() if made is torch.tensor else X), made(y)).predict(made(Z))
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


INDUCING = partial(VariationalCKA, num_inducing=6)


@pytest.mark.parametrize(
    ("physics", "options", "by"),
    [
        (wave, {"fit_method": "bayes"}, pickle),
        (torch_wave, {"model": INDUCING}, pickle),
        (None, {}, pickle),
        ([lambda X: wave(X), wave], {}, cloudpickle),
    ],
)
def test_a_pickle_of_what_was_fitted(data, physics, options, by):
    regressor = fast(physics, **options).fit(*data)
    again = by.loads(by.dumps(regressor))
    mean, std = regressor.predict(Z, return_std=True)
    np.testing.assert_allclose(again.predict(Z, return_std=True), (mean, std), rtol=1e-9)
    _, covariance = regressor.predict(Z, return_cov=True)
    np.testing.assert_allclose(np.diag(covariance), std**2, rtol=1e-6)
    refused(NotFittedError, "not fitted", clone(again).predict, Z)
    assert clone(again).fit(*data).score(*data) > 0.9
    if by is cloudpickle:
        refused((pickle.PicklingError, AttributeError), "lambda", pickle.dumps, regressor)
        assert regressor.physics is physics


REFUSED = [
    ({"model": "krr"}, ValueError, "one of 'cka', 'rra'.*got 'krr'"),
    ({"model": 3}, TypeError, r"callable \(X, Y, \*\*physics\) .*found 3"),
    ({"model": lambda X, Y, physics: X}, TypeError, "to make a gpadjust Predictive; found nda"),
    ({"model": "rra", "physics": None}, ValueError, "without one take model='zero_mean'"),
    ({"num_draws": 3}, ValueError, "a multiple of 4, from 4 on; found 3"),
    ({"num_draws": 8.0}, TypeError, "num_draws must be a whole number; found 8.0"),
    ({"model": partial(CKA, centre=0)}, TypeError, "option 'centre' of CKA"),
    ({"physics": None, "model": CKA}, TypeError, "argument: 'physics'"),
    ({"model_options": ["log"]}, TypeError, "Expected model_options as a dictionary"),
    ({"model_options": {"physics": wave}}, TypeError, "without data and physics"),
    ({"random_state": "seed"}, ValueError, "cannot be used to seed"),
]


@pytest.mark.parametrize(("parameters", "error", "words"), REFUSED)
def test_bad_parameters(data, parameters, error, words):
    regressor = fast(**parameters)  # no error before the fit, as scikit-learn has it
    refused(error, words, regressor.fit, *data)
    assert not hasattr(regressor, "model_")


def test_bad_data_and_requests(data):
    X, y = data  # scikit-learn's checks have other bad data
    words = "Expected 2 outputs of physics 'wave'"
    refused(ValueError, words, fast().fit, X, np.column_stack([y, y]))
    refused(NotFittedError, "not fitted", fast().predict, Z)
    predict = fast().fit(*data).predict
    words = "return_std or return_cov, got both"
    refused(RuntimeError, words, predict, Z, return_std=True, return_cov=True)
    words = "X has 2 features, but CKARegressor is expecting 1"
    refused(ValueError, words, predict, np.hstack([Z, Z]))
    refused(ValueError, "n_samples must be at least 1; found 0", fast().fit(*data).sample_y, Z, 0)
