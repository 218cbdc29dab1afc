"""Without the extra ``rl``."""

import importlib
import sys

import pytest


@pytest.mark.parametrize(
    ("package", "missing"),
    [("gpadjust.rl", "stable_baselines3"), ("gpadjust.systems", "gymnasium")],
)
def test_what_is_missing_is_named(package, missing, monkeypatch):
    monkeypatch.delitem(sys.modules, package)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r'pip install "gpadjust\[rl\]"') as error:
        importlib.import_module(package)
    assert "\n" not in str(error.value)
