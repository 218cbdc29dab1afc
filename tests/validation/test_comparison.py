"""`compare`: its numbers, its rankings, what it recommends and says about the physics."""

import math
import sys
import warnings
from functools import partial

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import PhysicsWarning
from gpadjust.core import CKA, FitResult, PhysicsMeanGP, StackedGP, ZeroMeanGP, load, save
from gpadjust.core.data import Data
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.links import Linked
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.validation import STRUCTURES, Gain, Structure, compare, leave_one_out
from gpadjust.validation.comparison import (
    _by_name,
    _candidates,
    _densities,
    _known,
    _physics_alone,
)
from gpadjust.validation.verdict import Candidate, advice, gain_of, unsampled


def rows_of(names, of_use):
    """Candidates by their names, of which nothing else is asked than a probability."""
    return [
        Candidate(
            name,
            *[math.nan] * 8,
            of_use.get(name, math.nan),
            "data alone" if name == "zero mean" else "adjusted",
        )
        for name in names
    ]


def crude(X):
    return 5 * (20 * X[..., :1]).sin()


@pytest.fixture
def noise():
    return 0.03 * torch.randn(8, 1, dtype=torch.float64)


@pytest.fixture
def X():
    return torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)


@pytest.fixture
def scaled(X, noise):
    """Data of a scaled physics, on which CKA is clearly best."""
    return X, 3 * crude(X) + X + noise


def row(comparison, name, output="y"):
    return next(row for row in comparison.table[output] if row.structure == name)


def says(comparison, words):
    return words in str(comparison)


def test_the_best_structure_is_recommended_where_it_is_clear(scaled):
    comparison = compare(*scaled, crude, structures=["physics mean", "CKA"])
    *rows, alone = comparison.table["y"]
    assert alone.structure == "physics alone"
    elpd = [row.elpd for row in rows]
    assert elpd == sorted(elpd, reverse=True)
    assert rows[0][:4] == ("CKA", elpd[0], 0.0, 0.0)
    assert comparison.chosen == "CKA"
    assert comparison.recommended is comparison.models["CKA"]
    assert sum(row.weight for row in rows) == pytest.approx(1)
    assert rows[0].weight > 0.95
    for each in rows[1:]:
        assert each.elpd_diff == pytest.approx(each.elpd - elpd[0])
        assert each.se_diff > 0
    assert comparison.advice[1].startswith("Scaling the physics helps: elpd +")
    lines = str(comparison).splitlines()
    errors = comparison.errors()["y"]
    assert [*errors] == ["physics alone", "adjusted"]
    told = f"RMSE {errors['physics alone']:.3g}; adjusted, left out: RMSE {errors['adjusted']:.3g}"
    assert lines[:2] == [f"physics alone: {told}", ""]
    assert lines[2].split()[:2] == ["y", "elpd"]
    names = [*(row.structure for row in rows), "physics alone"]
    assert [line.split("  ")[0] for line in lines[3:6]] == names
    assert len({len(line) for line in lines[2:6]}) == 1


@pytest.mark.slow
def test_each_output_is_judged_by_itself(X, scaled, noise):
    Y = torch.cat([scaled[1], 100 * (3 * X).cos() + noise], -1)
    Y[3, 1] = torch.nan

    def physics(X):
        return torch.cat([crude(X), (1e4 * X).sin()], -1)

    comparison = compare(X, Y, physics, structures=["zero mean", "CKA"])
    assert comparison.table["y1"][0].structure == "CKA"
    assert says(comparison, "The physics helps to predict y1: elpd")
    assert comparison.gain["y2"].answer in ("No", "Not shown")
    assert not says(comparison, "The physics helps to predict y2")
    assert not says(comparison, "y2: Scaling the physics")
    stacked = comparison.stacked
    assert isinstance(stacked, StackedGP)
    for name, weights in stacked.weights.items():
        assert weights == [row(comparison, name, output).weight for output in ("y1", "y2")]
    assert stacked.predict(X).mean[:, 0].sub(Y[:, 0]).abs().max() < 1
    assert str(comparison).count("its error") == 2


