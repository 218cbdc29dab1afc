"""Run one of the paper's experiments."""

from __future__ import annotations

import argparse

from paper import active, arm, cartpole, exploration, forrester, multifidelity
from paper.report import report


def main() -> None:
    """Parse the command line and run the experiment that it names."""
    parser = argparse.ArgumentParser(prog="python -m paper", description=__doc__)
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="experiment")
    forrester.add_arguments(
        experiments.add_parser("forrester", help="eight models of Forrester's function (figure 1)")
    )
    multifidelity.add_arguments(
        experiments.add_parser(
            "multifidelity", help="eight methods on functions of low and high fidelity"
        )
    )
    cartpole.add_arguments(
        experiments.add_parser("cartpole", help="learners that swing up a cart-pole")
    )
    arm.add_arguments(experiments.add_parser("arm", help="learners that reach with a muscle arm"))
    active.add_arguments(
        experiments.add_parser("active", help="error over measurements, by who chooses them")
    )
    exploration.add_arguments(
        experiments.add_parser(
            "exploration", help="cart-poles whose real trials are random, SAC's or informative"
        )
    )
    experiments.add_parser(
        "report", help="copy the results that are committed into the READMEs"
    ).set_defaults(run=lambda arguments: report())
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except KeyboardInterrupt:
        raise SystemExit(
            "\nInterrupted. The same command goes on where this one stopped."
        ) from None


if __name__ == "__main__":
    main()
