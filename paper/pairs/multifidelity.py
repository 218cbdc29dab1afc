"""Eight methods on textbook pairs, and a claim of the paper.

U1 is that of the paper's abstract: the uncertainty of CKA and RRA is more accurate than that of a
Gaussian process and of AR1. It is judged by how far the coverage of the 95 % interval is from 95 %
and by the NLPD, paired by pair and data set; both scores are to be less than those of either. It is
undetermined if the two scores give different verdicts. The paper's own case is in the chapter
forrester.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.posteriors import GPyTorchPosterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from gpytorch.distributions import MultivariateNormal
from linear_operator.operators import DiagLinearOperator
from matplotlib.ticker import LogLocator, NullFormatter
from scipy import stats
from torch import Tensor

from gpadjust import fit
from gpadjust.inference import SamplingWarning
from gpadjust.physics import PhysicsWarning
from gpadjust.validation import coverage, crps, nlpd, rmse
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save, strips
from paper.common.learners import LEARNERS, LITERAL
from paper.common.tables import (
    Cell,
    across,
    claims_table,
    exact_mean,
    frame,
    groups,
    markdown,
    number,
    of,
    table,
)
from paper.common.verdicts import Difference, Judged, Verdict, all_of, within
from paper.pairs import METHODS, Multifidelity
from paper.pairs.functions import Pair, low_inputs, observations, pair

FIRST_LOOK = 8  # runs
_CHUNK = 50  # points predicted jointly, for the sake of memory
_LEAST_VARIANCE = 1e-300  # SMT's may round to zero, which has no density
_LEARNERS = {"GP": "gp", "Phy": "phymean", "AR1": "ar1", "CKA Bayes": "cka", "RRA": "rra"}
_PAIRED = ("GP", "Phy", "AR1", "SMT MFK")  # which CKA is compared with
_NAMED = ("CKA", "RRA", "GP", "AR1")  # of U1


class SMTModel:
    """SMT's MFK with its defaults, trained, with BoTorch's way to ask for predictions.

    Args:
        low_X: Inputs of the low level, ``n_1 x d``, among them those of the high one.
        low_Y: Its values, ``n_1 x 1``.
        train_X: Inputs of the high level, ``n x d``.
        train_Y: Its values, ``n x 1``.
    """

    def __init__(self, low_X: Tensor, low_Y: Tensor, train_X: Tensor, train_Y: Tensor) -> None:
        from smt.applications import MFK  # slow to import

        self.mfk = MFK(print_global=False)
        self.mfk.set_training_values(low_X.numpy(), low_Y.numpy(), name=0)
        self.mfk.set_training_values(train_X.numpy(), train_Y.numpy())
        self.mfk.train()

    def posterior(self, X: Tensor, observation_noise: bool = False) -> GPyTorchPosterior:
        """Independent predictions at ``q x d`` inputs; the model has no observation noise."""
        mean = torch.as_tensor(self.mfk.predict_values(X.numpy())).squeeze(-1)
        variance = torch.as_tensor(self.mfk.predict_variances(X.numpy())).squeeze(-1)
        covariance = DiagLinearOperator(variance.clamp_min(_LEAST_VARIANCE))
        return GPyTorchPosterior(MultivariateNormal(mean, covariance))


@cache
def _prepare(method: str, num_low: int) -> None:
    """Set a process up: one fit of the method that is not timed."""
    forrester = pair("forrester")
    trained(method, forrester, *observations(forrester, 5, 0), num_low, 0)


def run(experiment: Multifidelity, name: str, per_input: int, method: str, seed: int) -> Run:
    """Train a method on a data set; return its scores, in units of the truth's sd."""
    settings, problem = experiment.settings, pair(name)
    _prepare(method, settings.num_low)
    X, Y = observations(problem, per_input * problem.d, seed)
    test_X = problem.sobol(settings.num_test, seed=0)
    test_Y = problem.truth(test_X)
    start = time.perf_counter()
    model = trained(method, problem, X, Y, settings.num_low, seed)
    seconds = time.perf_counter() - start
    with torch.no_grad():
        parts = [model.posterior(part, observation_noise=True) for part in test_X.split(_CHUNK)]
    mean, variance = (
        torch.cat([getattr(part, name) for part in parts], dim=-2) for name in ("mean", "variance")
    )
    mixture = MCMC_DIM if isinstance(parts[0], GaussianMixturePosterior) else None
    sd = test_Y.std().item()
    return {
        "N": len(X),
        "nrmse": rmse(mean, test_Y, mixture_dim=mixture).item() / sd,
        "nlpd": nlpd(mean, variance, test_Y, mixture_dim=mixture).item() - math.log(sd),
        "crps": crps(mean, variance, test_Y, mixture_dim=mixture).item() / sd,
        "coverage": coverage(mean, variance, test_Y, mixture_dim=mixture).item(),
        "seconds": seconds,
    }


