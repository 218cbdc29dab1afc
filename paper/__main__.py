"""Run one of the paper's experiments, or one of ours.

Each says its options: `python -m paper forrester --help`.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

CHAPTERS = {
    "forrester": ("Forrester",),
    "cartpole": ("CartPole",),
    "arm": ("Arm",),
    "functions": ("Functions",),
    "published": ("Masses", "Steels", "Uci", "Emps", "Freeruns", "Nist"),
    "machines": ("Real", "Tanks"),
    "parameters": ("Parameters", "Nuts"),
    "kinds": ("Kinds",),
    "control": ("Known", "First"),
    "misled": ("Misled",),
    "simulators": ("Simulators",),
}
"""Folders, and the classes of the experiments that they declare."""
EXPERIMENTS = {
    kind.lower(): f"paper.{chapter}:{kind}" for chapter, kinds in CHAPTERS.items() for kind in kinds
}
"""Classes of the experiments, by their names."""
FIGURES = {"figure1": "forrester", "figure2": "cartpole", "figure3": "arm"}
"""The paper's figures, and the experiments that draw them."""
_OTHER = {
    **{name: f"the paper's, of {of}; --quick: of two runs" for name, of in FIGURES.items()},
    "all": "run what is missing of every experiment, with --out paper/results, then report",
    "report": "copy the results that are committed into the pages",
    "check": "make a cheap case of each learner again; --write says in tables which are stale",
}


def main() -> None:
    """Run what the command line names; nothing that it does not need is imported."""
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in EXPERIMENTS:
        _run(name, arguments)
    elif name in FIGURES and {*arguments} <= {"--quick"}:
        _figure(FIGURES[name], quick=bool(arguments))
    elif name == "all" and {*arguments} <= {"--only-tables"}:
        _all(arguments)
    elif name == "report" and not arguments:
        import_module("paper.pages").report()
    elif name == "check" and {*arguments} <= {"--write"}:
        import_module("paper.check").main(EXPERIMENTS, write=bool(arguments))
    elif {"-h", "--help"} & {name, *arguments}:
        print(_usage())
        raise SystemExit(0)
    elif name in _OTHER:
        raise SystemExit(f"{name}: unknown options {' '.join(arguments)}; see --help.")
    else:
        raise SystemExit(f"{_usage()}\n\nThere is no experiment {name!r}.")


def _usage() -> str:
    names = {name: _about(name) for name in EXPERIMENTS} | _OTHER
    lines = [f"  {name:<15}{what}" for name, what in names.items()]
    return f"usage: python -m paper experiment [options]\n\n{__doc__}\n" + "\n".join(lines)


def _all(arguments: list[str]) -> None:
    """Run what is missing of each experiment, then report; say at the end what was refused."""
    refused = []
    for name in EXPERIMENTS:
        print(f"\n{name}: {_about(name)}")
        try:
            _run(name, ["--out", f"{Path(__file__).parent}/results", *arguments])
        except SystemExit as error:
            refused.append(f"{name}: {error}")
    import_module("paper.pages").report()
    if refused:
        raise SystemExit("\nNothing was run of these:\n" + "\n".join(refused))


def _about(name: str) -> str:
    """Return the first line of the docstring of a class."""
    return str(resolve_name(EXPERIMENTS[name]).__doc__).partition("\n")[0]


def _figure(name: str, quick: bool) -> None:
    """Draw a figure of the committed runs, or of two new ones of each curve in ten minutes."""
    kind = resolve_name(EXPERIMENTS[name])
    if quick:
        quicker = replace(kind(), runs=2, out=Path("results/quick"), only=kind.curves)
        _main(quicker.changed(kind.quick))
        return
    experiment = kind(out=Path(__file__).parent / "results")
    runs = import_module("paper.common.runner").runs_file(experiment).read()
    print(*experiment.draw([*runs.values()]), sep="\n")


def _run(name: str, arguments: list[str]) -> None:
    import tyro

    kind = resolve_name(EXPERIMENTS[name])
    config = [tyro.conf.FlagCreatePairsOff]
    _main(tyro.cli(kind, prog=f"python -m paper {name}", args=arguments, config=config))


def _main(experiment: object) -> None:
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
