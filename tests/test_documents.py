"""What the documents speak of exists: files, extras, commands, versions, pages of the reference."""

import doctest
import json
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
DOCS = ROOT / "docs"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if "_build" not in path.parts]
DOCUMENTS = ["README", "CONTRIBUTING", "CHANGELOG", "CODE_OF_CONDUCT", "SECURITY", "paper/README"]
DOCUMENTS = [*(f"{name}.md" for name in DOCUMENTS), *(str(p.relative_to(ROOT)) for p in PAGES)]
TEXTS = {name: (ROOT / name).read_text() for name in DOCUMENTS}
REFERENCE = sorted((DOCS / "reference").glob("*.rst"))
ROOM_PAGES = [page for page in REFERENCE if page.stem not in ("index", "gpadjust")]
TOOLS = {"coverage", "mypy", "ruff", "sphinx-build", "tox", "twine"}
BUILT = {"docs/_build", "docs/_build/index.html"}
PICTURES = "tutorials/pictures/"  # taken from the notebooks as the site is built
YOURS = {"NAME.py"}
MODULES = {
    p.name for room in ("docs", "gpadjust", "paper", "tests") for p in (ROOT / room).rglob("*.py")
}
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
COLUMN = 88  # characters of code that fit the site's column
WORDS, CHANGES, NAMES = 35_000, 60, 110  # of the site, lines of the newest version, public names
AVOIDED = re.compile(
    r"\b(by the default fit|next to nothing|of one's own|is none|errs?|pays|nobody (says|told)|"
    r"(intervals?|those) (of 95 % )?(that )?hold|go(es)? on|told|said)\b"
)


def shell_blocks(text):
    return re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)


def commands(text):
    """Commands of the shell blocks of a document, and quoted ones of `python -m`."""
    lines = [
        line for block in shell_blocks(text) for line in block.replace("\\\n", " ").split("\n")
    ]
    quoted = re.findall(r"`(python -m [^`]*)`", text)
    parts = [part.strip() for line in lines + quoted for part in line.split("&&")]
    return [shlex.split(part, comments=True) for part in parts if part]


def lacking(name):
    """Yield linked and quoted files and extras that are not there, and long lines of code."""
    text = TEXTS[name]
    links = {link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link}
    links |= set(re.findall(r"\{download\}`[^`]*<([^>]*)>`", text))
    quoted = set(re.findall(r"`((?:gpadjust|paper|tests|docs|\.ci)/[\w./-]*)`", text))
    quoted |= set(re.findall(r"`(\w+\.(?:md|cff|toml))`", text))
    quoted = {path for path in quoted - BUILT if not re.search(r"-v\d$", path)}  # environments' ids
    links = {link for link in links if PICTURES not in link}
    yield from (link for link in links if not (ROOT / name).parent.joinpath(link).exists())
    yield from (path for path in quoted if not (ROOT / path).exists())
    yield from set(re.findall(r"`(?:\w+/)*(\w+\.py)`", text)) - MODULES - YOURS
    extras = set(re.findall(r"extra\s+`(\w+)`", text))
    lists = re.findall(r'(?:\.|gpadjust)\[([\w,]+)\]["\s]', text)
    extras |= {extra for names in lists for extra in names.split(",")}
    yield from extras - set(PROJECT["optional-dependencies"])
    blocks = re.findall(r"```(?:python|none)\n(.*?)```", text, flags=re.DOTALL)
    yield from (line for line in "".join(blocks).splitlines() if len(line) > COLUMN)


def test_documents_name_what_there_is_and_their_code_fits_its_column():
    missing = {name: problems for name in DOCUMENTS if (problems := [*lacking(name)])}
    for path in (ROOT / "examples").glob("*.py"):
        if long := [line for line in path.read_text().splitlines() if len(line) > COLUMN]:
            missing[path.name] = long
    assert not missing


def test_the_documents_are_short_and_plain():
    pages = [*PAGES, *REFERENCE, ROOT / "tutorials" / "README.md"]
    assert sum(len(page.read_text().split()) for page in pages) <= WORDS
    newest = TEXTS["CHANGELOG.md"].split("\n## [")[1]
    assert newest.count("\n") <= CHANGES
    vague = {page.name: AVOIDED.findall(page.read_text()) for page in pages}
    assert not {name: words for name, words in vague.items() if words}


def is_known(command):
    """Whether the needs of a command are there."""
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
        case ["pip", "install", package]:
            return re.fullmatch(
                r"gpadjust\[\w+\] @ git\+https://github.com/OWNER/gpadjust", package
            )
        case [tool, *_]:
            return tool in TOOLS


def test_commands_exist(monkeypatch):
    found = [command for text in TEXTS.values() for command in commands(text)]
    assert not [command for command in found if not is_known(command)]
    for command in {tuple(each) for each in found if each[:3] == ["python", "-m", "paper"]}:
        monkeypatch.setattr("sys.argv", ["paper", *command[3:], "--help"])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0, command


def test_a_guide_begins_with_a_picture_and_says_what_it_shows():
    picture = re.compile(r"!\[.{20,}\]\(\S+\)")
    for page in (DOCS / "guide").rglob("*.md"):
        title, next_ = page.read_text().split("\n\n")[:2]
        assert title.startswith("# "), page
        assert picture.fullmatch(next_), page


