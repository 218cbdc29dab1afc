"""Physics of a formula that is a text."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from keyword import kwlist
from typing import Any
from unicodedata import normalize

import torch
from torch import Tensor

from gpadjust.checks import check_kind
from gpadjust.physics.base import Physics, symbol
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

Functions = Mapping[str, Callable[..., Any]]
"""Functions of a formula by their names, and of operators by their names in a tree."""

_LONGEST = 2000  # characters
# Parts of a tree, and the functions of the module operator.
_PAIRS = "Add:add Sub:sub Mult:mul Div:truediv Pow:pow USub:neg UAdd:pos"
ARITHMETIC: Functions = {
    part: getattr(operator, name) for part, name in (pair.split(":") for pair in _PAIRS.split())
}
NAMES = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh"),
    *("exp", "log", "log10", "sqrt", "abs", "sign", "ln", "min", "max", "pow", "where"),
)
_OF_TORCH: Functions = {
    **ARITHMETIC,
    **{name: getattr(torch, name) for name in NAMES if hasattr(torch, name)},
    # A comparison is one or zero.
    "Lt": lambda x, y: (x < y).to(x),
    "LtE": lambda x, y: (x <= y).to(x),
    "Gt": lambda x, y: (x > y).to(x),
    "GtE": lambda x, y: (x >= y).to(x),
    "ln": torch.log,
    "min": torch.minimum,
    "max": torch.maximum,
    "where": lambda c, x, y: torch.where(c != 0, x, y),
}
_OF_SHEETS = {"wurzel": "sqrt", "power": "pow", "potenz": "pow", "if": "where", "wenn": "where"}
_OTHERWISE = {  # the meaning in spreadsheets, and the way out
    "log": "LOG of a spreadsheet has the base 10: write log10(x), or ln(x)",
    "atan2": "ATAN2 of a spreadsheet takes x first: write atan2(y, x) in small letters, without =",
}
_SIGNS = str.maketrans({"\u2212": "-", "\u00b7": "*", "\u00d7": "*", "\u00f7": "/", "^": "**"})
_WORDS = re.compile(rf"\b({'|'.join({*kwlist} - {'True', 'False', 'None'})})\b")
_ASSIGNED = re.compile(r"[^\W\d]\w*\s*=(?!=)")  # k = at the beginning
_RAISED = re.compile(r"([^\W\u00b2\u00b3]*)([\u00b2\u00b3])")  # b with a small 2 or 3
_GRAMMAR = (
    "Formulas have numbers, names, pi, + - * / and ** or ^, brackets, comparisons of two values "
    f"such as a < b, and the functions {', '.join(NAMES)}, such as max(a, b) and "
    "where(a < b, x, y). Commas part the outputs. There are no units, and water flow is water_flow."
)


class FormulaPhysics(Physics):
    """Physics given as a formula, a text in Python's notation, which a saved model contains.

    It is read, never executed, so that a stranger's formula is harmless.

    Args:
        formula: The output, or outputs with commas between them, such as ``"U * I, U / I"``. It has
            numbers, names of columns and of unknown parameters, ``pi``, ``+ - * / **`` (or ``^``),
            comparisons, and the functions sin, cos, tan, asin, acos, atan, atan2, sinh, cosh, tanh,
            exp, log and ln (the same), log10, sqrt, abs, sign, pow, min and max of two, and
            ``where(a < b, x, y)``. It may be a spreadsheet's, with ``=`` in front, ``SQRT``,
            ``PI()`` and ``IF``, and in German, ``0,5*MAX(a;b)``.
        columns: The ``d`` names of the columns of X, in the formula without units and with ``_``
            for other marks: "air flow [m3/h]" is ``air_flow``. "lambda" is ``lambda`` or
            ``lambda_``, as all words of Python; a column "pi" is ``pi_``.
        unknowns, name: As of :class:`Physics`. A function has in the formula its value in each row.

    Attributes:
        outputs: The outputs as syntax trees, for :func:`value_of`.

    Example:
        >>> power = FormulaPhysics("U * I", ["U [V]", "I [A]"])
        >>> power(torch.tensor([[230.0, 2.0]], dtype=torch.float64))
        tensor([[460.]], dtype=torch.float64)
    """

    def __init__(
        self,
        formula: str,
        columns: Sequence[str],
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        name: str | None = None,
    ) -> None:
        check_kind("formula", formula, str, "a text")
        super().__init__(unknowns=unknowns, name=name or " ".join(formula.split()))
        self.formula = formula
        self.columns = self.column_names = tuple(map(symbol, columns))
        declared = self.unknowns.declared
        names = [*self.columns, *declared]
        for name in declared:
            if name in self.columns:
                raise ValueError(
                    f"{name!r} is a column and an unknown parameter in {formula!r}: give the "
                    "unknown parameter another name."
                )
        if len({*names}) < len(names) or "pi" in names:
            raise ValueError(f"Expected different names, and none 'pi'; found {names}.")
        self.outputs = parse(formula)
        self.num_outputs = len(self.outputs)
        if has_pi(formula) and "pi_" in names:
            raise ValueError(
                f"The formula {formula!r} has pi, which is 3.14159, and there is a column 'pi', "
                "which is pi_: write pi_, or the number."
            )
        for name in sorted(_names(self.outputs) - {*names, "pi"}):
            raise ValueError(
                f"The formula {formula!r} has {name!r}; expected one of its names: "
                f"{', '.join(names)}. Give its value as a number, or add it to unknowns."
            )
        self.variables = {}
        numbers = [*self.columns, *(name for name in declared if name in self.unknowns)]
        # The variable of a function is a formula, too, of numbers alone.
        for function in self.unknowns.functions:
            text = declared[function].function_of
            (self.variables[function],) = variable = parse(text)
            for name in sorted(_names(variable) - {*numbers, "pi"}):
                raise ValueError(
                    f"{function} is a function of {text!r}, which has {name!r}; expected one of "
                    f"{', '.join(numbers)}, or a formula of these."
                )

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if these are the names of the columns in another order."""
        super().check_names([*map(symbol, names)])

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the values of the formula, ``N x m``."""
        if X.shape[-1] != len(self.columns):
            raise ValueError(f"the formula has columns {self.columns}, and X has {X.shape[-1]}")
        values = parameters[0] if parameters else ParameterValues((), X)
        outputs = self.values_at(X.unbind(-1), values, values.functions, _OF_TORCH, X.new_tensor)
        return torch.stack([Y.expand(len(X)) for Y in outputs], dim=-1)

    def values_at(
        self,
        columns: Sequence[Any],
        parameters: Mapping[str, Any],
        curves: Mapping[str, Callable[[Any], Any]],
        functions: Functions,
        number: Callable[[float], Any],
    ) -> list[Any]:
        """Return the outputs in tensors or numbers of another kind, as of :func:`value_of`."""
        values = dict(zip(self.columns, columns, strict=True)) | dict(parameters)
        value = partial(value_of, values=values, functions=functions, number=number)
        for name, variable in self.variables.items():
            values[name] = curves[name](value(variable))
        return [value(output) for output in self.outputs]


def names_in(formula: str) -> set[str]:
    """Return the names of columns and parameters in a formula."""
    return _names(parse(formula)) - {"pi"}


def has_pi(formula: str) -> bool:
    """Return whether a formula has pi as a name, not as a spreadsheet's function."""
    return "pi" in _names(parse(formula))


