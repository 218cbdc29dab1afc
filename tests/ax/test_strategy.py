"""generation_strategy in Ax's client: trials, predictions, cross-validation, files."""

import math
import sys
from functools import partial
from types import ModuleType

import pytest
import torch
from ax.adapter.cross_validation import cross_validate
from ax.api.client import Client
from ax.api.configs import RangeParameterConfig
from ax.exceptions.storage import JSONEncodeError

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.ax import (
    TRANSFORMS,
    ParameterPhysics,
    TellPhysics,
    generation_strategy,
    generator_kwargs,
)
from tests.systems import refused

FAST = {"method": "map"}
# Data without noise, on which Ax's acquisition functions are nearly singular.
pytestmark = pytest.mark.filterwarnings(
    "ignore::linear_operator.utils.warnings.NumericalWarning",
    "ignore::botorch.exceptions.warnings.OptimizationWarning",
    "ignore:Optimization failed",
    "ignore:When all training points are infeasible",
)


def crude(time, dose):
    return 100 * dose * (1 - torch.exp(-time)) - 20 * dose**2


def truth(time, dose):
    noise = 0.5 * math.sin(40 * time + 9 * dose)
    return {
        "output": 90 * dose * (1 - math.exp(-1.3 * time)) - 22 * dose**2 + 5 + noise,
        "waste": 3 * dose + 0.3 * time + 0.1 * noise,
    }


def client(fit_options=FAST, **options):
    ours = Client()
    time = {"name": "time", "bounds": (0.01, 10.0), "scaling": "log"}
    parameters = [time, {"name": "dose", "bounds": (0.0, 4.0)}]
    ours.configure_experiment(
        parameters=[RangeParameterConfig(parameter_type="float", **each) for each in parameters]
    )
    ours.configure_optimization(objective="output", outcome_constraints=["waste <= 9"])
    strategy = generation_strategy(
        {"output": crude},
        fit_options=fit_options,
        initialization_random_seed=0,
        **options,
    )
    ours.set_generation_strategy(strategy)
    return ours


def try_out(ours, trials):
    for _ in range(trials):
        for index, arm in ours.get_next_trials(max_trials=1).items():
            ours.complete_trial(index, truth(**arm))
    return ours


def adapter(ours):
    return ours._generation_strategy.adapter


@pytest.mark.slow
def test_trials_constraints_and_predictions():
    torch.manual_seed(0)
    ours = try_out(client(fit_options=None), 9)
    model = adapter(ours).generator.surrogate.model
    assert [type(each) for each in model.models] == [CKA, ZeroMeanGP]
    assert {len(each.u) for each in model.models} == {16}
    tried = ours._experiment.trials[2].arm.parameters
    (predicted,) = ours.predict([tried])
    for metric, value in truth(**tried).items():
        mean, sd = predicted[metric]
        assert mean == pytest.approx(value, abs=3 * sd + 0.5)
    best, metrics, _, _ = ours.get_best_parameterization()
    assert truth(**best)["waste"] <= 9.2
    assert metrics["output"][0] > 50
    assert truth(**best)["output"] > 78


@pytest.mark.slow
def test_the_model_is_the_one_that_the_library_fits():
    ours = try_out(client(), 6)
    model = adapter(ours).generator.surrogate.model.models[0]
    data, units = model.data, adapter(ours).transforms["StandardizeY"]
    Y = data.Y * units.Ystd["output"] + units.Ymean["output"]
    log_time = CKA(data.X, Y, physics=lambda X: crude(10 ** X[:, 0], X[:, 1]))
    fit(log_time, **FAST)
    point = torch.tensor([[0.2, 1.4]], dtype=torch.float64)
    mean, variance = log_time.predict(point)
    (found, sd) = ours.predict([{"time": 10**0.2, "dose": 1.4}])[0]["output"]
    assert found == pytest.approx(mean.item(), rel=1e-3)
    assert sd == pytest.approx(variance.sqrt().item(), rel=0.05, abs=1e-3)


@pytest.mark.slow
def test_cross_validation_leaves_each_trial_out():
    ours = try_out(client(), 6)
    results = cross_validate(adapter(ours))
    assert len(results) == 5  # those that the last choice knew
    units = adapter(ours).transforms["StandardizeY"]
    sd = units.Ystd["output"]
    model = adapter(ours).generator.surrogate.model.models[0]
    means = model.left_out().prediction.mean.flatten() * sd + units.Ymean["output"]
    for result, mean in zip(sorted(results, key=lambda r: r.observed.arm_name), means, strict=True):
        index = result.predicted.metric_signatures.index("output")
        # Without a trial, units of targets and ranges of inputs are a bit different.
        assert result.predicted.means[index] == pytest.approx(mean.item(), abs=0.25 * sd)


