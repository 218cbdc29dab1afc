"""The tutorials run, and what is committed of them is their output."""

import re
import sys
import tempfile

import nbformat
import pytest

from tutorials.run import FOLDER, KEPT, execute, notebooks, quick_settings, shrink

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")
LARGEST = 500_000  # bytes
# What differs from machine to machine: folders, the kernel's files, packages, addresses.
FOLDERS = [re.escape(f"{folder}") for folder in (FOLDER, sys.prefix, tempfile.gettempdir())]
PATHS = re.compile(
    "|".join([*FOLDERS, r"[A-Z]:\\", "ipykernel", "site-packages", "0x[0-9a-f]{6,}"])
)


def code_cells(path):
    cells = nbformat.read(path, as_version=4).cells
    return [cell for cell in cells if cell.cell_type == "code"]


def texts(cell):
    for output in cell.outputs:
        yield output.get("text", "")
        yield output.get("data", {}).get("text/plain", "")


@pytest.mark.slow
@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)
def test_a_tutorial_runs_without_a_warning(path):
    notebook = nbformat.read(path, as_version=4)
    shrink(notebook, quick_settings().get(path.name, {}))
    execute(notebook)  # raises what a cell raises
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            # Where SQLAlchemy is installed Ax says so as it is imported.
            is_news = output.get("text", "").startswith("[INFO")
            assert output.get("name") != "stderr" or is_news, output.text


def test_there_are_tutorials_and_their_settings():
    names = [path.name for path in notebooks()]
    assert names
    assert set(quick_settings()) <= set(names)


def test_what_is_committed_is_small_and_of_one_clean_run_on_no_named_machine():
    for path in notebooks():
        notebook, cells = nbformat.read(path, as_version=4), code_cells(path)
        assert path.stat().st_size < LARGEST, path
        assert notebook.metadata == KEPT, path
        assert not [cell.metadata for cell in notebook.cells if cell.metadata], path
        assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)], path
        outputs = [output for cell in cells for output in cell.outputs]
        assert any("image/png" in output.get("data", {}) for output in outputs), path
        wrong = [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
        assert not wrong, path
        found = [PATHS.search(text) for cell in cells for text in texts(cell)]
        assert not [match.group() for match in found if match], path
        shrink(notebook, quick_settings().get(path.name, {}))  # whose texts are there


def test_a_setting_that_is_gone_is_an_error():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("steps = 100")])
    shrink(notebook, {"steps = 100": "steps = 1"})
    assert notebook.cells[0].source == "steps = 1"
    with pytest.raises(ValueError, match="which no code cell has"):
        shrink(notebook, {"steps = 100": "steps = 1"})


def test_the_readme_lists_every_tutorial():
    readme = (FOLDER / "README.md").read_text()
    assert set(re.findall(r"\]\((\w+\.ipynb)\)", readme)) == {path.name for path in notebooks()}
