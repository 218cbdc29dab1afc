"""What an import of the package brings along."""

import subprocess
import sys

import pytest


@pytest.fixture(scope="module")
def loaded():
    code = "import sys, gpadjust.active; print('\\n'.join(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize(
    "name", ["gymnasium", "stable_baselines3", "pygame", "opensim", "matplotlib", "pandas"]
)
def test_optional_dependencies_are_not_imported(loaded, name):
    assert "gpadjust" in loaded
    assert name not in loaded
