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


X = line(8)
NOISE = 0.03 * normal(8, 1)
SCALED = X, 3 * crude(X) + X + NOISE  # of a scaled physics, on which CKA is clearly best
DEFAULT = [structure.name for structure in STRUCTURES if structure.kind != "calibrated physics"]


@pytest.fixture(scope="module")
def comparison():
    return compare(*SCALED, crude, structures=["zero mean", "physics mean", "CKA"])


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
    # As it is printed
    lines, errors = str(comparison).splitlines(), comparison.errors()["y"].items()
    notes = ["", ", left out", ", left out"]
    words = [f"{name}{s}: RMSE {rmse:.3g}" for (name, rmse), s in zip(errors, notes, strict=True)]
    assert lines[:2] == ["; ".join(words), ""]
    assert lines[2].split()[:2] == ["y", "elpd"]
    names = [row.structure for row in (*rows, alone)]
    assert [line.split("  ")[0] for line in lines[3:7]] == names
    assert len({len(line) for line in lines[2:7]}) == 1


@pytest.mark.slow
def test_each_output_is_judged_by_itself():
    Y = torch.cat([SCALED[1], 100 * (3 * X).cos() + NOISE], -1)
    Y[3, 1] = torch.nan
    physics = lambda X: torch.cat([crude(X), (1e4 * X).sin()], -1)  # noqa: E731
    comparison = compare(X, Y, physics, structures=["zero mean", "CKA"])
    assert comparison.table["y1"][0].structure == "CKA"
    assert "\ny1: Use " in str(comparison)
    assert comparison.verdict["y2"].answer in (NOT, OPEN)
    for name, weights in comparison.stacked.weights.items():
        assert weights == [row(comparison, name, output).weight for output in ("y1", "y2")]
    assert comparison.stacked.predict(X).mean[:, 0].sub(Y[:, 0]).abs().max() < 1
    assert str(comparison).count("its error") == 2


def test_the_tables_are_of_the_left_out_predictions(comparison):
    X, Y = SCALED
    for candidate in comparison.table["y"]:
        loo = comparison.left_out[candidate.structure]
        assert loo.log_density.sum().item() == pytest.approx(candidate.elpd)
        assert loo.score().coverage.item() == pytest.approx(candidate.coverage)
        assert loo.score().rmse.item() == pytest.approx(candidate.error)
        is_alone = candidate.structure == "physics alone"
        assert math.isnan(candidate.weight) == math.isnan(candidate.log_evidence) == is_alone
        assert math.isnan(candidate.of_use) == (candidate.structure != "CKA")
    expected = leave_one_out(comparison.recommended)
    torch.testing.assert_close(comparison.leave_one_out().log_density, expected.log_density)
    best, *_, alone = comparison.table["y"]
    assert alone.structure == "physics alone"
    assert "physics alone" not in {*comparison.models, *comparison.stacked.weights}
    rmse = (Y - crude(X)).square().mean().sqrt().item()
    adjusted, data = (comparison.left_out[name].score().rmse for name in ("CKA", "zero mean"))
    errors = {"physics alone": rmse, "adjusted": float(adjusted), "data alone": float(data)}
    assert comparison.errors()["y"] == pytest.approx(errors)
    assert alone.rmse == pytest.approx(rmse / Y.std().item())
    assert alone.elpd_diff == pytest.approx(alone.elpd - best.elpd)


def of_physics(physics, X, Y, Yvar=None):
    return left_out_by_physics(as_physics(physics), Data.read(X, Y, Yvar, None))


@pytest.mark.parametrize("is_relative", [False, True])
def test_densities_of_a_physics_alone_are_those_of_an_unknown_variance(is_relative):
    f = crude(X) + 3
    sizes = f.abs() if is_relative else torch.ones_like(f)
    Y = f + sizes * NOISE
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


def test_noise_of_a_physics_alone_is_relative_where_that_predicts_better():
    f = (4 * X).exp()
    Y = torch.cat([f + 0.2 * NOISE, f * (1 + 0.2 * NOISE)], -1)
    loo = of_physics(lambda X: (4 * X).exp().expand(-1, 2), X, Y)
    spread = loo.variance.amax(0) / loo.variance.amin(0)
    assert spread[0] < 10 < 1000 < spread[1]


@pytest.mark.parametrize("n", [2, 3, 8])
def test_an_exact_physics_of_any_number_of_points(n):
    loo = of_physics(crude, X[:n], crude(X[:n]))
    assert loo.log_density.isfinite().all()
    assert loo.score().coverage.item() == 1
    assert not loo.variance.isnan().any()


def test_known_variances_are_the_noise_of_a_physics_alone():
    loo = of_physics(crude, X, crude(X) + NOISE, 0.04)
    expected = torch.distributions.Normal(crude(X), 0.2).log_prob(crude(X) + NOISE)
    torch.testing.assert_close(loo.log_density, expected)


