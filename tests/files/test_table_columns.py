"""Columns of CSV files as they come; what reads records is in tests/records/test_records.py."""

import pytest

from gpadjust.files.table_columns import TableColumns


@pytest.fixture
def columns(tmp_path):
    """Reads a text as a CSV file."""

    def columns(text, *args, **options):
        path = tmp_path / "table.csv"
        path.write_bytes(text.encode())
        return TableColumns(path, *args, **options)

    return columns


def test_lines_are_those_of_an_editor(columns):
    table = columns('\nx,"y\nin words"\n1,2\n\n3,"4"\n"5\n",6\n7,bad\n')
    assert table.names == ("x", "y\nin words")
    assert table.lines == (4, 6, 7, 9)
    assert table.numbers("x").tolist() == [1, 3, 5, 7]
    with pytest.raises(ValueError, match=r"line 9, column 2 .*'bad'"):
        table.numbers("y\nin words")
    with pytest.raises(ValueError, match="line 2: expected a column 'z'"):
        table.numbers("z")


def test_decimal_marks_and_what_is_no_number(columns):
    for decimal, text, value in ((".", "1.5", 1.5), (",", "1,5", 1.5), (",", "-1,5e3", -1500.0)):
        table = columns(f"x;y\n{text};0\n", ";", decimal=decimal)
        assert table.numbers("x").tolist() == [value]
    for decimal, text, hint in (
        (".", "1,5", "If this comma is a decimal comma, say so by `decimal=','`."),
        (",", "1.5", "If this point is a decimal point, say so by `decimal='.'`."),
        (",", "1.234,5", "leave the line out."),
        (".", "1_000", "leave the line out."),
        (".", "1,5 m", "leave the line out."),
    ):
        table = columns(f"x;y\n{text};0\n", ";", decimal=decimal)
        with pytest.raises(ValueError, match="line 2, column 1") as error:
            table.numbers("x")
        assert str(error.value).endswith(hint)


def test_a_column_that_is_not_there_has_the_likest_name(columns):
    table = columns("Flow [m3/h],head\n1,2\n")
    for near in ("flow", "Flow [l/s]", "flw"):
        with pytest.raises(ValueError, match=r"Is it 'Flow \[m3/h\]'\?"):
            table.numbers(near)
    with pytest.raises(ValueError, match=r"found 'Flow \[m3/h\]', 'head'"):
        table.numbers("pressure")


def test_another_delimiter_is_told(columns):
    for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
        with pytest.raises(ValueError, match=rf"{name} .*--delimiter"):
            columns(f"x{mark}y\n1{mark}2\n", option="--{} {!r}").numbers("x")
        with pytest.raises(ValueError, match=rf"1 field,.* {name}"):
            columns(f"x{mark}y\n1{mark}2,5\n")
