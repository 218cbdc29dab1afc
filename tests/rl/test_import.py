"""Without the extras ``control`` and ``rl``; ``gpadjust.control`` itself needs neither."""

import importlib
import sys

import pytest


@pytest.mark.parametrize(
    ("package", "missing", "extra"),
    [
        ("gpadjust.rl", "stable_baselines3", "rl"),
        ("gpadjust.systems", "gymnasium", "control"),
    ],
)
def test_what_is_missing_is_named(package, missing, extra, monkeypatch):
    monkeypatch.delitem(sys.modules, package)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=rf'pip install "gpadjust\[{extra}\]"') as error:
        importlib.import_module(package)
    assert "\n" not in str(error.value)
