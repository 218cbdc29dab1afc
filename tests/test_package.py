"""What an import brings, in a process of its own."""

import pickle
import subprocess
import sys

import pytest

import gpadjust


def python(code):
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_what_is_not_needed_is_not_imported():
    """One after the other, so that none may bring what a later one is to do without."""
    steps = {
        "import gpadjust": "torch",
        "import gpadjust.states": "botorch gpytorch linear_operator gymnasium",
        "from gpadjust import ODEPhysics": "botorch gpytorch gymnasium",
        "import gpadjust.envs": "botorch gpytorch linear_operator stable_baselines3 opensim",
    }
    code = "import sys\n" + "".join(
        f"{first}\nprint({first!r}, *set({absent.split()}) & {{*sys.modules}})\n"
        for first, absent in steps.items()
    )
    assert python(code).splitlines() == [*steps]


def test_every_name_is_there_and_brings_nothing_optional():
    optional = ["gymnasium", "stable_baselines3", "pygame", "opensim", "matplotlib", "pandas"]
    optional.append("sklearn")
    code = (
        "import sys, gpadjust.active\n"
        f"assert not {set(optional)} & {{*sys.modules}}, 'needless imports'\n"
        "from gpadjust import *; import gpadjust\n"
        "for name in gpadjust.__all__:\n"
        "    assert globals()[name] is getattr(gpadjust, name), name\n"
        "    assert name in dir(gpadjust), name\n"
        "assert gpadjust.models.CKA is CKA and gpadjust.dynamics.LearnedDynamics\n"
        "print(gpadjust.__version__)"
    )
    assert python(code).strip() == gpadjust.__version__
    assert pickle.loads(pickle.dumps(gpadjust.CKA)) is gpadjust.CKA


def test_other_names_are_not():
    assert not hasattr(gpadjust, "GPModel")
    with pytest.raises(AttributeError, match="'gpadjust' has no attribute 'GPModel'"):
        gpadjust.GPModel  # noqa: B018