def test_warnings_come_once_and_those_of_the_seed_as_advice():
    X, Y = (torch.cat([values, values[:1]]) for values in SCALED)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        compare(X, Y, crude, 1e-3, structures=["zero mean", "physics mean"])
    assert [str(warning.message)[:14] for warning in caught] == ["1 of 9 rows eq"]
    zero = compare(*SCALED, crude, structures=["zero mean"])
    assert [*zero.errors()["y"]] == ["physics alone", "data alone"]  # none that adjusts
    (text,) = unsampled(zero.table, {"zero mean": FitResult("bayes", error=0.9)})
    assert text.startswith("Results of zero mean depend on the seed")
    assert unsampled(zero.table, {"zero mean": FitResult("bayes", error=0.1)}) == []


@pytest.mark.parametrize(("rival", "warns"), [(0.01, False), (1000.0, True)])
def test_only_a_recommended_structure_warns(rival, warns):
    """Of two structures that suppose noises, the nearer one has all weight."""

    def warning(X, Y):
        warnings.warn("look at this", UserWarning, stacklevel=2)
        return ZeroMeanGP(X, Y, 100.0**2)

    other = partial(ZeroMeanGP, train_Yvar=rival**2)
    structures = [Structure("it", warning, "data alone"), Structure("other", other, "data alone")]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        comparison = compare(*SCALED, crude, structures=structures)
    assert (comparison.chosen == "it") == warns
    assert ("look at this" in [str(warning.message) for warning in caught]) == warns


@pytest.mark.parametrize("variance", [None, 0.01], ids=["fitted noise", "known noise"])
def test_units_make_no_difference(variance):
    rows = []
    for k, physics in ((1, crude), (1000, lambda X: 1000 * crude(X))):
        known = None if variance is None else k**2 * variance
        comparison = compare(X, k * SCALED[1], physics, known, structures=["physics mean"])
        rows.append(row(comparison, "physics mean"))
    assert rows[1].elpd == pytest.approx(rows[0].elpd - len(X) * math.log(1000), abs=1e-3)
    assert rows[1].rmse == pytest.approx(rows[0].rmse, rel=1e-3)


def test_candidates_of_several_physics_and_of_classes():
    several = physics_by_name([crude, torch.sin, lambda X: X])
    assert [*several] == ["crude", "sin", "f_3"]
    names = ["crude", "sin", "f_3", "all"]
    expected = [f"{kind} of {name}" for kind in ("physics mean", "CKA") for name in names]
    for physics, candidates in (
        (several, ["zero mean", *expected]),
        (physics_by_name(crude), DEFAULT),
    ):
        assert [s.name for s, _ in candidates_of(STRUCTURES, physics)] == candidates
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


def test_the_straight_line_and_its_error_of_left_out_points():
    f, y = crude(X)[:, 0], (2 * crude(X) - 1 + NOISE)[:, 0]
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
        (lambda X: (3 * X).sin(), lambda X: 3 * (40 * X).sin(), 60, NOT),
        (lambda X: 300 + 3 * (5 * X).sin(), lambda X: 0 * X + 300, 12, OPEN),
        (lambda X: (6 * X).sin(), lambda X: (6 * X).sin(), 20, AS_IS),
        (lambda X: 2 * (6 * X).sin() + 1, lambda X: (6 * X).sin(), 20, AS_IS),
        (lambda X: (1 + X) * (6 * X).sin(), lambda X: (6 * X).sin(), 20, CORRECTED),
    ],
    ids=["useless", "300", "right", "up to a factor", "corrected"],
)
def test_each_answer_is_given(truth, physics, n, answer):
    generator = torch.Generator().manual_seed(5)
    X, e = (torch.rand(n, 2, generator=generator, dtype=torch.float64)).unsqueeze(-1).unbind(1)
    comparison = compare(X, truth(X) + 0.05 * (e - 0.5) * 12**0.5, physics)
    assert [*comparison.models] == DEFAULT
    assert comparison.verdict["y"].answer == answer


def test_a_formula_that_is_off_by_a_factor_is_never_used():
    X = line(12)
    Y = 1000 * (2 + (6 * X).sin() + 0.02 * normal(12, 1))
    law = FunctionPhysics(
        lambda X, p: (2 + (6 * X).sin()) * p.a.unsqueeze(-1), unknowns={"a": Unknown(1.0, sd=0.2)}
    )
    with pytest.warns(PhysicsWarning, match="times too small; are its units those") as caught:
        comparison = compare(X, Y, law, structures=["zero mean", "CKA"])
    assert [warning.filename for warning in caught] == [__file__]  # once
    verdict = comparison.verdict["y"]
    cause = r"it is about [\d,]+ times too small"
    assert re.fullmatch(f"{FAULTY}: {cause}", verdict.answer)
    assert re.match(f"At the data your formula has a root mean.*{cause}", verdict.reasons[0])


