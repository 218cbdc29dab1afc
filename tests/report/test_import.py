"""Without matplotlib."""

import sys

import pytest

import gpadjust.report
from gpadjust.__main__ import main


def test_what_is_missing_is_named(monkeypatch, capsys):
    for name in [name for name in sys.modules if name.startswith("gpadjust.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delattr(gpadjust, "report")
    given = ["--inputs", "a", "--outputs", "b", "--physics", "c:d"]
    assert main(["report", "data.csv", *given]) == 1
    error = capsys.readouterr().err
    assert error == (
        'gpadjust: gpadjust.report needs matplotlib; run `pip install "gpadjust[report]"`.\n'
    )


@pytest.mark.parametrize("arguments", [[], ["report"], ["report", "data.csv", "--inputs", "a"]])
def test_a_command_that_lacks_something_says_what(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert "the following arguments are required" in capsys.readouterr().err
