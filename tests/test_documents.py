"""What the documents speak of exists: files, extras, commands, versions, pages of the reference."""

import doctest
import re
import shlex
import tomllib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import gpadjust
from gpadjust.__main__ import parser
from paper.__main__ import main

ROOT = Path(__file__).parents[1]
CI = (ROOT / ".ci" / "run").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COPIED = {"changelog", "contributing"}  # into docs/ by a build
FOLDERS = ("docs", "guide", "control", "laboratory", "coming_from")
PAGES = [p for p in sorted((ROOT / "docs").rglob("*.md")) if p.parent.name in FOLDERS]
DOCUMENTS = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "paper/README.md"]
DOCUMENTS += ["CODE_OF_CONDUCT.md", "SECURITY.md"]
DOCUMENTS += [str(page.relative_to(ROOT)) for page in PAGES if page.stem not in COPIED]
TOOLS = {"coverage", "mypy", "ruff", "sphinx-build", "tox", "twine"}
BUILT = {"docs/_build", "docs/_build/index.html"}
PICTURES = "tutorials/pictures/"  # taken from the notebooks as the site is built
REFERENCE = sorted((ROOT / "docs" / "reference").glob("*.rst"))
ROOM_PAGES = [page for page in REFERENCE if page.stem not in ("index", "gpadjust")]
GUIDE = sorted((ROOT / "docs" / "guide").rglob("*.md"))
DOCTESTS = [p for p in sorted((ROOT / "docs").rglob("*.rst")) if "_build" not in p.parts]

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))

YOURS = {"NAME.py"}
MODULES = {
    p.name for room in ("docs", "gpadjust", "paper", "tests") for p in (ROOT / room).rglob("*.py")
}

COLUMN = 88  # characters of code that fit the site's column


def commands(text):
    """Those of the shell blocks of a document, and what it quotes of `python -m`."""
    blocks = re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    quoted = re.findall(r"`(python -m [^`]*)`", text)
    parts = [part.strip() for line in lines + quoted for part in line.split("&&")]
    return [shlex.split(part, comments=True) for part in parts if part]


def lacking(name):
    """Linked and quoted files and extras of a document that are not there, and long lines."""
    text = (ROOT / name).read_text()
    links = {link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link}
    quoted = set(re.findall(r"`((?:gpadjust|paper|tests|docs|\.ci)/[\w./-]*)`", text))
    quoted |= set(re.findall(r"`(\w+\.(?:md|cff|toml))`", text))
    quoted = {path for path in quoted - BUILT if not re.search(r"-v\d$", path)}  # environments' ids
    links = {link for link in links if PICTURES not in link}
    yield from (link for link in links if not (ROOT / name).parent.joinpath(link).exists())
    yield from (path for path in quoted if not (ROOT / path).exists())
    yield from set(re.findall(r"`(?:\w+/)*(\w+\.py)`", text)) - MODULES - YOURS
    named = set(re.findall(r"extra\s+`(\w+)`", text))
    named |= {e for found in re.findall(r'\.\[([\w,]+)\]"', text) for e in found.split(",")}
    yield from named - set(PROJECT["optional-dependencies"])
    blocks = re.findall(r"```(?:python|none)\n(.*?)```", text, flags=re.DOTALL)
    yield from (line for line in "".join(blocks).splitlines() if len(line) > COLUMN)


def test_documents_name_what_there_is_and_their_code_fits_its_column():
    missing = {name: found for name in DOCUMENTS if (found := [*lacking(name)])}
    for path in (ROOT / "examples").glob("*.py"):
        if found := [line for line in path.read_text().splitlines() if len(line) > COLUMN]:
            missing[path.name] = found
    assert not missing


def is_known(command):
    """Whether what a command needs is there."""
    match command:
        case ["python", "-m", "paper", *_]:
            return True  # below
        case ["python", "-m", module, *arguments]:
            places = [ROOT / a for a in arguments if a.startswith("tests")]
            return (find_spec(module) or module == "build") and all(p.exists() for p in places)
        case ["gpadjust", *arguments]:
            return parser().parse_args(arguments)
        case ["cd", folder]:
            return (ROOT / folder).is_dir()
        case ["python", file, *_] | ["pip", "install", "--constraint", file, *_]:
            return (ROOT / file).is_file()
        case [tool, *_]:
            return tool in TOOLS


def test_commands_exist(monkeypatch):
    found = [each for name in DOCUMENTS for each in commands((ROOT / name).read_text())]
    assert not [command for command in found if not is_known(command)]
    for command in {tuple(each) for each in found if each[:3] == ["python", "-m", "paper"]}:
        monkeypatch.setattr("sys.argv", ["paper", *command[3:], "--help"])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0, command


def test_a_guide_begins_with_a_picture_and_says_what_it_shows():
    pages = {page.stem: page.read_text().split("\n\n")[:2] for page in GUIDE}
    picture = re.compile(r"!\[.{20,}\]\(\S+\)")
    assert not [
        n
        for n, (title, next_) in pages.items()
        if not title.startswith("# ") or not picture.fullmatch(next_)
    ]


