"""A physics that is a text."""

import math

import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust import CKA, Unknown, load, save
from gpadjust.physics import FormulaPhysics, PhysicsError
from gpadjust.physics.base import symbol
from gpadjust.physics.import_path import import_path, physics_from_path
from tests.systems import refused

X = torch.tensor([[1.0, 2.0], [0.5, -3.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("formula", "value"),
    {
        "a + b*2 - -a/4": lambda a, b: a + 2 * b + a / 4,
        "a**2**0.5": lambda a, b: a ** (2**0.5),
        "sqrt(a) * sin(pi*b) + exp(-a)": lambda a, b: a**0.5 * (torch.pi * b).sin() + (-a).exp(),
        "where(b < 0, a, max(a, abs(b)))": lambda a, b: torch.where(b < 0, a, b.abs()),
        "(a >= 1) * atan2(a, b)": lambda a, b: (a >= 1) * torch.atan2(a, b),
        "(a < 0.7) + (a < 1.1) - (b < 0)": lambda a, b: 1.0 + (a < 0.7).to(a) - (b < 0).to(a),
        "where(a, -(b < 0), b)": lambda a, b: -(b < 0).to(a),
        "1e3 + ln(a) - log(a)": lambda a, b: 1000 + 0 * a,
        "a^2 \u2212 3\u00b7b^(1+1)": lambda a, b: a**2 - 3 * b**2,
        "-(a^2) + (-a)^2 - 2^-a": lambda a, b: -(2**-a),
        "= 2*SQRT(a)*PI() + IF(b<0; 0,5; 1,5)": lambda a, b: (
            2 * torch.pi * a.sqrt() + torch.where(b < 0, 0.5, 1.5)
        ),
        "=0,5*a": lambda a, b: 0.5 * a,
        "=IF(a<1,5,b)": lambda a, b: torch.where(a < 1, 5.0, b),
        "=wurzel(POTENZ(a;2))+MAX(a;0,75)": lambda a, b: a.abs() + a.clamp_min(0.75),
        "a^1,5 * max(a; 1)": lambda a, b: a**1.5 * a.clamp_min(1.0),
    }.items(),
)
def test_values_are_those_of_torch(formula, value):
    found = FormulaPhysics(formula, ["a [m]", "b"])(X)
    torch.testing.assert_close(found, value(*X.unbind(-1)).unsqueeze(-1))


def test_several_outputs_and_gradients():
    physics = FormulaPhysics("2 * b, -b", ["a", "b"])
    assert physics.num_outputs == 2
    torch.testing.assert_close(physics(X), torch.stack([2 * X[:, 1], -X[:, 1]], -1))
    inputs = X.clone().requires_grad_()
    FormulaPhysics("a**2 * b", ["a", "b"])(inputs).sum().backward()
    torch.testing.assert_close(inputs.grad, torch.stack([2 * X[:, 0] * X[:, 1], X[:, 0] ** 2], -1))


WRONG = {
    "": "Expected a formula such as",
    "a ** (": "never closed",
    "-a^2": r"'-a \*\* 2' has two meanings: .*write brackets",
    "b*-sin(a)^2": "has two meanings",
    "a^b^2": "has two meanings",
    "=LOG(a)": r"LOG of a spreadsheet has the base 10: write log10\(x\), or ln\(x\)",
    "2*LOG(a)": "LOG of a spreadsheet",
    "=atan2(a; b)": "ATAN2 of a spreadsheet takes x first",
    "=a, b": "a formula with = in front has one output",
    "=A1:A2": "Expected a formula such as",
    "head = a": "leave out 'head ='",
    "a\u00b2 + b": r"write 'a\^2'",
    "sinn(a)": r"'sinn\(a\)' is not a part of a formula.*functions sin, ",
    "max(a)": r"missing 1 required.*such as max\(a, b\)",
    "where(a, b)": "missing 1 required",
    "sin(a, b)": "takes 1 positional",
    "()": r"'\(\)' is not a part",
    "a < b < 2": "'a < b < 2' is not a part of a formula.*comparisons of two values",
    "a == b": "'a == b' is not a part",
    "c * a": "has 'c'; expected one of its names: a, b",
    "True": "'True' is not a part",
    "'a'": "is not a part",
    "2j": "'2j' is not a part",
    "1" + "0" * 400: "too large",
    "(" * 300 + "a" + ")" * 300: "too many nested",
    "a + " * 900 + "a": "more than 2000 characters",
    "a+" * 900 + "a": "recursion depth",
    "-" * 900 + "a": "recursion depth",
    "\ud800": "Expected a formula such as",
}


CODE = [
    *("__import__('os')", "a.__class__", "().__class__", "[a for a in (1,)]", "lambda: a"),
    *("a if b else a", "f'{a}'", "a[0]", "(a := 2)", "exec(a)", "sin(*a)", "sin(x=a)", "a @ b"),
]


def test_texts_that_are_no_formula():
    for formula, says in {**WRONG, **dict.fromkeys(CODE, "Expected a formula such as")}.items():
        refused(ValueError, says, FormulaPhysics, formula, ["a", "b"])


@given(st.text(max_size=30))
def test_any_text_is_a_formula_or_an_error_of_ours(text):
    try:
        found = FormulaPhysics(text, ["a", "b"]).num_outputs
    except ValueError as error:
        found = "formula" in str(error)
    assert found


def test_names_and_columns():
    names = ["air flow [m3/h]", "E", "2nd", "dT/dt", "lambda [W/mK]", "\u00b5"]
    assert [*map(symbol, names)] == ["air_flow", "E", "_2nd", "dT_dt", "lambda_", "\u03bc"]
    assert FormulaPhysics("\u00b5", ["\u00b5 [m]"])(X[:, :1])[0] == 1
    refused(ValueError, r"found \['a', 'a'\]", FormulaPhysics, "a", ["a", "a [m]"])
    words, a = "'a' is a column and an unknown parameter in 'a'", {"a": Unknown(1.0, sd=1.0)}
    refused(ValueError, words, FormulaPhysics, "a", ["a"], unknowns=a)
    refused(TypeError, "must be a text", FormulaPhysics, torch.sin, ["a"])
    data = pd.DataFrame(X.numpy(), columns=["b [m]", "a"])
    formula = FormulaPhysics("a * b", ["a", "b"])
    words = "has the columns a, b, and the data have b, a"
    for physics in (formula, [formula, torch.sin]):
        refused(ValueError, words, CKA, data, X[:, :1], physics=physics)
    CKA(data[["a", "b [m]"]], X[:, :1], physics=formula)
    refused(PhysicsError, r"has columns \('a', 'b'\), and X has 1", formula, X[:, :1])


@pytest.mark.parametrize("word", ["lambda", "in", "if", "class", "is"])
def test_words_of_python_are_names(word):
    for written in (word, f"{word}_"):
        physics = FormulaPhysics(f"2*{written} + b - max({written}, 0)", [f"{word} [m]", "b"])
        torch.testing.assert_close(physics(X)[:, 0], X[:, 0] + X[:, 1])


def test_a_column_pi_or_e_is_never_the_constant():
    for formula in ("2*(pi - b)", "b * pi_ + pi"):
        words = "has pi, which is 3.14159, and there is a column 'pi', which is pi_"
        refused(ValueError, words, FormulaPhysics, formula, ["pi [bar]", "b"])
    assert FormulaPhysics("pi_ * PI()", ["pi", "b"])(X)[0] == math.pi
    assert FormulaPhysics("e * E", ["e", "E"])(X)[0] == 2
    refused(ValueError, "has 'e'; expected one of", FormulaPhysics, "e * b", ["a", "b"])
    pi = {"pi": Unknown(1.0, sd=1.0)}
    refused(ValueError, "none 'pi'", FormulaPhysics, "pi * a", ["a"], unknowns=pi)


def test_a_formula_can_be_made_of_its_text_and_is_saved(tmp_path):
    unknowns = {"c": Unknown(2.0, sd=0.5, bounds=(0.0, math.inf), unit="m")}
    physics = FormulaPhysics("c * a + b", ["a", "b"], unknowns=unknowns, name="my law")
    again = physics_from_path(import_path(physics))
    assert (again.formula, again.columns, again.name) == ("c * a + b", ("a", "b"), "my law")
    assert again.unknowns == physics.unknowns
    assert torch.equal(again(X), physics(X))
    for damaged in ("formula:", "formula:{}", import_path(physics).replace("c *", "d *")):
        refused(ValueError, "which is damaged", physics_from_path, damaged)
    model = CKA(X, 2 * X[:, :1], physics=physics)
    assert save(model, tmp_path / "model.pt").missing == ()
    again = load(tmp_path / "model.pt")
    torch.testing.assert_close(again.predict(X)[0], model.predict(X)[0], rtol=0, atol=1e-6)
