"""The first trial: where the physics is best, or at the centre where it does not say."""

import logging

import numpy as np
import pytest
import torch
from ax.api.client import Client
from ax.api.configs import ChoiceParameterConfig, RangeParameterConfig
from ax.core.parameter import DerivedParameter, ParameterType, RangeParameter

from gpadjust import BlackBoxPhysics, Unknown
from gpadjust.ax import generation_strategy
from gpadjust.ax.physics_optimum import NUM_REFINED, NUM_SOBOL, STEPS
from gpadjust.physics import FunctionPhysics


def number(name, lower=0.0, upper=1.0, **options):
    options = {"parameter_type": "float", **options}
    return RangeParameterConfig(name=name, bounds=(lower, upper), **options)


def choice(name, values, kind="int", ordered=True):
    return ChoiceParameterConfig(name=name, values=values, parameter_type=kind, is_ordered=ordered)


X, Y = number("x"), number("y")


def client(parameters, physics, objective="-cost", limits=(), within=(), **options):
    ours = Client()
    ours.configure_experiment(parameters=parameters, parameter_constraints=within)
    ours.configure_optimization(objective=objective, outcome_constraints=limits)
    ours.set_generation_strategy(generation_strategy(physics, **options))
    return ours


def first(ours):
    ((_, parameters),) = ours.get_next_trials(max_trials=1).items()
    return parameters


def key(ours):
    """Which generator made the last trial."""
    return [*ours._experiment.trials.values()][-1].generator_runs[0]._generator_key


BOWL = {"cost": lambda x, y: (x - 0.3) ** 2 + 3 * (y - 0.8) ** 2}


@pytest.mark.parametrize("objective", ["-cost", "cost"])
def test_it_is_at_the_optimum_of_the_physics_either_way(objective):
    sign = 1.0 if objective == "-cost" else -1.0
    ours = client([X, Y], {"cost": lambda x, y: sign * BOWL["cost"](x, y)}, objective)
    assert first(ours) == pytest.approx({"x": 0.3, "y": 0.8}, abs=0.01)
    assert key(ours) == "PhysicsOptimum"


def test_the_best_of_several_optima_is_taken():
    ours = client([X], {"cost": lambda x: (6 * x - 2) ** 2 * (12 * x - 4).sin()})  # Forrester's
    assert first(ours)["x"] == pytest.approx(0.75725, abs=1e-3)


def test_an_optimum_at_bounds_is_there_exactly():
    ours = client([X, number("y", -3, 5)], {"cost": lambda x, y: y - x})
    assert first(ours) == {"x": 1.0, "y": -3.0}


def test_a_log_scale_is_searched_as_one():
    rate = number("rate", 1e-6, 1.0, scaling="log")
    ours = client([rate], {"cost": lambda rate: (rate.log10() + 4.3) ** 2})
    assert np.log10(first(ours)["rate"]) == pytest.approx(-4.3, abs=0.01)


def test_whole_numbers_and_choices():
    parameters = [
        number("n", 1, 200, parameter_type="int"),
        choice("size", [1, 2, 4, 8]),
        choice("grid", [7, 3, 5], ordered=False),
        choice("glue", ["a", "b", "c"], "str", ordered=False),
        X,
    ]

    def f_p(n, size, grid, x):
        return (n / 100 - 1.37) ** 2 + (size - 4) ** 2 / 9 + (grid - 3).abs() + (x - 0.2) ** 2

    found = first(client(parameters, {"cost": f_p}))
    assert (found["n"], found["size"], found["grid"]) == (137, 4, 3)
    assert found["x"] == pytest.approx(0.2, abs=0.02)
    assert found["glue"] == "b"  # in the middle, as f_p does not read it
    assert [type(found[name]) for name in ("n", "size", "grid")] == [int, int, int]


def test_a_space_of_few_points_is_gone_through_once():
    asked = []

    def f_p(n):
        asked.append(len(n))
        return (n - 2) ** 2

    assert first(client([choice("n", [1, 2, 4, 8])], {"cost": f_p})) == {"n": 2}
    assert asked[0] == 4
    assert max(asked) == 4


def test_parameter_constraints_are_kept():
    for within, expected in (
        ("x + y <= 0.5", {"x": 0.5, "y": 0.0}),
        ("x + 2*y >= 2.5", {"x": 1.0, "y": 0.75}),
    ):
        ours = client([X, Y], {"cost": lambda x, y: y - 2 * x}, within=[within])
        found = first(ours)
        assert found == pytest.approx(expected, abs=0.02)
        assert ours._experiment.search_space.check_membership(found)


