"""Bars: those that are asked for, and those that long work shows by itself."""

import sys

import pytest

from gpadjust import ZeroMeanGP, fit, progress
from gpadjust.progress import long_work, progress_bar, tick
from gpadjust.records import Record, Records, smooth
from gpadjust.states import StateSpec
from tests.systems import line


def test_shown_and_unseen_bars_go_the_same_way(capsys):
    for shown in (False, True):
        with progress_bar(shown, total=3) as bar:
            bar.set_description("start")
            bar.set_postfix(failed=1)
            bar.update()
            bar.update(2)
            assert bar.n == 3
        assert [*progress_bar(shown, [5, 6], unit="part")] == [5, 6]
        assert ("start" in capsys.readouterr().err) == shown


def test_tqdm_is_needed_where_one_is_shown(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert [*progress_bar(False, [5, 6])] == [5, 6]
    with pytest.raises(ImportError, match="pip install tqdm"):
        progress_bar(True, [5, 6])


@pytest.mark.filterwarnings("ignore::gpadjust.records.SmoothingWarning")
def test_a_fit_shows_a_bar_after_five_seconds_where_somebody_sees_it(capsys, monkeypatch):
    X = line(5)
    for is_seen, patience in ((True, 5.0), (False, 0.0), (True, 0.0)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_seen=is_seen: is_seen, raising=False)
        monkeypatch.setattr(progress, "PATIENCE", patience)
        fit(ZeroMeanGP(X, X.sin()), "map")
        assert ("evaluations" in capsys.readouterr().err) == (is_seen and patience == 0)
    records = Records(Record(X[:, 0], X.sin(), X), StateSpec(["x"], ["u"]))
    smooth(records, lambda X: X[:, :1], max_rounds=3, num_starts=1)
    assert " rounds" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "tqdm", None)
    fit(ZeroMeanGP(X, X.sin()), "map")
    assert not capsys.readouterr().err


def test_only_the_innermost_work_counts_and_only_its_own_units(monkeypatch):
    bars = []

    def recorded(shown, **options):
        bars.append(progress_bar(False))
        return bars[-1]

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "progress_bar", recorded)
    with long_work("learn", "steps", total=3):
        tick("steps")
        with long_work("fit", "evaluations"):
            tick("evaluations")
            tick("steps")
        tick("evaluations")
        tick("steps", to=3)
    tick("steps")
    assert [bar.n for bar in bars] == [3, 1]
