"""Binding energies of nuclides: a liquid drop with five unknown parameters, and what it lacks.

Data: AME2020, nuclides with at least eight protons and eight neutrons. Known noise: the variances
of the evaluators. Inputs of all models and of the trees: Z, N, whether each is odd (pairing is not
the same everywhere), and exp(-|N - Z| / 2) (nuclides with as many protons as neutrons are bound
more, the Wigner energy). Scores: root mean square error in MeV, and the share of 95 % intervals,
with the evaluators' standard deviation, that hold the left-out value.

Tasks: ten folds by a permutation of the nuclides with ``split``; of each chain of isotopes with
more than 2k the k lightest and the k heaviest, all left out at once, k = 2 and 4; and the
evaluators' extrapolations, which are no data, predicted from all that is measured.

Tried before the first run, on the first of the ten folds of the seed 1000 alone: RBF and Matern
kernels, inputs without parity and without the fifth, CKA and a physics mean, and how many rows and
iterations a fit needs. The ends of chains were looked at in no way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, Unknown, ZeroMeanGP, fit
from gpadjust.core import GP, MATERN52, Stationary
from gpadjust.core.kernels import RHO
from gpadjust.physics import FunctionPhysics, ParameterValues
from paper.common.experiment import Run, Table
from paper.common.figures import save
from paper.common.tables import frame, markdown, number
from paper.published import Masses, MassesSettings

DATA = Path(__file__).parent / "data" / "masses" / "ame2020.csv"
MAGIC = (8, 20, 28, 50, 82, 126, 184)
PUBLISHED = {
    "published: drop and deep net, 26 features, ten folds of 2,149": "0.263",
    "published: the same, Z, N and A alone": "0.332",
}
"""RMSE of ten folds in MeV: C.-Q. Li et al., Deep learning on nuclear mass and alpha decay
half-lives, tenfold cross-validation."""
_INPUTS = ["Z", "N", "odd Z", "odd N", "near N = Z"]


def drop(X: Tensor, p: ParameterValues) -> Tensor:
    """Binding energy in MeV by Bethe and Weizsaecker, as textbooks of nuclear physics have it."""
    Z, N = X[:, 0], X[:, 1]
    A, both = Z + N, 1 - Z % 2 - N % 2  # 1 if both are even, -1 if both are odd
    bulk = p.volume * A - p.surface * A ** (2 / 3)
    charge = p.coulomb * Z * (Z - 1) / A ** (1 / 3)
    return bulk - charge - p.asymmetry * (N - Z) ** 2 / A + p.pairing * both / A.sqrt()


def shell(X: Tensor, p: ParameterValues) -> Tensor:
    """The drop, and the valence nucleons or holes (Dieperink and Van Isacker 2009).

    A term in their number, as in their equation, and one in the P-factor (Casten et al. 1987).
    """
    magic = torch.tensor(MAGIC).to(X)
    z, n = ((X[:, i : i + 1] - magic).abs().amin(-1) for i in (0, 1))
    return drop(X, p) + p.valence * (z + n) + p.promiscuity * z * n / (z + n).clamp_min(1)


# Values and spread of textbooks; of the two shell coefficients the size alone, in MeV a nucleon.
_DROP = {
    "volume": Unknown(15.8, sd=0.5, unit="MeV"),
    "surface": Unknown(18.3, sd=1.0, unit="MeV"),
    "coulomb": Unknown(0.714, sd=0.05, unit="MeV"),
    "asymmetry": Unknown(23.2, sd=2.0, unit="MeV"),
    "pairing": Unknown(12.0, sd=3.0, unit="MeV"),
}
_SHELL = {**_DROP, "valence": Unknown(0.0, sd=1.0), "promiscuity": Unknown(0.0, sd=1.0)}


# The formula alone, whose noise is learnt (known noise is far less than what it lacks), and the
# seconds of its fit: the last one, which the trees of the same case need, too.
_ALONE: dict[tuple[object, ...], tuple[GP, float]] = {}


def nuclides(stride: int = 1) -> pd.DataFrame:
    """Nuclides with Z and N of at least 8, of every how many-th Z; energy and sd in MeV."""
    table = pd.read_csv(DATA)
    table = table[(table.Z >= 8) & (table.N >= 8)]
    table = table[table.Z % stride == 0].reset_index(drop=True)
    table["odd Z"], table["odd N"] = table.Z % 2, table.N % 2
    table["near N = Z"] = np.exp(-(table.N - table.Z).abs() / 2)
    for name in ("binding", "sd"):
        column = table[f"{name}_keV_per_nucleon"]
        table[{"binding": "energy"}.get(name, name)] = column * (table.Z + table.N) / 1000
    return table


def left_out(table: pd.DataFrame, task: str, split: int, seed: int) -> np.ndarray:
    """Which of the measured nuclides a task leaves out."""
    if task == "fold":
        order = np.random.default_rng(split).permutation(len(table))
        return np.asarray(order % 10 == seed % 10)
    k, chains = int(task.removeprefix("outer")), table.groupby("Z").N
    ends = (chains.rank() <= k) | (chains.rank(ascending=False) <= k)
    return np.asarray(ends & (chains.transform("size") > 2 * k))


def build(model: str, physics: FunctionPhysics) -> Callable[..., GP]:
    """What makes a model of inputs, energies and variances; shells close with kinks."""
    of_rho, matern = Stationary(MATERN52, RHO), Stationary(MATERN52)
    makers: dict[str, Callable[..., GP]] = {
        "cka": lambda X, Y, V: CKA(
            X, Y, V, physics=physics, rho_covar_module=of_rho, delta_covar_module=matern
        ),
        "mean": lambda X, Y, V: PhysicsMeanGP(X, Y, V, physics=physics, covar_module=matern),
        "gp": lambda X, Y, V: ZeroMeanGP(X, Y, V, covar_module=matern),
    }
    return makers[model]


def fitted(
    make: Callable[..., GP], data: Sequence[Tensor], settings: MassesSettings, seed: int
) -> GP:
    """A model of all rows, whose hyper-parameters are those of some of them."""
    model = make(*data)
    some: Any = model.subset_rows(torch.from_numpy(_some(len(data[0]), settings, seed)))
    fit(some, "map", seed=seed)
    model.set_draws(some.draws)
    return model


def _some(number_of_rows: int, settings: MassesSettings, seed: int) -> np.ndarray:
    order = np.random.default_rng(seed).permutation(number_of_rows)
    return np.sort(order[: settings.num_rows])


def run(experiment: Masses, task: str, physics: str, model: str, seed: int) -> Run:
    """Fit one model to the nuclides that a task does not leave out, and predict the others."""
    settings, table = experiment.settings, nuclides(experiment.settings.stride)
    known = table[table.measured == 1].reset_index(drop=True)
    if task == "unmeasured":
        train, test = known, table[table.measured == 0]
    else:
        out = left_out(known, task, settings.split, seed)
        train, test = known[~out], known[out]
    law = FunctionPhysics(
        shell if physics == "shell" else drop, unknowns=_SHELL if physics == "shell" else _DROP
    )
    begin, earlier = time.perf_counter(), 0.0
    X, Y, V = _tensors(train)
    if model in ("alone", "trees"):
        key = (task, physics, seed, settings)
        if key not in _ALONE:
            _ALONE.clear()
            some = _some(len(X), settings, seed)  # five parameters need no more
            alone = CalibratedPhysics(X[some], Y[some], physics=law)
            fit(alone, "map", seed=seed)
            _ALONE[key] = alone, time.perf_counter() - begin
        else:
            earlier = _ALONE[key][1]
        made: GP = _ALONE[key][0]
    else:
        made = fitted(build(model, law), (X, Y, V), settings, seed)
    test_X, test_Y, test_V = _tensors(test)
    held = half = middle = None
    with torch.no_grad():
        mean = made.predict(test_X).mean
        if model == "trees":
            mean = mean + _trees(train, Y - made.predict(X).mean, test)
        else:
            noise: Any = True if model == "alone" else test_V
            lower, upper = made.interval(test_X, observation_noise=noise)
            held = ((lower <= test_Y) & (test_Y <= upper)).double().mean().item()
            half = ((upper - lower) / 2).mean().item()
            middle = ((upper - lower) / 2).median().item()
    seconds = time.perf_counter() - begin + earlier
    error = mean - test_Y
    found: Run = {
        "train": len(train),
        "test": len(test),
        "mean_square": error.square().mean().item(),
        "median_error": error.abs().median().item(),
        "held": held,
        "half_width": half,
        "median_half_width": middle,
        "seconds": seconds,
        "parameters": {} if model == "gp" else _values(made),
    }
    if task == "unmeasured" and model in ("cka", "mean", "alone"):
        with torch.no_grad():
            everywhere = made.predict(_tensors(table)[0])
        found["energy"] = everywhere.mean.flatten().round(decimals=2).tolist()
        if model != "alone":
            found["sd"] = everywhere.variance.sqrt().flatten().round(decimals=2).tolist()
    return found


def _tensors(table: pd.DataFrame) -> tuple[Tensor, Tensor, Tensor]:
    X, Y, sd = (
        torch.from_numpy(table[columns].to_numpy(dtype=float, copy=True))
        for columns in (_INPUTS, ["energy"], ["sd"])
    )
    return X, Y, sd.square()


def _values(model: GP) -> dict[str, float]:
    return {name: draws.mean().item() for name, draws in model.physics_parameters.items()}


def _trees(train: pd.DataFrame, residual: Tensor, test: pd.DataFrame) -> Tensor:
    """Gradient boosting of what the fitted drop lacks, by scikit-learn."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    trees = HistGradientBoostingRegressor(max_iter=1000, random_state=0)
    trees.fit(train[_INPUTS].to_numpy(), residual.flatten().numpy())
    return torch.from_numpy(trees.predict(test[_INPUTS].to_numpy())).unsqueeze(-1)


