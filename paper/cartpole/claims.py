"""The paper's claims about this experiment, each with the number that decides it.

"In 6 trials" and "after 12" allow one trial more, "at trial 30" five more or less. Phy's decay is a
mean of trials 13-25 above that of the trials from the first at 0.5 or below to 12, and no recovery
a mean of 41-50 above 0.5. Never to learn, and to fail, is to stay above 0.5 (RRA's in trials 1-25).
CKA holds if its mean of 41-50 is at most 0.45. RRA has caught up if its mean of 41-50 is no more
than two standard errors of the paired difference above CKA's.
"""

from __future__ import annotations

import math

from paper.cartpole.scenarios import SCENARIOS
from paper.control.claims import Claim, Finding, counted, reached, reproduced, signed
from paper.control.curves import Curves


def _model_free(curves: Curves) -> Finding:
    first, touch = curves.first("mf", 0.5), curves.first("mf", 0.4)
    held = first is not None and touch is not None and first <= 35
    verdict = reproduced(held, beaten=first is not None and first < 25)
    return verdict, _described(curves, "mf") + _beside(curves, "mf-best")


def _physics_alone(curves: Curves) -> Finding:
    first = curves.first("phy", 0.5)
    early, late = (_mean(curves, "phy", *trials) for trials in ((13, 25), (41, 50)))
    held = first is not None and first <= 7 and late > 0.5
    held = held and early > _mean(curves, "phy", first or 1, 12)
    return reproduced(held), f"{_described(curves, 'phy')}, mean of 13-25 {early:.3f}"


def _gp(curves: Curves) -> Finding:
    held = curves.first("gp-paper", 0.5) is None
    return reproduced(held), _described(curves, "gp-paper") + _beside(curves, "gp")


def _cka(curves: Curves) -> Finding:
    first, touch = curves.first("cka", 0.5), curves.first("cka", 0.4)
    late = _mean(curves, "cka", 41, 50)
    held = first is not None and touch is not None and first <= 7 and touch <= 13 and late <= 0.45
    beaten = held and (first or 0) < 6 and (touch or 0) < 12 and late <= 0.4
    return reproduced(held, beaten), _described(curves, "cka")


def _rra(curves: Curves) -> Finding:
    first = curves.first("rra-paper", 0.5)
    more, error = curves.more("rra-paper", 41, 50)
    caught = more <= 2 * (0 if math.isnan(error) else error)
    failed = first is None or first > 25
    measured = f"{_described(curves, 'rra-paper')}, {signed(more, error)} of CKA's"
    return reproduced(failed and caught), measured + _beside(curves, "rra")


CLAIMS = (
    Claim("P1", "model-free reaches 0.5 at trial 30 and touches 0.4 by 50", ("mf",), _model_free),
    Claim(
        "P2",
        "Dyna-Phy reaches 0.5 in 6 trials, then decays and does not recover",
        ("phy",),
        _physics_alone,
    ),
    Claim("P3", "Dyna-GP never learns", ("gp-paper",), _gp),
    Claim(
        "P4", "Dyna-CKA reaches 0.5 in 6 trials, touches 0.4 after 12, holds to 50", ("cka",), _cka
    ),
    Claim(
        "P5",
        "Dyna-RRA fails in 1-25 and catches CKA in 26-50",
        ("rra-paper", "cka"),
        _rra,
    ),
)


def _mean(curves: Curves, name: str, first: int, last: int) -> float:
    return float(curves.window(name, first, last).mean())


def _described(curves: Curves, name: str) -> str:
    parts = [f"{level} {reached(curves.first(name, level))}" for level in (0.5, 0.4)]
    return f"{', '.join(parts)}, mean of 41-50 {_mean(curves, name, 41, 50):.3f}"


def _beside(curves: Curves, name: str) -> str:
    runs = len(curves.seeds(name, 50))
    if not runs:
        return ""
    return f"; {SCENARIOS[name].label}, {counted(runs)}: {_described(curves, name)}"
