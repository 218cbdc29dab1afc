"""`compare`: its numbers, its rankings, what it recommends and says about the physics."""

import math
import re
import sys
import warnings
from functools import partial

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import PhysicsWarning
from gpadjust.core import CKA, FitResult, PhysicsMeanGP, StackedGP, ZeroMeanGP, load, save
from gpadjust.core.data import Data
from gpadjust.kinds import Categories
from gpadjust.kinds.heavy_tails import HeavyTails
from gpadjust.kinds.links import Linked
from gpadjust.physics import FunctionPhysics, Unknown, as_physics
from gpadjust.validation import STRUCTURES, Structure, compare, leave_one_out
from gpadjust.validation.comparison import candidates_of, checked_structures, physics_by_name
from gpadjust.validation.faults import Fault
from gpadjust.validation.leave_one_out import _with_noise, left_out_by_physics
from gpadjust.validation.verdict import (
    AS_IS,
    CORRECTED,
    FAULTY,
    NOT,
    OPEN,
    Evidence,
    _at,
    straight_line,
    unsampled,
    verdict_on,
)
from tests.systems import line, normal


def crude(X):
    return 5 * (20 * X[..., :1]).sin()


@pytest.fixture(scope="module")
def noise():
    return 0.03 * normal(8, 1)


@pytest.fixture(scope="module")
def X():
    return line(8)


@pytest.fixture(scope="module")
def scaled(X, noise):
    """Data of a scaled physics, on which CKA is clearly best."""
    return X, 3 * crude(X) + X + noise


@pytest.fixture(scope="module")
def comparison(scaled):
    return compare(*scaled, crude, structures=["zero mean", "physics mean", "CKA"])


def row(comparison, name, output="y"):
    return next(row for row in comparison.table[output] if row.structure == name)


def test_the_best_structure_is_recommended_where_it_is_clear(comparison):
    *rows, alone = comparison.table["y"]
    elpd = [row.elpd for row in rows]
    assert elpd == sorted(elpd, reverse=True)
    assert rows[0][:4] == ("CKA", elpd[0], 0.0, 0.0)
    assert comparison.chosen == "CKA"
    assert comparison.recommended is comparison.models["CKA"]
    assert sum(row.weight for row in rows) == pytest.approx(1)
    assert rows[0].weight > 0.95
    for other in rows[1:]:
        assert other.elpd_diff == pytest.approx(other.elpd - elpd[0])
        assert other.se_diff > 0
    errors = comparison.errors()["y"]
    assert [*errors] == ["physics alone", "adjusted", "data alone"]
    assert errors["adjusted"] == comparison.leave_one_out().score().rmse.item()
    assert errors["data alone"] == comparison.left_out["zero mean"].score().rmse.item()
    lines = str(comparison).splitlines()
    first, *others = errors.items()
    words = [f"{first[0]}: RMSE {first[1]:.3g}"]
    words += [f"{name}, left out: RMSE {rmse:.3g}" for name, rmse in others]
    assert lines[:2] == ["; ".join(words), ""]
    assert lines[2].split()[:2] == ["y", "elpd"]
    names = [row.structure for row in (*rows, alone)]
    assert [line.split("  ")[0] for line in lines[3:7]] == names
    assert len({len(line) for line in lines[2:7]}) == 1
    alone = compare(*comparison.stacked.data[:2], crude, structures=["CKA"])
    assert alone.verdict == {}  # there is no structure without it


@pytest.mark.slow
def test_each_output_is_judged_by_itself(X, scaled, noise):
    Y = torch.cat([scaled[1], 100 * (3 * X).cos() + noise], -1)
    Y[3, 1] = torch.nan

    def physics(X):
        return torch.cat([crude(X), (1e4 * X).sin()], -1)

    comparison = compare(X, Y, physics, structures=["zero mean", "CKA"])
    assert comparison.table["y1"][0].structure == "CKA"
    assert "\ny1: Use " in str(comparison)
    assert comparison.verdict["y2"].answer in ("Do not use it", "These data do not tell")
    for name, weights in comparison.stacked.weights.items():
        assert weights == [row(comparison, name, output).weight for output in ("y1", "y2")]
    assert comparison.stacked.predict(X).mean[:, 0].sub(Y[:, 0]).abs().max() < 1
    assert str(comparison).count("its error") == 2


