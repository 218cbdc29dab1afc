"""The command: from a CSV file and a function to a page, or an error that says what to do."""

import math
import re
import subprocess
import sys
from unittest.mock import Mock

import openpyxl
import pytest
import torch

import gpadjust.report
from gpadjust.__main__ import main
from gpadjust.core import load
from gpadjust.kinds.categories import levels_of
from gpadjust.physics import Unknown
from gpadjust.report.inputs import unknown_of

MODULE = """
import sys
import numpy as np, torch
def wave(X): return torch.sin(6 * X[:, :1])
def of_arrays(X): return np.sin(6 * X[:, 0])
def two(X): return torch.stack([X[:, 0], X[:, 0]], -1)
def root(X): return (0.55 - X[:, 0]).sqrt()
def strict(X):
    if (X > 0.95).any(): raise RuntimeError("too far")
    return X[:, 0]
def noise(X): return torch.randn(len(X))
def huge(X): return torch.where(X[:, 0] > 0.9, 1e300, X[:, 0])
def leaves(X): sys.exit(2)
no_function = 3.0
"""
ROWS = [(i / 8, round(2 * torch.tensor(6 * i / 8).sin().item() + i / 8, 4)) for i in range(9)]
TABLE = "time [s],head [m],note\n" + "".join(f"{x},{y},ok\n" for x, y in ROWS)
WAVE = ["--physics", "hill:wave"]
OUTPUT = ["--outputs", "head"]
FORMULA = ["--physics", "a * sin(6 * time)", "--unknown", "a=1 +- 50 %", *OUTPUT]
COMMAND = ["report", "data.csv", "--inputs", "time", *OUTPUT, "--fit", "map"]


@pytest.fixture
def folder(folder):
    """The working directory: a table, modules of physics, and an earlier report."""
    texts = {"data.csv": TABLE, "hill.py": MODULE, "broken.py": "x = 1\ny = 1 / 0\n"}
    texts["lacks.py"] = "import no_such_module_here\n"
    texts["report.html"] = texts["report.pt"] = "earlier"
    for name, text in texts.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def fitted(folder, undrawn):
    """Writes a table of a header and rows, runs the command, and loads the model."""

    def fitted(header, rows, *options):
        if header:
            (folder / "data.csv").write_text("\n".join([header, *rows, ""]))
        assert main(["report", "data.csv", "--fit", "map", *options]) == 0
        return load("report.pt", trusted=True)

    return fitted


def code_of(page):
    """Runs the code of a page that loads the model."""
    code, names = page.loading_code(), {}
    exec(code, names)
    assert abs(names["mean"] - 2 * (6 * names["X"]).sin() - names["X"]) < 0.2
    return code, names


@pytest.mark.parametrize("function", ["wave", "of_arrays"])
def test_a_page_and_a_model_that_its_code_loads(folder, read, capsys, undrawn, function):
    rows = TABLE.splitlines()
    rows[3] = "0.25,,no measurement"
    (folder / "data.csv").write_text("\n".join([*rows, ",,", ""]))
    assert main([*COMMAND, "--physics", f"hill:{function}", "--seed", "3"]) == 0
    out, err = capsys.readouterr()
    assert "Wrote report.html and report.pt." in out
    assert "data.csv: 8 rows, head [m] from time [s]." in err
    page = read(folder / "report.html")
    assert page.needs_nothing_else()
    assert "Left out, as they have no output: line 4." in page.text
    settings = dict(page.tables["How this page came about"])
    assert settings["command"].endswith(f"--physics hill:{function} --seed 3")
    worst = page.tables["The 5 observations of head [m] that are farthest from their predictions"]
    for line, *_, time in worst[1:]:
        place = int(line.removeprefix("line ")) - 2
        assert float(time) == pytest.approx(ROWS[place][0])
    code, _ = code_of(page)
    assert ("BlackBoxPhysics(hill.of_arrays)" in code) == (function == "of_arrays")
    assert not [file for file in folder.iterdir() if file.name.startswith(".report")]
    # Of one model the page and the terminal name the command that compares.
    how = "has none: the same command, without --fit."
    assert how in out
    assert how in page.text
    assert re.search(r"your formula [\d.e-]+ m adjusted [\d.e-]+ m root mean", page.text)
    assert "report(compare(" not in page.text


