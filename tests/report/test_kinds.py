"""Pages of all kinds of models, physics and names."""

import math
import subprocess
import sys

import pandas
import pytest
import torch

from gpadjust.core import CKA, CalibratedPhysics, ScaleGP, StackedGP, fit, load
from gpadjust.kinds.ar1 import AR1
from gpadjust.kinds.categories import Categories
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.report import report
from gpadjust.validation import compare
from tests.systems import line, normal, uniform

NASTY = ("<script>alert('1')</script>", '"><img src="https://x.y/z">', "$\\frac$ & 水 \n 5 €")
WORST = "The 5 observations of {} that are farthest from their predictions"


def problem(d, m, n=12):
    X = uniform(n, d, seed=d)
    Y = torch.stack([(j + 1) * X.sum(-1).sin() + 0.1 * X[:, 0] for j in range(m)], -1)
    return X, Y + 0.05 * normal(n, m, seed=d + 1)


def physics(m):
    return lambda X: X.sum(-1, keepdim=True).sin().expand(-1, m)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [NASTY[:2], NASTY[1:]])
def test_any_names_make_a_page(tmp_path, read, monkeypatch, first, second):
    monkeypatch.chdir(tmp_path)
    X, Y = problem(2, 1)
    model = CKA(X, Y, physics=physics(1))
    model.data = model.data._replace(input_names=(first, second), output_names=(first,))
    fit(model, "map")
    page = read(report(model, "report.html", title=second, rows=[first] * 12))
    assert page.needs_nothing_else()
    assert ("<script>alert" in page.text) == ("<script>alert" in first + second)
    names = {"f_p": physics(1)}
    exec(page.loading_code(), names)
    assert names["model"].data.input_names == (first, second)


@pytest.mark.slow
def test_several_outputs_some_of_them_missing_and_two_inputs(tmp_path, read):
    X, Y = problem(2, 2)
    Y[3, 0] = Y[5, 1] = math.nan
    comparison = compare(X, Y, physics(2), structures=["zero mean", "CKA"])
    page = read(report(comparison, tmp_path / "report.html"))
    assert page.needs_nothing_else()
    assert [row[-1] for row in page.tables["Columns"][1:]] == ["0", "0", "1", "1"]
    for name, row in (("y1", "row 3"), ("y2", "row 5")):
        assert f"{name} " in page.text
        assert comparison.verdict[name].reasons[0] in page.text
        assert row not in [cells[0] for cells in page.tables[WORST.format(name)]]
    loaded = load(tmp_path / "report.pt", physics=physics(2))
    torch.testing.assert_close(loaded.predict(X).mean, comparison.recommended.predict(X).mean)


@pytest.mark.slow
def test_unknown_parameters_and_those_that_stay_as_known_before(tmp_path, read):
    X, Y = problem(1, 1)
    unknowns = {"gain": Unknown(2.0, sd=1.0, unit="m"), "beyond": Unknown(1.0, sd=0.5)}
    law = lambda X, p: p.gain * X.sum(-1).sin() + p.beyond * (X[:, 0] - 9).clamp_min(0.0)  # noqa: E731
    model = CalibratedPhysics(X, Y, physics=FunctionPhysics(law, unknowns=unknowns))
    fit(model)
    page = read(report(model, tmp_path / "report.html"))
    _, row, _ = page.tables["Parameters of the physics, by CalibratedPhysics"]
    assert row[0] == "gain"
    assert float(row[1]) == pytest.approx(float(model.physics_parameters.mean[0]), rel=1e-3)
    assert row[-2:] == ["2 ± 1", "m"]
    assert "(with fitted parameters) is off by" in page.text
    words = "the data barely constrain beyond: the posterior is about the prior."
    assert f"By CalibratedPhysics, {words}" in page.text


