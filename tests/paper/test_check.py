"""What keeps the numbers true: quotes are those of their tables, and runs can be made again."""

from importlib import import_module
from pkgutil import resolve_name

import pytest

from paper import check
from paper.__main__ import EXPERIMENTS
from paper.check import difference
from paper.common import runner
from paper.common.runner import main, runs_file, stale_list, stamp
from paper.common.runs import commit_of
from paper.pages import PAPER, QUOTING, results, wrong_quotes
from tests.paper.toy import Toy

TABLE = """| model, n | RMSE, m | held |
| --- | --- | --- |
| CKA, 5 | 0.274 ± 0.02 (3) | 0.943 |
| **GP, 5** | **1,234.5** | 41 of 48 |
| GP, 9 |  | 0.5 |"""


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("0.27", "CKA, 5 :: RMSE, m", None),
        ("0.274 ± 0.02", "CKA, 5 :: RMSE, m", None),
        ("94 %", "CKA, 5 :: held", None),
        ("1,234", "GP, 5 :: RMSE, m", None),
        ("41 of 48", "GP, 5 :: held", None),
        ("all errors", "", None),
        ("0.28", "CKA, 5 :: RMSE, m", "the table has '0.274"),
        ("0.02 ± 0.274", "CKA, 5 :: RMSE, m", "the table has"),
        ("40 of 48", "GP, 5 :: held", "the table has"),
        ("0.27", "", "no title with a place"),
        ("0.27", "CKA :: RMSE, m", "there are 0 cells"),
        ("0.27", "CKA, 5 :: RMSE", "there are 0 cells"),
    ],
)
def test_a_number_is_quoted_as_it_is_or_rounded(text, place, words):
    title = f' "{place}"' if place else ""
    wrong = wrong_quotes(f"It is [{text}](x/tables.md#toy:all{title}).", {"toy:All": TABLE})
    assert len(wrong) == (words is not None)
    assert all(words in quote for quote in wrong)
    assert "no such table" in wrong_quotes("[x](a/tables.md#toy:none)", {"toy:all": TABLE})[0]


def test_documents_quote_their_tables():
    """If this fails, a table has changed: quote it anew, or drop what it no longer shows."""
    tables = results(PAPER / "results")
    wrong = {path.name: wrong_quotes(path.read_text(), tables) for path in QUOTING}
    assert {name: quotes for name, quotes in wrong.items() if quotes} == {}


def test_differences_of_runs():
    old = {"a": 1.0, "list": [1.0, 2.0, 3.0], "seconds": 9.0, "none": None, "x": {"y": [0.5]}}
    assert difference(old, {**old, "seconds": 1.0, "a": 1.0001}) == ""
    assert difference(old, {"list": [1.0, 2.0]}) == ""  # a cheaper case is shorter
    assert difference(old, {"list": [1.0, 2.1]}) == "list[1] was 2.0 and is now 2.1"
    assert difference(old, {"x": {"y": [0.6]}}) == "x.y[0] was 0.5 and is now 0.6"
    assert difference(old, {"none": 1.0}) == "none was None and is now 1.0"
    assert difference({}, {"x": {"y": [0.5]}}) == "x was None and is now {'y': [0.5]}"
    assert difference({}, {"list": [1.0]}) == "list was None and is now [1.0]"


@pytest.fixture
def squares(tmp_path, monkeypatch):
    """An experiment whose runs are there, as `check` sees it."""
    monkeypatch.setattr(runner, "commit_of", lambda root: ("f" * 40, "2026-01-01"))
    (tmp_path / "results").mkdir()
    experiment = Toy(out=tmp_path / "results", runs=2)
    main(experiment)
    monkeypatch.setattr(check, "PAPER", tmp_path)
    monkeypatch.setattr(runner, "STALE", tmp_path / "stale.txt")
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    return experiment, {"toy": "tests.paper.toy:Toy"}


def rewrite(experiment, **entries):
    """Change entries of all recorded runs."""
    file = runs_file(experiment)
    runs = [{**run, **entries} for run in file.read().values()]
    file.path.unlink()
    for run in runs:
        file.append(run)


def test_stale_learners_are_named_below_their_tables(squares):
    experiment, known = squares
    runs = [*runs_file(experiment).read().values()]
    assert check.check(known) == {}
    assert stamp(experiment, runs) == "*Runs: 4 by ffffffff of 2026-01-01.*"
    runner.STALE.write_text("toy a\n")
    rewrite(experiment, commit=None)
    assert check.check(known) == dict.fromkeys(["toy a", "toy b"], "its code was not committed")
    assert [*check.check(known, known=False)] == ["toy b"]
    assert stamp(experiment, runs).endswith(" Stale: today's code gives other numbers (a).*")


def test_what_is_not_installed_is_not_stale(squares, monkeypatch, capsys):
    _, known = squares
    monkeypatch.setattr(Toy, "run", lambda self, kind, seed: {"value": -1})
    monkeypatch.setattr(Toy, "check", lambda self: import_module("not_there"))
    assert check.check(known) == {}
    assert "toy a: No module named 'not_there', not made again" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(commit_of(check.ROOT) is None, reason="an unpacked archive has no history")
def test_the_code_of_the_record_decides_between_the_machine_and_a_change(
    squares, monkeypatch, capsys
):
    experiment, known = squares
    rewrite(experiment, commit=commit_of(check.ROOT)[0].rstrip("+"), value=5, took=0)
    assert check.check(known) == {}  # the committed code gives 0 here, as today's does
    assert "toy a: value was 5 and is now 0.0; on this machine" in capsys.readouterr().out
    monkeypatch.setattr(Toy, "run", lambda self, kind, seed: {"value": {"a": 9, "b": seed}[kind]})
    assert check.check(known) == {"toy a": "value was 0.0 and is now 9"}
    rewrite(experiment, commit="f" * 40)
    assert check.check(known) == {}
    assert f"this clone does not have the record's commit {'f' * 40}" in capsys.readouterr().out


@pytest.mark.slow
def test_committed_numbers_are_made_again_or_called_stale():
    """If this fails, `python -m paper check --write` says in the tables what is stale.

    That command makes the expensive cases, too.
    """
    assert check.check(EXPERIMENTS, known=False, budget=100) == {}


def test_the_list_of_stale_learners_is_of_those_that_there_are():
    there = {
        f"{name} {learner}"
        for name, kind in EXPERIMENTS.items()
        for learner, *_ in check.cheapest(resolve_name(kind)(out=PAPER / "results"))
    }
    assert stale_list() <= there
