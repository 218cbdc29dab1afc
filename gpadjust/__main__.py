"""The command line: ``gpadjust report data.csv ...``, or ``python -m gpadjust``."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Sequence

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
    add(
        "--unknown",
        action="append",
        default=[],
        metavar="E=2+-0.4",
        help="an unknown number of the formula, its guess and standard deviation, which may be a "
        "percentage; or a factor, E=2*/1.5; or bounds, E=1..3. Several: give it again",
    )
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
        default=1000,
        metavar="1000",
        help="the most rows that are taken; of more, so many are drawn at random (%(default)s)",
    )
    add("--sheet", metavar="name", help="the sheet of a workbook that has several")
    add(
        "--delimiter", default=",", metavar="mark", help='between two fields (","); ";" or tab, say'
    )
    add("--decimal", default=".", choices=(".", ","), metavar="mark", help='the decimal mark (".")')
    add("--title", metavar="text", help="the title of the page")
    return main_parser


def main(command: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit status: 0, or 1 with a message, or 130 if interrupted."""
    command = sys.argv[1:] if command is None else [*command]
    arguments = parser().parse_args(command)
    try:
        # Not earlier: --help and what is wrong with options need no torch.
        from gpadjust.physics import PhysicsError
        from gpadjust.report.command import run
    except ImportError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        return _fail("interrupted; nothing was written.", 130)
    try:
        run(arguments, command)
    except (ValueError, OSError, ImportError, PhysicsError) as error:
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


def _positive(text: str) -> int:
    """A number of rows."""
    if not text.isdecimal() or not int(text):
        raise ArgumentTypeError(f"expected a number of rows from 1 on, found {text!r}")
    return int(text)


def _fail(message: str, status: int = 1) -> int:
    print(f"gpadjust: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