def physics(path, words):
    return [*COMMAND, "--physics", path], words


def option(name, value, words):
    return [*COMMAND, *WAVE, name, value], words


def formula(text, words):
    return ["report", "data.csv", "--physics", text, *FORMULA[2:]], words


ALONE = ["report", "data.csv", *OUTPUT]  # without inputs

REFUSED = [
    physics("hill", "table, time, note, and of --unknown; found 'hill'.* given as module:function"),
    physics("hill.py:wave", "No module named 'hill.py'.* Is it 'hill'"),
    physics("./hill.py:wave", "Expected module:function, such as pump:head .* in this folder"),
    physics("hill:no_function", "physics must be a Physics or a callable.* found a float"),
    physics("broken:f", r"cannot be imported, ZeroDivisionError: .* \(broken.py, line 2\)"),
    physics("lacks:f", "cannot be imported, ModuleNotFoundError: .*no_such_module.*lacks.py"),
    physics("hill:two", "expected 1 column, one for each of --outputs head"),
    physics("hill:noise", "expected the same values whenever it is called, found others in 9 of 9"),
    physics("hill:huge", r"found others in 1 of 9 rows.*\n  line 10: time \[s\] = 1$"),
    physics("hill:leaves", r"the physics ended Python by sys.exit\(2\), expected values"),
    physics("hill:root", r"returned NaN or inf in 4 of 9 row\(s\).*\n  line 7: time \[s\] = 0.625"),
    physics("hill:strict", r"raised RuntimeError: too far.*\n  line 10: time \[s\] = 1$"),
    option("--out", "report.pdf", "Expected a page such as 'report.html'"),
    option("--out", "taken.html", "'taken.pt' is a folder, expected a file"),
    option("--physics", "hill:wave", "different --physics, found 'hill:wave' more than once"),
    option("--inputs", "time,head", r"as inputs and outputs, found 'head \[m\]' more than once"),
    option("--units", "head", "such as a=1,b=2, with different names, found 'head'"),
    option("--units", "tail=m", "--units names 'tail'; expected one of 'time', 'head'"),
    option("--noise", "much", "deviation in the unit of 'head', such as 0.1, found 'much'"),
    option("--sheet", "a", r"data.csv: expected a workbook, \*.xlsx, to have a sheet 'a'"),
    option("--delimiter", "ab", "Expected --delimiter as one character, or tab, found 'ab'"),
    option("--unknown", "a=2 +- 1", "names 'a', which is in no formula. A function has its"),
    option("--categories", "note", "names 'note'; expected one of --inputs time; name it there"),
    option("--bounds", "1,0", "--bounds as two numbers, the lower first: 0,1; found '1,0'"),
    option("--input-noise", "head=1", "names 'head'; expected one of --inputs"),
    formula("a * sin(6 * tme)", r"table, time, note, and of --unknown; found 'tme' .*'time'\?"),
    formula("a + 2", r"found 'none of them' in --physics"),
    formula("a * B2", "found 'B2' .* B2 seems to be a cell: write the name of its column"),
    formula("a, time", r"expected 1 column, one for each of --outputs"),
    formula("log(time - 0.55 * a)", r"NaN or inf in 5 of 9 row.*\n  line 2: time \[s\] = 0"),
    ([*ALONE, "--physics", "2 * time", "--unknown", "time=2 +- 1"], "is a column and an unknown"),
    ([*ALONE, *WAVE], "Expected --inputs, the columns that hill:wave reads"),
]
TABLES = {
    "": "found an empty file",
    "time,Head [m]\n0,1\n": r"line 1: expected a column 'head', found .* Is it 'Head \[m\]'\?",
    "time,head\n0,1\n,2\n": r"line 3, column 1 \('time'\): expected a number, found ''",
    "time,head\n0,1\n1,1e300\n": r"line 3, column 2 .*between -1e\+100 and 1e\+100, found '1e300'",
    "time,head\n0,1\n1,\n": "expected two rows or more with a number in 'head', found 1",
}