def parse(formula: str) -> list[ast.expr]:
    """Return the outputs of a formula, each as a tree of allowed parts, or raise a ValueError.

    A text that cannot be read with points and commas may have decimal commas and semicolons.
    """
    of_sheet = formula.strip().startswith("=")
    text = formula.strip().removeprefix("=").strip()
    # 0,5*MAX(a;b) is 0.5*MAX(a,b)
    continental = re.sub(r"(?<=\d),(?=\d)", ".", text).replace(";", ",")
    errors: list[Exception] = []
    for reading in dict.fromkeys((text, continental)):
        try:
            return _parsed(reading, of_sheet)
        except Exception as error:  # of reading, or of the trial
            errors.append(error)
    cause = errors[-1 if ";" in text else 0]
    message = getattr(cause, "msg", cause)
    if match := _ASSIGNED.match(text):
        message = f"leave out {match[0]!r}"
    elif match := _RAISED.search(text):
        message = f"write '{match[1]}^{normalize('NFKC', match[2])}'"
    raise ValueError(
        f"Expected a formula such as 'force * length**3 / (3 * E * I)', found {formula!r}: "
        f"{message}. {_GRAMMAR}"
    ) from cause


def _parsed(text: str, of_sheet: bool) -> list[ast.expr]:
    """Return the outputs of a formula in Python's notation, or a spreadsheet's, as trees."""
    if len(text) > _LONGEST:
        raise ValueError(f"it has more than {_LONGEST} characters")
    source = _WORDS.sub(r"\1_", text.translate(_SIGNS))
    tree = ast.parse(source, mode="eval").body
    outputs = tree.elts if isinstance(tree, ast.Tuple) and tree.elts else [tree]
    if of_sheet and len(outputs) > 1:
        raise ValueError("a formula with = in front has one output")
    one = torch.ones(())
    for output in outputs:
        # A trial with ones finds parts that are not allowed, and wrong numbers of arguments.
        value_of(output, dict.fromkeys(_names(outputs), one), _OF_TORCH, one.new_tensor)
        for node in ast.walk(output):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name.lower() in _OTHERWISE and (of_sheet or name.isupper()):
                    raise ValueError(_OTHERWISE[name.lower()])
            elif "^" in text and _is_ambiguous(node, source):
                raise ValueError(
                    f"{ast.unparse(node)!r} has two meanings: spreadsheets take -a^2 as (-a)^2, "
                    "and a^b^c as (a^b)^c; write brackets"
                )
    return outputs