def test_a_strategy_is_ax_s_own_but_for_the_model():
    strategy = client(initialization_budget=3, initialize_with_center=False)._generation_strategy
    assert strategy.name == "Sobol+MBM:CKA"
    assert [node.name for node in strategy._nodes] == ["Sobol", "MBM"]
    kwargs = strategy.nodes_by_name["MBM"].generator_specs[0].generator_kwargs
    assert kwargs["transforms"] == TRANSFORMS
    assert "acquisition_options" in kwargs


def test_other_models_and_their_options():
    kwargs = generator_kwargs({"output": crude}, model=partial(PhysicsMeanGP, constants=False))
    (config,) = kwargs["surrogate_spec"].metric_to_model_configs["output"]
    assert config.botorch_model_class is PhysicsMeanGP
    assert config.model_options["constants"] is False
    for model in (lambda X, Y, physics: CKA(X, Y, physics=physics), 3, partial(CKA, None)):
        words = r"class of models, such as CKA, or functools\.partial"
        refused(TypeError, words, generator_kwargs, {"output": crude}, model=model)
    for physics in ({}, None, crude, [crude]):
        words = "the physics of at least one metric by its name"
        refused(TypeError, words, generator_kwargs, physics)


@pytest.fixture
def named(monkeypatch):
    """A function of a module, as a user has them."""
    module = ModuleType("my_physics")
    exec("def f_p(x):\n    return (6 * x).sin()", module.__dict__)
    monkeypatch.setitem(sys.modules, "my_physics", module)
    return module.f_p


def of_one(physics, trials):
    ours = Client()
    x = RangeParameterConfig(name="x", parameter_type="float", bounds=(0.0, 1.0))
    ours.configure_experiment(parameters=[x])
    ours.configure_optimization(objective="-y", outcome_constraints=["z <= 0.9"])
    ours.set_generation_strategy(
        generation_strategy(
            physics, fit_options=FAST, initialization_random_seed=0, initialization_budget=3
        )
    )
    for _ in range(trials):
        complete(ours, ours.get_next_trials(max_trials=1))
    return ours


def complete(ours, trials):
    for index, arm in trials.items():
        y = math.sin(6 * arm["x"]) + 0.3 * arm["x"] ** 2
        ours.complete_trial(index, {"y": y, "z": arm["x"]})
    return trials


def test_a_physics_without_a_path_is_an_error(named, tmp_path, monkeypatch):
    path = str(tmp_path / "client.json")
    save = of_one({"y": lambda x: x}, 0).save_to_json_file
    refused(JSONEncodeError, r"the physics '<lambda>'.*Write `def f_p", save, path)
    of_one({"y": named}, 0).save_to_json_file(path)
    monkeypatch.delitem(sys.modules, "my_physics")
    words = r"'my_physics:f_p' cannot be imported"
    refused(ValueError, words, Client.load_from_json_file, path)


@pytest.mark.slow
def test_it_goes_on_from_a_file(named, tmp_path):
    """With the first trials, then by the model."""
    first = of_one({"y": {"fine": named}}, 2)
    first.save_to_json_file(str(tmp_path / "client.json"))
    again = Client.load_from_json_file(str(tmp_path / "client.json"))
    assert again._generation_strategy.name == "Center+Sobol+MBM:CKA"
    node = again._generation_strategy.nodes_by_name["MBM"]
    kwargs = node.generator_specs[0].generator_kwargs
    spec = kwargs["surrogate_spec"]
    (config,) = spec.metric_to_model_configs["y"]
    assert config.botorch_model_class is CKA
    assert config.model_options["physics"] == {"fine": ParameterPhysics(named)}
    assert spec.model_configs[0].botorch_model_class is ZeroMeanGP
    assert kwargs["transforms"][-1] is TellPhysics
    trials = [complete(each, each.get_next_trials(max_trials=1)) for each in (first, again)]
    assert trials[0] == trials[1]
    predicted = []
    for each in (first, again):
        each.get_next_trials(max_trials=1)
        predicted.append(each.predict([{"x": 0.35}])[0]["y"])
    assert predicted[0] == pytest.approx(predicted[1], rel=0.01)