def tables(runs: Sequence[Run], experiment: Masses) -> dict[str, Table]:
    """All tables, by name."""
    data = frame(runs)
    tasks, kinds = experiment.axes["task"], experiment.axes["physics", "model"]
    heads = [
        f"{label}: {what}"
        for task, label in tasks.items()
        if task != "unmeasured"
        for what in ("RMSE, MeV", "held", "half width, MeV")
    ]
    errors, all_rows = [], []
    for (physics, model), label in kinds.items():
        own = data[(data.physics == physics) & (data.model == model)]
        cells = [label]
        for task, title in tasks.items():
            part = own[own.task == task]
            rms, held, half = _scores(part)
            if task != "unmeasured":
                cells += [number(rms, ".3f"), number(held, ".3f"), number(half, ".2f")]
            if len(part):
                rest = [
                    f"{number(part.test.sum(), '.0f')} in {len(part)}",
                    *(number(each, ".3f") for each in (rms, held, half)),
                    *(
                        number(part[name].mean(), ".3f")
                        for name in ("median_error", "median_half_width")
                    ),
                    number(part.seconds.median(), ".0f"),
                ]
                all_rows.append([title, label, *rest])
        errors.append([*cells, number(own[own.task == "fold"].seconds.median(), ".0f")])
    errors += [[label, value, *[""] * (len(heads))] for label, value in PUBLISHED.items()]
    header = ["task", "model", "nuclides in runs", "RMSE, MeV", "held by 95 %"]
    header += ["half width of 95 %, mean, MeV", "median error, MeV"]
    header += ["half width, median, MeV", "seconds of a fit, median"]
    return {
        "errors": Table(
            "RMSE in MeV, share held by intervals of 95 %, their mean half width in MeV",
            markdown(["model", *heads, "seconds of a fit"], errors),
        ),
        "all": Table("All tasks", markdown(header, all_rows)),
        "beyond": _beyond(runs, experiment),
        "parameters": _parameters(data, kinds),
    }


