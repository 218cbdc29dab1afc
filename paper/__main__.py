"""Run one of the paper's experiments."""

from __future__ import annotations

import argparse

from paper import forrester


def main() -> None:
    """Parse the command line and run the experiment that it names."""
    parser = argparse.ArgumentParser(prog="python -m paper", description=__doc__)
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="experiment")
    forrester.add_arguments(
        experiments.add_parser("forrester", help="seven models of Forrester's function (figure 1)")
    )
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
