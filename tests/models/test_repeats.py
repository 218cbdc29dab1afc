"""Rows of equal inputs: the answers of the dense formulas, at the cost of the distinct inputs."""

import math
import warnings

import pytest
import torch

from gpadjust import CKA, RRA, PhysicsMeanGP, ZeroMeanGP, fit, load, save
from gpadjust.gp.gaussian import log_likelihood
from gpadjust.gp.repeats import Repeats
from gpadjust.inference import register_priors
from gpadjust.inference.targets import LogLikelihood, LogPosterior
from gpadjust.models import terms_gp
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.validation import leave_one_out

PLACES = torch.rand(9, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
TEST = torch.rand(5, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def f_p(X):
    return torch.sin(6 * X[..., :1])


def data(outputs=1, missing=False):
    """Unequal replicates of nine places, in no order."""
    draw = torch.Generator().manual_seed(0)
    rows = torch.cat([torch.arange(9), torch.randint(9, (21,), generator=draw)])
    X = PLACES[rows[torch.randperm(30, generator=draw)]]
    Y = torch.cat([f_p(X) + (j + X[:, 1:]).square() for j in range(outputs)], dim=-1)
    Y = Y + 0.1 * torch.randn(Y.shape, generator=draw, dtype=torch.float64)
    if missing:
        Y[::4, 0] = torch.nan
        Y[1::4, 1] = torch.nan
    return X, Y


@pytest.fixture
def ways(monkeypatch):
    """A result of a model with repeated rows together, and of one with each by itself."""

    def found(make, result):
        both = []
        for share in (0.75, 0.0):
            monkeypatch.setattr(terms_gp, "_DISTINCT", share)
            model = make()
            assert model.has_repeats == (share > 0)
            both.append(result(model))
        return both

    return found


def answers(model):
    model.eval()
    loo = leave_one_out(model)
    known = {"noise": torch.full((2, model.num_outputs), 0.01).double()}
    given = known if model.noise.is_known else {}
    more = model
    for rows in (slice(2), slice(2, 4)):  # the second time, on rows that came later, too
        Y = torch.zeros(2, model.num_outputs, dtype=torch.float64)
        more = more.condition_on_observations(TEST[rows], Y, **given)
    found = [*model.predict(TEST), model.posterior(TEST).mean, *more.predict(TEST)]
    found += [loo.mean, loo.variance, loo.log_density, model.log_evidence()[1]]
    found += [model.mean_functions()(TEST)]
    if not isinstance(model, RRA):  # whose draws depend on signs of factors
        found.append(model.sample_functions(2, seed=0)(TEST))
    return [each.detach().nan_to_num() for each in found]


def assert_same(first, second, tolerance=1e-8):
    for ours, theirs in zip(first, second, strict=True):
        assert torch.allclose(ours, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("model_class", [CKA, ZeroMeanGP, RRA])
def test_all_answers_are_those_of_single_rows(ways, model_class, known, missing):
    X, Y = data(2, missing)
    variances = 0.01 + 0.02 * torch.rand(Y.shape, dtype=torch.float64) if known else None
    options = {} if model_class is ZeroMeanGP else {"physics": lambda X: f_p(X).repeat(1, 2)}
    assert_same(*ways(lambda: model_class(X, Y, variances, **options), answers))


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("target_class", [LogLikelihood, LogPosterior])
def test_the_likelihood_and_its_gradient_are_those_of_single_rows(ways, target_class, known):
    X, Y = data(2, True)
    variances = 0.01 + 0.02 * torch.rand(Y.shape, dtype=torch.float64) if known else None

    def value(model):
        register_priors(model)
        target = target_class(model)
        vectors = target.parameters.draw(4, torch.Generator().manual_seed(0))
        noise = target.parameters.noise.bool().any(0)
        vectors[..., noise] = vectors[..., noise].clamp_min(-6)  # the nugget is of rows
        return target.value_and_gradient(vectors)

    make = lambda: CKA(X, Y, variances, physics=lambda X: f_p(X).repeat(1, 2))  # noqa: E731
    assert_same(*ways(make, value), tolerance=1e-6)


def test_the_likelihood_by_the_book():
    X, Y = data()
    model = PhysicsMeanGP(X, Y, physics=f_p, outcome_transform=None)
    model.likelihood.noise = 0.02
    assert model.has_repeats
    model.eval()
    with torch.no_grad():
        K = model.covar_module(model.transform_inputs(X)).to_dense() + 0.02 * torch.eye(30)
    expected = log_likelihood((Y - f_p(X))[:, 0], K)
    assert model.log_evidence()[1].item() == pytest.approx(expected.item(), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["map", "bayes"])
def test_a_fit_is_that_of_single_rows(ways, method):
    X, Y = data()

    def fitted(model):
        fit(model, method, num_starts=2, num_screened=8)
        return [*model.predict(TEST), leave_one_out(model).mean]

    assert_same(*ways(lambda: CKA(X, Y, physics=f_p), fitted), tolerance=1e-4)


def test_unknown_parameters(ways):
    X, Y = data()
    physics = FunctionPhysics(
        lambda X, p: torch.sin(p.a * X[:, 0]), unknowns={"a": Unknown(5.0, sd=1.0)}
    )

    def fitted(model):
        fit(model, "map", num_starts=2, num_screened=8)
        return [*model.predict(TEST), model.physics_parameters.mean]

    assert_same(*ways(lambda: PhysicsMeanGP(X, Y, physics=physics), fitted), tolerance=1e-4)


def test_groups_of_rows():
    X = torch.tensor([[1.0], [0.0], [1.0], [2.0], [0.0]]).double()
    repeats = Repeats.of(X)
    assert repeats.first.tolist() == [0, 1, 3]
    assert repeats.group.tolist() == [0, 1, 0, 2, 1]
    means = repeats.means(torch.tensor([1.0, 2.0, 3.0, math.nan, 4.0]).double(), torch.ones(5))
    assert means.targets.nan_to_num(-1.0).tolist() == [2.0, 3.0, -1.0]
    assert means.within.number.tolist() == [2.0, 2.0, 0.0]


def test_rows_count_by_themselves_where_few_are_repeated():
    X = torch.cat([TEST, TEST[:1]])
    Y = f_p(X) + 0.1 * torch.rand(6, 1, dtype=torch.float64)
    assert not CKA(X, Y, physics=f_p).has_repeats


def test_a_saved_model_has_its_rows(tmp_path):
    X, Y = data()
    model = CKA(X, Y, physics=f_p)
    fit(model, "map", num_starts=1, num_screened=4)
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=f_p)
    assert again.has_repeats
    assert torch.equal(again.data()["train_X"], X)
    assert torch.allclose(again.predict(TEST).mean, model.predict(TEST).mean)


def warned(X, Y):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        CKA(X, Y, physics=f_p)
    return [str(each.message) for each in found if "to the last bit" in str(each.message)]


def test_the_same_row_twice_is_told_from_a_true_repeat():
    X, Y = data()
    assert not warned(X, Y)
    (text,) = warned(torch.cat([X, X[:3]]), torch.cat([Y, Y[:3]]))
    assert "3 of 33 rows" in text
    assert "drop_duplicates" in text
    rounded = (1000 * Y).round() / 1000  # finer than the noise
    assert warned(torch.cat([X, X[:9]]), torch.cat([rounded, rounded[:9]]))


@pytest.mark.parametrize(
    "coarse",
    [
        pytest.param(lambda Y: (5 * Y).round() / 5, id="one digit"),
        pytest.param(lambda Y: (Y / 0.15625).round() * 0.15625, id="counts of a converter"),
        pytest.param(lambda Y: (10 * Y).round(), id="whole numbers"),
        pytest.param(torch.zeros_like, id="a constant"),
    ],
)
def test_equal_outputs_on_a_coarse_grid_are_expected(coarse):
    X, Y = data()
    found = coarse(Y)
    assert len(torch.cat([X, found], dim=-1).unique(dim=0)) < 30
    assert not warned(X, found)
