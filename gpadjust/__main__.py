"""The command line: ``gpadjust report data.csv ...``, or ``python -m gpadjust``."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from typing import Any

_ABOUT = """\
One page that shows whether a crude physics model helps to predict your measurements, where it is
wrong, how well left-out measurements are predicted, and which model to take, which is saved beside
it. You need a table, whose first line names its columns, and the physics: a formula of these
columns, or a Python function.
"""
_EXAMPLE = """\
example: beam.csv has the columns "force [N]", "length [m]", "thickness [m]" and "deflection [m]"

    gpadjust report beam.csv --outputs deflection --unknown "E [GPa] = 210 +- 20 %" \\
        --physics "4000 * force * length**3 / (E * 0.03 * thickness**3)"

writes report.html and report.pt. Where an output was not measured its field is empty. A function is
given as module:function, and its inputs are named in the order of its columns: of pump.py with

    def head(X):  # a row for each measurement, its columns in the order of --inputs
        flow, speed = X[:, 0], X[:, 1]
        return 30 * (speed / 1450) ** 2 - 0.02 * flow**2

of NumPy arrays or torch tensors, in its folder,

    gpadjust report pump.csv --inputs flow,speed --outputs head --physics pump:head
"""
_ABOUT_LOGS = """\
One page about a machine by its log: parameters of its equations with intervals, noise of the
sensors, hidden states, and how well the equations follow the last part of the log, which is held
out. You need a CSV file, whose first line names its columns, and equations, one for each state.
"""
_EXAMPLE_OF_LOGS = """\
example: swing.csv has the columns "time [s]", "angle [rad]" and "torque [N m]", and no rate

    gpadjust identify swing.csv --states angle,rate --hidden "rate [rad/s] = 0 +- 3" \\
        --actions torque --step 0.05 --physics "angle' = rate" \\
        --physics "rate' = -9.81/l*sin(angle) - c*rate + torque/J" \\
        --unknown "l [m] = 0.5 */ 1.5" --unknown "c [1/s] = 0.1 */ 2" --unknown "J = 0.3 */ 1.5"