def test_the_tables_are_of_the_left_out_predictions(comparison, scaled):
    X, Y = scaled
    for candidate in comparison.table["y"]:
        loo = comparison.left_out[candidate.structure]
        assert loo.log_density.sum().item() == pytest.approx(candidate.elpd)
        assert loo.score().coverage.item() == pytest.approx(candidate.coverage)
        assert loo.score().rmse.item() == pytest.approx(candidate.error)
        assert math.isnan(candidate.weight) == (candidate.structure == "physics alone")
        assert math.isnan(candidate.log_evidence) == (candidate.structure == "physics alone")
        assert math.isnan(candidate.of_use) == (candidate.structure != "CKA")
    expected = leave_one_out(comparison.recommended)
    torch.testing.assert_close(comparison.leave_one_out().log_density, expected.log_density)
    best, *_, alone = comparison.table["y"]
    assert alone.structure == "physics alone"
    assert "physics alone" not in {*comparison.models, *comparison.stacked.weights}
    rmse = (Y - crude(X)).square().mean().sqrt().item()
    assert comparison.errors()["y"]["physics alone"] == pytest.approx(rmse)
    assert alone.rmse == pytest.approx(rmse / Y.std().item())
    assert alone.elpd_diff == pytest.approx(alone.elpd - best.elpd)


def of_physics(physics, X, Y, Yvar=None):
    return left_out_by_physics(as_physics(physics), Data.read(X, Y, Yvar, None))


class TestPhysicsAlone:
    @pytest.mark.parametrize("is_relative", [False, True])
    def test_its_densities_are_those_of_an_unknown_variance(self, X, noise, is_relative):
        f = crude(X) + 3
        sizes = f.abs() if is_relative else torch.ones_like(f)
        Y = f + sizes * noise
        Y[3, 0] = torch.nan
        variance, log_density = _with_noise(Y, f, sizes, torch.zeros(1).double())
        rest = [i for i in range(8) if i not in (3, 5)]
        errors = ((Y - f) / sizes)[:, 0]
        scales = torch.linspace(-8, 2, 4001, dtype=torch.float64).exp()  # even in their logarithm
        weight = torch.distributions.Normal(0.0, scales).log_prob(errors[rest, None]).sum(0)
        weight = weight.softmax(0)
        density = torch.distributions.Normal(0.0, scales * sizes[5]).log_prob((Y - f)[5]).exp()
        torch.testing.assert_close(log_density[5, 0].exp(), weight @ density)
        torch.testing.assert_close(variance[5, 0], weight @ (scales * sizes[5]).square())
        assert log_density[3, 0].isnan()

    def test_its_noise_is_relative_where_that_predicts_better(self, X, noise):
        f = (4 * X).exp()
        Y = torch.cat([f + 0.2 * noise, f * (1 + 0.2 * noise)], -1)
        loo = of_physics(lambda X: (4 * X).exp().expand(-1, 2), X, Y)
        spread = loo.variance.amax(0) / loo.variance.amin(0)
        assert spread[0] < 10 < 1000 < spread[1]

    def test_an_exact_physics_of_any_number_of_points(self, X):
        for n in (2, 3, 8):
            loo = of_physics(crude, X[:n], crude(X[:n]))
            assert loo.log_density.isfinite().all()
            assert loo.score().coverage.item() == 1
            assert not loo.variance.isnan().any()

    def test_known_variances_are_its_noise(self, X, noise):
        loo = of_physics(crude, X, crude(X) + noise, 0.04)
        expected = torch.distributions.Normal(crude(X), 0.2).log_prob(crude(X) + noise)
        torch.testing.assert_close(loo.log_density, expected)