def test_what_is_left_out_is_what_the_tables_tell_of(scaled, noise):
    X, Y = scaled
    structures = ["zero mean", "physics mean", "CKA"]
    comparison = compare(X, Y + noise, crude, structures=structures)
    rows = comparison.table["y"]
    for each in rows:
        loo = comparison.left_out[each.structure]
        assert loo.log_density.sum().item() == pytest.approx(each.elpd)
        assert loo.score().coverage.item() == pytest.approx(each.coverage)
        assert loo.score().rmse.item() == pytest.approx(each.error)
        assert math.isnan(each.weight) == (each.structure == "physics alone")
        assert math.isnan(each.log_evidence) == (each.structure == "physics alone")
        assert math.isnan(each.of_use) == (each.structure != "CKA")
    gain = comparison.gain["y"]
    elpd = {each.structure: each.elpd for each in rows}
    assert gain.elpd == pytest.approx(elpd[gain.structure] - elpd["zero mean"])
    whole = leave_one_out(comparison.recommended)
    torch.testing.assert_close(comparison.leave_one_out().log_density, whole.log_density)


class TestPhysicsAlone:
    def test_its_errors_are_those_of_f_p_and_it_has_no_weight(self, scaled, noise):
        X, Y = scaled
        comparison = compare(X, Y + noise, crude, structures=["zero mean", "CKA"])
        best, _, alone = comparison.table["y"]
        assert alone.structure == "physics alone"
        assert "physics alone" not in {*comparison.models, *comparison.stacked.weights}
        rmse = (Y + noise - crude(X)).square().mean().sqrt().item()
        errors = comparison.errors()["y"]
        assert errors["physics alone"] == pytest.approx(rmse)
        assert alone.rmse == pytest.approx(rmse / (Y + noise).std().item())
        assert errors["adjusted"] == comparison.leave_one_out().score().rmse.item()
        assert errors["data alone"] == comparison.left_out["zero mean"].score().rmse.item()
        assert alone.elpd_diff == pytest.approx(alone.elpd - best.elpd)
        assert math.isnan(alone.weight)

    def test_its_densities_are_those_of_an_unknown_variance(self, X, noise):
        Y = torch.cat([crude(X) + noise, 2 * crude(X)], -1)
        Y[3, 0] = torch.nan
        data = Data.of(X, Y, None, None)
        (loo,) = _physics_alone(_by_name(lambda X: crude(X).expand(-1, 2)), data).values()
        rest = [i for i in range(8) if i not in (3, 5)]
        errors = (Y - crude(X))[:, 0]
        scales = torch.linspace(-8, 2, 4001, dtype=torch.float64).exp()  # even in their logarithm
        weight = torch.distributions.Normal(0.0, scales).log_prob(errors[rest, None]).sum(0)
        weight = weight.softmax(0)
        density = torch.distributions.Normal(0.0, scales).log_prob(errors[5]).exp()
        torch.testing.assert_close(loo.log_density[5, 0].exp(), weight @ density)
        torch.testing.assert_close(loo.variance[5, 0], weight @ scales.square())
        assert loo.log_density[3, 0].isnan()
        assert loo.log_density[:, 1].isfinite().all()

    def test_an_exact_physics_of_any_number_of_points(self, X):
        for n in (2, 3, 8):
            data = Data.of(X[:n], crude(X[:n]), None, None)
            (loo,) = _physics_alone(_by_name(crude), data).values()
            assert loo.log_density.isfinite().all()
            assert loo.score().coverage.item() == 1
            assert not loo.variance.isnan().any()

    def test_known_variances_are_its_noise(self, X, noise):
        data = Data.of(X, crude(X) + noise, 0.04, None)
        (loo,) = _physics_alone(_by_name(crude), data).values()
        expected = torch.distributions.Normal(crude(X), 0.2).log_prob(crude(X) + noise)
        torch.testing.assert_close(loo.log_density, expected)

    def test_each_of_several_and_none_of_unknown_parameters(self, X):
        unknown = FunctionPhysics(lambda X, p: p.a * X[:, 0], unknowns={"a": Unknown(1.0, sd=1.0)})
        physics = _by_name({"wave": crude, "line": lambda X: X, "slope": unknown})
        found = _physics_alone(physics, Data.of(X, crude(X), None, None))
        assert [*found] == ["physics alone of wave", "physics alone of line"]
        torch.testing.assert_close(found["physics alone of line"].mean, X)

    def test_without_a_structure_that_adjusts_there_is_no_such_error(self, scaled):
        comparison = compare(*scaled, crude, structures=["zero mean"])
        assert [*comparison.errors()["y"]] == ["physics alone", "data alone"]

    def test_a_physics_that_is_off_is_said_to_be_once(self, scaled):
        X, Y = scaled
        with pytest.warns(PhysicsWarning, match="about 330 times too large") as caught:
            compare(X, Y, lambda X: 1000 * crude(X), structures=["zero mean", "physics mean"])
        assert [each.filename for each in caught] == [__file__]


