"""The methods that are compared, each with its defaults."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ZeroMeanGP, compare, fit
from gpadjust.inference import SamplingWarning
from paper.multifidelity.mfk import SMTModel
from paper.multifidelity.problem import Pair, low_inputs


def _gp(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = ZeroMeanGP(X, Y)
    fit(model)
    return model


def _phy(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = PhysicsMeanGP(X, Y, physics=pair.physics())
    fit(model)
    return model


def _ar1(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = AR1(X, Y, physics=pair.physics(), low_X=low_inputs(pair, X, seed))
    fit(model)
    return model


def _smt(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    low_X = low_inputs(pair, X, seed)
    return SMTModel(low_X, pair.physics()(low_X), X, Y)


def _cka(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = CKA(X, Y, physics=pair.physics())
    fit(model)
    return model


def _cka_bayes(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = CKA(X, Y, physics=pair.physics())
    fit(model, "hmc")
    return model


def _rra(pair: Pair, X: Tensor, Y: Tensor, seed: int) -> Any:
    model = RRA(X, Y, physics=pair.physics())
    fit(model)
    return model


_BUILD: dict[str, Callable[[Pair, Tensor, Tensor, int], Any]] = {
    "GP": _gp,
    "Phy": _phy,
    "AR1": _ar1,
    "SMT MFK": _smt,
    "CKA": _cka,
    "CKA Bayes": _cka_bayes,
    "chosen": lambda pair, X, Y, seed: compare(X, Y, pair.physics()),
    "RRA": _rra,
}
METHODS = tuple(_BUILD)


def trained(method: str, pair: Pair, X: Tensor, Y: Tensor, seed: int) -> tuple[Any, str]:
    """Build and train a model by one of the methods.

    Args:
        method: Its name.
        pair: The truth and the physics.
        X: Inputs of the observations, ``n x d``.
        Y: The observations, ``n x 1``.
        seed: The seed of the low level's samples, for the methods that need them.

    Returns:
        The model, and the name of the structure that "chosen" chose (empty for the others).
    """
    with warnings.catch_warnings():
        # A fit that has not converged is shown by its scores.
        warnings.filterwarnings("ignore", category=OptimizationWarning)
        warnings.filterwarnings("ignore", category=SamplingWarning)
        result = _BUILD[method](pair, X, Y, seed)
    return (result.best, result.chosen) if method == "chosen" else (result, "")
