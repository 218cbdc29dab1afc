"""What a page says is what the comparison says, and it is a page by itself."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust.core import CKA, CalibratedPhysics, ZeroMeanGP, fit, load
from gpadjust.kinds import with_options
from gpadjust.physics import FunctionPhysics, PhysicsError, Unknown
from gpadjust.report import figures, report, tables
from gpadjust.report.markup import Markup, failure, side_by_side, table, tag
from gpadjust.report.page import cards, formula_of, headline
from gpadjust.report.subject import Adjusted, subject_of
from gpadjust.validation import Verdict
from gpadjust.validation.plots import lines_along
from gpadjust.words import about, listed, name_among, name_and_unit, number, plural, shortened
from tests.systems import line, refused, uniform, wave

from .conftest import Page


@pytest.mark.slow
def test_a_comparison(comparison, tmp_path, read, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = report(comparison, "a b.html", rows=range(2, 12), settings={"seed": 7})
    assert {file.name for file in tmp_path.iterdir()} == {"a b.html", "a b.pt"}
    page = read(path)
    assert page.needs_nothing_else()
    assert path.stat().st_size < 500_000
    assert len(page.images) == 5
    assert all(len(image["alt"]) > 10 for image in page.images)
    (verdict,) = comparison.verdict.values()
    assert f"{verdict.answer} {' '.join(verdict.reasons)} {_three(comparison)}" in page.text
    for sentence in comparison.advice:
        assert sentence.replace("+-", "±") in page.text
    settings = dict(page.tables["How this page came about"][1:])
    assert settings["seed"] == "7"
    assert settings["physics"] == "wave (FunctionPhysics)"
    # The table is that of the comparison.
    head, *rows = page.tables["Left-out predictions of y, best first"]
    assert head[0] == "structure"
    assert (rows[-1][0], rows[-1][4]) == ("physics alone", "-")
    for row, expected in zip(rows, comparison.table["y"], strict=True):
        assert row[0] == expected.structure
        numbers = [float(text) for text in row[1:5] if text != "-"]
        assert numbers == pytest.approx(expected[1 : 1 + len(numbers)], rel=0.06, abs=0.006)
        assert float(row[6]) == pytest.approx(expected.rmse, rel=0.01)
        assert row[7] == f"{100 * expected.coverage:.0f} %"
    # Left-out observations are its own, too.
    loo = comparison.leave_one_out()
    head, row, *_ = page.tables["The 5 observations of y that are farthest from their predictions"]
    worst = int(loo.residuals[:, 0].abs().argmax())
    assert row[0] == str(worst + 2)
    numbers = [float(row[i]) for i in (1, 2, head.index("x"))]
    expected = [float(values[worst]) for values in (loo.Y, loo.mean, loo.X)]
    assert numbers == pytest.approx(expected, rel=1e-3)
    coverage = {row[0]: row[1] for row in page.tables["Coverage of left-out intervals"]}
    assert coverage["y, 80 %"] == f"{round(10 * float(loo.score(0.8).coverage))} of 10"
    # Its code predicts as the model.
    code, names = page.loading_code(), {}
    assert "load('a b.pt', trusted=True)" in code
    assert "by its name" in page.text
    exec(code, names)
    torch.testing.assert_close(names["mean"], comparison.recommended.predict(names["X"]).mean)
    assert names["lower"] < names["mean"] < names["upper"]


def _three(comparison):
    alone, adjusted, data = map(number, comparison.errors()["y"].values())
    words = f"your formula {alone} adjusted {adjusted} data alone {data}"
    return f"{words} root mean square errors of left-out observations"


def test_one_model_whose_physics_has_no_name(tmp_path, read, monkeypatch, undrawn):
    X = uniform(7, 2)
    model = CKA(X, X.sum(-1, keepdim=True).sin(), physics=lambda X: X[:, :1])
    model.data = model.data._replace(output_names=("p [Pa]",))
    fit(model, "map")
    monkeypatch.chdir(tmp_path)
    page = read(report(model, "report.html"))
    assert "Not compared" in page.text
    assert "report(compare(train_X, train_Y, physics))" in page.text
    rmse = number(float(subject_of(model).loo.score().rmse[0]))
    alone = number(float((X.sum(-1).sin() - X[:, 0]).square().mean().sqrt()))
    assert f"your formula {alone} Pa adjusted {rmse} Pa root mean square" in page.text
    names = {"f_p": lambda X: X[:, :1]}
    exec(page.loading_code(), names)
    torch.testing.assert_close(names["mean"], model.predict(names["X"]).mean)


@pytest.mark.parametrize(
    ("link", "scale"), [(None, "{}"), ("log", "log({})"), ((1, 3), "log(({0} - 1) / (3 - {0}))")]
)
def test_the_adjustment_is_on_the_scale_of_the_link(link, scale):
    X = line(7)
    options = {} if link is None else {"link": link}
    model = with_options(CKA, options)(X, 1.5 + X, physics=lambda X: 1.2 + X)
    fit(model, "map")
    subject = subject_of(model)
    prediction, formula = (scale.format(name) for name in ("prediction", "formula(x)"))
    assert formula_of(subject) == f"{prediction} = rho(x) {formula} + delta(x)"
    text = "a scale and a bias that depend on the inputs"
    if link is not None:
        text += f", on the scale of {scale.format('y')}"
    assert tables.described("CKA", subject.link).endswith(text)
    assert tables.described("zero mean", subject.link).endswith("of the data alone")


def test_a_model_without_physics(tmp_path, read, undrawn):
    model = ZeroMeanGP(line(7), line(7).sin())
    fit(model, "map")
    page = read(report(model, tmp_path / "report.html"))
    for words in (
        "has no physics to judge",
        "data alone ",
        "This model has no formula to adjust or to trust",
    ):
        assert words in page.text
    assert "your formula" not in page.text
    assert dict(page.tables["How this page came about"])["physics"] == "none"
    assert load(tmp_path / "report.pt").data.output_names == ("y",)


def test_the_verdict_and_its_color(comparison):
    for answer, color in (
        ("Use your formula as it is", "yes"),
        ("Use it corrected", "yes"),
        ("Do not use it", "no"),
        ("These data do not tell", "open"),
        ("Correct your formula: it is about 1,000 times too large", "open"),
    ):
        verdict = Verdict(answer, ["One reason.", "Another."])
        shown = cards(subject_of(dataclasses.replace(comparison, verdict={"y": verdict})))
        page = side_by_side(shown)
        assert Page(page).text == f"{answer} One reason. Another. {_three(comparison)}"
        assert f'class="card {color}"' in page
        assert headline(shown, "Errors").endswith(f"\n{answer}. One reason.")


def test_nothing_is_written_of_what_cannot_be_reported(comparison, tmp_path):
    X = line(5)
    model = CKA(X, X.sin(), physics=wave)
    old = tmp_path / "report.html"
    old.write_text("old")
    (tmp_path / "folder.html").mkdir()
    for subject, path, rows, error, words in (
        (
            model,
            old,
            None,
            ValueError,
            r"Expected a fitted model; .*: call `gpadjust.fit\(mod",
        ),
        (torch.nn.Linear(1, 1), old, None, TypeError, "found Linear. Of many rows report on"),
        (comparison, old, [1, 2], ValueError, "Expected 10 names of rows, .* found 2"),
        (comparison, tmp_path / "a.csv", None, ValueError, r"page such as 'report.html' .*a.csv"),
        (comparison, tmp_path / "none" / "a.html", None, FileNotFoundError, "There is no folder"),
        (comparison, tmp_path / "folder.html", None, IsADirectoryError, "give the page another"),
    ):
        refused(error, words, report, subject, path, rows=rows)
    assert old.read_text() == "old"
    assert {file.name for file in tmp_path.iterdir()} == {"report.html", "folder.html"}


def test_an_interrupted_page_and_a_model_that_cannot_be_saved(
    comparison, tmp_path, read, monkeypatch, undrawn
):
    page, model = tmp_path / "report.html", tmp_path / "report.pt"
    page.write_text("old")
    with monkeypatch.context() as patched:
        patched.setattr("gpadjust.report.tables.data", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            report(comparison, page)
    assert page.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
    model.write_text("old")
    monkeypatch.setattr("gpadjust.report.page.save", Mock(side_effect=ValueError("no way")))
    assert "The model could not be saved: no way" in read(report(comparison, page)).text
    assert not model.exists()  # of the earlier page


def test_inputs_that_move_predictions_are_drawn_and_repeated_rows_are_counted():
    X = uniform(20, 13)
    X[1:3] = X[0]
    Y = 5 * X[:, -1:]
    Y[:3, 0] += torch.tensor([-1.0, 0.0, 1.0])
    model = CKA(X, Y, physics=lambda X: 5 * X[:, -1:])
    model.data = model.data._replace(output_names=("p [Pa]",))
    fit(model, "map")
    subject = subject_of(model)
    drawn = figures.inputs_drawn(subject)
    assert len(drawn) == 12
    assert drawn[-1] == 12
    same = "3 rows share their inputs with another, and their outputs differ"
    assert f"{same} by a standard deviation of 1 Pa (p)." in tables.data(subject, ())


def test_a_physics_that_fails_leaves_the_shares_of_the_other_output():
    X, least = line(9), [0.0]
    fragile = FunctionPhysics(lambda X: X.where(X.ge(least[0]), torch.nan).repeat(1, 2))
    models = [CKA(X, X.repeat(1, 2).sin(), physics=f) for f in (fragile, lambda X: X.repeat(1, 2))]
    fit(models[1], "map")
    least[0] = 1.0
    adjusted = [Adjusted("CKA", model) for model in models]
    page = Page(figures.trusted(dataclasses.replace(subject_of(models[1]), adjusted=adjusted)))
    assert "y1: Physics" in page.text
    assert [row[0] for row in page.tables["Basis of the predictions"][1:]] == ["y2"]


def test_inputs_are_drawn_in_double_precision():
    X = 1e60 * (1 + line(7, 0, 1e-8))
    ((_, drawn),) = lines_along(ZeroMeanGP(X, X / 1e60))
    assert len(drawn.unique()) == len(drawn) > 9


def test_dots_at_the_ends_of_a_figure_are_complete(monkeypatch):
    X = line(7)
    model = CKA(X, X.sin(), physics=lambda X: X)
    fit(model, "map")
    drawn = []
    monkeypatch.setattr(figures, "image", lambda figure, alt: drawn.append(figure) or Markup(alt))
    figures.corrections(subject_of(model), 0, [0])
    low, high = drawn[0].axes[0].get_xlim()
    assert low < -0.02
    assert high > 1.02


def test_where_a_physics_fails_is_told_in_a_line():
    X = torch.arange(6.0).unsqueeze(-1)
    with pytest.raises(PhysicsError) as error:
        FunctionPhysics(lambda X: (1.5 - X).sqrt(), name="root")(X)
    told = failure(error.value)
    assert told.startswith("Physics 'root' returned NaN or inf in 4 of 6 row(s)")
    assert told.endswith("such inputs: at inputs (2), (3), (4) and 1 more.")
    assert failure(PhysicsError("It fails.")) == "It fails."


@settings(max_examples=30)
@given(st.lists(st.text(st.characters(exclude_categories=["Cc", "Cn", "Cs"])), min_size=2))
def test_any_text_comes_back_from_the_markup(texts):
    page = Page(tag("main", table(texts[0], texts, [texts]), id=texts[0]))
    assert page.root[0].get("id") == texts[0]
    assert page.tables[texts[0]][1] == texts


def test_numbers_names_with_units_counts_and_lists():
    numbers = {0.0: "0", 123456.0: "123000", 0.00012345: "0.000123", 1e9: "1e+09", -2.5: "-2.5"}
    assert {value: number(value) for value in numbers} == numbers
    names = {"head [m]": ("head", "m"), "x[0]": ("x", "0"), "[m]": ("[m]", ""), "a": ("a", "")}
    assert {text: name_and_unit(text) for text in names} == names
    assert [plural(n, "row") for n in (0, 1, 1200)] == ["0 rows", "1 row", "1,200 rows"]
    assert [listed("abc"[:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]
    assert [shortened("abc", n) for n in (3, 2)] == [["a", "b", "c"], ["a", "b", "1 more"]]
    assert about([name_among("y", ["y"]), name_among("z", ["y", "z"])], "low") == "z: low"


@pytest.mark.parametrize(("form", "pairs"), [("sum", 1), ("line", 0)])
def test_correlated_parameters_are_drawn_as_a_pair(form, pairs):
    """Data tell a + b alone; a and b of a + b x about x = 0 are independent."""
    X = line(9) - 0.5
    slope = 1.0 if form == "sum" else X
    physics = FunctionPhysics(
        lambda X, p: p.a + p.b * (X[:, 0] ** (form == "line")),
        unknowns={name: Unknown(1.0, sd=0.3) for name in "ab"},
    )
    model = CalibratedPhysics(X, 1.0 + slope + 0.01 * (7 * X).cos(), physics=physics)
    fit(model, seed=0)
    drawn = figures.densities(model.physics_parameters)
    assert drawn.count("<img") == 2 + pairs
    assert drawn.count("draws of a and b, correlated") == pairs
