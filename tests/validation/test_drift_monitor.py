"""Alarms of rho, delta and predictions that have left their intervals."""

import pytest
import torch

from gpadjust import CKA, RRA, VariationalCKA, fit
from gpadjust.validation import DriftMonitor


def wave(X):
    return torch.sin(3 * X[:, :1])


def rows(n, seed, scale=1.2):
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    return X, scale * wave(X) + 0.05 * torch.randn(n, 1, generator=generator, dtype=torch.float64)


@pytest.fixture
def model():
    model = RRA(*rows(60, 0), physics=wave, num_features=16)
    fit(model, "map", num_starts=2, num_screened=16)
    return model


def first_alarm(model, monitor, scale, n=200):
    X, Y = rows(n, 1, scale)
    for i in range(n):
        model.update(X[i : i + 1], Y[i : i + 1], forget=30)
        if alarm := monitor.check():
            return alarm
    return None


@pytest.mark.slow
def test_what_does_not_drift_gives_no_alarm(model):
    assert first_alarm(model, DriftMonitor(model), 1.2) is None


def test_a_change_gives_an_alarm_that_says_what_f_p_is(model):
    monitor = DriftMonitor(model, torch.tensor([[0.5]], dtype=torch.float64))
    alarm = first_alarm(model, monitor, 0.8)
    assert alarm.observation < 60
    low, high = alarm.interval
    assert not low <= alarm.value <= high
    text = repr(alarm)
    assert text.startswith(f"{alarm.name} of y at x = 0.5 left its 95 % interval")
    assert "There f_p is 0.9975" in text
    assert " % too " in text
    # It is said once, until the reference is set again.
    while monitor.check():
        pass
    assert monitor.check("today") is None
    monitor.reset()
    assert monitor.check() is None


def test_rho_leaves_when_it_is_known(model):
    monitor = DriftMonitor(model, level=0.5, false_alarms=0.5)
    X, Y = rows(200, 2, 0.2)
    model.update(X, Y, forget=30)
    names = set()
    while alarm := monitor.check("now"):
        names.add(alarm.name)
    assert "prediction" in names
    assert alarm is None


def test_exact_models_have_one_too():
    model = CKA(*rows(40, 0), physics=wave)
    fit(model, "map", num_starts=2, num_screened=16)
    monitor = DriftMonitor(model)
    assert len(monitor.X) == 5
    model.update(*rows(40, 1, 0.7), forget=40)
    assert monitor.check(4312).observation == 4312


def test_bad_input(model):
    with pytest.raises(TypeError, match="take an RRA"):
        DriftMonitor(VariationalCKA(*rows(30, 0), physics=wave, num_inducing=5))
    with pytest.raises(ValueError, match="between 0 and 1"):
        DriftMonitor(model, level=95)
