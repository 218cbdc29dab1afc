"""Physics of a formula that is a text."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from keyword import iskeyword
from unicodedata import normalize

import torch
from torch import Tensor

from gpadjust.checks import check_kind
from gpadjust.physics.base import Physics
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

_LONGEST = 2000  # characters
# Parts of a tree, and the functions of the module operator.
_PAIRS = "Add:add Sub:sub Mult:mul Div:truediv Pow:pow USub:neg UAdd:pos Lt:lt LtE:le Gt:gt GtE:ge"
_OPERATORS: dict[str, Callable[..., Tensor]] = {
    part: getattr(operator, name) for part, name in (pair.split(":") for pair in _PAIRS.split())
}
_OF_TORCH = "sin cos tan asin acos atan atan2 sinh cosh tanh exp log log10 sqrt abs sign"
_FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    **{name: getattr(torch, name) for name in _OF_TORCH.split()},
    "ln": torch.log,
    "min": torch.minimum,
    "max": torch.maximum,
    "where": lambda c, x, y: torch.where(c != 0, x, y),
}
_GRAMMAR = (
    "Formulas have numbers, names, pi, + - * / and ** (^ is not a power), brackets, comparisons of "
    f"two values such as a < b, and the functions {', '.join(_FUNCTIONS)}, such as max(a, b) and "
    "where(a < b, x, y). Commas part the outputs. There are no units and no =; water flow is "
    "water_flow, and lambda, which Python reserves, is lambda_."
)


class FormulaPhysics(Physics):
    """Physics given as a formula, a text in Python's notation, which a saved model contains.

    It is read, never executed, so that a formula from a stranger does no harm.

    Args:
        formula: The output, or outputs with commas between them, such as ``"U * I, U / I"``. It has
            numbers, names of columns and of unknown parameters, ``pi``, ``+ - * / **``,
            comparisons, and the functions sin, cos, tan, asin, acos, atan, atan2, sinh, cosh, tanh,
            exp, log and ln (the same), log10, sqrt, abs, sign, min and max of two, and
            ``where(a < b, x, y)``.
        columns: The names of the columns of X, ``d`` of them, without units and with ``_`` for
            other marks: "air flow [m3/h]" is ``air_flow``, and "lambda" is ``lambda_``.
        unknowns, name: As of :class:`Physics`.

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
        self.columns = tuple(map(symbol, columns))
        known = [*self.columns, *self.unknowns, "pi"]
        if len({*known}) < len(known):
            raise ValueError(f"Expected different names, and none 'pi'; found {known}.")
        self._outputs = parse(formula)
        absent = sorted(_names(self._outputs) - {*known})
        if absent:
            raise ValueError(
                f"The formula {formula!r} has {absent[0]!r}; expected one of its names: "
                f"{', '.join(known)}. Give its value as a number, or add it to unknowns."
            )
        self.num_outputs = len(self._outputs)

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if these are the names of the columns in another order."""
        found = tuple(map(symbol, names))
        places = {name: i for i, name in enumerate(self.columns)}
        if any(places.get(name, i) != i for i, name in enumerate(found)):
            raise ValueError(
                f"The formula {self.formula!r} has the columns {', '.join(self.columns)}, and the "
                f"data have {', '.join(found)}: give it the columns in the order of the data."
            )

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the values of the formula, ``N x m``."""
        if X.shape[-1] != len(self.columns):
            raise ValueError(f"the formula has columns {self.columns}, and X has {X.shape[-1]}")
        values = dict(zip(self.columns, X.unbind(-1), strict=True))
        values["pi"] = X.new_tensor(math.pi)
        for own in parameters:
            values |= own
        outputs = [_value(node, values, X) for node in self._outputs]
        return torch.stack([Y.expand(len(X)) for Y in outputs], dim=-1)


def symbol(name: str) -> str:
    """Return the name of a column in a formula: without its unit, and ``_`` for other marks."""
    name = normalize("NFKC", name.partition("[")[0].strip())  # as Python does with names
    bare = re.sub(r"\W+", "_", name).strip("_")
    bare = f"{bare}_" if iskeyword(bare) else bare
    return f"_{bare}" if bare[:1].isdigit() else bare


def names_in(formula: str) -> set[str]:
    """Return the names of columns and parameters in a formula."""
    return _names(parse(formula)) - {"pi"}


def parse(formula: str) -> list[ast.expr]:
    """Return the outputs of a formula, each as a tree of allowed parts, or raise a ValueError."""
    try:
        if len(formula) > _LONGEST:
            raise ValueError(f"it has more than {_LONGEST} characters")
        tree = ast.parse(formula.strip(), mode="eval").body
        outputs = tree.elts if isinstance(tree, ast.Tuple) and tree.elts else [tree]
        one = torch.ones(())
        for output in outputs:
            _value(output, dict.fromkeys(_names(outputs), one), one)
    except Exception as error:  # of reading, or of the trial
        raise ValueError(
            f"Expected a formula such as 'force * length**3 / (3 * E * I)', found {formula!r}: "
            f"{getattr(error, 'msg', error)}. {_GRAMMAR}"
        ) from error
    return outputs


def _names(outputs: Sequence[ast.expr]) -> set[str]:
    """Return the names in trees, without those of functions."""
    nodes = [node for output in outputs for node in ast.walk(output)]
    functions = [node.func for node in nodes if isinstance(node, ast.Call)]
    return {node.id for node in nodes if isinstance(node, ast.Name) and node not in functions}


def _value(node: ast.expr, values: Mapping[str, Tensor], like: Tensor) -> Tensor:
    """Return the value of a part of a formula, ``N`` or one number, in the dtype of ``like``."""
    function: Callable[..., Tensor] | None = None
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int() | float() as value) if type(value) is not bool:
            return like.new_tensor(float(value))
        case ast.UnaryOp(op=op, operand=operand):
            function, parts = _OPERATORS.get(type(op).__name__), [operand]
        case (
            ast.BinOp(op=op, left=left, right=right)
            | ast.Compare(ops=[op], left=left, comparators=[right])
        ):
            function, parts = _OPERATORS.get(type(op).__name__), [left, right]
        case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]):
            function = _FUNCTIONS.get(name)
    if function is None:
        raise ValueError(f"{ast.unparse(node)!r} is not a part of a formula")
    # A comparison is one or zero.
    return function(*(_value(part, values, like) for part in parts)).to(like)