@pytest.mark.slow
def test_a_physics_that_fails_away_from_the_data(tmp_path, read):
    X = torch.tensor([[0.0], [0.1], [0.2], [0.8], [0.9], [1.0]], dtype=torch.float64)
    model = CKA(X, X.sin(), physics=lambda X: torch.where((X - 0.5).abs() < 0.1, torch.nan, X))
    fit(model, "map")
    page = read(report(model, tmp_path / "report.html"))
    assert "No figure: Physics '<lambda>' returned NaN or inf" in page.text
    assert "Coverage of left-out intervals" in page.tables


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["AR1", "ScaleGP", "StackedGP"])
def test_other_models(tmp_path, read, kind):
    X, Y = problem(1, 1)
    if kind == "AR1":
        model, again = AR1(X, Y, physics=physics(1), low_X=X + 0.01), {}
    else:
        model, again = ScaleGP(X, Y, physics=physics(1)), {"physics": physics(1)}
    fit(model, "map")
    if kind == "StackedGP":
        model = StackedGP({"ScaleGP": model}, [1.0])
    page = read(report(model, tmp_path / "report.html"))
    assert page.needs_nothing_else()
    assert "Not compared" in page.text
    loaded = load(tmp_path / "report.pt", **again)
    torch.testing.assert_close(loaded.predict(X).mean, model.predict(X).mean)


@pytest.mark.slow
def test_the_whole_command_by_an_interpreter_of_its_own(tmp_path, read, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [("a [m]", "b", "y [Pa]"), *torch.cat(problem(2, 1, 8), -1).tolist()]
    (tmp_path / "data.csv").write_text("\n".join(",".join(map(str, row)) for row in rows))
    (tmp_path / "crude_sine.py").write_text("import numpy\ndef f(X): return numpy.sin(X.sum(-1))\n")
    arguments = ["--inputs", "a,b", "--outputs", "y", "--physics", "crude_sine:f"]
    command = [sys.executable, "-m", "gpadjust", "report", "data.csv", *arguments]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "structure" in run.stderr  # the progress
    page = read(tmp_path / "report.html")
    answer, _, sentence = run.stdout.splitlines()[1].partition(". ")
    assert f"{answer} {sentence.partition(':')[0]}" in page.text
    assert subprocess.run([sys.executable, "-c", page.loading_code()]).returncode == 0


@pytest.mark.slow
def test_errors_and_coverage_are_without_outliers(tmp_path, read):
    X, f_p = line(20), physics(1)
    Y = f_p(X) + 0.3 * X + 0.03 * normal(20, 1)
    Y[5] += 20
    comparison = compare(X, Y, f_p, noise=HeavyTails(), structures=["CKA"])
    assert comparison.leave_one_out().is_outlier.nonzero()[:, 0].tolist() == [5]
    alone = float((Y - f_p(X))[torch.arange(20) != 5].square().mean().sqrt())
    assert comparison.errors()["y"]["physics alone"] == pytest.approx(alone)
    names = [f"line {i + 2}" for i in range(20)]
    page = read(report(comparison, tmp_path / "report.html", rows=names))
    assert "Taken for outliers, and not in errors and coverage here: line 7." in page.text
    assert f"is off by {alone:.3g} " in page.text
    assert page.tables[WORST.format("y")][1][0] == "line 7 (outlier)"
    for row in page.tables["Coverage of left-out intervals"][1:]:
        inside, _, n = row[1].split()
        assert (n, row[2]) == ("19", f"{100 * int(inside) / 19:.0f} %")


@pytest.mark.slow
def test_categories_have_their_names(tmp_path, read):
    x = line(12)
    frame = pandas.DataFrame({"x": x[:, 0], "rig": ["R1", "R2", "R3"] * 4})
    rigs = Categories((), batches=["rig"])
    Y = x + 0.1 * (3 * x).sin()
    model = CKA(frame, Y, physics=lambda X: X[:, :1], input_transform=rigs)
    fit(model, "map")
    page = read(report(model, tmp_path / "report.html"))
    assert "rig = R2" in page.text
    assert "offsets of rig" in page.text
    assert "categories in" not in page.text
    assert {row[-1] for row in page.tables[WORST.format("y")][1:]} <= {"R1", "R2", "R3"}
    assert page.tables["Columns"][2][3:6] == ["-", "-", "-"]
    code = page.loading_code()
    assert "# rig: 0 is R1, 1 is R2, 2 is R3, any other number is a new one" in code
