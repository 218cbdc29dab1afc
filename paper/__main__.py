"""Run one of the paper's experiments, or one of ours; `python -m paper report` fills the pages.

Each says its options: `python -m paper forrester --help`.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

EXPERIMENTS = {
    "forrester": ("forrester:Forrester", "eight models of Forrester's function (figure 1)"),
    "multifidelity": ("pairs:Multifidelity", "eight methods on functions of low and high fidelity"),
    "calibration": (
        "calibration:Calibration",
        "do intervals hold? CKA by each method of inference",
    ),
    "structures": (
        "structures:Structures",
        "does the richer model pay? CKA beside what it contains",
    ),
    "active": ("measuring:Active", "error over measurements, by who chooses them"),
    "cartpole": ("cartpole:CartPole", "learners that swing up a cart-pole"),
    "arm": ("arm:Arm", "learners that reach with a muscle arm"),
    "foresight": ("foresight:Foresight", "do dynamics foresee the next trial, and know how well?"),
    "planning": ("planning:Planning", "cart-poles that are swung up by planning in several models"),
    "reaching": (
        "reaching:Reaching",
        "muscle arms that reach after a few trials, by several models",
    ),
    "parameters": (
        "parameters:Parameters",
        "intervals of a physics' parameters, by several discrepancies",
    ),
    "real": ("real:Real", "learners of real machines, by free runs beside what was measured"),
    "elsewhere": ("elsewhere:Elsewhere", "free runs on other torques, loads, days and machines"),
    "tanks": ("tanks:Tanks", "cascaded tanks: structures of f_p and GPs, by a free run"),
    "large": ("pairs:Large", "100,000 observations: inducing points, or an exact model of some"),
    "optimisation": (
        "measuring:Optimisation",
        "trials of Bayesian optimisation in Ax, with and without f_p",
    ),
    "misled": ("measuring:Misled", "Bayesian optimisation with a physics that misleads, or helps"),
    "choice": ("structures:Choice", "a physics of no use, and what compare recommends"),
    "kinks": (
        "kinks:Kinks",
        "next states of systems with dry friction, impacts, gaps and switches",
    ),
    "ridges": (
        "parameters:Ridges",
        "intervals of parameters on a ridge, or of which several values do",
    ),
    "polynomials": (
        "pairs:Polynomials",
        "CKA, AR1 and MFK on functions that are nearly polynomials",
    ),
    "seeds": ("calibration:Seeds", "fits of the same data by several seeds, beside long sampling"),
    "floor": ("floor:Floor", "what the control tasks cost at best"),
}
"""By name, its class (with the chapter that declares it) and what it is about."""
_OTHER = {
    "all": "run what is missing of every experiment, with --out paper/results/NAME, then report",
    "report": "copy the results that are committed into the pages",
}


def main() -> None:
    """Run what the command line names; nothing that it does not need is imported."""
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in EXPERIMENTS:
        _run(name, arguments)
    elif name == "all":  # options are those that all experiments have
        for each in EXPERIMENTS:
            print(f"\n{each}: {EXPERIMENTS[each][1]}")
            _run(each, ["--out", f"{Path(__file__).parent}/results/{each}", *arguments])
        import_module("paper.report").report()
    elif name == "report" and not arguments:
        import_module("paper.report").report()
    else:
        lines = [f"  {known:<15}{what}" for known, (_, what) in EXPERIMENTS.items()]
        lines += [f"  {known:<15}{what}" for known, what in _OTHER.items()]
        usage = f"usage: python -m paper experiment [options]\n\n{__doc__}\n" + "\n".join(lines)
        if {"-h", "--help"} & {name, *arguments}:
            print(usage)
            raise SystemExit(0)
        raise SystemExit(f"{usage}\n\nThere is no experiment {name!r}.")


def _run(name: str, arguments: list[str]) -> None:
    import tyro

    kind = resolve_name(f"paper.{EXPERIMENTS[name][0]}")
    config = [tyro.conf.FlagCreatePairsOff, *([tyro.conf.OmitArgPrefixes] if kind.flat else [])]
    experiment = tyro.cli(kind, prog=f"python -m paper {name}", args=arguments, config=config)
    runner = import_module("paper.common.runner")
    # joblib's word on an interruption, of which the user knows.
    warnings.filterwarnings("ignore", ".*still being processed by the workers.*")
    try:
        runner.main(experiment)
    except runner.Refused as error:
        raise SystemExit(str(error)) from error
    except KeyboardInterrupt:
        raise SystemExit(
            "\nInterrupted. The same command goes on where this one stopped."
        ) from None


if __name__ == "__main__":
    main()
