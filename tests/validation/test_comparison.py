"""`compare`: its numbers, its ranking, and what it says about the physics."""

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import CKA, compare
from gpadjust.inference.objective import Objective
from gpadjust.validation import STRUCTURES, Structure, leave_one_out

QUICK = {"num_starts": 2, "num_screened": 32}
THREE = ["zero mean", "physics mean", "CKA"]


def crude(X):
    return 2 + (7 * X[..., :1]).sin()


@pytest.fixture
def noise():
    return 0.03 * torch.randn(14, 1, dtype=torch.float64)


@pytest.fixture
def X():
    return torch.linspace(0, 1, 14, dtype=torch.float64).unsqueeze(-1)


@pytest.fixture
def scaled(X, noise):
    """Data of a scaled physics, on which CKA is clearly best."""
    return X, (1 + 2 * X) * crude(X) + X + noise


def row(comparison, name):
    return next(row for row in comparison.table if row.structure == name)


def says(comparison, words):
    return any(words in sentence for sentence in comparison.advice)


@pytest.mark.parametrize("num_outputs", [1, 2])
def test_numbers(X, scaled, noise, num_outputs):
    Y = torch.cat([scaled[1], 100 * crude(X) + 40 * X.square() + 9 * noise], -1)[:, :num_outputs]

    def physics(X):
        return torch.cat([crude(X), 100 * crude(X)], -1)[..., :num_outputs]

    names = [*THREE, "CKA centred, learnt rho mean"]
    comparison = compare(X, Y, physics, structures=names, **QUICK)
    assert set(comparison.models) == {row.structure for row in comparison.table} == set(names)
    for name, model in comparison.models.items():
        number = row(comparison, name)
        loo = leave_one_out(model)
        n = Y.numel()
        assert number.log_predictive == pytest.approx(-loo.nlpd.mean().item() * n)
        relative = (loo.mean - Y).square().mean(0).sqrt() / Y.std(0)
        assert number.rmse == pytest.approx(relative.mean().item())
        inside = (loo.mean - Y).abs() <= 1.9599639845 * loo.variance.sqrt()
        assert number.coverage == pytest.approx(inside.double().mean().item())
        if "learnt" in name:
            continue  # its unknown mean is profiled out of the likelihood
        prior = model.likelihood(model.forward(model.train_inputs[0]))
        # log p(y) of y = scale * target.
        log_scale = model.outcome_transform.stdvs.log().sum().item()
        expected = prior.log_prob(model.train_targets).sum().item() - len(X) * log_scale
        assert number.evidence == pytest.approx(expected, rel=1e-6, abs=1e-4)
    assert row(comparison, "zero mean").num_parameters == 3 * num_outputs
    assert row(comparison, "CKA").num_parameters == 5 * num_outputs
    assert row(comparison, "CKA centred, learnt rho mean").num_parameters == 6 * num_outputs


@pytest.mark.parametrize(
    ("criterion", "field"), [("leave-one-out", "log_predictive"), ("evidence", "evidence")]
)
def test_ranking(scaled, criterion, field):
    comparison = compare(*scaled, crude, structures=THREE, criterion=criterion, **QUICK)
    values = [getattr(row, field) for row in comparison.table]
    assert values == sorted(values, reverse=True)
    assert comparison.criterion == criterion
    assert comparison.chosen == comparison.table[0].structure == "CKA"
    assert comparison.best is comparison.models["CKA"]
    assert comparison.advice[0] == "Best: CKA."
    assert not says(comparison, "no better")
    lines = str(comparison).splitlines()
    assert lines[0].split()[:2] == ["structure", "evidence"]
    ranked = [row.structure for row in comparison.table]
    assert [line.split("  ")[0] for line in lines[1:4]] == ranked
    assert len({len(line) for line in lines[:4]}) == 1


def test_evidence_is_in_the_users_units(scaled):
    X, Y = scaled
    small = compare(X, Y, crude, structures=THREE, **QUICK)
    large = compare(X, 1000 * Y, lambda X: 1000 * crude(X), structures=THREE, **QUICK)
    known = compare(X, Y, crude, torch.full_like(Y, 1e-3), structures=["CKA"], **QUICK)
    assert known.table[0].num_parameters == row(small, "CKA").num_parameters - 1
    shift = len(X) * torch.tensor(1000.0).log().item()
    for name in THREE:
        assert row(large, name).evidence == pytest.approx(
            row(small, name).evidence - shift, abs=0.1
        )


@pytest.mark.slow
def test_all_structures_by_default(scaled):
    comparison = compare(*scaled, crude, **QUICK)
    assert set(comparison.models) == {structure.name for structure in STRUCTURES}
    assert not says(comparison, "does not help")


