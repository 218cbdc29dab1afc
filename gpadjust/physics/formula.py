"""Physics of a formula that is a text."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from difflib import get_close_matches
from keyword import iskeyword
from typing import Any
from unicodedata import normalize

import torch
from torch import Tensor

from gpadjust.physics.base import Physics
from gpadjust.physics.unknown import ParameterValues, Unknown

_LONGEST = 2000  # characters
_LARGEST = 1e300  # number
_DEEPEST = 100
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_FUNCTIONS: dict[str, tuple[Callable[..., Tensor], int]] = {
    **{name: (getattr(torch, name), 1) for name in ("sin", "cos", "tan", "asin", "acos", "atan")},
    **{name: (getattr(torch, name), 1) for name in ("sinh", "cosh", "tanh", "exp", "log")},
    **{name: (getattr(torch, name), 1) for name in ("log10", "sqrt", "abs", "sign")},
    "ln": (torch.log, 1),
    **{"atan2": (torch.atan2, 2), "min": (torch.minimum, 2), "max": (torch.maximum, 2)},
    "where": (lambda c, x, y: torch.where(c != 0, x, y), 3),
}
_SIGNS = "It has no units, no = and no names with blanks: water flow is water_flow."
_GRAMMAR = (
    "Formulas have numbers, names, + - * / **, brackets, comparisons such as a < b, and the "
    f"functions {', '.join(_FUNCTIONS)}; pi is known. Outputs are parted by commas."
)


class FormulaPhysics(Physics):
    """Physics given as a formula, a text in Python's notation.

    The text is read, never executed, so that a formula from a stranger does no harm; a saved model
    holds it.

    Args:
        formula: The output, or outputs with commas between them, such as ``"U * I, U / I"``. It has
            numbers, names of columns and of unknown parameters, ``pi``, ``+ - * / **``,
            comparisons, and the functions sin, cos, tan, asin, acos, atan, atan2, sinh, cosh, tanh,
            exp, log and ln (the same), log10, sqrt, abs, sign, min and max of two, and
            ``where(a < b, x, y)``.
        columns: The names of the columns of X, ``d`` of them. Of a name as the models have it the
            unit is left out, and what no name can have is ``_``: "air flow [m3/h]" is ``air_flow``,
            and "lambda" is ``lambda_``.
        unknowns: Unknown parameters by name.
        name: The name in messages. Default: the formula.

    Attributes:
        formula: The text.
        columns: The names that the formula may use.

    Raises:
        TypeError: If the formula is no text.
        ValueError: If it is none, or names what there is not; or if two names are the same.

    Example:
        >>> import torch
        >>> power = FormulaPhysics("U * I", ["U [V]", "I [A]"])
        >>> power(torch.tensor([[230.0, 2.0], [230.0, 3.0]], dtype=torch.float64))
        tensor([[460.],
                [690.]], dtype=torch.float64)
    """

    def __init__(
        self,
        formula: str,
        columns: Sequence[str],
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        name: str | None = None,
    ) -> None:
        if not isinstance(formula, str):
            raise TypeError(f"Expected a formula as a text, found {formula!r}.")
        super().__init__(
            unknowns=unknowns, name=" ".join(formula.split()) if name is None else name
        )
        self.formula = formula
        self.columns = tuple(map(symbol, columns))
        known = [*self.columns, *self.unknowns]
        if "pi" in known:
            raise ValueError("Expected other names than 'pi', which formulas have as a number.")
        if again := [name for name in known if known.count(name) > 1]:
            raise ValueError(
                f"Expected different names of columns and unknown parameters, found {again[0]!r} "
                "more than once."
            )
        self._outputs = parse(formula)
        named = names_in(formula)
        if absent := sorted(named - {*known}):
            near = get_close_matches(absent[0], known, n=1)
            raise ValueError(
                f"The formula {formula!r} has {absent[0]!r}, which is none of its names: "
                f"{', '.join(known)}.{''.join(f' Is it {each!r}?' for each in near)} Give its "
                "value as a number, or name it as an unknown parameter."
            )
        self.num_outputs = len(self._outputs)

    @property
    def made_of(self) -> dict[str, Any]:
        """The arguments, as JSON has them."""
        unknowns = {name: asdict(own) for name, own in self.unknowns.items()}
        own = {"formula": self.formula, "columns": self.columns, "name": self.name}
        return {**own, "unknowns": unknowns}

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if these are the names of the columns in another order."""
        found = tuple(map(symbol, names))
        places = {name: i for i, name in enumerate(self.columns)}
        if any(places.get(name, i) != i for i, name in enumerate(found)):
            raise ValueError(
                f"The formula {self.formula!r} has the columns {', '.join(self.columns)}, and the "
                f"data have {', '.join(found)}: expected the same order, as columns are passed by "
                "it. Make the formula with the columns in the order of the data."
            )

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The values of the formula, ``N x m``."""
        if X.shape[-1] != len(self.columns):
            raise ValueError(
                f"the formula has {len(self.columns)} columns, {', '.join(self.columns)}, and X "
                f"has {X.shape[-1]}"
            )
        values = dict(zip(self.columns, X.unbind(-1), strict=True))
        for own in parameters:
            values |= {name: own[name] for name in self.unknowns}
        values.setdefault("pi", X.new_tensor(math.pi))
        outputs = [_value(node, values, X) for node in self._outputs]
        return torch.stack([Y.to(X).expand(len(X)) for Y in outputs], dim=-1)


def symbol(name: str) -> str:
    """The name by which a formula has a column: without its unit, and ``_`` for other marks."""
    name = normalize("NFKC", name.partition("[")[0].strip())  # as Python does with names
    bare = re.sub(r"\W+", "_", name).strip("_")
    bare = f"{bare}_" if iskeyword(bare) else bare
    return f"_{bare}" if bare[:1].isdigit() else bare


def names_in(formula: str) -> set[str]:
    """The names of columns and parameters in a formula, without those of functions."""
    nodes = [node for output in parse(formula) for node in ast.walk(output)]
    functions = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    found = {node.id for node in nodes if isinstance(node, ast.Name) and id(node) not in functions}
    return found - {"pi"}


def parse(formula: str) -> list[ast.expr]:
    """The outputs of a formula, each as a tree of allowed parts.

    Raises:
        ValueError: If it is no formula.
    """
    told = f"Expected a formula such as 'force * length**3 / (3 * E * I)', found {formula!r}"
    if len(formula) > _LONGEST:
        raise ValueError(f"Expected a formula of at most {_LONGEST} characters.")
    try:
        tree = ast.parse(formula.strip(), mode="eval").body
        outputs = tree.elts if isinstance(tree, ast.Tuple) else [tree]
        if any(_depth(output) > _DEEPEST for output in outputs):
            raise RecursionError
        for node in (node for output in outputs for node in ast.walk(output)):
            if wrong := _wrong(node):
                raise ValueError(f"{told}: {wrong}. {_GRAMMAR}")
    except (SyntaxError, UnicodeError) as error:
        what = getattr(error, "msg", "not a text")
        taken = [word for word in re.findall(r"\w+", str(formula)) if iskeyword(word)]
        what += f"; of a column {taken[0]} write {taken[0]}_" if taken else ""
        raise ValueError(f"{told}: {what}. {_SIGNS} {_GRAMMAR}") from error
    except (RecursionError, MemoryError) as error:
        raise ValueError(f"{told}: it is nested too deeply.") from error
    if not outputs:
        raise ValueError(f"{told}. {_GRAMMAR}")
    return outputs


def _depth(node: ast.AST) -> int:
    """The depth of a tree, found without recursion."""
    depth, level = 0, [node]
    while level:
        depth, level = depth + 1, [each for n in level for each in ast.iter_child_nodes(n)]
    return depth


def _wrong(node: ast.AST) -> str:
    """Why a part of a tree is not allowed; nothing if it is."""
    match node:
        case ast.Constant(value=int() | float() as value) if abs(value) <= _LARGEST:
            return "" if not isinstance(value, bool) else f"{value} is no number"
        case ast.Constant(value=value):
            return f"{value!r} is no number that a formula can have"
        case ast.BinOp(op=ast.BitXor()):
            return "^ is no power, expected **"
        case ast.BinOp(op=op) | ast.UnaryOp(op=op):
            return "" if type(op) in _OPERATORS else f"{type(op).__name__} is unknown"
        case ast.Compare(ops=ops):
            allowed = len(ops) == 1 and type(ops[0]) in _OPERATORS
            return "" if allowed else "a comparison is of two values, by <, <=, > or >="
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in _FUNCTIONS:
                near = get_close_matches(name, _FUNCTIONS, n=1)
                meant = "".join(f", is it {each}?" for each in near)
                return f"{name} is no function of formulas{meant}"
            count = _FUNCTIONS[name][1]
            return "" if len(args) == count else f"{name} takes {count} values, found {len(args)}"
        case ast.Name() | ast.operator() | ast.unaryop() | ast.cmpop() | ast.expr_context():
            return ""
    return f"{ast.unparse(node)!r} is no part of a formula"


def _value(node: ast.expr, values: Mapping[str, Tensor], like: Tensor) -> Tensor:
    """The value of a part of a formula, ``N`` or one number, in the dtype of ``like``."""
    match node:
        case ast.Constant(value=value):
            return like.new_tensor(value)
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=op, operand=operand):
            parts = [operand]
        case ast.BinOp(op=op, left=left, right=right):
            parts = [left, right]
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            ends = (_value(part, values, like) for part in (left, right))
            return _OPERATORS[type(op)](*ends).to(like)  # one or zero
        case ast.Call(func=ast.Name(id=name), args=parts):
            return _FUNCTIONS[name][0](*(_value(part, values, like) for part in parts))
        case _:
            raise NotImplementedError(ast.dump(node))
    return _OPERATORS[type(op)](*(_value(part, values, like) for part in parts))
