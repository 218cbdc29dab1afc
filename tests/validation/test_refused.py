"""Bad input of the room, and the decisive words of its errors."""

import matplotlib as mpl
import pytest
import torch
from botorch.models import ModelListGP
from matplotlib.figure import Figure

from gpadjust.core import CKA, StackedGP, ZeroMeanGP
from gpadjust.validation import Scores, Structure, compare, leave_one_out, score, trust
from gpadjust.validation.plots import plot_coverage, plot_leave_one_out, plot_model, plot_prediction
from tests.systems import crude, line, truth, uniform, wave

mpl.use("Agg")
X = uniform(9, 2, high=2.0)
Y = truth(X)
PLANE = CKA(X, Y, physics=crude)
LINE = CKA(line(9), wave(line(9)), physics=wave)
MEAN, VARIANCE = uniform(2, 7, 3, low=-2, high=2), uniform(2, 7, 3, low=0.1, high=3, seed=2)
NEGATIVE, NAN = VARIANCE.clone(), MEAN.clone()
NEGATIVE[0, 1, 2], NAN[0, 1, 2] = -0.5, torch.nan


def scores(words, mean, variance=VARIANCE, y=MEAN, error=ValueError, **options):
    return (lambda: Scores.compute(mean, variance, y, **options)), error, words


def compared(words, structures=("CKA",), y=Y):
    return (lambda: compare(X, y, crude, structures=structures)), ValueError, words


def trusted(words, model, points=None, error=TypeError):
    return (lambda: trust(model, points)), error, words


def drawn(words, draw, *args, error=ValueError, **options):
    return (lambda: draw(*args, **options)), error, words


REFUSED = [
    scores(r"got ndarray; convert .*as_tensor\(mean, ", MEAN.numpy(), error=TypeError),
    scores(r"got list; convert .*as_tensor\(y, ", MEAN, y=MEAN.tolist(), error=TypeError),
    scores(r"at least 0, got -0.5; .*`variance.clamp_min\(0\)`", MEAN, NEGATIVE),
    scores("Expected mean without NaN, found 1 of 42", NAN),
    scores(r"y of shape ... x n x m.*unsqueeze\(-1\)", *[MEAN[0, :, 0]] * 3),
    scores(r"variance of y's shape \(2, 7, 3\), got", MEAN, VARIANCE[..., :2]),
    scores(r"mean of y's shape \(2, 7, 1\), got", MEAN, y=MEAN[..., :1]),
    scores("level must be between 0 and 1; found", MEAN, level=95),
    ((lambda: score(PLANE, Y)), TypeError, r"got CKA; a model has one, `model.posterior\(X, "),
    (
        lambda: leave_one_out(ModelListGP(PLANE)),
        TypeError,
        "found ModelListGP. Pass the models of a list one by one",
    ),
    ((lambda: leave_one_out(torch.nn.Linear(1, 1))), TypeError, "found Linear"),
    trusted("a physics to trust, such as CKA; found ZeroMeanGP", ZeroMeanGP(X, Y)),
    trusted(r"found StackedGP.*comparison\.models\['CKA'\]", StackedGP({"CKA": LINE}, [1.0])),
    trusted("For LearnedDynamics pass its `model`", "CKA"),
    trusted("columns", LINE, X, ValueError),
    trusted("one point or more", LINE, X[:0, :1], ValueError),
    trusted("Expected X of shape n x d", LINE, X[None, :, :1], ValueError),
    compared("structures", []),
    compared("structures", ["CKA", "kriging"]),
    compared(r"or functools\.partial of one", [3.0]),
    compared("none of them 'stacked'", [Structure("stacked", CKA)]),
    compared("kind", [Structure("mine", CKA, "best")]),
    compared("or 'physics alone'; found", [Structure("physics alone", CKA)]),
    compared("unknown parameters for 'calibrated phys", "calibrated physics"),
    compared("train_Y", y=Y[:5]),
    drawn("a model of one input, got 2; `plot_model`", plot_prediction, PLANE, X),
    drawn("Expected Y of shape 9 x 1", plot_prediction, LINE, line(9), Y),
    drawn("Expected X of shape n x 1", plot_prediction, LINE, X),
    drawn("1 x 1 axes", plot_prediction, LINE, line(5), ax=Figure().subplots(2)),
    drawn("predictions with PIT values, got Tensor", plot_coverage, X, error=TypeError),
    drawn("no output 2; there are 2, from 0", plot_coverage, leave_one_out(PLANE), output=2),
    drawn("no output 2", plot_model, PLANE, output=2),
    drawn("Expected a LeaveOneOut, got CKA", plot_leave_one_out, PLANE, error=TypeError),
    drawn(
        "Expected 1 x 2 axes, got 1",
        plot_leave_one_out,
        leave_one_out(LINE),
        axes=Figure().subplots(),
    ),
]


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_refused(call, error, words):
    with pytest.raises(error, match=words):
        call()
