"""What a physics is asked, and the units in which it answers, whatever Ax transforms."""

import pytest
import torch
from ax.adapter.registry import Cont_X_trans, Generators, MBM_X_trans, Mixed_transforms, Y_trans
from ax.adapter.transforms.log_y import LogY
from ax.adapter.transforms.unit_x import UnitX
from ax.api.client import Client
from ax.api.configs import ChoiceParameterConfig, RangeParameterConfig
from ax.exceptions.core import UserInputError
from ax.generators.torch.botorch_modular.surrogate import SurrogateSpec
from ax.generators.torch.botorch_modular.utils import ModelConfig
from botorch.models.transforms.input import Normalize

from gpadjust import CKA, BlackBoxPhysics, FunctionPhysics, Unknown
from gpadjust.ax import TRANSFORMS, ParameterPhysics, TellPhysics, generator_kwargs
from tests.systems import refused

# Data without noise, on which Ax's acquisition functions are nearly singular.
pytestmark = pytest.mark.filterwarnings(
    "ignore::linear_operator.utils.warnings.NumericalWarning",
    "ignore::botorch.exceptions.warnings.OptimizationWarning",
    "ignore:Optimization failed",
)

FAST = {"method": "map"}
PARAMETERS = [
    RangeParameterConfig(name="rate", parameter_type="float", bounds=(1e-4, 1.0), scaling="log"),
    RangeParameterConfig(name="width", parameter_type="int", bounds=(1, 9)),
    RangeParameterConfig(name="x", parameter_type="float", bounds=(-2.0, 3.0)),
    ChoiceParameterConfig(
        name="glue", parameter_type="str", values=["a", "b", "c"], is_ordered=False
    ),
    ChoiceParameterConfig(
        name="size", parameter_type="float", values=[0.5, 2.0, 8.0], is_ordered=True
    ),
    ChoiceParameterConfig(name="grid", parameter_type="int", values=[7, 3, 5], is_ordered=False),
]
ARMS = [
    {"rate": 1e-4, "width": 1, "x": -2.0, "glue": "a", "size": 0.5, "grid": 3},
    {"rate": 0.03, "width": 4, "x": 3.0, "glue": "c", "size": 8.0, "grid": 7},
    {"rate": 1.0, "width": 9, "x": 0.1, "glue": "b", "size": 2.0, "grid": 5},
    {"rate": 0.2, "width": 2, "x": 1.5, "glue": "b", "size": 0.5, "grid": 5},
    {"rate": 1e-3, "width": 7, "x": -0.4, "glue": "a", "size": 8.0, "grid": 3},
]


def truth(rate, width, x, size, grid):
    return 400 + 50 * rate + width * x**3 + 10 * size + grid


class Recorded:
    """A physics that remembers what it was asked."""

    def __init__(self, error=0.0):
        self.asked = []
        self.error = error

    def __call__(self, rate, x, width, size, grid):
        self.asked.append(torch.stack([rate, width, x, size, grid], dim=-1).detach())
        return truth(rate, width, x, size, grid) + self.error * torch.sin(5 * x + width)


def experiment(parameters=PARAMETERS, arms=ARMS, constrained=True):
    client = Client()
    client.configure_experiment(parameters=parameters)
    constraints = ["load <= 415"] if constrained else []
    client.configure_optimization(objective="-cost", outcome_constraints=constraints)
    for arm in arms:
        index = client.attach_trial(arm)
        y = truth(*(arm.get(name, 0.0) for name in ("rate", "width", "x", "size", "grid")))
        client.complete_trial(index, {"cost": y, **({"load": y} if constrained else {})})
    return client._experiment


def adapter(experiment, physics, transforms=TRANSFORMS, config=None, metrics=("cost", "load")):
    options = {"botorch_model_class": CKA, "mll_options": FAST, **(config or {})}
    configs = {
        metric: [ModelConfig(model_options={"physics": physics}, **options)] for metric in metrics
    }
    spec = SurrogateSpec(metric_to_model_configs=configs)
    return Generators.BOTORCH_MODULAR(
        experiment=experiment, surrogate_spec=spec, transforms=transforms
    )


def models(adapter):
    surrogate = adapter.generator.surrogate
    found = getattr(surrogate.model, "models", [surrogate.model])
    return dict(zip(surrogate.outcomes, found, strict=True))