def test_faults_are_reported_and_nothing_is_written(folder, fails):
    (folder / "taken.pt").mkdir()
    for command, words in REFUSED:
        fails(command, words)
    for text, words in TABLES.items():
        (folder / "data.csv").write_text(text)
        fails([*COMMAND, *WAVE], words)


def test_a_file_that_is_not_there_or_is_the_page(folder, fails):
    (folder / "data.csv").rename(folder / "date.csv")
    (folder / "data.csv2").mkdir()
    fails([*COMMAND, *WAVE], r"There is no file 'data.csv'. Is it 'date.csv'\?")
    (folder / "data.csv").symlink_to("/dev/null")
    fails([*COMMAND, *WAVE], "'data.csv' is a device or a pipe, expected a CSV file")
    (folder / "data.csv").unlink()
    (folder / "data.csv").mkdir()
    fails([*COMMAND, *WAVE], "'data.csv' is a folder, expected a CSV file")
    for data in ("report.pt", "report.html"):
        (folder / data).write_text(TABLE)
        words = f"{data} is the data; give the page another name by --out"
        fails(["report", data, *FORMULA], words)


def test_an_interrupted_fit_leaves_nothing(folder, capsys, monkeypatch):
    monkeypatch.setattr("gpadjust.report.command.fit", Mock(side_effect=KeyboardInterrupt))
    assert main([*COMMAND, *WAVE]) == 130
    assert "interrupted; nothing was written" in capsys.readouterr().err
    assert {(folder / name).read_text() for name in ("report.html", "report.pt")} == {"earlier"}


def test_units_and_noise(fitted, folder, read, capsys):
    options = [*OUTPUT, "--units", "time=ms,head=Pa", "--noise", "0.5", "--out", "report.htm"]
    options += ["--inputs", "time", "--delimiter", ";", "--decimal", ","]
    rows = [f"{x};{y}".replace(".", ",") for x, y in ROWS]
    data = fitted("time;head [m]", rows, *WAVE, *options).data
    assert (data.input_names, data.output_names) == (("time [ms]",), ("head [Pa]",))
    assert data.Y.flatten().tolist() == pytest.approx([y for _, y in ROWS])
    assert data.Yvar.flatten().tolist() == pytest.approx([0.25] * 9)
    # A unit of the file is replaced, not converted, and the page and the terminal report it.
    words = "head is taken in Pa instead of m, its unit in the file; its numbers are not converted."
    assert words in read(folder / "report.htm").text
    err = capsys.readouterr().err
    assert words in err
    assert "time is taken" not in err


def test_help_has_an_example_and_needs_no_torch():
    code = "import sys; from gpadjust.__main__ import main\ntry: main(['report', '--help'])\n"
    code += "except SystemExit as end: assert end.code == 0\nassert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "--inputs flow,speed --outputs head --physics pump:head" in run.stdout


def test_the_help_on_logs_says_what_is_in_python_alone(capsys):
    with pytest.raises(SystemExit):
        main(["identify", "--help"])
    words = " ".join(capsys.readouterr().out.split())
    _, _, text = words.partition("In Python alone")
    assert re.search(r"identify: sensors with unknown gains.* \(by_free_runs=True\)", text)