def test_warnings_come_once_and_those_of_the_seed_as_advice(scaled):
    X, Y = (torch.cat([each, each[:1]]) for each in scaled)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        compare(X, Y, crude, 1e-3, structures=["zero mean", "physics mean"])
    assert [str(each.message)[:14] for each in caught] == ["1 of 9 rows eq"]
    zero = compare(*scaled, crude, structures=["zero mean"])
    assert [*zero.errors()["y"]] == ["physics alone", "data alone"]  # none that adjusts
    rows = zero.table
    (text,) = unsampled(rows, {"zero mean": FitResult("bayes", error=0.9)})
    assert text.startswith("Results of zero mean depend on the seed")
    assert unsampled(rows, {"zero mean": FitResult("bayes", error=0.1)}) == []


@pytest.mark.parametrize(("rival", "warns"), [(0.01, False), (1000.0, True)])
def test_only_a_recommended_structure_warns(scaled, rival, warns):
    """Of two structures that suppose noises, the nearer one has all weight."""

    def warning(X, Y):
        warnings.warn("look at this", UserWarning, stacklevel=2)
        return ZeroMeanGP(X, Y, 100.0**2)

    other = partial(ZeroMeanGP, train_Yvar=rival**2)
    structures = [Structure("it", warning, "data alone"), Structure("other", other, "data alone")]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = compare(*scaled, crude, structures=structures)
    assert (found.chosen == "it") == warns
    assert ("look at this" in [str(each.message) for each in caught]) == warns


@pytest.mark.parametrize("variance", [None, 0.01], ids=["fitted noise", "known noise"])
def test_units_make_no_difference(X, scaled, variance):
    options = {"structures": ["physics mean"]}
    small = compare(*scaled, crude, variance, **options)
    variance = None if variance is None else 1e6 * variance
    large = compare(X, 1000 * scaled[1], lambda X: 1000 * crude(X), variance, **options)
    small, large = row(small, "physics mean"), row(large, "physics mean")
    assert large.elpd == pytest.approx(small.elpd - len(X) * math.log(1000), abs=1e-3)
    assert large.rmse == pytest.approx(small.rmse, rel=1e-3)


def test_candidates_of_several_physics_and_of_classes():
    plain = [structure for structure in STRUCTURES if structure.kind != "calibrated physics"]
    several = physics_by_name([crude, torch.sin, lambda X: X])
    assert [*several] == ["crude", "sin", "f_3"]
    found = candidates_of(plain, several)
    names = ["crude", "sin", "f_3", "all"]
    expected = [f"{kind} of {name}" for kind in ("physics mean", "CKA") for name in names]
    assert [structure.name for structure, _ in found] == ["zero mean", *expected]
    assert [s.name for s, _ in candidates_of(STRUCTURES, physics_by_name(crude))] == [
        s.name for s in plain
    ]
    named = checked_structures(["CKA", "zero mean"])
    classes = checked_structures([partial(CKA, rho_mean=2.0), ZeroMeanGP])
    assert [s.name for s in classes] == ["CKA(rho_mean=2.0)", "ZeroMeanGP"]
    for ours, theirs in zip(classes, named, strict=True):
        assert ours._replace(name=theirs.name, model=theirs.model) == theirs