def test_warnings_come_once_and_those_of_the_seed_as_advice(scaled):
    X, Y = (torch.cat([each, each[:1]]) for each in scaled)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        compare(X, Y, crude, 1e-3, structures=["zero mean", "physics mean"])
    assert [str(each.message)[:14] for each in caught] == ["1 of 9 rows eq"]
    rows = compare(*scaled, crude, structures=["zero mean"]).table
    (text,) = unsampled(rows, {"zero mean": FitResult("bayes", error=0.9)})
    assert text.startswith("Results of zero mean depend on the seed")
    assert unsampled(rows, {"zero mean": FitResult("bayes", error=0.1)}) == []


@pytest.mark.parametrize("variance", [None, 0.01], ids=["learnt noise", "known noise"])
def test_units_make_no_difference(X, scaled, variance):
    Y = scaled[1]
    options = {"structures": ["physics mean"]}
    small = compare(X, Y, crude, variance, **options)
    variance = None if variance is None else 1e6 * variance
    large = compare(X, 1000 * Y, lambda X: 1000 * crude(X), variance, **options)
    small, large = row(small, "physics mean"), row(large, "physics mean")
    assert large.elpd == pytest.approx(small.elpd - len(X) * math.log(1000), abs=1e-3)
    assert large.rmse == pytest.approx(small.rmse, rel=1e-3)


def test_rounding_errors_show_nothing(X):
    comparison = compare(X, crude(X), crude, structures=["physics mean", "CKA"])
    assert says(comparison, "Scaling the physics is not shown to help")


def test_candidates_of_several_physics_and_classes_are_known():
    plain = [structure for structure in STRUCTURES if structure.kind != "calibrated physics"]
    several = _by_name([crude, torch.sin, lambda X: X])
    assert [*several] == ["crude", "sin", "f_3"]
    found = _candidates(plain, several)
    names = ["crude", "sin", "f_3", "all"]
    expected = [f"{kind} of {name}" for kind in ("physics mean", "CKA") for name in names]
    assert [structure.name for structure, _ in found] == ["zero mean", *expected]
    assert [s.name for s, _ in _candidates(STRUCTURES, _by_name(crude))] == [s.name for s in plain]
    named, classes = (
        [each._replace(name="", model=None) for each in _known(given)]
        for given in (["CKA", "zero mean"], [partial(CKA, rho_mean=2.0), ZeroMeanGP])
    )
    assert named == classes


class TestAdvice:
    def test_a_physics_that_says_nothing(self, X, noise):
        names = ["zero mean", "physics mean"]
        comparison = compare(X, X.exp() + noise, lambda X: 0 * X, structures=names)
        assert says(comparison, "do not show whether the physics helps to predict y: elpd")
        assert says(comparison, "not shown to be worse")
        assert comparison.chosen == "stacked"

    def test_a_physics_that_is_worse_than_none(self):
        density = {"zero mean": 4.0, "CKA": 1.0, "physics mean": -9.0}
        values = {n: torch.tensor([v, v + 0.1] * 4).double() for n, v in density.items()}
        (sentence,) = gain_of(rows_of(density, {}), values).sentences("y")
        assert sentence.startswith("With the physics, y is predicted worse than without it: elpd -")
        assert "-24.0 +- 0.0 nats (CKA)" in sentence
        values["CKA"] = values["zero mean"] + torch.tensor([1.0, -1.0] * 4)
        finding, reason = gain_of(rows_of(density, {}), values).sentences("y")
        assert "do not show whether the physics helps to predict y: elpd +0.0" in finding
        assert "within two standard errors" in reason
        values["CKA"] = values["zero mean"] + 1
        (sentence,) = gain_of(rows_of(density, {}), values).sentences("y")
        assert sentence.startswith("The physics helps to predict y")
        assert "2.72 times as likely" in sentence  # one nat each
        _, sentence = advice(rows_of(density, {}), {"CKA"}, values, None)
        assert sentence.startswith("Scaling the physics helps")

    def test_the_physics_of_few_observations_is_neither_praised_nor_denied(self):
        for sign in (1.0, -1.0):
            better = {"zero mean": torch.zeros(8), "CKA": sign * torch.ones(8)}
            gain = gain_of(rows_of(better, {}), better)
            assert gain == Gain(8 * sign, 0.0, "CKA", "zero mean", int(sign))
            few = {name: density[:7] for name, density in better.items()}
            assert gain_of(rows_of(few, {}), few).shown == 0
            _, reason = gain_of(rows_of(few, {}), few).sentences("y")
            assert reason.startswith("Of fewer than 8 observations")
        assert gain_of(rows_of(["CKA"], {}), better) is None

    def test_the_evidence_has_its_say(self):
        for sign in (1.0, -1.0):
            better = {"zero mean": torch.zeros(8), "CKA": sign * torch.ones(8)}
            for relevance, agrees in (
                ({}, True),
                ({"CKA": 0.9}, sign > 0),
                ({"CKA": 0.1}, False),
                ({"CKA": 0.1, "RRA": 0.9}, False),  # its own is what counts
                ({"CKA of a": 0.1, "CKA of b": 0.9}, sign > 0),
            ):
                rows = rows_of(dict.fromkeys([*better, *relevance]), relevance)
                gain = gain_of(rows, better)
                assert gain.shown == (sign if agrees else 0)
                assert gain.by_evidence is not agrees
        density = {"CKA": torch.ones(8), "zero mean": torch.zeros(8)}
        gain = gain_of(rows_of(density, {"CKA": 0.1}), density)
        finding, reason = gain.sentences("y")
        assert "elpd +8.0 +- 0.0 nats (CKA)" in finding
        assert "by the evidence of a model with and without the physics" in reason

    @pytest.mark.slow
    def test_one_physics_of_no_use_does_not_hide_another(self, X, noise):
        parts = {"good": crude, "unrelated": lambda X: (23 * X + 1).cos()}
        comparison = compare(X, 2 * crude(X) + X + noise, parts)
        assert says(comparison, "is of use: 0.")
        assert comparison.gain["y"].shown == 1