def test_what_is_not_read_stays_at_the_centre_unless_it_is_tied():
    parameters = [X, Y, number("z", 1.0, 100.0, scaling="log")]
    ours = client(parameters, {"cost": lambda x: (x - 0.9) ** 2}, within=["x + y <= 1"])
    found = first(ours)
    assert found["x"] == pytest.approx(0.9, abs=0.01)
    assert found["y"] <= 0.11
    assert found["z"] == pytest.approx(10.0)


def test_outcome_constraints_with_a_physics_are_kept():
    physics = {"cost": lambda x, y: -x - y, "waste": lambda x: x**2}
    ours = client([X, Y], physics, limits=["waste <= 0.25", "noise <= 1"])
    found = first(ours)
    assert found == pytest.approx({"x": 0.5, "y": 1.0}, abs=0.01)
    assert found["x"] ** 2 <= 0.25


def test_of_constraints_that_cannot_be_kept_as_little_as_possible_is_broken():
    physics = {"cost": lambda x, y: -x - y, "output": lambda x: x}
    found = first(client([X, Y], physics, limits=["output <= -1"]))
    assert found == pytest.approx({"x": 0.0, "y": 1.0}, abs=1e-6)


def test_limits_relative_to_a_status_quo_are_not_looked_at():
    physics = {"cost": lambda x: -x, "waste": lambda x: x}
    ours = client([X], physics, limits=["waste <= 0.1*baseline"])
    ours._experiment.status_quo = None
    assert first(ours) == {"x": 1.0}


def test_a_weighted_sum_of_metrics_is_optimised_as_it_is():
    physics = {"cost": lambda x: (x - 0.2) ** 2, "waste": lambda x: (x - 0.8) ** 2}
    ours = client([X], physics, objective="-cost - 2*waste")
    assert first(ours)["x"] == pytest.approx(0.6, abs=0.01)


def test_several_objectives_count_alike_whatever_their_units():
    physics = {"cost": lambda x: (x - 0.2) ** 2, "waste": lambda x: 1e6 * (x - 0.8) ** 2}
    ours = client([X], physics, objective="-cost, -waste")
    assert first(ours)["x"] == pytest.approx(0.5, abs=0.01)


def test_several_physics_of_a_metric_count_by_their_mean():
    both = [lambda x: (x - 0.2) ** 2, lambda x: 3 * (x - 0.6) ** 2]
    for several in (both, dict(zip("ab", both, strict=True))):
        assert first(client([X], {"cost": several}))["x"] == pytest.approx(0.5, abs=0.01)


def test_unknown_parameters_are_at_their_guesses():
    physics = FunctionPhysics(
        lambda X, p: (X[:, 0] - p.best) ** 2, unknowns={"best": Unknown(0.35, factor=2.0)}
    )
    assert first(client([X], {"cost": physics}))["x"] == pytest.approx(0.35, abs=0.01)


def test_it_is_the_same_each_time_and_leaves_what_is_random_alone():
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    found = [first(client([X, Y], BOWL)) for _ in range(2)]
    assert found[0] == found[1]
    assert torch.equal(torch.rand(1), expected)


def test_a_black_box_is_asked_in_five_batches():
    asked = []

    def simulation(X):
        asked.append(X)
        return (X[:, 0] - 0.3) ** 2 + X[:, 1] ** 2

    ours = client([X, Y], {"cost": BlackBoxPhysics(simulation)})
    assert first(ours)["x"] == pytest.approx(0.3, abs=0.01)
    assert [len(rows) for rows in asked] == [NUM_SOBOL] + [NUM_REFINED] * len(STEPS)
    assert (NUM_SOBOL, NUM_REFINED, len(STEPS)) == (1024, 64, 4)
    rows = np.concatenate(asked)
    assert rows.min() >= 0
    assert rows.max() <= 1
    ours.get_next_trials(max_trials=1)  # a Sobol point
    assert len(asked) == 5


CENTRE = {"x": 0.5, "y": 0.5}