writes identify.html. Of a Python module, --physics module:name is a physics of the library, or a
function of rows of states and actions to the next states.
"""
_SEEDS = 2**32


def parser() -> ArgumentParser:
    """The options, and what they say of themselves."""
    main_parser = ArgumentParser(prog="gpadjust", description="Adjust physics to data.")
    commands = main_parser.add_subparsers(dest="command", required=True)
    report = commands.add_parser(
        "report",
        help="a page about a table and a physics",
        description=_ABOUT,
        epilog=_EXAMPLE,
        formatter_class=RawDescriptionHelpFormatter,
    )
    add = report.add_argument
    add("data", help="the table: a CSV file in UTF-8, or *.xlsx (the extra excel)")
    add(
        "--inputs",
        metavar="a,b",
        help="the columns that the physics reads; by default those that its formula names",
    )
    add("--outputs", required=True, metavar="y", help="the columns that it predicts")
    add(
        "--physics",
        required=True,
        action="append",
        metavar="formula",
        help="the physics: a formula of the columns' names, with + - * / ** and functions such as "
        "sqrt, of several outputs with commas between them; or module:function. Several: give it "
        "again",
    )
    add("--unknown", **_unknown("formula"))
    add(
        "--out",
        default="report.html",
        metavar="page.html",
        help="the page to write (%(default)s); the model beside it, page.pt. Both replace what has "
        "these names",
    )
    add("--units", metavar="a=m,y=Pa", help='units, of columns that do not say them, as "a [m]"')
    add(
        "--noise",
        metavar="0.1",
        help="known standard deviation of the outputs; or y=0.1,z=2; or relative, which grows with "
        "the physics and is learnt",
    )
    add("--outliers", action="store_true", help="some measurements may be far off")
    add("--input-noise", metavar="a=0.5", help="standard deviations of inputs that are noisy, too")
    ends = report.add_mutually_exclusive_group()
    ends.add_argument("--positive", action="store_true", help="the outputs cannot be negative")
    ends.add_argument("--bounds", metavar="0,1", help="the outputs are between these numbers")
    add("--categories", metavar="a,b", help="inputs that are names, not sizes: numbers or text")
    add("--batches", metavar="rig", help="categories that each shift the outputs by an offset")
    add(
        "--fit",
        choices=("compare", "bayes", "map"),
        default="compare",
        help="compare structures, which tells whether the physics helps (the default); or one CKA "
        "alone, by full Bayes or at the likeliest hyper-parameters, which is quicker",
    )
    add("--seed", type=_seed, default=0, metavar="0", help="of the fits (%(default)s)")
    add(
        "--rows",
        type=_positive,
        default=500,
        metavar="500",
        help="the most rows that are taken; of more, so many are drawn at random (%(default)s)",
    )
    add("--sheet", metavar="name", help="the sheet of a workbook that has several")
    add(
        "--delimiter", default=",", metavar="mark", help='between two fields (","); ";" or tab, say'
    )
    add("--decimal", default=".", choices=(".", ","), metavar="mark", help='the decimal mark (".")')
    add("--title", metavar="text", help="the title of the page")
    _add_identify(commands.add_parser)
    return main_parser


def _add_identify(add_parser: Callable[..., ArgumentParser]) -> None:
    """The options of ``gpadjust identify``."""
    log = add_parser(
        "identify",
        help="a page about a machine by its log, and equations",
        description=_ABOUT_LOGS,
        epilog=_EXAMPLE_OF_LOGS,
        formatter_class=RawDescriptionHelpFormatter,
    )
    add = log.add_argument
    add("data", nargs="+", help="the log: CSV files in UTF-8, a record each")
    add(
        "--time",
        default="time",
        metavar="t",
        help="the column of times (%(default)s), or a number: the time from row to row",
    )
    add(
        "--states",
        required=True,
        metavar="a,b",
        help="the states, columns of the log; or a=q, where a's column is q",
    )
    add(
        "--hidden",
        action="append",
        default=[],
        metavar="b=0+-2",
        help="a state that was not measured, with mean and standard deviation at the beginning. "
        "Several: give it again",
    )
    add("--actions", metavar="u", help="what acts on the machine; without it, the time")
    add("--angles", metavar="a", help="states in rad that jump where they have gone round")
    add(
        "--physics",
        required=True,
        action="append",
        metavar="equation",
        help="an equation for each state: \"a'=...\", its time derivative, or 'a=...', its next "
        "value; or module:name",
    )
    add("--unknown", **_unknown("equations"))
    add(
        "--step",
        type=float,
        metavar="0.05",
        help="the step of the free run, a multiple of the sampling step, which it is by default; a "
        "longer one is quicker, and averages the actions over it",
    )
    add("--segment", metavar="run", help="a column of labels: where they change, a new run begins")
    add(
        "--held-out",
        type=float,
        default=0.25,
        metavar="0.25",
        help="the share of the log that is held out at its end (%(default)s)",
    )
    add("--starts", type=_positive, metavar="4", help="searches to take the best of")
    add("--out", default="identify.html", metavar="page.html", help="the page (%(default)s)")
    add("--seed", type=_seed, default=0, metavar="0", help="of the free runs (%(default)s)")
    add("--delimiter", default=",", metavar="mark", help='between two fields (",")')
    add("--decimal", default=".", choices=(".", ","), metavar="mark", help='the decimal mark (".")')
    add("--title", metavar="text", help="the title of the page")


def main(command: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit status: 0, or 1 with a message, or 130 if interrupted."""
    command = sys.argv[1:] if command is None else [*command]
    arguments = parser().parse_args(command)
    try:
        # Not earlier: --help and what is wrong with options need no torch.
        from gpadjust.report.command import run

        run(arguments, command)
    except (ValueError, OSError, ImportError) as error:
        return _fail(str(error))
    except SystemExit as error:  # of the user's code
        return _fail(
            f"the physics ended Python by sys.exit({error.code!r}), expected values, or an error "
            "that is raised; nothing was written."
        )
    except KeyboardInterrupt:
        return _fail("interrupted; nothing was written.", 130)
    return 0


def _seed(text: str) -> int:
    """A seed that all generators take."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if not 0 <= seed < _SEEDS:
        raise ArgumentTypeError(f"expected a whole number from 0 to {_SEEDS - 1}, found {text!r}")
    return seed


def _unknown(where: str) -> dict[str, Any]:
    """The option of unknown numbers."""
    text = (
        f"an unknown number of the {where}, its guess and standard deviation, which may be a "
        "percentage; or a factor, E=2*/1.5; or bounds, E=1..3. Several: give it again"
    )
    return {"action": "append", "default": [], "metavar": "E=2+-0.4", "help": text}


def _positive(text: str) -> int:
    """A number of 1 or more."""
    if not text.isdecimal() or not int(text):
        raise ArgumentTypeError(f"expected a whole number from 1 on, found {text!r}")
    return int(text)


def _fail(message: str, status: int = 1) -> int:
    print(f"gpadjust: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