def test_what_makes_a_model_is_a_structure(scaled):
    own = Structure("mine", lambda *data, **options: CKA(*data, rho_mean=3.0, **options))
    made = ["zero mean", partial(CKA, rho_mean=3.0), PhysicsMeanGP, own]
    comparison = compare(*scaled, crude, structures=made)
    assert [*comparison.models] == ["zero mean", "CKA(rho_mean=3.0)", "PhysicsMeanGP", "mine"]
    for name in ("CKA(rho_mean=3.0)", "mine"):
        assert comparison.models[name].terms[0].mean == 3.0
    assert comparison.gain["y"].answer == "Yes"
    alone = compare(*scaled, crude, 1e-3, structures=own)
    assert alone.chosen == "mine"
    assert alone.recommended is alone.models["mine"]


def test_two_points():
    X = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    comparison = compare(X, X.exp(), crude)
    assert comparison.recommended.predict(X).mean.isfinite().all()
    assert comparison.gain["y"].answer == "Not shown"


@pytest.mark.slow
def test_options_of_data_are_handed_to_all_and_a_structure_keeps_its_own(X, noise, tmp_path):
    own = partial(CKA, noise=HeavyTails(0.1))
    options = {"noise": HeavyTails(), "link": "log", "input_transform": Normalize(1)}
    comparison = compare(
        X, (2 * X.sin() + noise).exp(), lambda X: X.exp(), structures=["zero mean", own], **options
    )
    zero, cka = comparison.models.values()
    assert isinstance(zero, Linked)
    assert isinstance(cka, Linked)
    assert (zero.noise.share, cka.noise.share) == (0.02, 0.1)
    assert comparison.stacked.data.transform is not None
    assert (comparison.stacked.interval(X)[0] > 0).all()
    with pytest.warns(UserWarning, match="input_transform=..., physics=..."):
        save(comparison.stacked, tmp_path / "stacked.pt")


@pytest.mark.parametrize("weights", [[0.25, 0.75], [[0.25, 1.0], [0.75, 0.0]]])
def test_a_mixture_in_a_file(X, weights, tmp_path):
    Y = torch.cat([X.sin(), X.cos()], -1)
    models = {"a": CKA(X, Y, physics=lambda X: X.expand(-1, 2)), "b": ZeroMeanGP(X, Y)}
    stacked = StackedGP(models, weights, 8)
    with pytest.warns(UserWarning, match="a lambda"):
        saved = save(stacked, tmp_path / "stacked.pt")
    assert "physics" in saved.missing
    again = load(tmp_path / "stacked.pt", physics=lambda X: X.expand(-1, 2))
    ours, theirs = stacked.posterior(X), again.posterior(X)
    torch.testing.assert_close(theirs.mean, ours.mean)
    torch.testing.assert_close(theirs.gaussians[1], ours.gaussians[1])
    with pytest.raises(ValueError, match="physics"):
        load(tmp_path / "stacked.pt")