@pytest.mark.slow
def test_kinds_of_data(fitted, folder, read):
    rigs = ["old", "new", "lent"]
    rows = [f"{x},{rigs[i % 3]},{y + 3}" for i, (x, y) in enumerate(ROWS)]
    (folder / "hill.py").write_text("def wave(X):\n    return 4 + X[:, 0].sin()\n")
    kinds = ["--positive", "--outliers", "--batches", "rig", "--input-noise", "time=0.01"]
    columns = ["--inputs", "time,rig", *OUTPUT, *WAVE]
    model = fitted("time [s],rig,head [m]", rows, *columns, *kinds)
    text = read(folder / "report.html").text
    assert "The physics reads rig as a number: 0 is lent, 1 is new and 2 is old." in text
    for words in ("heavy tails", "time by 0.01 s", "head above 0"):
        assert words in text
    assert model.link is not None
    assert levels_of(model) == {1: ("lent", "new", "old")}
    fitted(None, None, *columns, "--noise", "relative", "--categories", "rig")
    text = read(folder / "report.html").text
    assert "Assumed: noise that grows with the formula" in text
    assert "categories in rig" in text


UNKNOWNS = {
    "E [Pa]=210e9 +- 20 %": Unknown(210e9, sd=42e9, bounds=(0, math.inf), unit="Pa"),
    "c = -2 ± 50%": Unknown(-2.0, sd=1.0, bounds=(-math.inf, 0)),
    "c=-2+-1": Unknown(-2.0, sd=1.0),
    "c=1e-3 */ 2": Unknown(1e-3, factor=2.0),
    "c=0.1..0.3": Unknown(0.2, bounds=(0.1, 0.3)),
    "c(x: 0 .. 2) = 1 */ 3": Unknown(1.0, factor=3.0, function_of="x", between=(0.0, 2.0)),
}


def test_priors_of_unknown_parameters():
    for text, expected in UNKNOWNS.items():
        assert unknown_of(text) == (text[0], expected)
    for text in ("E", "E=", "E=2", "E=2+-", "E=x+-1", "=2+-1", "E=2+-0", "E=2*/20 %", "E=3..1"):
        with pytest.raises(ValueError, match=r"Expected --unknown such as .* found"):
            unknown_of(text)


def test_a_formula_names_its_inputs_and_is_in_the_file(folder, read, capsys, undrawn):
    assert main(["report", "data.csv", "--fit", "map", *FORMULA]) == 0
    assert "head [m] from time [s]." in capsys.readouterr().err
    page = read(folder / "report.html")
    for words in (
        "The file holds the formula.",
        "your formula, with fitted parameters",
        "(with the parameters fitted together with the correction) is off by",
        "Each dot is a measurement less the formula, at its own values",
    ):
        assert words in page.text
    code, names = code_of(page)
    assert "load('report.pt')" in code
    assert names["model"].physics[0].unknowns == {"a": unknown_of("a=1 +- 50 %")[1]}


def test_inputs_are_those_of_the_option_of_formulas_and_groups(fitted, fails, capsys):
    rows = [f"{x},R{i % 2},{y}" for i, (x, y) in enumerate(ROWS)]
    header = "time [s],rig,head [m]"
    model = fitted(header, rows, *FORMULA, "--batches", "rig")
    assert model.data.input_names == ("time [s]", "rig")
    assert model.data.transform.batches == [1]
    options = ["--inputs", "time,rig", *OUTPUT, *WAVE]
    capsys.readouterr()
    model = fitted(header, rows, *options)  # texts are categories
    words = "The physics reads rig as a number: 0 is R0 and 1 is R1."
    assert words in capsys.readouterr().err
    assert levels_of(model) == {1: ("R0", "R1")}
    assert model.data.transform.batches == []
    rows = [f"{x},{x},id{i},{y}" for i, (x, y) in enumerate(ROWS)]  # texts that do not repeat
    options = ["--inputs", "q=air flow", "--physics", "q + sin(6*in)", "--outputs", "h"]
    model = fitted("in [s],air flow,rig,h", rows, *options)
    assert model.data.input_names == ("q", "in [s]")
    command = ["report", "data.csv", *options, "--inputs", "q=air flow,rig"]
    fails(command, r"column 3 \('rig'\): expected a number")