def test_where_no_physics_tells_it_is_at_the_centre():
    for physics, objective in (
        ({"waste": lambda x: x}, "-cost"),
        ({"waste": lambda x: x}, "-cost - waste"),
        ({"waste": lambda x: x}, "-cost, -waste"),
        ({"cost": lambda x: x * torch.nan}, "-cost"),
        ({"cost": lambda x: 1 // 0}, "-cost"),
        ({"cost": lambda x: torch.stack([x, x], -1)}, "-cost"),
    ):
        ours = client([X, Y], physics, objective, limits=[])
        assert first(ours) == CENTRE
        assert key(ours) == "CenterOfSearchSpace"
        assert ours.get_next_trials(max_trials=1)
        assert key(ours) == "Sobol"
    assert first(client([X, Y], {"cost": lambda x: 0 * x})) == CENTRE


@pytest.fixture
def logged(caplog, monkeypatch):
    """What Ax's loggers say, which they keep to themselves."""
    monkeypatch.setattr(logging.getLogger("ax"), "propagate", True)
    return caplog


def test_a_failure_is_logged(logged):
    first(client([X], {"cost": lambda x: x * torch.nan}))
    assert "center of the search space: The physics of cost fail at each of 1024" in logged.text


def test_that_choices_repeat_is_not(logged):
    first(client([choice("n", [1, 2, 4, 8])], {"cost": lambda n: n}))
    assert [record.levelname for record in logged.records if record.levelno > 20] == []


def test_points_at_which_a_physics_fails_are_left_out():
    def f_p(x):
        return torch.where(x > 0.6, torch.nan, (x - 0.9) ** 2)

    assert first(client([X], {"cost": f_p}))["x"] == pytest.approx(0.6, abs=0.01)


def test_what_a_physics_cannot_read_is_said_before_the_first_trial():
    glue = choice("glue", ["a", "b"], "str")
    for physics, words in (
        (lambda x, speed: x, "but speed is no parameter of the search space"),
        (lambda x, glue: x, r"reads the parameter\(s\) glue, which are text"),
    ):
        with pytest.raises(ValueError, match=words):
            first(client([X, glue], {"cost": physics}))


def test_a_derived_parameter_follows():
    ours = client([X, Y], {"cost": lambda x, both: (both - 1.4) ** 2 + (x - 0.9) ** 2})
    both = DerivedParameter(
        name="both", parameter_type=ParameterType.FLOAT, expression_str="1.0*x + 1.0*y"
    )
    ours._experiment.search_space.add_parameter(both)
    found = first(ours)
    assert found["both"] == pytest.approx(found["x"] + found["y"])
    assert found == pytest.approx({"x": 0.9, "y": 0.5, "both": 1.4}, abs=0.02)


def test_a_logit_scale_is_searched_as_one():
    ours = client([X], {"cost": lambda share: ((share / (1 - share)).log() - 6) ** 2})
    share = RangeParameter(
        "share", ParameterType.FLOAT, lower=1e-4, upper=1 - 1e-4, logit_scale=True
    )
    ours._experiment.search_space.add_parameter(share)
    found = first(ours)["share"]
    assert np.log(found / (1 - found)) == pytest.approx(6, abs=0.05)


def test_a_trial_that_is_there_is_not_made_again():
    found = first(client([X], {"cost": lambda x: -x}))
    ours = client([X], {"cost": lambda x: -x}, use_existing_trials_for_initialization=False)
    ours.attach_trial(found)
    assert first(ours) != found
    assert key(ours) == "Sobol"


def test_it_is_left_out_where_existing_trials_count_as_in_ax():
    for counted, expected in ((True, "Sobol"), (False, "PhysicsOptimum")):
        options = {"use_existing_trials_for_initialization": counted}
        ours = client([X], {"cost": lambda x: -x}, **options)
        ours.complete_trial(ours.attach_trial({"x": 0.1}), {"cost": 0.1})
        first(ours)
        assert key(ours) == expected


def test_options_say_where_trials_begin():
    for options, nodes, start in (
        ({}, ["PhysicsOptimum", "Sobol", "MBM"], 1.0),
        ({"initialize_with_center": True}, ["CenterOfSearchSpace", "Sobol", "MBM"], 0.5),
        ({"initialize_with_center": False}, ["Sobol", "MBM"], None),
        ({"initialization_budget": 1}, ["PhysicsOptimum", "MBM"], 1.0),
        ({"initialization_budget": 0}, ["MBM"], None),
    ):
        ours = client([X], {"cost": lambda x: -x}, **options)
        strategy = ours._generation_strategy
        name = "+".join([*nodes[:-1], "MBM:CKA"]).replace("CenterOfSearchSpace", "Center")
        assert strategy.name == name
        assert [node.name for node in strategy._nodes] == nodes
        if start is not None:
            assert first(ours) == {"x": start}


def test_as_many_trials_come_before_the_model_as_in_ax():
    ours = client([X], {"cost": lambda x: -x}, initialization_random_seed=0)
    keys = []
    for _ in range(5):
        ((index, parameters),) = ours.get_next_trials(max_trials=1).items()
        ours.complete_trial(index, {"cost": parameters["x"]})
        keys.append(key(ours))
    assert keys == ["PhysicsOptimum", *["Sobol"] * 4]
    assert ours._generation_strategy.current_node.should_transition_to_next_node()[1] == "MBM"