@pytest.mark.slow
def test_several_physics_each_alone_and_all(X, noise, tmp_path):
    physics = {"wave": crude, "line": lambda X: 5 * X}
    Y = 2 * crude(X) + 15 * X + noise
    comparison = compare(X, Y, physics, structures=["zero mean", "CKA"])
    names = {f"CKA of {name}" for name in ("wave", "line", "all")}
    assert set(comparison.models) == {"zero mean", *names}
    rows = {row.structure for row in comparison.table["y"]}
    assert rows == {"zero mean", *names, "physics alone of wave", "physics alone of line"}
    assert comparison.table["y"][0].structure in ("CKA of wave", "CKA of all")
    both = StackedGP(comparison.models, [0.25] * 4)
    with pytest.warns(UserWarning, match="a lambda"):
        save(both, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=physics)
    torch.testing.assert_close(again.predict(X).mean, both.predict(X).mean)


@pytest.mark.slow
def test_all_structures_by_default(scaled):
    comparison = compare(*scaled, crude)
    known = {structure.name for structure in STRUCTURES if structure.kind != "calibrated physics"}
    assert set(comparison.models) == known
    assert comparison.gain["y"].answer == "Yes"


def test_an_impossible_observation_counts_finitely(scaled):
    loo = leave_one_out(ZeroMeanGP(*scaled))
    loo.log_density[2] = -torch.inf
    assert _densities({"bad": loo}, 0)["bad"].isfinite().all()


def test_as_a_frame(scaled, monkeypatch):
    found = compare(*scaled, crude, structures=["physics mean", "CKA"])
    table = found.to_dataframe()
    rows = found.table["y"]
    assert [*table["structure"]] == [each.structure for each in rows]
    assert {*table["output"]} == {"y"}
    assert table["elpd"].tolist() == [each.elpd for each in rows]
    assert table["weight"].isna().tolist() == [n == "physics alone" for n in table["structure"]]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        found.to_dataframe()


def test_bad_input(scaled):
    X, Y = scaled
    for data, options, words in (
        (scaled, {"structures": []}, "structures"),
        (scaled, {"structures": ["CKA", "kriging"]}, "structures"),
        (scaled, {"structures": [3.0]}, r"or functools\.partial of one"),
        (scaled, {"structures": [Structure("stacked", CKA)]}, "none of them 'stacked'"),
        (scaled, {"structures": [Structure("mine", CKA, "best")]}, "kind"),
        (scaled, {"structures": [Structure("physics alone", CKA)]}, "or 'physics alone'; found"),
        (scaled, {"structures": "calibrated physics"}, "unknown parameters for 'calibrated phys"),
        ((X, Y[:5]), {}, "train_Y"),
    ):
        with pytest.raises(ValueError, match=words):
            compare(*data, crude, **{"structures": ["CKA"], **options})


@pytest.mark.slow
def test_a_physics_with_unknown_parameters_is_calibrated_by_each_structure():
    X = torch.linspace(0.1, 3, 12, dtype=torch.float64).unsqueeze(-1)
    unknowns = {"size": Unknown(4.0, factor=1.5), "rate": Unknown(1.5, factor=1.5)}
    law = FunctionPhysics(lambda X, p: p.size * (1 - (-p.rate * X[:, 0]).exp()), unknowns=unknowns)
    noise = 0.05 * torch.randn(12, 1, generator=torch.Generator().manual_seed(0)).double()
    Y = 5 * (1 - (-X).exp()) + noise
    comparison = compare(X, Y, law, structures=["calibrated physics", "physics mean"])
    for model in comparison.models.values():
        low, high = model.physics_parameters.interval()
        assert ((low < torch.tensor([5.0, 1.0])) & (torch.tensor([5.0, 1.0]) < high)).all()
    (rows,) = comparison.table.values()
    assert {row.structure for row in rows} == {"calibrated physics", "physics mean"}
    errors = comparison.errors()["y"]
    assert [*errors] == ["calibrated physics", "adjusted"]


@pytest.mark.slow
def test_repeated_inputs_are_no_evidence_of_the_physics():
    X = torch.tensor([[0.1], [0.5], [0.9]], dtype=torch.float64).repeat(8, 1)
    generator = torch.Generator().manual_seed(0)
    Y = torch.randn(24, 1, generator=generator, dtype=torch.float64)
    assert compare(X, Y, lambda X: 5 * X.sin()).gain["y"].shown == 0