def test_formulas_of_several_forms(fitted, folder, read):
    model = fitted(None, None, *FORMULA, "--physics", "cos(time)")
    assert "formula 1" in read(folder / "report.html").text
    names = [term.name for term in model.terms if term.physics is not None]
    assert names == ["rho_formula 1", "rho_formula 2"]
    fitted(None, None, *OUTPUT, "--physics", "-2*(time - 1)^2")  # no option


@pytest.mark.slow
def test_of_many_rows_some_are_drawn(fitted, folder, read, capsys):
    rows = [f"{i / 1e5},{i % 7}" for i in range(100_000)]
    X = fitted("time,head", rows, *FORMULA, "--rows", "12").data.X
    words = "Of 100,000 rows 12 were taken, drawn at random by --seed"
    assert words in capsys.readouterr().err
    assert words in read(folder / "report.html").text
    assert len(X) == 12
    assert X.std() > 0.1
    with pytest.raises(SystemExit):
        main(["report", "data.csv", *FORMULA, "--rows", "0"])


def test_what_is_missing_is_named(monkeypatch, capsys):
    for name in [name for name in sys.modules if name.startswith("gpadjust.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delattr(gpadjust, "report")
    assert main([*COMMAND, "--physics", "c:d"]) == 1
    way = 'gpadjust: gpadjust.report needs matplotlib; run `pip install "gpadjust[report]"`.\n'
    assert capsys.readouterr().err == way
    for arguments in ([], ["report"], ["report", "data.csv", "--inputs", "a"]):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        assert "the following arguments are required" in capsys.readouterr().err


def test_a_german_spreadsheet_with_a_formula_of_a_spreadsheet(fitted, capsys):
    header = "Draht d (mm);Länge über alles [mm];Prüfer"
    rows = [f"{x};{1000 * (y + 3)};R".replace(".", ",") for x, y in ROWS]
    physics = ["--physics", "=1000*(3 + 2*SIN(6*d)^1,0) + 0*PI()"]
    options = ["--inputs", "d=Draht d", "--outputs", "y=Länge über alles", *physics]
    data = fitted(header, rows, *options).data
    assert "y [mm] from d [mm]." in capsys.readouterr().err
    assert (data.input_names, data.output_names) == (("d [mm]",), ("y [mm]",))
    assert data.Y.flatten().tolist() == pytest.approx([1000 * (y + 3) for _, y in ROWS])


@pytest.mark.slow
def test_a_sheet_of_a_workbook_is_chosen(folder, undrawn):
    book = openpyxl.Workbook()
    for row in (("time [s]", "head [m]"), *ROWS):
        book.active.append(row)
    book.create_sheet("other")["A1"] = "notes"
    book.save("data.xlsx")
    assert main(["report", "data.xlsx", "--fit", "map", *FORMULA, "--sheet", "Sheet"]) == 0
    assert load("report.pt").data.Y.flatten().tolist() == [y for _, y in ROWS]


def test_a_column_pi_is_never_the_constant(fitted, fails):
    rows = [f"{x + 1},{x},{y}" for x, y in ROWS]
    model = fitted("pi,po,q", rows, "--outputs", "q", "--physics", "2*(pi_-po)*PI()")
    assert model.data.input_names == ("pi", "po")
    options = ["--outputs", "q", "--inputs", "p=pi", "--physics", "pi*p - po"]
    assert fitted(None, None, *options).data.input_names == ("p", "po")
    for inputs in ([], ["--inputs", "po"], ["--inputs", "pi,po"]):
        command = ["report", "data.csv", "--outputs", "q", "--physics", "2*(pi-po)", *inputs]
        fails(command, "formulas take it as 3.14159, and here is a 'pi' of your own")