GOOD = Evidence(
    name="drag [N]", number=20, of_use=0.99, gain=9.0, se=2.0, alone=0.5, line=0.5, adjusted=0.1,
    data=0.3, factor=1.0, offset=0.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "answer", "words"),
    [
        ({}, CORRECTED, "Errors fall from 0.5 N to 0.1 N; largest"),
        ({"data": 0.1}, CORRECTED, "the data alone do as well (0.1 N)"),
        ({"alone": math.nan, "line": math.nan}, CORRECTED, "The error is 0.1 N, of the"),
        ({"alone": 0.1, "line": 0.1}, AS_IS, "Its error is 0.1 N, corrected"),
        (
            {"alone": 0.1, "line": 0.1, "is_surpassed": True},
            CORRECTED,
            "0.1 N, as it is 0.1 N, but most observations are predicted better",
        ),
        ({"alone": 4.0, "line": 0.4}, OPEN, "By itself your formula is off by 4"),
        ({"correction_needed": 0.4}, AS_IS, "Its error is 0.5 N"),
        ({"correction_needed": 0.4, "is_surpassed": True}, CORRECTED, "from 0.5 N to 0.1"),
        ({"line": 0.1, "factor": 2.0}, AS_IS, "Take 2 times your formula: "),
        ({"line": 0.1, "factor": 2.0, "offset": -3.0}, AS_IS, "less 3 N: "),
        ({"of_use": 0.01, "gain": 0.5}, NOT, "Without it the error is 0.3 N, with it"),
        ({"of_use": 0.01}, OPEN, "Without it"),  # they contradict one another
        ({"of_use": 0.9, "gain": 0.5}, OPEN, "would tell, the first one here"),
        ({"gain": -9.0}, OPEN, "Without it"),
        ({"adjusted": 0.4}, OPEN, "Without it the error is 0.3 N, with it 0.4"),
        ({"number": 7}, OPEN, "at least 8 observations"),
        ({"factor": 0.0}, OPEN, "the same value at all observations"),
        ({"fault": Fault("it is off", "by 2")}, f"{FAULTY}: it is off", "By 2 Correct it and run"),
        ({"of_use": math.nan}, CORRECTED, "Errors fall"),  # by left-out observations alone
        ({"of_use": math.nan, "gain": 0.9, "se": 0.1}, OPEN, "Without it"),
        ({"of_use": math.nan, "gain": -9.0}, NOT, "Without it the error is 0.3 N"),
    ],
)
def test_a_verdict_by_its_evidence(changes, answer, words):
    verdict = verdict_on(GOOD._replace(**changes), "largest +12 %", "here")
    assert verdict.answer == answer
    text = " ".join(verdict.reasons)
    assert words in text
    assert "nats" not in text
    line = changes.get("factor") or 1, changes.get("offset", 0)
    assert (verdict.factor, verdict.offset) == line


def test_the_straight_line_and_its_error_of_left_out_points(X, noise):
    f, y = crude(X)[:, 0], (2 * crude(X) - 1 + noise)[:, 0]
    factor, offset, error = straight_line(y, f)
    off = []
    for i in range(8):
        rest = torch.arange(8) != i
        a, b, _ = straight_line(y[rest], f[rest])
        off.append(y[i] - a * f[i] - b)
    assert (factor, offset) == (pytest.approx(2, abs=0.02), pytest.approx(-1, abs=0.05))
    assert error == pytest.approx(torch.stack(off).square().mean().sqrt().item())
    assert straight_line(y, torch.full_like(f, 300.0))[:2] == (0.0, pytest.approx(y.mean().item()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "physics", "n", "answer"),
    [
        (lambda X: (3 * X).sin(), lambda X: 3 * (40 * X).sin(), 120, "Do not use it"),
        (lambda X: (3 * X).sin(), lambda X: 0 * X + 0.2, 40, "These data do not tell"),
        (lambda X: 300 + 3 * (5 * X).sin(), lambda X: 0 * X + 300, 12, "These data do not tell"),
        (lambda X: (6 * X).sin(), lambda X: (6 * X).sin(), 40, "Use your formula as it is"),
        (lambda X: 2 * (6 * X).sin() + 1, lambda X: (6 * X).sin(), 40, "Use your formula as it is"),
        (lambda X: (1 + X) * (6 * X).sin(), lambda X: (6 * X).sin(), 40, "Use it corrected"),
    ],
    ids=["useless", "constant", "300", "right", "up to a factor", "corrected"],
)
def test_each_answer_is_given(truth, physics, n, answer):
    generator = torch.Generator().manual_seed(5)
    X, e = (torch.rand(n, 2, generator=generator, dtype=torch.float64)).unsqueeze(-1).unbind(1)
    Y = truth(X) + 0.05 * (e - 0.5) * 12**0.5
    assert compare(X, Y, physics).verdict["y"].answer == answer