@pytest.mark.parametrize(
    "transforms",
    [TRANSFORMS, [*MBM_X_trans, *Y_trans, TellPhysics], [*Cont_X_trans, *Y_trans, TellPhysics]],
    ids=["ours", "Ax's default", "continuous relaxation"],
)
def test_the_physics_is_asked_in_the_search_space_and_answers_as_the_metric(transforms):
    f_p = Recorded()
    fitted = adapter(experiment(), f_p, transforms)
    names = ("rate", "width", "x", "size", "grid")
    expected = torch.tensor([[arm[n] for n in names] for arm in ARMS], dtype=torch.float64)
    torch.testing.assert_close(f_p.asked[0], expected, rtol=1e-9, atol=1e-12)
    for model in models(fitted).values():
        # f_p is the truth, so that what it says is what Ax made of the data.
        f = model.physics[0](model.data.X)
        torch.testing.assert_close(f, model.data.Y, rtol=1e-9, atol=1e-9)
    size, cost = model.data.X.shape[-1], model.data.Y
    assert size > 6  # codes of choices are columns
    assert cost.abs().max() < 5  # and metrics standardised


def test_it_is_asked_within_the_search_space_alone():
    fitted = models(adapter(experiment(), Recorded(), metrics=["cost"]))
    assert type(fitted["load"]).__name__ == "SingleTaskGP"  # Ax's own
    (physics,), inside = fitted["cost"].physics, fitted["cost"].data.X[:1]
    beyond = inside - 0.7 * torch.eye(inside.shape[-1], dtype=torch.float64)[:3]
    asked = physics.units.raw(beyond, ["rate", "width", "x"])
    assert asked[0].tolist() == [1e-4, 1.0, -2.0]
    assert (asked >= torch.tensor([1e-4, 1.0, -2.0], dtype=torch.float64)).all()
    beyond.requires_grad_()
    (slope,) = torch.autograd.grad(physics(beyond).sum(), beyond)
    assert (slope[:, :2] != 0).any()  # or a search that begins at a bound would stay there


def test_gradients_pass_the_transforms():
    fitted = adapter(experiment(), Recorded())
    for model in models(fitted).values():
        (physics,), X = model.physics, model.data.X[1:2].clone().requires_grad_()
        (slope,) = torch.autograd.grad(physics(X).sum(), X)
        step = 1e-6 * torch.eye(2, X.shape[-1], dtype=torch.float64)  # rate and width
        by_difference = ((physics(X + step) - physics(X - step)) / 2e-6).mT
        torch.testing.assert_close(slope[:, :2], by_difference.detach(), rtol=1e-5, atol=1e-7)
        assert slope[:, :2].abs().min() > 1e-3


WIDTHS = {"name": "width", "parameter_type": "int"}


@pytest.mark.parametrize(
    "config",
    [
        ChoiceParameterConfig(**WIDTHS, values=[1, 2, 4, 8], is_ordered=True),
        ChoiceParameterConfig(
            name="width", parameter_type="float", values=[1.0, 2.0, 4.0, 8.0], is_ordered=True
        ),
        RangeParameterConfig(**WIDTHS, bounds=(1, 8)),
        RangeParameterConfig(**WIDTHS, bounds=(1, 8), scaling="log"),
    ],
    ids=["choice", "choice of floats", "range", "log"],
)
def test_whole_numbers_reach_the_physics_as_they_are_listed(config):
    asked = []

    def f_p(width, x):
        asked.append(width.detach())
        return width.long().double() + x

    values = [1, 2, 4, 8] if isinstance(config, ChoiceParameterConfig) else [*range(1, 9)]
    kind = float if config.parameter_type == "float" else int
    arms = [{"width": kind(n), "x": 0.2 * i - 1} for i, n in enumerate(values)]
    fitted = adapter(experiment([config, PARAMETERS[2]], arms), f_p, metrics=["cost"])
    assert asked[0].tolist() == values
    X = models(fitted)["cost"].data.X
    near = X + 1e-12 * torch.randn(X.shape, dtype=torch.float64)
    asked.clear()
    models(fitted)["cost"].physics[0](near)
    assert asked[0].tolist() == values


SIZES = [PARAMETERS[4], PARAMETERS[2]]
SIZED = [{"size": arm["size"], "x": arm["x"]} for arm in ARMS]