def _scores(part: pd.DataFrame) -> tuple[float, float, float]:
    """Root mean square error, share held and mean half width over the nuclides of all runs."""
    if not len(part):
        return (float("nan"),) * 3
    weights = part.test / part.test.sum()
    square, held, half = (
        float((weights * pd.to_numeric(part[name])).sum(skipna=False))
        for name in ("mean_square", "held", "half_width")
    )
    return square**0.5, held, half


def _beyond(runs: Sequence[Run], experiment: Masses) -> Table:
    """The evaluators' extrapolations, which are no data, by parts of the chart."""
    table, rows = nuclides(experiment.settings.stride), []
    left = table.measured == 0
    parts = {
        "A below 50": left & (table.Z + table.N < 50),
        "A from 50, N to 160": left & (table.Z + table.N >= 50) & (table.N <= 160),
        "N above 160": left & (table.N > 160),
    }
    for run in runs:
        if run["task"] != "unmeasured" or "sd" not in run:
            continue
        error = (np.array(run["energy"]) - table.energy).abs()
        held = error < 1.96 * np.hypot(run["sd"], table.sd)
        label = experiment.axes["physics", "model"][run["physics"], run["model"]]
        for part, which in parts.items():
            rms = float((error[which] ** 2).mean() ** 0.5)
            numbers = [rms, error[which].max(), held[which].mean()]
            rows.append([label, part, f"{which.sum()}", *(number(n, ".3g") for n in numbers)])
    header = ["model", "part", "nuclides", "RMSE, MeV", "largest error, MeV", "held by 95 %"]
    return Table("Evaluators' extrapolations, no data", markdown(header, rows))


