"""Ax saves a strategy with a physics that has a name, and says what is wrong with others."""

import sys
from types import ModuleType

import pytest
import torch
from ax.api.client import Client
from ax.api.configs import RangeParameterConfig
from ax.exceptions.storage import JSONEncodeError

from gpadjust import CKA, ZeroMeanGP
from gpadjust.ax import ParameterPhysics, TellPhysics, generation_strategy

# Data without noise, on which Ax's acquisition functions are nearly singular.
pytestmark = pytest.mark.filterwarnings(
    "ignore::linear_operator.utils.warnings.NumericalWarning",
    "ignore::botorch.exceptions.warnings.OptimizationWarning",
    "ignore:Optimization failed",
)


@pytest.fixture
def named(monkeypatch):
    """A function of a module, as a user has them."""
    module = ModuleType("my_physics")
    exec("def f_p(x):\n    return (6 * x).sin()", module.__dict__)
    monkeypatch.setitem(sys.modules, "my_physics", module)
    return module.f_p


def client(physics, trials):
    ours = Client()
    x = RangeParameterConfig(name="x", parameter_type="float", bounds=(0.0, 1.0))
    ours.configure_experiment(parameters=[x])
    ours.configure_optimization(objective="-y", outcome_constraints=["z <= 0.9"])
    ours.set_generation_strategy(
        generation_strategy(
            physics,
            fit_options={"method": "map", "num_starts": 1, "num_screened": 4},
            initialization_random_seed=0,
            initialization_budget=3,
        )
    )
    for _ in range(trials):
        for index, arm in ours.get_next_trials(max_trials=1).items():
            y = torch.tensor(6 * arm["x"]).sin().item() + 0.3 * arm["x"] ** 2
            ours.complete_trial(index, {"y": y, "z": arm["x"]})
    return ours


def specs(ours):
    node = ours._generation_strategy.nodes_by_name["MBM"]
    kwargs = node.generator_specs[0].generator_kwargs
    return kwargs["surrogate_spec"], kwargs["transforms"]


@pytest.mark.slow
def test_it_goes_on_from_a_file(named, tmp_path):
    first = client({"y": named}, 3)
    first.save_to_json_file(str(tmp_path / "client.json"))
    again = Client.load_from_json_file(str(tmp_path / "client.json"))
    spec, transforms = specs(again)
    (config,) = spec.metric_to_model_configs["y"]
    assert config.botorch_model_class is CKA
    assert config.model_options["physics"] == ParameterPhysics(named)
    assert spec.model_configs[0].botorch_model_class is ZeroMeanGP
    assert transforms[-1] is TellPhysics
    predicted = []
    for each in (first, again):
        each.get_next_trials(max_trials=1)
        predicted.append(each.predict([{"x": 0.35}])[0]["y"])
    assert predicted[0] == pytest.approx(predicted[1], rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("trials", [0, 1, 2])
def test_it_goes_on_with_the_first_trials_from_a_file(named, tmp_path, trials):
    first = client({"y": {"fine": named}}, trials)
    first.save_to_json_file(str(tmp_path / "client.json"))
    again = Client.load_from_json_file(str(tmp_path / "client.json"))
    strategy = again._generation_strategy
    assert strategy.name == "Center+Sobol+MBM:CKA"
    for _ in range(3 - trials):
        expected, found = (each.get_next_trials(max_trials=1) for each in (first, again))
        assert found == expected


def test_several_physics_are_saved_too(named, tmp_path):
    ours = client({"y": {"coarse": named, "fine": "torch:sin"}}, 1)
    ours.save_to_json_file(str(tmp_path / "client.json"))
    again = Client.load_from_json_file(str(tmp_path / "client.json"))
    (config,) = specs(again)[0].metric_to_model_configs["y"]
    assert config.model_options["physics"] == {
        "coarse": ParameterPhysics(named),
        "fine": ParameterPhysics("torch:sin"),
    }


def test_a_lambda_cannot_be_saved(tmp_path):
    ours = client({"y": lambda x: x}, 0)
    with pytest.raises(JSONEncodeError, match=r"the physics '<lambda>'.*Write `def f_p"):
        ours.save_to_json_file(str(tmp_path / "client.json"))


def test_a_physics_that_is_gone_is_an_error(named, tmp_path, monkeypatch):
    client({"y": named}, 0).save_to_json_file(str(tmp_path / "client.json"))
    monkeypatch.delitem(sys.modules, "my_physics")
    with pytest.raises(ValueError, match=r"'my_physics:f_p' cannot be imported"):
        Client.load_from_json_file(str(tmp_path / "client.json"))