def test_between_choices_the_nearest_is_asked():
    fitted = adapter(experiment(SIZES, SIZED), lambda size, x: size * x, metrics=["cost"])
    units = models(fitted)["cost"].physics[0].units
    between = torch.tensor([[0.0, 0.0], [1.2, 0.0], [1.3, 0.0], [9.0, 0.0]], dtype=torch.float64)
    between.requires_grad_()
    raw = units.raw(between, ["size"])
    assert raw.flatten().tolist() == [0.5, 0.5, 2.0, 8.0]
    (slope,) = torch.autograd.grad(raw.sum(), between)
    assert (slope[:, 0] == 1).all()


def test_a_tensor_has_the_columns_of_the_search_space_fixed_ones_too():
    fixed = ChoiceParameterConfig(**WIDTHS, values=[4])
    asked = []

    def f_p(X):
        asked.append(X.copy())
        return X.sum(-1)

    arms = [{"x": arm["x"], "rate": arm["rate"], "width": 4} for arm in ARMS]
    parameters = [PARAMETERS[2], PARAMETERS[0], fixed]
    adapter(experiment(parameters, arms), BlackBoxPhysics(f_p), metrics=["cost"])
    expected = torch.tensor([[*arm.values()] for arm in arms], dtype=torch.float64)
    torch.testing.assert_close(torch.from_numpy(asked[0]), expected, rtol=1e-9, atol=1e-12)


def test_a_second_experiment_leaves_the_units_of_the_first():
    f_p = ParameterPhysics(Recorded())
    kwargs = generator_kwargs({"cost": f_p}, fit_options=FAST)
    first = Generators.BOTORCH_MODULAR(experiment=experiment(), **kwargs)
    before = models(first)["cost"].physics[0].units
    shifted = experiment(arms=ARMS[:4])
    second = Generators.BOTORCH_MODULAR(experiment=shifted, **kwargs)
    assert models(first)["cost"].physics[0].units is before
    assert models(second)["cost"].physics[0].units is not before
    assert first.generator.surrogate_spec is not second.generator.surrogate_spec
    assert kwargs["surrogate_spec"].metric_to_model_configs["cost"][0].model_options == {
        "physics": f_p
    }


LATE, LOGGED = [*TRANSFORMS, UnitX], [*MBM_X_trans, LogY, TellPhysics]
REFUSED = [
    ({"transforms": [*MBM_X_trans, *Y_trans]}, "would get inputs after Ax's.*TellPhysics"),
    ({"transforms": LATE}, "TellPhysics as the last.*found UnitX after it"),
    ({"transforms": LOGGED}, r"transform\(s\) LogY of Ax are not supported"),
    ({"transforms": [*Mixed_transforms, TellPhysics]}, "no kernel for categorical"),
    ({"config": {"input_transform_classes": [Normalize]}}, "makes its own parts"),
    ({"metrics": ["costs"]}, "unknown metric costs; expected some of cost, load"),
    ({"physics": lambda X: X[:, 0]}, r"reads the parameter\(s\) glue, which are text"),
    ({"physics": lambda rate, speed: rate}, "but speed is not a parameter"),
    ({"physics": lambda rate: torch.stack([rate, rate], -1)}, "2 columns for the me"),
]


@pytest.mark.parametrize(("change", "words"), REFUSED)
def test_what_cannot_be_right_is_an_error(change, words):
    errors = (ValueError, UserInputError, RuntimeError)
    refused(errors, words, adapter, experiment(), **{"physics": Recorded(), **change})


def test_of_a_single_metric_it_is_of_that_with_unknown_parameters():
    unknowns = {"a": Unknown(5.0, factor=3.0)}
    law = FunctionPhysics(lambda X, p: 400 + p.a * X[:, 0], unknowns=unknowns)
    config = ModelConfig(botorch_model_class=CKA, model_options={"physics": law}, mll_options=FAST)
    spec = SurrogateSpec(model_configs=[config])
    options = {"surrogate_spec": spec, "transforms": TRANSFORMS}
    of_size = experiment(SIZES, SIZED, constrained=False)
    model = models(Generators.BOTORCH_MODULAR(experiment=of_size, **options))["cost"]
    assert model.physics[0].metric == "cost"
    assert model.physics_parameters["a"].mean().item() == pytest.approx(10, rel=0.02)