def test_a_formula_that_is_off_by_a_factor_is_never_used():
    X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
    noise = 0.02 * torch.randn(12, 1, generator=torch.Generator().manual_seed(0)).double()
    law = FunctionPhysics(
        lambda X, p: (2 + (6 * X).sin()) * p.a.unsqueeze(-1), unknowns={"a": Unknown(1.0, sd=0.2)}
    )
    with pytest.warns(PhysicsWarning, match="times too small; are its units those") as caught:
        comparison = compare(X, 1000 * (2 + (6 * X).sin() + noise), law)
    assert [warning.filename for warning in caught] == [__file__]  # once
    assert re.fullmatch(
        r"Correct your formula: it is about [\d,]+ times too small", comparison.verdict["y"].answer
    )
    assert comparison.verdict["y"].reasons[0].startswith("At the data your formula has a root mean")
    assert "times too small" in comparison.verdict["y"].reasons[0]


@pytest.mark.slow
def test_one_physics_of_no_use_does_not_hide_another(X, noise):
    parts = {"good": crude, "unrelated": lambda X: (23 * X + 1).cos()}
    comparison = compare(X, 2 * crude(X) + X + noise, parts)
    assert comparison.verdict["y"].answer == "Use it corrected"


def test_what_makes_a_model_is_a_structure(scaled):
    own = Structure("mine", lambda *data, **options: CKA(*data, rho_mean=3.0, **options))
    made = ["zero mean", partial(CKA, rho_mean=3.0), PhysicsMeanGP, own]
    comparison = compare(*scaled, crude, structures=made)
    assert [*comparison.models] == ["zero mean", "CKA(rho_mean=3.0)", "PhysicsMeanGP", "mine"]
    for name in ("CKA(rho_mean=3.0)", "mine"):
        assert comparison.models[name].terms[0].mean == 3.0
    assert comparison.verdict["y"].answer in ("Use it corrected", "Use your formula as it is")
    alone = compare(*scaled, crude, 1e-3, structures=own)
    assert alone.chosen == "mine"
    assert alone.recommended is alone.models["mine"]


def test_two_points():
    X = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    comparison = compare(X, X.exp(), crude)
    assert comparison.recommended.predict(X).mean.isfinite().all()
    assert comparison.verdict["y"].answer == OPEN


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


def test_a_mixture_in_a_file(X, tmp_path):
    Y = torch.cat([X.sin(), X.cos()], -1)
    models = {"a": CKA(X, Y, physics=lambda X: X.expand(-1, 2)), "b": ZeroMeanGP(X, Y)}
    stacked = StackedGP(models, [[0.25, 1.0], [0.75, 0.0]], 8)
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
    assert comparison.verdict["y"].answer == "Use it corrected"


def test_an_impossible_observation_counts_finitely(scaled):
    loo = leave_one_out(ZeroMeanGP(*scaled))
    loo.log_density[2] = -torch.inf
    assert loo.densities_of(0).isfinite().all()


def test_as_a_frame(comparison, monkeypatch):
    table = comparison.to_dataframe()
    rows = comparison.table["y"]
    assert [*table["structure"]] == [row.structure for row in rows]
    assert {*table["output"]} == {"y"}
    assert table["elpd"].tolist() == [row.elpd for row in rows]
    assert table["weight"].isna().tolist() == [n == "physics alone" for n in table["structure"]]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        comparison.to_dataframe()


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
    assert compare(X, Y, lambda X: 5 * X.sin()).verdict["y"].answer == "These data do not tell"


def test_the_next_point_has_names_of_categories():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"x": [0.0, 1.0] * 3, "metal": ["brass", "iron", "zinc"] * 2})
    Y = torch.arange(6.0).double().unsqueeze(-1)
    first = CKA(frame, Y, physics=lambda X: X[:, :1], input_transform=Categories(["metal"]))
    assert _at(first, torch.tensor([0.5, 2.0])) == " at x = 0.5 and metal = zinc"
