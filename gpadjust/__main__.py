"""The command line: ``gpadjust report data.csv ...``, or ``python -m gpadjust``."""

from __future__ import annotations

import re
import sys
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Sequence
from functools import partial
from typing import Any

_ABOUT = """\
Write a page that shows whether a crude physics model helps to predict your measurements, where it
is wrong, how well left-out measurements are predicted, and which model to take; the model is saved
beside it. You need a table with names of its columns, and the physics: a formula of these columns,
or a Python function.
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
Write a page about a machine by its log: parameters of its equations with intervals, noise of the
sensors, hidden states, and how well the equations follow the last part of the log, which is held
out. You need a CSV file with names of its columns, and equations, one for each state.
"""
_EXAMPLE_OF_LOGS = """\
example: swing.csv has the columns "time [s]", "angle [rad]" and "torque [N m]", and no rate

    gpadjust identify swing.csv --states angle,rate --hidden "rate [rad/s] = 0 +- 3" \\
        --actions torque --step 0.05 --physics "angle' = rate" \\
        --physics "rate' = -9.81/l*sin(angle) - c*rate + torque/J" \\
        --unknown "l [m] = 0.5 */ 1.5" --unknown "c [1/s] = 0.1 */ 2" --unknown "J = 0.3 */ 1.5"

writes identify.html. Of a Python module, --physics module:name is a physics of the library, or a
function of rows of states and actions to the next states. In Python alone, as options of
gpadjust.records.identify: sensors with unknown gains, offsets and delays, and a fit to free runs
(by_free_runs=True). The page ends with the program to add them to.
"""
# An option a paragraph: its name, what the help calls its value, and what it is.
_OPTIONS = """\
data: the table: a CSV file, or *.xlsx (the extra excel)
--inputs a,b: the columns that the physics reads, and others that matter; by default those that its
    formula names; "d=wire d" calls a column d
--outputs y: the columns to predict; "y=Force 1" calls a column y
--physics formula: the physics: a formula of the columns' names, with + - * / ** or ^ and functions
    such as sqrt, or a spreadsheet's, of several outputs with commas between them; or
    module:function. Several: give it again
--units a=m,y=Pa: units of columns, as in "a [m]"; they replace those of the file, and convert
    nothing
--noise 0.1: known standard deviation of the outputs; or y=0.1,z=2; or fitted: constant, or
    relative, which grows with the physics. By default the kind that left-out observations prefer
--outliers: some measurements may be far off
--input-noise a=0.5: standard deviations of noisy inputs
--positive: the outputs cannot be negative
--bounds 0,1: the outputs are between these numbers
--categories a,b: inputs that are names, not sizes: numbers or text
--batches rig: categories that each shift the outputs by an offset
--fit: compare structures, which shows whether the physics helps (the default); or one CKA alone, by
    full Bayes or at the likeliest hyper-parameters, which is quicker
--rows 500: maximum number of rows; of more, this many are drawn at random (%(default)s)
"""
_OPTIONS_OF_LOGS = """\
data: the log: CSV files or *.xlsx, a record each
--time t: the column of times or dates (%(default)s, or the only column of dates), or a number: the
    time from row to row
--time-unit h: the unit of rates, steps and times, to which the column is converted: s, ms, us, min,
    h or d; seconds by default
--states a,b: the states, columns of the log; or a=q, where a's column is q
--hidden b=0+-2: a state that was not measured, with mean and standard deviation at the beginning.
    Several: give it again
--actions u: inputs that act on the machine; by default the time
--angles a: angles in rad that jump after a full turn
--physics equation: an equation for each state: "a'=...", its time derivative, or 'a=...', its next
    value; or module:name
--step 0.05: the step of the free run, a multiple of the sampling step, which it is by default; a
    longer one takes the measurements at its ends alone; equations follow the actions in between
--segment run: a column of labels: where they change, a new run begins
--held-out 0.25: the share of the log that is held out at its end (%(default)s)
--starts 4: number of searches, of which the best is taken
"""
_OPTIONS_OF_BOTH = """\
--unknown E=2+-0.4: an unknown number of the physics, its guess and standard deviation, which may be
    a percentage; or a factor, E=2*/1.5; or bounds, E=1..3; or of a function of v, from 0 to 9,
    "F(v: 0..9)=2*/1.5". Several: give it again
--out page.html: the page to write (%(default)s), and for a table its model, page.pt; earlier files
    of these names are replaced
--seed 0: seed of the fits and free runs (%(default)s)
--names a,b: names of all columns, for a file without names or in place of them
--delimiter mark: between two fields, such as ";" or tab; inferred by default
--decimal mark: the decimal mark, "." or ","; inferred by default
--sheet name: the sheet of a workbook that has several
--title text: the title of the page
"""
_SEEDS = 2**32
_ABOUT_COMMANDS = {
    "report": ("a page about a table and a physics", _ABOUT, _EXAMPLE),
    "identify": ("a page about a machine by its log, and equations", _ABOUT_LOGS, _EXAMPLE_OF_LOGS),
}