def _is_ambiguous(node: ast.AST, source: str) -> bool:
    """Return whether a part is a sign before a power, or a power of a power, without brackets."""
    match node:
        case ast.UnaryOp(operand=ast.BinOp(op=ast.Pow()) as power):
            between = node.col_offset + 1, power.col_offset
        case ast.BinOp(op=ast.Pow(), left=left, right=ast.BinOp(op=ast.Pow()) as power):
            between = left.end_col_offset or 0, power.col_offset
        case _:
            return False
    return b"(" not in source.encode()[slice(*between)]


def _names(outputs: Sequence[ast.expr]) -> set[str]:
    """Return the names in trees, without those of functions."""
    nodes = [node for output in outputs for node in ast.walk(output)]
    functions = [node.func for node in nodes if isinstance(node, ast.Call)]
    return {node.id for node in nodes if isinstance(node, ast.Name) and node not in functions}


def value_of(
    node: ast.expr,
    values: Mapping[str, Any],
    functions: Functions,
    number: Callable[[float], Any],
) -> Any:
    """Return the value of a part of a formula, in tensors or in numbers of another kind.

    ``number`` makes such a number of a float, ``functions`` are of such numbers.
    """
    function: Callable[..., Any] | None = None
    match node:
        case ast.Name(id="pi"):
            return number(math.pi)
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int() | float() as value) if type(value) is not bool:
            return number(float(value))
        case ast.UnaryOp(op=op, operand=operand):
            function, parts = functions.get(type(op).__name__), [operand]
        case (
            ast.BinOp(op=op, left=left, right=right)
            | ast.Compare(ops=[op], left=left, comparators=[right])
        ):
            function, parts = functions.get(type(op).__name__), [left, right]
        case ast.Call(func=ast.Name(id=name), args=[], keywords=[]) if name.lower() == "pi":
            return number(math.pi)
        case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]):
            short = name.lower().rstrip("_")
            if name not in NAMES:
                name = _OF_SHEETS.get(short, short)
            if name in NAMES:
                function = functions.get(name)
    if function is None:
        raise ValueError(f"{ast.unparse(node)!r} is not a part of a formula")
    return function(*(value_of(part, values, functions, number) for part in parts))
