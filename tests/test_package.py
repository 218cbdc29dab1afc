"""What an import brings, in a process of its own, and the cheat sheet."""

import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib import import_module, reload
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gpadjust
from gpadjust import RRA
from gpadjust.kinds import pyro_model
from gpadjust.physics import MujocoPhysics
from tests.fmus import fmu
from tests.systems import line
from tests.test_display import OBJECTS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def python(code, **options):
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, **options)
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.slow
def test_a_script_beside_a_clone_imports_the_library(tmp_path):
    """The clone's folder has the library's name, and no `__init__.py`: a namespace package."""
    (tmp_path / "gpadjust").symlink_to(Path(__file__).parents[1], target_is_directory=True)
    # As installed: a PYTHONPATH with the repository would hide what the installation does.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "from gpadjust import CKA, __version__; print(CKA.__name__, __version__)"
    found = python(code, cwd=tmp_path, env=environment)
    assert found.split() == ["CKA", gpadjust.__version__]


@pytest.mark.slow
def test_what_is_not_needed_is_not_imported():
    """One after the other, so that none may bring what a later one is to do without."""
    steps = {
        "import gpadjust": "torch",
        "import gpadjust.states, gpadjust.files": "botorch gpytorch linear_operator gymnasium",
        "from gpadjust import ODEPhysics": "botorch gpytorch gymnasium",
        "import gpadjust.systems": "botorch gpytorch linear_operator stable_baselines3",
        "from gpadjust import CKA, compare, fit": "scipy.stats scipy.integrate joblib",
        "import gpadjust.active": "stable_baselines3 pygame matplotlib pandas sklearn",
    }
    code = "import sys\n" + "".join(
        f"{first}\nprint({first!r}, *set({absent.split()}) & {{*sys.modules}})\n"
        for first, absent in steps.items()
    )
    assert python(code).splitlines() == [*steps]


def brought_by(package, known=frozenset()):
    """The packages that come with one, as far as they are installed here."""
    with suppress(PackageNotFoundError):
        for each in map(Requirement, requires(package) or ()):
            name = canonicalize_name(each.name)
            if name not in known and (not each.marker or each.marker.evaluate({"extra": ""})):
                known = brought_by(name, known | {name})
    return known


@pytest.mark.slow
def test_the_core_brings_no_more_than_botorch():
    """And the README's ten lines, and a comparison, need no more."""
    core = {canonicalize_name(Requirement(each).name) for each in PROJECT["dependencies"]}
    assert core <= {"botorch", *brought_by("botorch")}
    absent = ["gymnasium", "matplotlib", "pandas", "pyro", "tqdm"]
    lines = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[0]
    python(
        f"import sys\nsys.modules.update(dict.fromkeys({absent}))\n{lines}\n"
        "from gpadjust import active, compare, dynamics, records\n"
        "compare(train_X, train_Y, f_p, structures=['CKA'])\n"
    )


NEEDED = {
    "matplotlib": ("plot", lambda: RRA(line(5), line(5), physics=torch.sin).plot()),
    "mujoco": ("mujoco", lambda: MujocoPhysics("<mujoco/>")),
    "sklearn": ("sklearn", lambda: reload(import_module("gpadjust.sklearn"))),
    "pyro": ("pyro", lambda: pyro_model(RRA(line(5), line(5), physics=torch.sin))),
}


@pytest.mark.parametrize("missing", NEEDED)
def test_an_error_names_the_extra(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    extra, call = NEEDED[missing]
    with pytest.raises(ImportError, match=rf'pip install "gpadjust\[{extra}\]"'):
        call()


def rate(state, action):
    return -state


def f_p(X):
    return 1 + X[:, :1]


@pytest.mark.slow
def test_each_line_of_the_cheat_sheet_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(fmu("tank"), "tank.fmu")
    X = line(6)
    names = {name: getattr(gpadjust, name) for name in gpadjust.__all__}
    names |= {"X": X, "Y": 2 * f_p(X) + 0.1 * X.sin(), "f_p": f_p, "g_p": torch.exp}
    names |= {name: getattr(gpadjust.kinds, name) for name in gpadjust.kinds.__all__}
    frame = pd.DataFrame({"x": X[:, 0], "rig": ["old", "new"] * 3})
    names |= {"simulator": np.sin, "rate": rate, "frame": frame}
    names |= {name: make() for name, (make, *_) in OBJECTS.items()}
    names["leave_one_out"] = gpadjust.validation.leave_one_out
    calls = re.findall(r"^ {4}(.+)", inspect.getdoc(gpadjust), flags=re.MULTILINE)
    assert len(calls) > 25
    for call in calls:
        exec(call, names)
    assert names["mean"].shape == names["rho"].mean.shape == (6, 1)


def test_what_a_user_can_take_is_listed_and_nothing_else(monkeypatch):
    rooms = {path.parent.name for path in Path(gpadjust.__file__).parent.glob("*/__init__.py")}
    assert set(dir(gpadjust)) == {*gpadjust.__all__, *rooms, "__version__"}
    assert gpadjust.report.report
    monkeypatch.setitem(sys.modules, "sklearn", None)
    for name in ("gpadjust.sklearn", "gpadjust.sklearn.cka_regressor"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delattr(gpadjust, "sklearn", raising=False)
    with pytest.raises(AttributeError, match="needs scikit-learn"):
        gpadjust.sklearn  # noqa: B018
    with pytest.raises(AttributeError, match="'gpadjust' has no attribute 'GPModel'"):
        gpadjust.GPModel  # noqa: B018
