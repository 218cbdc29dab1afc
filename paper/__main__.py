"""Run one of the paper's experiments, or one of ours; `python -m paper report` fills the pages.

Each says its options: `python -m paper forrester --help`.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

CHAPTERS = {
    "forrester": ("Forrester",),
    "structures": ("Structures",),
    "parameters": ("Parameters", "Nuts"),
    "measuring": ("Active", "Misled"),
    "cartpole": ("CartPole", "Planning"),
    "arm": ("Arm", "Reaching"),
    "laboratory": (
        *("Balldrop", "Categories", "Drift", "Emulated", "Links"),
        *("Noisyinputs", "Outliers", "Relative", "Vanishing"),
    ),
    "control": ("Known", "First"),
    "published": ("Masses", "Uci", "Emps", "Freeruns", "Formula", "Nist"),
    "machines": ("Real", "Tanks"),
    "simulators": ("Simulators",),
}
"""Folders, and the classes of the experiments that they declare."""
EXPERIMENTS = {
    kind.lower(): f"paper.{chapter}:{kind}" for chapter, kinds in CHAPTERS.items() for kind in kinds
}
"""Classes of the experiments, by their names."""
_OTHER = {
    "all": "run what is missing of every experiment, with --out paper/results/NAME, then report",
    "report": "copy the results that are committed into the pages",
}


def main() -> None:
    """Run what the command line names; nothing that it does not need is imported."""
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in EXPERIMENTS:
        _run(name, arguments)
    elif name == "all" and {*arguments} <= {"--only-tables"}:
        refused = []
        for each in EXPERIMENTS:
            print(f"\n{each}: {_about(each)}")
            try:
                _run(each, ["--out", f"{Path(__file__).parent}/results/{each}", *arguments])
            except SystemExit as error:
                refused.append(f"{each}: {error}")
        import_module("paper.report").report()
        if refused:
            raise SystemExit("\nNothing was run of these:\n" + "\n".join(refused))
    elif name == "report" and not arguments:
        import_module("paper.report").report()
    else:
        lines = [f"  {known:<15}{_about(known)}" for known in EXPERIMENTS]
        lines += [f"  {known:<15}{what}" for known, what in _OTHER.items()]
        usage = f"usage: python -m paper experiment [options]\n\n{__doc__}\n" + "\n".join(lines)
        if {"-h", "--help"} & {name, *arguments}:
            print(usage)
            raise SystemExit(0)
        if name in _OTHER:
            known = "none but --only-tables" if name == "all" else "no options"
            raise SystemExit(f"{name} takes {known}; found {' '.join(arguments)}.")
        raise SystemExit(f"{usage}\n\nThere is no experiment {name!r}.")


def _about(name: str) -> str:
    """The first line of what its class says."""
    return str(resolve_name(EXPERIMENTS[name]).__doc__).partition("\n")[0]


def _run(name: str, arguments: list[str]) -> None:
    import tyro

    kind = resolve_name(EXPERIMENTS[name])
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