class TestAdvice:
    def test_few_observations(self, X):
        comparison = compare(X[:5], X[:5].exp(), crude, structures=THREE, **QUICK)
        assert says(comparison, "observations are few")
        comparison = compare(X[:2], X[:2].exp(), crude, **QUICK)
        assert "constant rho" not in comparison.models

    @pytest.mark.parametrize("criterion", ["leave-one-out", "evidence"])
    def test_a_physics_that_does_not_help(self, X, noise, criterion):
        for physics in (lambda X: (1e4 * X).sin(), lambda X: 0 * X):
            options = {"structures": THREE, "criterion": criterion, **QUICK}
            comparison = compare(X, X.exp().sin() + noise, physics, **options)
            assert says(comparison, "physics does not help")

    def test_rra_is_not_chosen_where_cka_is_at_hand(self, scaled):
        comparison = compare(*scaled, crude, structures=["RRA", "CKA"], **QUICK)
        assert comparison.chosen == "CKA"
        assert comparison.best is comparison.models["CKA"]
        alone = compare(*scaled, crude, structures=["RRA"], **QUICK)
        assert alone.chosen == "RRA"

    def test_a_smooth_bias(self, X, noise):
        def rough(X):
            return 5 * (20 * X).sin()

        comparison = compare(X, rough(X) + X.exp() + noise, rough, structures=THREE, **QUICK)
        assert says(comparison, "no better than the physics mean")
        assert not says(comparison, "does not help")


class Wave(torch.nn.Module):
    """The physics of inputs in other units, with a rate to be learnt."""

    def __init__(self):
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor(6.5, dtype=torch.float64))

    def forward(self, X):
        return 2 + (self.rate * (X - 100) / 50).sin()


class TestEachModelHasItsOwn:
    def test_physics_and_input_transform(self, scaled):
        X, Y = 100 + 50 * scaled[0], scaled[1]
        wave, names = Wave(), [*THREE, "constant rho"]
        comparison = compare(X, Y, wave, structures=names, input_transform=Normalize(1), **QUICK)
        assert wave.rate.item() == 6.5
        models = [model for name, model in comparison.models.items() if name != "zero mean"]
        assert len({model.physics.function.rate.item() for model in models}) == len(models)
        assert comparison.best is comparison.models[comparison.chosen]
        for name, model in comparison.models.items():
            number, loo = row(comparison, name), leave_one_out(model)
            assert number.log_predictive == pytest.approx(-loo.nlpd.item() * len(X), rel=1e-9)
            assert number.rmse == pytest.approx((loo.rmse / Y.std(0)).item(), rel=1e-9)
            # As good as on the data: a model whose physics moved after its fit would be off.
            error = (model.predict(X).mean - Y).square().mean().sqrt() / Y.std()
            assert error <= number.rmse
            assert number.evidence == pytest.approx(evidence_of(model), rel=1e-6, abs=1e-4)

    def test_a_structure_of_the_users(self, scaled):
        own = Structure("mine", lambda *data, **options: CKA(*data, rho_mean=2.0, **options))
        comparison = compare(*scaled, crude, structures=["zero mean", own], **QUICK)
        assert comparison.chosen == "mine"
        assert comparison.best.term_mean("rho") == 2.0


def evidence_of(model):
    """The log marginal likelihood, with unknown means as the fit left them, in the users' units."""
    value = -Objective(model)(Objective(model).parameters.current()).sum().item()
    model.eval()
    return value - model.train_targets.shape[-1] * model.outcome_transform.stdvs.log().sum().item()


def test_missing_targets(X, scaled, noise):
    Y = torch.cat([scaled[1], 3 * crude(X) + X.square() + noise], dim=-1)
    Y[2:5, 1] = torch.nan
    seen = ~Y[:, 1].isnan()
    both = compare(X, Y, lambda X: crude(X).expand(-1, 2), structures=THREE)
    first = compare(X, Y[:, :1], crude, structures=THREE)
    second = compare(X[seen], Y[seen][:, 1:], crude, structures=THREE)
    for name in THREE:
        alone = [row(each, name) for each in (first, second)]
        for field in ("evidence", "log_predictive"):
            expected = sum(getattr(each, field) for each in alone)
            assert getattr(row(both, name), field) == pytest.approx(expected, abs=0.1)


def test_several_physics_each_alone_and_all(X, noise):
    physics = {"wave": crude, "line": lambda X: 5 * X}
    Y = torch.where(X < 0.5, crude(X), 5 * X) + noise
    comparison = compare(X, Y, physics, structures=[*THREE, "constant rho"], **QUICK)
    kinds = ("physics mean", "CKA", "constant rho")
    names = {f"{kind} of {name}" for kind in kinds for name in ("wave", "line", "all")}
    assert set(comparison.models) == {"zero mean", *names}
    for name, model in comparison.models.items():
        loo = leave_one_out(model)
        assert row(comparison, name).log_predictive == pytest.approx(-loo.nlpd.item() * 14)
    assert "CKA of all" in str(comparison)


def test_bad_input(scaled):
    X, Y = scaled
    for data, options, says in (
        ((X, Y), {"structures": []}, "structures"),
        ((X, Y), {"structures": ["CKA", "kriging"]}, "structures"),
        ((X, Y), {"criterion": "BIC"}, "leave-one-out"),
        ((X.expand(2, -1, -1), Y.expand(2, -1, -1)), {}, "one data set"),
        ((X, Y[:5]), {}, "train_Y"),
        *(((X, Y), {n: -1}, f"Expected {n}") for n in ("num_starts", "num_screened", "seed")),
    ):
        with pytest.raises(ValueError, match=says):
            compare(*data, crude, **{"structures": ["CKA"], **options})
