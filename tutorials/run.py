"""Run the tutorials from top to bottom, each in a fresh kernel: python tutorials/run.py [files].

Outputs are written into the notebooks, unless --quick shrinks them by the settings in quick.toml.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).parent
KEPT = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


def notebooks() -> list[Path]:
    """Return all tutorials, in their order."""
    return sorted(FOLDER.glob("*.ipynb"))


def quick_settings() -> dict[str, dict[str, str]]:
    """Return what quick.toml replaces, by the notebook's file name."""
    with open(FOLDER / "quick.toml", "rb") as file:
        return tomllib.load(file)


def shrink(notebook: NotebookNode, replacements: dict[str, str]) -> None:
    """Replace settings in the source of a notebook, in place.

    Raises:
        ValueError: If an original is not in the notebook.
    """
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for original, quick in replacements.items():
        found = [cell for cell in cells if original in cell.source]
        if not found:
            raise ValueError(
                f"quick.toml replaces {original!r}, which no code cell has; correct quick.toml."
            )
        for cell in found:
            cell.source = cell.source.replace(original, quick)


def execute(notebook: NotebookNode) -> None:
    """Run a notebook in place, and drop what differs from run to run or machine to machine.

    Raises:
        nbclient.exceptions.CellExecutionError: If a cell raises an error.
    """
    client = NotebookClient(
        notebook,
        timeout=600,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": FOLDER}},
    )
    # Models this small are slower with more threads.
    client.execute(env={"OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1", **os.environ})
    notebook.metadata = nbformat.from_dict(KEPT)
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})


def main() -> None:
    """Run the notebooks that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="default: all tutorials")
    parser.add_argument("--quick", action="store_true", help="small settings; writes nothing")
    arguments = parser.parse_args()
    for path in arguments.files or notebooks():
        notebook = nbformat.read(path, as_version=4)
        if arguments.quick:
            shrink(notebook, quick_settings().get(path.name, {}))
        execute(notebook)
        if not arguments.quick:
            nbformat.write(notebook, path)
        print(f"{path.name}: done")


if __name__ == "__main__":
    main()
