"""One small log in the dialects of loggers and spreadsheets, read by both commands alike."""

import csv
import math
from datetime import datetime
from io import BytesIO, StringIO

import openpyxl
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.__main__ import parser
from gpadjust.files.table import Table
from gpadjust.records import Records
from gpadjust.report import inputs as read
from gpadjust.states import StateSpec

TIMES = ["0", "0.5", "1", "1.5"]
U = ["0", "50", "100", "25"]
T = ["20.5", "20.75", "", "1021.25"]
EXPECTED = [[float(x or "nan") for x in column] for column in (TIMES, U, T)]
BEFORE_MIDNIGHT = ["2015-02-13 23:59:59", "2015-02-13 23:59:59.5"]
ISO = [*BEFORE_MIDNIGHT, "2015-02-14 00:00:00", "2015-02-14 00:00:00.5"]
SQUARE = ("%", "°C")
ALIKE = {"time": "time", "u": "u", "T": "T"}


def made(header, mark=",", decimal=".", *, times=TIMES, temperatures=T, end="\n", after=""):
    """The log as a text."""
    rows = zip(times, U, temperatures, strict=True)
    lines = [mark.join(row).replace(".", decimal) + after for row in rows]
    return end.join([*([header] if header else []), *lines, ""])


def beside(header, first, log=None):
    """The log as a text with one column more in front."""
    lines = (log or made("")).split()
    return "\n".join([header, *(f"{x},{line}" for x, line in zip(first, lines, strict=True)), ""])