def test_ci_runs_the_checks_of_the_documents():
    blocks = (shell_blocks(TEXTS[name])[1] for name in ("README.md", "CONTRIBUTING.md"))
    checks = "".join(blocks).replace(" && ", "\n").splitlines()
    assert len(checks) > 7
    ci = (ROOT / ".ci" / "run").read_text()
    for check in checks:
        assert (
            check.replace("pip install", "pip install --quiet").removesuffix(" docs/_build") in ci
        )


def test_the_tools_come_with_the_extra_dev_and_are_pinned():
    dev = " ".join(PROJECT["optional-dependencies"]["dev"])
    assert "gpadjust[docs,test]" in dev
    pins = (ROOT / "constraints.txt").read_text().lower()
    for requirements in PROJECT["optional-dependencies"].values():
        for requirement in requirements:
            package = re.match(r"[\w.-]+", requirement)[0].lower()
            pin = rf"^{re.sub('[-_.]', '[-_.]', package)}=="
            assert package == "gpadjust" or re.search(pin, pins, flags=re.MULTILINE), package


def test_tox_asks_for_the_lowest_versions_and_tests_that_there_are():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["tox"]
    tests = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text())["jobs"]
    assert tests["core"]["strategy"]["matrix"]["env"] == settings["env_list"]
    tox = settings["env_run_base"]
    lists = (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    assert {*tox["deps"]} <= {requirement for each in lists for requirement in each}
    folders = [part for part in tox["commands"][0] if part.startswith("tests/")]
    assert folders
    assert all((ROOT / folder).is_dir() for folder in folders)


def test_one_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == gpadjust.__version__
    assert f"\n## [{cited['version']}] - {cited['date-released']}\n" in TEXTS["CHANGELOG.md"]


def test_the_rooms_have_the_files_to_read_first():
    text = TEXTS["docs/architecture.md"].split("## The rooms")[1]
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
    files = (ROOT / "gpadjust").glob("*/__init__.py")
    rooms = {file.parent.name for file in files if "__all__" in file.read_text()}
    assert {page.stem for page in ROOM_PAGES} == rooms
    names = [name for names in public_names().values() for name in names]
    assert len(names) == len({*names}) <= NAMES


def test_the_reference_lists_the_public_names():
    index = (DOCS / "reference" / "index.rst").read_text()
    pages = index.partition(".. toctree::")[2].split()[2:]
    assert {*pages} == {page.stem for page in REFERENCE} - {"index"}
    listed = re.findall(r"^   ~(gpadjust[\w.]*)\.(\w+)$", index, flags=re.MULTILINE)
    for module, names in public_names().items():
        assert {*names} == {name for room, name in listed if room == module}, module


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page.stem in ("control", "rl") else ())
        for page in REFERENCE
    ],
    ids=lambda page: page.stem,
)
def test_the_examples_of_the_reference_run(page):
    assert not doctest.testfile(str(page), module_relative=False).failed


def test_the_learner_of_the_recipes_runs():
    blocks = re.findall(r"```python\n(.*?)```", TEXTS["docs/extending.md"], flags=re.DOTALL)
    # core/test_recipes.py runs the others.
    (learner,) = [block for block in blocks if "class DynaDDPG" in block]
    exec(learner, {})


def test_notebooks_and_examples_run_outside_the_clone():
    """The sixth notebook is of an experiment, and says so; all data lie beside or are installed."""
    for path in (ROOT / "tutorials").glob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        code = "".join(
            line for cell in cells if cell["cell_type"] == "code" for line in cell["source"]
        )
        assert "../" not in code, path.name
        assert path.stem[0] == "6" or not re.search(r"^(from|import) (paper|tests)\b", code, re.M)
    gallery = TEXTS["docs/gallery.md"]
    for path in (ROOT / "examples").glob("*.py"):
        code = path.read_text()
        assert "parents" not in code, path.name
        files = [path.name, *re.findall(r'with_name\("([\w.]+)"\)', code)]
        assert all(f"{{download}}`{name} <../examples/{name}>`" in gallery for name in files)
    data = ROOT / "paper" / "published" / "data"
    for name, source in {"yacht": "uci/yacht", "nuclides": "masses/ame2020"}.items():
        rows = (ROOT / "examples" / f"{name}.csv").read_text().splitlines()
        assert {*rows} <= {*(data / f"{source}.csv").read_text().splitlines()}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_the_workflows_run_the_commands_of_the_documents(path):
    """In addition, what only a runner has to do: check a tag, push a site, take main branches."""
    blocks = (shell_blocks(TEXTS[name]) for name in ("README.md", "CONTRIBUTING.md"))
    lines = {line.strip() for texts in blocks for text in texts for line in text.splitlines()}
    lines |= {part.strip() for line in lines for part in line.split("&&")}
    lines |= {"tox -e ${{ matrix.env }}", ".ci/run"}
    lines |= {"pip install --constraint constraints.txt build setuptools twine"}
    runs, jobs = [], yaml.safe_load(path.read_text())["jobs"]
    for job in jobs.values():
        steps = job.get("steps", [{"uses": "actions/checkout"}])  # or those of another workflow
        first = steps[0].get("uses", "actions/checkout")
        assert first.startswith(("actions/checkout", "actions/download-artifact"))
        runs += [step["run"] for step in steps if "run" in step]
    own = [run for run in runs if run.startswith(("git fetch", "grep ", "pip install --no-deps"))]
    assert len(own) < 2
    assert {*runs} - {*own} <= lines