def test_what_makes_a_model_is_a_structure():
    own = Structure("mine", lambda *data, **options: CKA(*data, rho_mean=3.0, **options))
    structures = ["zero mean", partial(CKA, rho_mean=3.0), PhysicsMeanGP, own]
    comparison = compare(*SCALED, crude, structures=structures)
    assert [*comparison.models] == ["zero mean", "CKA(rho_mean=3.0)", "PhysicsMeanGP", "mine"]
    for name in ("CKA(rho_mean=3.0)", "mine"):
        assert comparison.models[name].terms[0].mean == 3.0
    assert comparison.verdict["y"].answer in (CORRECTED, AS_IS)
    alone = compare(*SCALED, crude, 1e-3, structures=own)
    assert alone.chosen == "mine"
    assert alone.recommended is alone.models["mine"]
    assert alone.verdict == {}  # there is no structure without it


def test_two_points():
    X = line(2)
    comparison = compare(X, X.exp(), crude)
    assert comparison.recommended.predict(X).mean.isfinite().all()
    assert comparison.verdict["y"].answer == OPEN


@pytest.mark.slow
def test_options_of_data_are_handed_to_all_and_a_structure_keeps_its_own(tmp_path):
    own = partial(CKA, noise=HeavyTails(0.1))
    options = {"noise": HeavyTails(), "link": "log", "input_transform": Normalize(1)}
    Y, structures = (2 * X.sin() + NOISE).exp(), ["zero mean", own]
    comparison = compare(X, Y, torch.exp, structures=structures, **options)
    zero, cka = comparison.models.values()
    assert isinstance(zero, Linked)
    assert isinstance(cka, Linked)
    assert (zero.noise.share, cka.noise.share) == (0.02, 0.1)
    assert comparison.stacked.data.transform is not None
    assert (comparison.stacked.interval(X)[0] > 0).all()
    with pytest.warns(UserWarning, match="input_transform=..., physics=..."):
        save(comparison.stacked, tmp_path / "stacked.pt")


@pytest.mark.slow
def test_several_physics_each_alone_and_all(tmp_path):
    """One of no use does not hide another."""
    physics = {"wave": crude, "line": lambda X: (23 * X + 1).cos()}
    comparison = compare(X, 2 * crude(X) + X + NOISE, physics, structures=["zero mean", "CKA"])
    names = {f"CKA of {name}" for name in ("wave", "line", "all")}
    assert set(comparison.models) == {"zero mean", *names}
    rows = {row.structure for row in comparison.table["y"]}
    assert rows == {"zero mean", *names, "physics alone of wave", "physics alone of line"}
    assert comparison.table["y"][0].structure in ("CKA of wave", "CKA of all")
    assert comparison.verdict["y"].answer == CORRECTED
    both = StackedGP(comparison.models, [[0.5], [0.0], [0.25], [0.25]])
    with pytest.warns(UserWarning, match="a lambda"):
        assert "physics" in save(both, tmp_path / "model.pt").missing
    again = load(tmp_path / "model.pt", physics=physics)
    torch.testing.assert_close(again.predict(X).mean, both.predict(X).mean)
    with pytest.raises(ValueError, match="physics"):
        load(tmp_path / "model.pt")


def test_an_impossible_observation_counts_finitely():
    loo = leave_one_out(ZeroMeanGP(*SCALED))
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
    X, true = line(12, 0.1, 3), torch.tensor([5.0, 1.0])
    unknowns = {"size": Unknown(4.0, factor=1.5), "rate": Unknown(1.5, factor=1.5)}
    law = FunctionPhysics(lambda X, p: p.size * (1 - (-p.rate * X[:, 0]).exp()), unknowns=unknowns)
    Y = 5 * (1 - (-X).exp()) + 0.05 * normal(12, 1)
    comparison = compare(X, Y, law, structures=["calibrated physics", "physics mean"])
    for model in comparison.models.values():
        low, high = model.physics_parameters.interval()
        assert ((low < true) & (true < high)).all()
    names = [row.structure for row in comparison.table["y"]]
    assert sorted(names) == ["calibrated physics", "physics mean"]
    assert [*comparison.errors()["y"]] == ["calibrated physics", "adjusted"]


@pytest.mark.slow
def test_repeated_inputs_are_no_evidence_of_the_physics():
    X = torch.tensor([[0.1], [0.5], [0.9]], dtype=torch.float64).repeat(8, 1)
    assert compare(X, normal(24, 1), lambda X: 5 * X.sin()).verdict["y"].answer == OPEN


def test_the_next_point_has_names_of_categories():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"x": [0.0, 1.0] * 3, "metal": ["brass", "iron", "zinc"] * 2})
    Y = torch.arange(6.0).double().unsqueeze(-1)
    first = CKA(frame, Y, physics=lambda X: X[:, :1], input_transform=Categories(["metal"]))
    assert _at(first, torch.tensor([0.5, 2.0])) == " at x = 0.5 and metal = zinc"