def dated(form):
    """The times as dates in a form of strftime, with tenths of a second."""
    moments = [datetime.fromisoformat(text) for text in ISO]
    return [m.strftime(form).replace("%1f", str(m.microsecond // 100_000)) for m in moments]


def workbook():
    """The log as a workbook with a title, dates, and a line of units."""
    book = openpyxl.Workbook()
    rows = zip(map(datetime.fromisoformat, ISO), map(float, U), T, strict=True)
    cells = [(time, u, float(x) if x else None) for time, u, x in rows]
    for row in [("Test bench 3",), ("when", "u", "T"), ("", "%", "°C"), *cells]:
        book.active.append(row)
    content = BytesIO()
    book.save(content)
    return content.getvalue()


def case(text, columns=ALIKE, units=("", ""), options=(), of_time=(), refused=None):
    """A file, its columns and their units, options of both commands, of ``identify``, an error."""
    return text, {**ALIKE, **columns}, units, [*options], [*of_time], refused


READ = {
    "plain": case(made("time,u,T")),
    "square brackets": case(made("time [s],u [%],T [°C]"), units=SQUARE),
    "round brackets": case(made("Time (s),u (%),T (°C)"), {"time": "Time"}, SQUARE),
    "names with blanks": case(
        made("Time (sec),Servo 3 (µs),Motor Speed (RPM)"),
        {"time": "Time", "u": "Servo 3", "T": "Motor_Speed"},
        ("µs", "RPM"),
    ),
    "brackets that names need": case(
        made("time,Temp (inner),Temp (outer)"), {"u": "Temp (inner)", "T": "Temp (outer)"}
    ),
    "a line of units in brackets": case(
        made("time;u;T\n[s];[ticks];(gizmos)", ";"), units=("ticks", "gizmos")
    ),
    "a German spreadsheet": case(made("time [s];u [%];T [°C]", ";", ","), units=SQUARE),
    "the same in Windows-1252": case(
        made("time [s];u [%];T [°C]", ";", ",").encode("cp1252"), units=SQUARE
    ),
    "French thousands": case(made("time;u;T", ";", ",").replace("1021", "1\u202f021")),
    "English thousands": case(made("time,u,T").replace("1021.25", '"1,021.25"')),
    "decimal commas between quotes": case(
        made("time,u,T", '","', ",", after='"').replace("\n", '\n"').removesuffix('"')
    ),
    "tabs and decimal commas": case(made("time\tu\tT", "\t", ",")),
    "a spreadsheet's Unicode text": case(
        made("time\tu [%]\tT [°C]", "\t").encode("utf-16"), units=SQUARE
    ),
    "blanks after commas": case(made("time, u, T", ", ")),
    "columns of blanks": case(made("time   u  T", "   ", temperatures=[x or "nan" for x in T])),
    "bars": case(made("time|u|T", "|")),
    "a mark in front, ends of lines of Windows": case(made('\ufeff"time","u","T"', end="\r\n")),
    "commas at the ends of lines": case(made("time,u,T", after=",")),
    "the line of Excel": case("sep=;\n" + made("time;u;T", ";")),
    "a head of other lines": case("Logger 7\nOperator,Müller\nRate,2 Hz\n\n" + made("time,u,T")),
    "NumPy's comment": case(made("# time,u,T")),
    "comments": case("% made by a rig\n% on Monday, again\n" + made("time,u,T")),
    "R's numbers of rows": case(beside('"time","u","T"', ['"1"', '"2"', '"3"', '"4"'])),
    "the index of pandas": case(beside(",time,u,T", "0123")),
    "names of other rows": case(beside("note,time,u,T", ["ok", "ok", "late", "ok"])),
    "no names": case(made(""), options=["--names", "time,u,T"]),
    "names in place of others": case(made("Zeit,Stellgrad,Temp"), options=["--names", "time,u,T"]),
    "words for what is missing": case(made("time,u,T", temperatures=[x or "N/A" for x in T])),
    "German dates": case(
        made("Datum;u;T", ";", times=dated("%d.%m.%Y %H:%M:%S,%%1f")), {"time": "Datum"}
    ),
    "a workbook": case(workbook(), {"time": "when"}, SQUARE),
    "seconds since another time": case(
        made("t [ms],u,T", times=["7000", "7500", "8000", "8500"]), {"time": "t", "offset": 7}
    ),
}
TIMED = {  # names and texts of times, a unit to read them in
    "ISO dates": ("date", ISO, ""),
    "ISO dates in a zone": ("date", [t.replace(" ", "T") + "+01:00" for t in ISO], ""),
    "American dates": ("date", dated("%m/%d/%Y %I:%M:%S.%%1f %p"), ""),
    "times of day": ("clock", ["14:19:59", "14:19:59.5", "14:20:00", "14:20:00.5"], ""),
    "microseconds": ("t (µs)", ["0", "5e5", "1e6", "15e5"], ""),
    "milliseconds in a name": ("time_ms", ["0", "500", "1000", "1500"], ""),
    "milliseconds as a name": ("millis", ["0", "500", "1000", "1500"], ""),
    "minutes": ("t [min]", TIMES, "min"),
    "minutes in hours": ("t [min]", ["0", "30", "60", "90"], "h"),
    "dates in days": (
        "t",
        ["2015-02-13", "2015-02-13 12:00", "2015-02-14", "2015-02-14 12:00"],
        "d",
    ),
}
READ |= {
    name: case(
        made(f"{head},u,T", times=times),
        {"time": head.split()[0]},
        of_time=["--time-unit", unit] if unit else [],
    )
    for name, (head, times, unit) in TIMED.items()
}
REFUSED = {
    "thousands, or decimals": case(
        made("time,u,T", temperatures=["20", "21", "", '"1,021"']),
        refused="found '1,021'.*comma, use --decimal ','; if it separates thousands, --dec",
    ),
    "decimal commas between commas": case(
        "time,u,T\n0,0,50,0,20,5\n0,5,20,0,20,75\n", refused="found 6.*Save it with semicolons"
    ),
    "no names": case(made(""), refused="line 1: expected a line of names.* by --names 'a,b'"),
    "dates of two readings": case(
        made("date,u,T", times=["2/3/2015", "3/3/2015", "4/3/2015", "5/3/2015"]),
        {"time": "date"},
        refused="'2/3/2015', whose day and month may be swapped; write dates as 2015-02-28",
    ),
    "hours and minutes, or minutes": case(
        made("clock,u,T", times=["14:19", "14:20", "14:21", "14:22"]),
        {"time": "clock"},
        refused="found '14:19'",
    ),
    "a date that is none": case(
        made("date,u,T", times=[*ISO[:3], "yesterday"]), {"time": "date"}, refused="'yesterday'"
    ),
    "binary": case(b"\x89HDF\r\n\x1a\n\0\0\0\0\0", refused="expected a CSV file in UTF-8"),
}
OF_A_LOG = {
    "minutes, or seconds": case(
        made("t [min],u,T"),
        {"time": "t"},
        refused="rates are per min, --time-unit 'min'; if per s, --time-unit 's', which converts",
    ),
    "a unit of no time": case(
        made("t [ticks],u,T"), {"time": "t"}, refused="in seconds, found 'ticks'; .*--time-unit 's'"
    ),
}


def by_report(path, columns, options):
    """Read inputs and the output as ``gpadjust report``: numbers, and names with units."""
    given = ["--outputs", "T", "--physics", "u", *options]
    arguments = parser().parse_args(["report", str(path), *given])
    inputs = {name: columns[name] for name in ("time", "u")}
    table = read.open_table(str(path), arguments)
    data = read.read_table(table, inputs, {"T": columns["T"]}, [], arguments)
    return data.X.values.unbind(-1), data.Y.values.flatten(), (*data.X.columns, *data.Y.columns)


def by_identify(path, columns, options):
    """Read a log as ``gpadjust identify``: times, actions, states and units."""
    states, actions = f'"T={columns["T"]}"', f'"u={columns["u"]}"'
    given = ["--states", states, "--actions", actions, "--time", columns["time"], *options]
    arguments = parser().parse_args(["identify", str(path), *given, "--physics", "T=T"])
    table = read.open_table(str(path), arguments)
    options, units = read.log_columns(table, {}, arguments)
    (record,) = Records.read_csv([table], StateSpec(["T"], ["u"]), **options)
    return record.times, record.actions[:, 0], record.states[:, 0], units


def same(values, expected):
    expected = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-9, equal_nan=True)


@pytest.fixture
def written(tmp_path):
    """Writes a text, in UTF-8, or bytes."""

    def written(text):
        kind = "xlsx" if text[:2] == b"PK" else "csv"
        path = tmp_path / f"log.{kind}"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return written


@pytest.mark.parametrize("name", READ)
def test_a_dialect_is_read_alike(written, name):
    text, columns, units, options, of_time, _ = READ[name]
    path, offset = written(text), columns.get("offset", 0)
    times, u, T, found = by_identify(path, columns, [*options, *of_time])
    same(times - offset, EXPECTED[0])
    same(u, EXPECTED[1])
    same(T, EXPECTED[2])
    assert tuple(found.get(each, "") for each in ("u", "T")) == units
    assert found["time"] == (of_time[-1] if of_time else "s")
    (_, u), T, names = by_report(path, columns, options)
    same(u, [EXPECTED[1][i] for i in (0, 1, 3)])  # without the row that has no output
    same(T, [EXPECTED[2][i] for i in (0, 1, 3)])
    assert names[1:] == tuple(
        f"{each} [{unit}]" if unit else each for each, unit in zip(("u", "T"), units, strict=True)
    )


@pytest.mark.parametrize("name", [*REFUSED, *OF_A_LOG])
def test_a_dialect_is_refused_with_the_way_out(written, name):
    text, columns, _, options, _, refused = {**REFUSED, **OF_A_LOG}[name]
    readers = (by_identify,) if name in OF_A_LOG else (by_identify, by_report)
    path = written(text)
    for reader in readers:
        with pytest.raises(ValueError, match=f"(?s){refused}"):
            reader(path, columns, options)


def test_dates_are_inputs_in_a_unit_of_choice(written):
    path = written(made("date,u,T", times=ISO))
    for unit, size in (("s", 1.0), ("min", 60.0)):
        options = [] if unit == "s" else ["--units", f"time={unit}"]
        (times, _), _, names = by_report(path, {**ALIKE, "time": "date"}, options)
        same(times * size, [0, 0.5, 1.5])
        assert names[0] == f"time [{unit}]"


TEXTS = st.sampled_from(["alpha", "b c", "Rig 2", "x,y"])
NUMBERS = st.one_of(
    st.integers(-(10**9), 10**9), st.floats(-1e9, 1e9).map(lambda x: round(x, 3)), st.none()
)


@given(
    columns=st.lists(st.one_of(*(st.lists(x, min_size=4, max_size=4) for x in (TEXTS, NUMBERS)))),
    form=st.sampled_from(["{}", "{} [m]", "{} (rpm)"]),
    mark=st.sampled_from([";", "\t", "|", ","]),
    decimal=st.sampled_from([".", ","]),
    title=st.sampled_from(["", "Logger 7\n\n"]),
)
def test_numbers_are_right_or_refused(tmp_path_factory, columns, form, mark, decimal, title):
    """Beside texts, and gaps; the first column has times, so that no row is empty."""
    columns = [[0.5, 1.5, 2.5, 3.75], *columns]
    buffer = StringIO()
    writer = csv.writer(buffer, delimiter=mark)
    writer.writerow([form.format(f"c{i}") for i in range(len(columns))])
    for row in zip(*columns, strict=True):
        texts = ["" if x is None else str(x) for x in row]
        writer.writerow(
            [
                t if isinstance(x, str) else t.replace(".", decimal)
                for x, t in zip(row, texts, strict=True)
            ]
        )
    path = tmp_path_factory.getbasetemp() / "random.csv"
    path.write_text(title + buffer.getvalue(), encoding="utf-8")
    for i, column in enumerate(columns):
        if any(isinstance(x, str) for x in column):
            continue
        try:
            found = Table(path).numbers(f"c{i}", may_miss=True)
        except ValueError as error:
            assert "decimal" in str(error) or len(columns) == 1  # noqa: PT017
        else:
            same(found, [math.nan if x is None else x for x in column])


@given(st.text(alphabet=" \t\n\r,;|\"'#.:/-+_[]()019aAeEnNmM\u00a0\u2212\ufeff\0", max_size=60))
def test_any_text_is_a_table_or_an_error_of_ours(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(text.encode())
    try:
        table = Table(path)
        for name in {*table.names}:
            table.times(name, "s")
    except ValueError as error:
        assert "any.csv" in str(error)  # noqa: PT017
