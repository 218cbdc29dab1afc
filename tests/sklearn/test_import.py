"""Without scikit-learn."""

import importlib
import sys

import pytest

import gpadjust.sklearn


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, gpadjust.sklearn.__name__)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(ImportError, match=r'pip install "gpadjust\[sklearn\]"') as error:
        importlib.import_module("gpadjust.sklearn")
    assert "\n" not in str(error.value)
