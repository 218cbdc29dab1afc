"""What kinds of data may change of a model: noises that learn of rows, kernels that read names."""

import pytest
import torch
from botorch.models.transforms.input import InputTransform

from gpadjust.core import CKA, KnownNoise, Noise, Stationary, Term, ZeroMeanGP, fit, load, save
from gpadjust.physics import FormulaPhysics

X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
Y = (3 * X).sin()


class Moved(Noise):
    """Noise with a known mean at each training point, which rough fits show."""

    def __init__(self, shift=0.0):
        super().__init__()
        self.shift = shift

    @property
    def settings(self):
        return {"shift": self.shift}

    def learnt(self, model, fitted):
        residual = (model.data.Y - fitted(Noise()).predict(model.data.X).mean).mT / model.unit
        return Moved(residual)


def test_a_noise_learns_of_rows_by_rough_fits(tmp_path):
    shifted = Y.clone()
    shifted[3] += 5.0
    model = ZeroMeanGP(X, shifted, noise=Moved(torch.zeros(1, 8, dtype=torch.float64)))
    fit(model, "map")
    expected = (shifted.mT / model.unit - model.noise.shift)[0]
    torch.testing.assert_close(model.conditioning().targets[0, 0], expected)
    mean, variance = model.left_out()
    alpha = model.conditioning().alpha * model.unit
    torch.testing.assert_close((model.data.Y - mean) / variance * model.unit**2, alpha.mT)
    torch.testing.assert_close(model.with_noise(Noise()).conditioning().targets.mT[0, :, 0],
                               (shifted / model.unit)[:, 0])  # fmt: skip
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt")  # with what it has learnt
    torch.testing.assert_close(again.predict(X).mean, model.predict(X).mean)


class OnColumn(Stationary):
    """A kernel of one column, by its name."""

    def __init__(self, name, number=None):
        super().__init__()
        self.name, self.number = name, number

    def of_data(self, data):
        return OnColumn(self.name, data.input_names.index(self.name))

    def rows(self, x, num_outputs):
        return super().rows(x[..., [self.number]], num_outputs)

    def covariance(self, own, x, other=None):
        other = None if other is None else other[..., [self.number]]
        return super().covariance(own, x[..., [self.number]], other)

    def with_pull_back(self, own, x):
        return super().with_pull_back(own, x[..., [self.number]])


class Texts(InputTransform):
    """Numbers in place of two texts, and a term of their own."""

    transform_on_train = transform_on_eval = transform_on_fantasize = True

    def coded(self, X):
        return X.replace({"low": 0.0, "high": 1.0}).astype(float) if hasattr(X, "columns") else X

    def transform(self, X):
        return X

    def terms(self, terms):
        return [*terms, Term("level", OnColumn("level"))]


@pytest.mark.filterwarnings("ignore:Downcasting")
def test_an_input_transform_makes_numbers_of_frames_and_adds_terms():
    pd = pytest.importorskip("pandas")
    level = ["low", "high"] * 4
    frame = pd.DataFrame({"level": level, "size": X[:, 0]})
    codes = torch.tensor([[0.0, 1.0] * 4]).double().mT
    model = CKA(frame, Y + codes, physics=lambda X: X[:, 1:], input_transform=Texts())
    assert [term.name for term in model.terms] == ["rho", "delta", "level"]
    assert model.data.input_names == ("level", "size")
    torch.testing.assert_close(model.data.X, torch.cat([codes, X], -1))
    assert list(model.predict(frame[:3]).mean.index) == [0, 1, 2]
    fit(model, "map")
    both = frame.assign(size=0.4)[:2]
    low, high = model.term("level", torch.tensor([[0.0, 0.4], [1.0, 0.4]]).double()).mean
    assert high > low
    assert model.predict(both).mean.shape == (2, 1)


def test_known_variances_and_a_noise_that_learns_them_are_too_much():
    with pytest.raises(ValueError, match="found both"):
        ZeroMeanGP(X, Y, 0.01, noise=Noise())
    known = ZeroMeanGP(X, Y, noise=KnownNoise(torch.full((1, 8), 0.1).double()))
    later = known.condition_on_observations(X[:1] + 0.3, Y[:1], known.unit.square() * 0.4)
    torch.testing.assert_close(later.noise.known[0, -2:], torch.tensor([0.1, 0.4]).double())


def test_a_formula_with_the_columns_in_another_order_is_refused():
    pd = pytest.importorskip("pandas")
    law = FormulaPhysics("a - b", ["a", "b"])
    frame = pd.DataFrame({"b": X[:, 0], "a": X[:, 0].sin()})
    with pytest.raises(ValueError, match="in the order of the data"):
        CKA(frame, Y, physics=law)