def parser() -> ArgumentParser:
    """Return the parser of both commands, with their help."""
    kinds: dict[str, dict[str, Any]] = {
        **{name: {"required": True} for name in ("--outputs", "--states")},
        **{name: {"action": "store_true"} for name in ("--outliers", "--positive")},
        **{name: {"action": "append", "default": []} for name in ("--unknown", "--hidden")},
        "--physics": {"action": "append", "required": True},
        "--fit": {"choices": ("compare", "bayes", "map"), "default": "compare"},
        "--seed": {"type": partial(_whole, least=0), "default": 0},
        "--rows": {"type": partial(_whole, least=1), "default": 500},
        "--starts": {"type": partial(_whole, least=1)},
        "--time": {"default": "time"},
        "--step": {"type": float},
        "--held-out": {"type": float, "default": 0.25},
        "--time-unit": {"choices": ("s", "ms", "us", "min", "h", "d")},
        "--decimal": {"choices": (".", ",")},
    }
    main_parser = ArgumentParser(prog="gpadjust", description="Adjust physics to data.")
    commands = main_parser.add_subparsers(dest="command", required=True)
    for command, (summary, about, example) in _ABOUT_COMMANDS.items():
        texts: dict[str, Any] = {"help": summary, "description": about, "epilog": example}
        add_to = commands.add_parser(command, **texts, formatter_class=RawDescriptionHelpFormatter)
        is_log = command == "identify"
        ends = add_to if is_log else add_to.add_mutually_exclusive_group()
        kinds |= {"--out": {"default": f"{command}.html"}, "data": {"nargs": "+" if is_log else 1}}
        options = (_OPTIONS_OF_LOGS if is_log else _OPTIONS) + _OPTIONS_OF_BOTH
        for paragraph in re.split(r"\n(?! )", options.strip()):
            option, _, text = paragraph.partition(": ")
            name, _, value = option.partition(" ")
            kind = {"help": " ".join(text.split()), **kinds.get(name, {})}
            kind |= {"metavar": value} if value else {}
            (ends if name in ("--positive", "--bounds") else add_to).add_argument(name, **kind)
    return main_parser


def main(command: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit status: 0, or 1 with a message, or 130 if interrupted."""
    command = sys.argv[1:] if command is None else [*command]
    words: list[str] = []
    for word in command:  # a formula may begin with a minus, which is no option
        if words[-1:] == ["--physics"] and re.match(r"-[^-]", word):
            words[-1] = f"--physics={word}"
        else:
            words.append(word)
    arguments = parser().parse_args(words)
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


def _whole(text: str, least: int) -> int:
    """Return a whole number that a seed may be."""
    number = int(text) if text.isdecimal() else -1
    if not least <= number < _SEEDS:
        raise ArgumentTypeError(
            f"expected a whole number from {least} to {_SEEDS - 1}, found {text!r}"
        )
    return number


def _fail(message: str, status: int = 1) -> int:
    print(f"gpadjust: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