def _parameters(data: pd.DataFrame, kinds: Any) -> Table:
    """Values of all measured nuclides, and the range over the folds."""
    rows = []
    for (physics, model), label in kinds.items():
        own = data[(data.physics == physics) & (data.model == model)]
        folds = pd.DataFrame([*own[own.task == "fold"].parameters])
        if model in ("gp", "trees") or folds.empty:
            continue
        cells = [
            f"{folds[name].mean():.3g} ({folds[name].min():.3g} to {folds[name].max():.3g})"
            if name in folds
            else ""
            for name in _SHELL
        ]
        rows.append([label, *cells])
    header = ["model", *(f"{name}, MeV" for name in _SHELL)]
    return Table("Parameters, mean and range over the folds", markdown(header, rows))


def draw(runs: Sequence[Run], experiment: Masses) -> list[Path]:
    """Draw the chart of nuclides: where the drop is wrong, and how sure the adjusted model is."""
    from matplotlib.figure import Figure

    found = {(run["physics"], run["model"]): run for run in runs if run["task"] == "unmeasured"}
    if ("drop", "alone") not in found or ("drop", "mean") not in found:
        return []
    table = nuclides(experiment.settings.stride)
    measured = table.measured == 1
    wrong = (table.energy - np.array(found["drop", "alone"]["energy"])).where(measured)
    sd = pd.Series(found["drop", "mean"]["sd"])
    figure = Figure(figsize=(8.0, 9.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    shown = [
        (wrong, "measured less liquid drop, fitted alone [MeV]", "RdBu", (-8.0, 8.0)),
        (sd.clip(lower=0.03), "sd of the adjusted model [MeV]", "viridis", (0.03, 5.0)),
    ]
    for ax, (values, label, colors, limits) in zip(panels, shown, strict=True):
        image = ax.pcolormesh(
            *(np.arange(0.5, n + 1) for n in (table.N.max(), table.Z.max())),
            _chart(table, values)[1:, 1:],
            cmap=colors,
            norm="log" if values is not wrong else None,
            **({} if values is not wrong else {"vmin": limits[0], "vmax": limits[1]}),
        )
        if values is not wrong:
            image.set_clim(*limits)
        figure.colorbar(image, ax=ax, label=label, extend="both" if values is wrong else "max")
        _outline(ax, table[measured], "black" if values is wrong else "white")
        for number_ in MAGIC:
            ax.axvline(number_, color="0.8", lw=0.5, zorder=0)
            if number_ < 120:
                ax.axhline(number_, color="0.8", lw=0.5, zorder=0)
        ax.set(ylabel="protons Z", aspect="equal", xlim=(4, 182), ylim=(4, 121))
        ax.spines[["top", "right"]].set_visible(False)
    panels[1].set_xlabel("neutrons N")
    return [save(figure, experiment.out / "masses.png")]


def _chart(table: pd.DataFrame, values: pd.Series[float]) -> np.ndarray:
    """Values on the grid of Z and N, nan where there is none."""
    chart = np.full((table.Z.max() + 1, table.N.max() + 1), np.nan)
    chart[table.Z, table.N] = values
    return chart


def _outline(ax: Any, measured: pd.DataFrame, color: str) -> None:
    """Draw the ends of the measured chains as a line of steps."""
    ends = measured.groupby("Z").N.agg(["min", "max"])
    for column, shift in (("min", -0.5), ("max", 0.5)):
        ax.step(ends[column] + shift, ends.index - 0.5, where="pre", color=color, lw=0.7)
