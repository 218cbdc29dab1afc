"""Columns of CSV files as they come; what reads records is in tests/records/test_records.py."""

import openpyxl
import pytest

from gpadjust.files.table import Table


@pytest.fixture
def columns(tmp_path):
    """Reads a text as a CSV file."""

    def columns(text, **options):
        path = tmp_path / "table.csv"
        path.write_bytes(text.encode())
        return Table(path, **options)

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
        table = columns(f"x;y\n{text};0\n", decimal=decimal)
        assert table.numbers("x").tolist() == [value]
    for decimal, text, hint in (
        (".", "1,5", "If this comma is a decimal comma, use `decimal=','`."),
        (",", "1.5", "If this point is a decimal point, use `decimal='.'`."),
        (",", "1,234.5", "If this point is a decimal point, use `decimal='.'`."),
        (".", "1_000", "leave the line out."),
        (".", "1,5 m", "Write its unit into the name, x [m]."),
    ):
        table = columns(f"x;y\n{text};0\n", decimal=decimal)
        with pytest.raises(ValueError, match="line 2, column 1") as error:
            table.numbers("x")
        assert str(error.value).endswith(hint)


def test_points_of_thousands_beside_decimal_commas(columns):
    table = columns("G;d\n70.000;2,66\n1.081.500;3,99\n")
    assert table.numbers("G").tolist() == [70_000, 1_081_500]
    assert table.numbers("d").tolist() == [2.66, 3.99]
    assert table.remarks[0].endswith("points separate thousands, as in '70.000'.")
    with pytest.raises(ValueError, match="If this point is a decimal point"):
        columns("G;d\n70.000;2,66\n81.50;3,99\n").numbers("G")


def test_errors_of_spreadsheets_are_missing(columns):
    table = columns("a;b\n1;#DIV/0!\n2;#N/A\n3;#NV\n4;#WERT!\n5;6,5\n")
    assert table.numbers("b", may_miss=True).isnan().tolist() == [True] * 4 + [False]


def test_sheets_without_a_value_need_no_choice(tmp_path):
    book = openpyxl.Workbook()
    for row in (("a", "b"), (1, 2), (3, 4)):
        book.active.append(row)
    book.create_sheet("Tabelle2")
    book.save(tmp_path / "table.xlsx")
    assert Table(tmp_path / "table.xlsx").numbers("b").tolist() == [2, 4]
    book["Tabelle2"]["A1"] = "notes"
    book.save(tmp_path / "table.xlsx")
    with pytest.raises(ValueError, match=r"'Sheet', 'Tabelle2'; choose one: `sheet='Sheet'`"):
        Table(tmp_path / "table.xlsx")
    with pytest.raises(ValueError, match="choose one: --sheet 'Sheet'"):
        Table(tmp_path / "table.xlsx", is_command=True)
    assert Table(tmp_path / "table.xlsx", sheet="Sheet").numbers("a").tolist() == [1, 3]
    book["Sheet"]["B3"] = "=1+1"
    book.save(tmp_path / "table.xlsx")
    with pytest.raises(ValueError, match="line 3: expected a value, found a formula without one"):
        Table(tmp_path / "table.xlsx", sheet="Sheet")
    (tmp_path / "table.xlsx").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"expected a workbook, \*.xlsx, but"):
        Table(tmp_path / "table.xlsx")


def test_a_column_that_is_not_there_has_the_likest_name(columns):
    table = columns("Flow [m3/h],head\n1,2\n")
    for near in ("flow", "Flow [l/s]", "flw"):
        with pytest.raises(ValueError, match=r"Is it 'Flow \[m3/h\]'\?"):
            table.numbers(near)
    with pytest.raises(ValueError, match=r"found 'Flow \[m3/h\]', 'head'"):
        table.numbers("pressure")


def test_a_delimiter_that_is_given_is_kept(columns):
    assert columns("x;y,z\n1;2,3\n", delimiter=",").headers == ("x;y", "z")
    assert columns("x;y\n1,000;2\n", decimal=".").numbers("x").tolist() == [1000]


def test_names_are_found_as_they_are_without_units_or_as_symbols(columns):
    table = columns("Air flow (m3/h),Air flow [l/s],dT/dt (K/s),x [m],x\n1,2,3,4,5\n")
    for name in ("dT/dt (K/s)", "dT/dt [K/s]", "dT/dt", "dT_dt"):
        assert table.numbers(name).tolist() == [3]
        assert table.label(name) == "dT/dt [K/s]"
    assert table.numbers("x").tolist() == [5]
    with pytest.raises(ValueError, match="expected a column 'Air flow'"):
        table.numbers("Air flow")


def test_what_comes_before_the_data(columns):
    assert columns("rig,head\nold,\nold,1\nnew,2\n").lines == (2, 3, 4)
    assert columns("time,2020,2021\n1,1,2\n2,3,4\n").names == ("time", "2020", "2021")
    assert columns("rig,kind\nold,a\nnew,b\n").names == ("rig", "kind")
    table = columns("rig,s\nC,\nC,1\nK,2\n")  # letters of rigs are no units
    assert (table.lines, table.units) == ((2, 3, 4), ("", ""))
    table = columns("t,s\ns,m\n1,2\n")
    assert (table.names, table.units) == (("t", "s"), ("s", "m"))
    table = columns("a;b;c\nmm;N;Nmm\n4,378;4,032;19,415\n2,6;2;6\n")
    assert (table.names, table.units) == (("a", "b", "c"), ("mm", "N", "Nmm"))
    table = columns("0,error\n1,2\n2,3\n", names=["t", "x"])  # the first row is no line of names
    with pytest.raises(ValueError, match=r"line 1, column 2 \('x'\): .*found 'error'"):
        table.numbers("x")
    remark = columns("Logger\n\na,b\n1,2\n").remarks[0]
    assert remark.endswith("line 3; earlier lines are not read.")
    with pytest.raises(ValueError, match="only a line of names"):
        columns("a,b\n")


def test_rows_of_another_length(columns):
    for text, words in (
        ("a,b\n0,1\n2\n", "line 3: expected 2 fields, one for each name, found 1"),
        ("a,b\n0,1\n1,2,3\n", "line 3: expected 2 fields, one for each name, found 3"),
        ("a,b\n0,1,7\n1,2,7\n", "line 2: .* Name all columns: `names=\\['a', 'b', 'other'\\]`"),
    ):
        with pytest.raises(ValueError, match=words):
            columns(text)
    assert "the first column has no name" in columns("a,b\n1,1,7\n2,2,7\n").remarks[0]
    with pytest.raises(ValueError, match=r"expected 3 fields, .* found 2"):
        columns("1,2\n3,4\n", names=["a", "b", "c"])