def trained(method: str, pair: Pair, X: Tensor, Y: Tensor, num_low: int, seed: int) -> Any:
    """Build and train a model by one of the methods.

    Args:
        method: Its name.
        pair: The truth and the physics.
        X: Inputs of the observations, ``n x d``.
        Y: The observations, ``n x 1``.
        num_low: Samples of the low level per input, for the methods that need them.
        seed: Of these samples.
    """
    low_X = low_inputs(pair, X, max(num_low * pair.d, len(X)), seed)
    if method == "SMT MFK":
        return SMTModel(low_X, pair.physics()(low_X), X, Y)
    options: dict[str, Any] = {"low_X": low_X} if method == "AR1" else {}
    options |= LITERAL if method == "RRA" else {}
    make = LEARNERS[_LEARNERS.get(method, "literal")].make
    model = make(X, Y, physics=pair.physics(), **options)
    return quietly_fitted(model, "bayes" if method == "CKA Bayes" else "map")


def quietly_fitted(model: Any, method: Any) -> Any:
    """Fit a model; a fit that has not converged, or a bad physics, is shown by its scores."""
    with warnings.catch_warnings():
        for category in (OptimizationWarning, SamplingWarning, PhysicsWarning):
            warnings.filterwarnings("ignore", category=category)
        fit(model, method)
    return model


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each run, the pairs in the order in which they were run, the methods as listed."""
    found = frame(runs)
    ranks = {"pair": list(found["pair"].unique()).index, "method": [*METHODS].index}
    order = ["pair", "per_input", "method", "seed"]
    return found.sort_values(
        order, key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c
    ).reset_index(drop=True)


def tables(runs: Sequence[Run], experiment: Multifidelity) -> dict[str, Table]:
    """All tables, by name."""
    scored = load(runs)
    rows = groups(scored, ["pair", "N"], "{}, N = {}".format)

    def by_method(cell: Cell) -> dict[str, Cell]:
        return across(scored, "method", METHODS, cell)

    found = {"short": Table("Five observations per input", _short(scored))}
    for name, how, title in (
        ("nrmse", "median", "Median RMSE / sd of the truth"),
        ("nlpd", "median", "Median NLPD"),
        ("nlpd-mean", "mean", "Mean NLPD"),
        ("crps", "median", "Median CRPS / sd of the truth"),
        ("coverage", "mean", "Mean coverage of the central 95 % interval"),
        ("seconds", "median", "Median seconds"),
    ):
        columns = by_method(of(name.partition("-")[0], how, ".2g"))
        bold = name not in ("coverage", "seconds")
        found[name] = Table(title, table(rows, columns, bold=bold))
    title = "RMSE of CKA / that of others on the same data sets, geometric mean (Wilcoxon's p)"
    others = [name for name in _PAIRED if name in {*scored["method"]}]
    for name, ours in (("paired", "CKA"), ("paired-default", "CKA Bayes")):
        paired: dict[str, Cell] = {other: _ratio_to(other, ours) for other in others}
        found[name] = Table(title.replace("CKA", ours), table(rows, paired, f"{ours} /"))
    judged = {
        f"N = {size} d": [judge_intervals(part)] for size, part in scored.groupby("per_input")
    }
    found["claims"] = Table("Claim on the intervals", claims_table("claim", judged))
    return found


def first_look(runs: Sequence[Run]) -> str | None:
    """The scores of the first runs as they are."""
    if len(runs) < FIRST_LOOK:
        return None
    rows = [
        [r["pair"], f"{r['N']}", r["method"], f"{r['seed']}", f"{r['nrmse']:.2g}"] for r in runs
    ]
    return "The first runs\n\n" + markdown(["", "N", "method", "seed", "RMSE / sd"], rows)


def judge_intervals(
    runs: pd.DataFrame, by: Sequence[str] = ("pair", "seed"), names: Sequence[str] = _NAMED
) -> Judged:
    """U1, on the runs of one size.

    Args:
        runs: A row for each run.
        by: What paired runs share.
        names: Of the methods: CKA, RRA, and those that they are compared with.
    """
    text = "CKA and RRA quantify uncertainty more accurately than " + " and ".join(names[2:])
    coverage, density = (
        runs.pivot_table(index=[*by], columns="method", values=score)
        for score in ("coverage", "nlpd")
    )
    if not {*names} <= set(coverage):
        return Judged("U1", text, "not run", "not all methods were run")
    found: list[Verdict] = []
    for score in ((coverage - 0.95).abs(), density):
        gaps = [Difference.of(score[one] - score[two]) for one in names[:2] for two in names[2:]]
        found.append(all_of(*(within(gap, high=0) for gap in gaps)))
    said = "95 % hold " + ", ".join(f"{name} {coverage[name].mean():.2f}" for name in names)
    said += f"; by coverage {found[0]}, by NLPD {found[1]}"
    return Judged("U1", text, found[0] if found[0] == found[1] else "undetermined", said)


def _short(runs: pd.DataFrame) -> str:
    """The median errors with the fewest observations per input; coverage and time over all pairs.

    The last two are means and medians over the pairs.
    """
    runs = runs[runs["per_input"] == runs["per_input"].min()]

    def columns(cell: Cell) -> dict[str, Cell]:
        return across(runs, "method", METHODS, cell)

    def seconds(part: pd.DataFrame) -> str:
        return f"{part.groupby('pair')['seconds'].median().median():.2g}"

    rows = groups(runs, ["pair", "N"], "{}, N = {}".format)
    errors = columns(of("nrmse", "median", ".2g"))
    found = table(rows, errors, "median RMSE / sd", bold=True)
    held = table({"mean coverage of 95 %": runs}, columns(of("coverage", "mean", ".2g")))
    time = table({"median seconds": runs}, columns(seconds))
    return "\n".join([found, *(part.splitlines()[-1] for part in (held, time))])


def _ratio_to(other: str, ours: str) -> Cell:
    """The error of a CKA over that of another, with Wilcoxon's p."""

    def cell(part: pd.DataFrame) -> str:
        logs = np.log(part.pivot(index="seed", columns="method", values="nrmse"))
        gap = (logs[ours] - logs[other]).dropna() if ours in logs else pd.Series(dtype=float)
        p = stats.wilcoxon(gap).pvalue if gap.abs().sum() > 0 else np.nan
        return f"{number(np.exp(exact_mean(gap)), '.2g')} ({number(p, '.2g', '-')})"

    return cell


def draw(runs: Sequence[Run], experiment: Multifidelity) -> list[Path]:
    """Draw the errors of all runs, a panel for each pair, a row for each method."""
    scored = load(runs)
    pairs = groups(scored, "pair")
    methods = [name for name in METHODS if name in {*scored["method"]}]
    size = (3.6, 0.6 + 0.3 * len(methods))
    figure, axes = panels([*pairs], 3, size, share=False, width=9)
    for i, (ax, part) in enumerate(zip(axes, pairs.values(), strict=True)):
        rows = {
            name: [each["nrmse"] for _, each in own.groupby("per_input")]
            for name, own in groups(part, "method", METHODS).items()
        }
        strips(ax, rows, ("tab:orange", "tab:blue"))
        ax.set_xscale("log")
        ax.xaxis.set_minor_formatter(NullFormatter())
        is_narrow = part["nrmse"].max() < 30 * part["nrmse"].min()
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if is_narrow else (1.0,)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.tick_params(labelleft=i % 3 == 0)
    figure.supxlabel(
        "RMSE / sd of the truth: each run, median and quartiles; orange: N = 5 d, blue: N = 10 d",
        fontsize="medium",
    )
    return [save(figure, experiment.out / "nrmse.png")]