def test_ci_runs_the_checks_that_documents_tell():
    told = []
    for name in ("README.md", "CONTRIBUTING.md"):
        block = re.findall(r"```bash\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL)[1]
        told += block.replace(" && ", "\n").splitlines()
    assert len(told) > 7
    for check in told:
        check = check.replace("pip install", "pip install --quiet").removesuffix(" docs/_build")
        assert check in CI


def test_the_tools_come_with_the_extra_dev_and_are_pinned():
    dev = " ".join(PROJECT["optional-dependencies"]["dev"])
    assert "gpadjust[docs,test]" in dev
    pins = (ROOT / "constraints.txt").read_text().lower()
    for requirements in PROJECT["optional-dependencies"].values():
        for requirement in requirements:
            package = re.match(r"[\w.-]+", requirement)[0].lower()
            assert package == "gpadjust" or re.search(
                rf"^{re.sub('[-_.]', '[-_.]', package)}==", pins, flags=re.MULTILINE
            ), package


def test_tox_asks_for_the_lowest_versions_and_tests_that_there_are():
    tox = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["tox"]["env_run_base"]
    lists = (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    assert {*tox["deps"]} <= {requirement for each in lists for requirement in each}
    folders = [part for part in tox["commands"][0] if part.startswith("tests/")]
    assert folders
    assert [folder for folder in folders if not (ROOT / folder).is_dir()] == []


def test_one_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == gpadjust.__version__
    told = f"\n## [{cited['version']}] - {cited['date-released']}\n"
    assert told in (ROOT / "CHANGELOG.md").read_text()


def test_the_rooms_have_the_files_to_read_first():
    text = (ROOT / "docs" / "architecture.md").read_text().split("## The rooms")[1]
    rows = re.findall(r"^\| `(\w+)` \| .* \| ([^|]*) \|$", text, flags=re.MULTILINE)
    read = [(room, file) for room, files in rows for file in re.findall(r"`([\w./]+\.py)`", files)]
    assert len({room for room, _ in read}) > 10
    paths = [ROOT / "gpadjust" / room / file for room, file in read]
    assert [path for path in paths if not path.parent.resolve().joinpath(path.name).exists()] == []


def public_names():
    """By module, what users import: each name has one home, the top or a room."""
    modules = ["gpadjust", "gpadjust.gpytorch", *(f"gpadjust.{page.stem}" for page in ROOM_PAGES)]
    return {name: import_module(name).__all__ for name in modules}


def test_the_public_names_are_few_and_each_has_one_home():
    rooms = (path.parent for path in (ROOT / "gpadjust").glob("*/__init__.py"))
    public = {room.name for room in rooms if "__all__" in (room / "__init__.py").read_text()}
    assert {page.stem for page in ROOM_PAGES} == public
    names = [name for names in public_names().values() for name in names]
    assert len(names) == len({*names}) <= 110


def test_the_reference_lists_the_public_names():
    index = (ROOT / "docs" / "reference" / "index.rst").read_text()
    pages = index.partition(".. toctree::")[2].split()[2:]
    assert {*pages} == {page.stem for page in REFERENCE} - {"index"}
    listed = re.findall(r"^   ~(gpadjust[\w.]*)\.(\w+)$", index, flags=re.MULTILINE)
    for module, names in public_names().items():
        assert {*names} == {name for room, name in listed if room == module}, module


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page.stem in ("control", "rl") else ())
        for page in DOCTESTS
    ],
    ids=lambda page: page.stem,
)
def test_the_examples_of_the_reference_run(page):
    assert not doctest.testfile(str(page), module_relative=False).failed


def test_the_learner_of_the_recipes_runs():
    text = (ROOT / "docs" / "extending.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    # core/test_recipes.py runs the others.
    (learner,) = [block for block in blocks if "class DynaDDPG" in block]
    exec(learner, {})


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_the_workflows_run_what_documents_tell(path):
    """Beside them, what only a runner has to do: check a tag, push a site, take main branches."""
    documents = [(ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md")]
    told = {
        line.strip()
        for text in documents
        for block in re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)
        for line in block.splitlines()
    }
    told |= {part.strip() for line in told for part in line.split("&&")}
    told |= {"tox -e ${{ matrix.env }}", ".ci/run"}
    told |= {"pip install --constraint constraints.txt build setuptools twine"}
    runs, jobs = [], yaml.safe_load(path.read_text())["jobs"]
    for job in jobs.values():
        steps = job.get("steps", [{"uses": "actions/checkout"}])  # or those of another workflow
        assert steps[0].get("uses", "actions/checkout").startswith("actions/checkout")
        runs += [step["run"] for step in steps if "run" in step]
    own = [run for run in runs if run.startswith(("git fetch", "grep ", "pip install --no-deps"))]
    assert len(own) < 2
    assert {*runs} - {*own} <= told
