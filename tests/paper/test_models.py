"""The experiments on models: Forrester's function, pairs, where to measure."""

import math
from dataclasses import replace

import pandas as pd
import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.inference import register_priors
from gpadjust.systems import cart_pole
from paper.active import Active
from paper.active import Settings as ActiveSettings
from paper.active import run as active_run
from paper.active.problems import problem
from paper.active.run import LEARNERS, integrated_variance, measured, scored
from paper.active.tables import needed, verdicts
from paper.calibration import METHODS, ROWS, Calibration
from paper.calibration import Settings as CalibrationSettings
from paper.calibration import run as calibration_run
from paper.calibration.claims import targets
from paper.calibration.leads import LEADS, taken
from paper.common.runner import main, run_missing, runs_file
from paper.forrester import Forrester
from paper.forrester import Settings as ForresterSettings
from paper.forrester.problem import CRUDE, GRID, observations, truth
from paper.forrester.tables import NAMES, judge
from paper.multifidelity import Multifidelity
from paper.multifidelity import Settings as MultifidelitySettings
from paper.multifidelity import problem as pairs
from paper.multifidelity.run import SMTModel
from paper.multifidelity.tables import judge_intervals, load
from paper.report import PAPER
from paper.structures import CELLS, GROUPS, MODELS, Structures, systems
from paper.structures import Settings as StructuresSettings
from paper.structures.tables import cells

RESULTS = PAPER / "results"

# The tiny settings stop optimisations early.
pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.BotorchWarning")


class TestForrester:
    def test_readings_of_the_crude_function(self):
        torch.testing.assert_close(truth(GRID), 2 * CRUDE["B"](GRID) - 5 * GRID)
        torch.testing.assert_close(truth(GRID), 8 * CRUDE["A"](GRID) - 20 * GRID)
        error = {r: (CRUDE[r](GRID) - truth(GRID)).square().mean().sqrt().item() for r in "AB"}
        assert error["A"] == pytest.approx(2.47, abs=0.01)
        assert error["B"] == pytest.approx(1.77, abs=0.01)
        X, Y = observations(3, 8)
        assert X.shape == Y.shape == (8, 1)
        assert ((X >= -0.6) & (X <= 1)).all()

    def test_smoke(self, tmp_path):
        """One data set for each protocol; the tables of the runs that are committed."""
        settings = ForresterSettings(steps=2, lengthscales=(0.5, 1.0), ridges=(0.01,))
        experiment = Forrester(out=tmp_path, settings=settings)
        found = {
            protocol: experiment.run("B", protocol, 1, unfinished=tmp_path)
            for protocol in ("gpadjust", "paper", "closed form")
        }
        assert found["closed form"]["model"] == ["f_p", "0.5, 0.01", "1, 0.01"]
        error = dict(zip(found["gpadjust"]["model"], found["gpadjust"]["rmse"], strict=True))
        assert error["CKA"] < 0.05 < error["Phy-mean GP"]
        assert error["Phy-mean GP"] == error["GP-bias"]
        records = list(runs_file(Forrester(out=RESULTS / "forrester")).read().values())[:50]
        assert "F7 | RRA about 50 %" in experiment.tables(records)["claims-B"].text
        assert "CKA | " in experiment.first_look(records)

    @pytest.mark.slow
    def test_command(self, tmp_path, capsys):
        settings = ForresterSettings(steps=2, lengthscales=(0.5, 1.0), ridges=(0.01,))
        main(Forrester(out=tmp_path, runs=2, jobs=1, settings=settings))
        assert "Claims, on reading B" in capsys.readouterr().out
        for protocol in ("paper", "gpadjust"):
            assert (tmp_path / f"forrester_{protocol}.png").stat().st_size > 20_000

    @pytest.mark.parametrize(
        ("claim", "rmse", "verdict"),
        [
            ("F1", {"Zero-mean GP": 0.9}, "reproduced"),
            ("F1", {"Zero-mean GP": 1.1}, "not reproduced"),
            ("F1", {"Zero-mean GP": 0.999}, "inconclusive"),
            ("F2", {"GP-scale": 0.9}, "reproduced"),
            ("F3", {"GP-bias": 1.1}, "not reproduced"),
            ("F4", {"GP-scale": 1.2}, "reproduced"),
            ("F4", {"GP-scale": 1.2, "AR1": 1.3}, "not reproduced"),
            ("F6", {"CKA": 0.7}, "reproduced"),
            ("F6", {"CKA": 0.9}, "not reproduced"),
            ("F6", {"CKA": 0.1}, "beaten"),
            ("F7", {"RRA": 0.5}, "reproduced"),
            ("F7", {"RRA": 0.5, "CKA": 0.4}, "not reproduced"),
        ],
    )
    def test_verdicts(self, claim, rmse, verdict):
        """Two runs of all models, whose differences vary by a hundredth."""
        runs = pd.DataFrame(
            {
                "seed": seed,
                "model": name,
                "rmse": rmse.get(name, 1) + seed * (0.3 if name == "GP-scale" else 0.1)
                - seed * 0.2 * (name == "GP-scale") + seed * 0.001 * NAMES.index(name),
            }
            for seed in (0, 1)
            for name in NAMES
        )  # fmt: skip
        f_p = pd.DataFrame({"seed": [0, 1], "model": "f_p", "rmse": [1.0, 1.101]})
        found = judge(pd.concat([runs, f_p]))
        assert next(c.verdict for c in found if c.id == claim) == verdict

    def test_a_closed_form_that_gives_both_verdicts_leaves_the_claim_undetermined(self):
        rows = [("f_p", 1.0), *((name, 1.0) for name in NAMES)]
        runs = pd.DataFrame([{"seed": s, "model": m, "rmse": e} for s in (0, 1) for m, e in rows])
        cells = [{"model": "0.5, 0.01", "rmse": 0.5}, {"model": "1, 0.01", "rmse": 1.2}]
        cells.append({"model": "f_p", "rmse": 1.0})
        grid = pd.DataFrame(
            [{**c, "seed": s, "protocol": "closed form"} for s in (0, 1) for c in cells]
        )
        found = judge(runs, grid)[-1]
        assert found.verdict == "undetermined"
        assert "-50% to +20%" in found.measured


class TestPairs:
    @pytest.mark.parametrize(
        ("name", "x", "high", "low"),
        [
            ("booth", [1.0, 3.0], 0.0, 11.9),
            ("bohachevsky", [0.0, 0.0], 0.0, -12.0),
            ("currin", [0.5, 0.5], (1 - math.exp(-1)) * 1868.5 / 159.5, 7.4425),
        ],
    )
    def test_pairs_have_known_values(self, name, x, high, low):
        pair, X = pairs.pair(name), torch.tensor([x], dtype=torch.float64)
        assert pair.truth(X).item() == pytest.approx(high, abs=1e-4)
        assert pair.physics()(X).item() == pytest.approx(low, abs=1e-4)

    def test_data(self):
        pair = pairs.pair("branin")
        X, Y = pairs.observations(pair, 10, 3)
        cells = (10 * (X - pair.bounds[0]) / (pair.bounds[1] - pair.bounds[0])).floor()
        for column in cells.sort(0).values.T:
            assert torch.equal(column, torch.arange(10.0, dtype=torch.float64))
        assert torch.equal(Y, pair.truth(X))
        low_X = pairs.low_inputs(pair, X, 40, 0)
        assert low_X.shape == (40, 2)
        assert torch.equal(low_X[:10], X)

    @pytest.mark.slow
    def test_mfk_predicts_in_the_units_of_the_data(self):
        pair = pairs.pair("booth")
        X, Y = pairs.observations(pair, 10, 0)
        low_X = pairs.low_inputs(pair, X, 40, 0)
        posterior = SMTModel(low_X, pair.physics()(low_X), X, Y).posterior(X)
        torch.testing.assert_close(posterior.mean, Y, rtol=1e-2, atol=1e-2)
        assert (posterior.variance > 0).all()

    @pytest.mark.slow
    def test_smoke(self, tmp_path, capsys):
        settings = MultifidelitySettings(num_test=50, sizes=(5,))
        experiment = Multifidelity(
            out=tmp_path,
            runs=4,
            jobs=1,
            pairs=("forrester",),
            methods=("GP", "CKA"),
            settings=settings,
        )
        main(experiment)
        printed = capsys.readouterr().out
        assert "The first runs" in printed
        assert "U1" in printed
        assert (tmp_path / "nrmse.png").stat().st_size > 10_000
        runs = load(list(runs_file(experiment).read().values()))
        assert (runs.groupby("seed")["N"].nunique() == 1).all()
        assert runs[runs["method"] == "CKA"]["nrmse"].median() < 0.1

    def test_unknown_pair(self, tmp_path):
        with pytest.raises(ValueError, match="There is no pair 'curin'; there are bohachevsky, "):
            Multifidelity(out=tmp_path, pairs=("curin",)).check()

    def test_intervals_are_judged_by_their_distance_from_95(self):
        rows = [
            {"pair": "booth", "seed": seed, "method": name, "coverage": value + seed / 1000}
            for seed in range(4)
            for name, value in {"CKA": 0.94, "RRA": 0.93, "GP": 0.6, "AR1": 0.7}.items()
        ]
        assert judge_intervals(pd.DataFrame(rows)).verdict == "reproduced"
        assert judge_intervals(pd.DataFrame(rows[:2])).verdict == "not run"


TINY = ActiveSettings(
    budget=6,
    every=2,
    num_test=20,
    integration_points=4,
    raw_samples=4,
    num_restarts=1,
    maxiter=2,
    num_screened=4,
    num_starts=1,
    max_iterations=5,
)


def scores(**errors):
    """Runs of Forrester's function: learner=[errors after 1, 2, ... of a seed, ...]."""
    rows = [
        {"problem": "forrester", "learner": name, "seed": seed, "measurements": n, "nrmse": error}
        for name, by_seed in errors.items()
        for seed, curve in enumerate(by_seed)
        for n, error in enumerate(curve, 1)
    ]
    return pd.DataFrame(rows)


class TestWhereToMeasure:
    @pytest.mark.parametrize("name", ["forrester", "currin", "park91a", "cartpole"])
    def test_problems(self, name):
        system = problem(name, 0)
        X = torch.cat([system.sobol(8, 1), system.uniform(8, 1), system.bounds])
        assert ((system.bounds[0] <= X) & (system.bounds[1] >= X)).all()
        assert system.truth(X).shape == (18, 4 if name == "cartpole" else 1)
        assert (system.physics(X) - system.truth(X)).abs().max() > 1e-3
        X.requires_grad_()
        system.physics(X).sum().backward()
        assert X.grad.isfinite().all()

    def test_the_cart_pole(self):
        system, X = problem("cartpole", 3), torch.tensor([[0.3, 0.1, 0.2, -0.5, 4.0]]).double()
        believed = cart_pole(3).physics(X) - X[:, :4]
        torch.testing.assert_close(system.physics(X), believed)
        X = system.sobol(6, 0)
        for kind, expected in (("CKA", CKA), ("physics mean", PhysicsMeanGP), ("GP", ZeroMeanGP)):
            model = system.model(X, system.truth(X), kind)
            assert isinstance(model, expected)
            once_round = X + torch.tensor([0, 2 * math.pi, 0, 0, 0], dtype=torch.float64)
            torch.testing.assert_close(model.predict(X).mean, model.predict(once_round).mean)

    @pytest.mark.parametrize("kind", ["CKA", "GP"])
    def test_integrated_variance_of_outputs_is_the_sum_in_their_units(self, kind):
        system = problem("cartpole", 0)
        X, points, x = system.sobol(7, 0), system.sobol(3, 5), system.sobol(1, 9)
        Y = system.truth(X)
        model = system.model(X, Y, kind)
        found = -integrated_variance(model, points)(x)
        with torch.no_grad():
            left = model.condition_on_observations(x, system.truth(x)).predict(points).variance
        expected = (left / Y.std(0).square()).sum(-1).mean()
        torch.testing.assert_close(found.detach(), expected.reshape(1), rtol=1e-3, atol=0)

    def test_all_learners_of_a_seed_begin_alike(self, tmp_path):
        system = problem("forrester", 0)
        points = {
            name: measured(system, learner, learner.model, TINY, 2, tmp_path / f"{name}.jsonl")
            for name, learner in LEARNERS.items()
            if learner.model is not None
        }
        assert all(torch.equal(X[:4], system.sobol(4, 2)) for X in points.values())
        assert all(X.shape == (6, 1) for X in points.values())
        assert torch.equal(points["sobol"], system.sobol(6, 2))
        assert not torch.equal(points["cka"][4:], points["gp"][4:])

    def test_scores(self):
        system = problem("forrester", 0)
        found = scored(
            system, "CKA", replace(ActiveSettings(), budget=6, every=2), system.sobol(6, 0)
        )
        assert found["measurements"] == [4, 6]
        assert found["nrmse"][1] < found["nrmse"][0] < 2

    @pytest.mark.slow
    def test_smoke(self, tmp_path, capsys):
        experiment = Active(
            out=tmp_path,
            runs=2,
            jobs=1,
            problems=("forrester",),
            learners=("f_p", "phy", "gp", "cka"),
            forrester=TINY,
        )
        main(experiment)
        assert "M1" in capsys.readouterr().out
        assert (tmp_path / "errors.png").stat().st_size > 10_000
        assert not list((tmp_path / "unfinished").glob("*.jsonl"))

    def test_an_interrupted_run_goes_on(self, tmp_path, monkeypatch):
        whole, cut = (
            Active(out=tmp_path / name, runs=1, jobs=1, problems=("forrester",), learners=("both",),
                   forrester=TINY) for name in ("whole", "cut")
        )  # fmt: skip
        run_missing(whole)
        asked = []

        def interrupted(name, seed):
            system = problem(name, seed)

            def measure(X):
                if len(X) == 1:
                    asked.append(X)
                    if len(asked) == 5:
                        raise KeyboardInterrupt
                return system.truth(X)

            return replace(system, truth=measure)

        monkeypatch.setattr(active_run, "problem", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_missing(cut)
        run_missing(cut)
        expected, found = (
            next(iter(runs_file(experiment).read().values())) for experiment in (whole, cut)
        )
        assert found["scores"] == expected["scores"]
        assert found["choice_seconds"] is None
        assert len(asked) == 7  # the one it was interrupted at twice
        assert torch.equal(asked[4], asked[5])

    def test_measurements_that_are_needed(self):
        runs = scores(gp=[[3.0, 2.0, 1.0]] * 2, cka=[[2.0, 1.0, 2.0], [2.0, 1.5, 1.1]])
        assert needed(runs, "cka").tolist() == [2, math.inf]
        assert needed(runs, "gp").tolist() == [3, 3]
        assert needed(runs[runs["learner"] == "cka"], "cka").empty

    @pytest.mark.parametrize(
        ("cka", "verdict", "said"),
        [
            ([[2.0, 1.0, 1.0, 1.0]] * 2, "met", "2 runs: with 2 of 4 (median), in 2 of them"),
            ([[2.0, 2.0, 1.0, 1.0]] * 2, "missed", "with 3 of 4"),
            ([[2.0, 2.0, 2.0, 2.0]] * 2, "missed", "never of 4 (median), in 0 of them"),
            ([[2.0, 1.0, 1.0, 1.0]], "not run", "too few runs"),
        ],
    )
    def test_verdicts(self, cka, verdict, said):
        (claim,) = verdicts(scores(gp=[[3.0, 2.0, 1.5, 1.0]] * 2, cka=cka))
        assert (claim.id, claim.verdict) == ("M1", verdict)
        assert said in claim.measured


class TestCalibration:
    @pytest.mark.slow
    def test_smoke(self, tmp_path):
        settings = CalibrationSettings(num_test=20)
        experiment = Calibration(out=tmp_path, methods=METHODS, settings=settings)
        kinds = [("forrester", 5, 0.0), ("branin", 2, 0.05), ("pump", 6, 1.0)]
        records = [
            dict(zip(experiment.key, (*kind, method, 0), strict=True))
            | experiment.run(*kind, method, 0, unfinished=tmp_path)
            for kind in kinds
            for method in ("map", "default")
        ]
        assert all(0 <= r["half"] <= r["coverage"] <= 1 for r in records)
        found = experiment.tables(records)
        assert "pump, N = 12, noisy" in found["coverage"].text
        assert "| default |" in found["summary"].text
        assert found["targets"].text.count("**not run**") == 2

    @pytest.mark.parametrize("worst", [0.9, 0.8])
    def test_targets(self, tmp_path, worst):
        """The rows of a trial in which all but two methods of one row are alike."""
        scores = {"nlpd": 0.0, "half": 0.5, "seconds": 1.0, "warned": False}
        kinds = [(*row, method) for row in (*ROWS, ("pump", 6, 1.0)) for method in METHODS]
        records = [
            {"problem": name, "per_input": size, "noise": noise, "method": method, "seed": 0,
             "N": size, "nrmse": 2.0 if (name, method) == ("booth", "compare") else 1.0,
             "coverage": worst if name == "currin" else 0.95, **scores}
            for name, size, noise, method in kinds
        ]  # fmt: skip
        runs = pd.DataFrame(records)
        rows = runs[(runs["method"] == "map") & (runs["problem"] != "pump")]
        singles = pd.concat([rows.assign(method="cka"), rows.assign(method="SMT MFK")])
        found = {each.id: each for each in targets(runs, singles)}
        assert (found["D2"].verdict, found["D2"].measured) == (
            ("met", "none")
            if worst > 0.85
            else ("missed", "currin, N = 5: 0.800; currin, N = 10: 0.800")
        )
        assert (found["D4"].verdict, found["D6"].verdict) == ("met", "missed")
        assert found["R4"].verdict == "met"
        assert found["R4"].measured.startswith("in 14 of 16;")
        runs = Calibration(out=tmp_path / "calibration").tables(records)["targets"].text
        assert "no results of structures" in runs

    def test_there_are_sixteen_kinds_and_the_noise_is_what_it_says(self):
        assert len(ROWS) == 16
        clean, noisy = (calibration_run.of_pair("branin", 500, noise, 10, 0) for noise in (0, 0.05))
        assert torch.equal(clean.X, noisy.X)
        assert (noisy.Y - clean.Y).std().item() == pytest.approx(noisy.noise.item(), rel=0.1)
        assert noisy.noise.item() == pytest.approx(0.05 * noisy.truth.std().item())

    def test_the_pump_has_outputs_of_very_different_units(self):
        data = calibration_run.pump(12, 0)
        assert data.Y.shape == (12, 2)
        size = data.truth.std(0)
        assert size[0] / size[1] > 1e6
        wrong = data.physics(data.points) - data.truth
        assert (wrong.square().mean(0).sqrt() > 3 * data.noise).all()

    def test_priors_are_taken_for_a_while(self):
        X = torch.rand(6, 1, dtype=torch.float64)

        def medians():
            model = ZeroMeanGP(X, X.sin())
            register_priors(model)
            return {name: prior.loc.exp() for name, _, prior, _, _ in model.named_priors()}

        before = medians()
        with taken(LEADS["all wide"]):
            within = medians()
        after = medians()
        name = "covar_module.terms.0.kernel.base_kernel.lengthscale_prior"
        assert torch.equal(before[name], after[name])
        torch.testing.assert_close(within[name] / before[name], torch.full((1, 1), 10.0).double())


class TestStructures:
    @pytest.mark.slow
    def test_smoke(self, tmp_path):
        settings = StructuresSettings(num_test=20, num_transitions=20)
        experiment = Structures(out=tmp_path, settings=settings)
        kinds = [("forrester", 5, 0.0), ("pendulum", 5, 0.0)]
        records = [
            dict(zip(experiment.key, (*kind, model, 0), strict=True))
            | experiment.run(*kind, model, 0, unfinished=tmp_path)
            for kind in kinds
            for model in MODELS
        ]
        assert all(0 <= r["coverage"] <= 1 and r["nrmse"] > 0 for r in records)
        assert [len(r["each"]["nlpd"]) for r in records] == [1] * 4 + [2] * 4
        found = experiment.tables(records)
        assert "pendulum, N = 5" in found["nrmse"].text
        assert "| all |" in found["summary"].text
        assert "| S1 |" in found["targets"].text

    def test_limits(self):
        """Both limits are against the better of the two, of each score by itself."""
        rmse = {
            "cka": [1.0, 1.3, 1.2],
            "phy": [2.0, 1.0, 9.0],
            "gp": [1.5, 2.0, 1.0],
            "rra": [3.0] * 3,
        }
        nlpd = {"cka": 0.1, "phy": 0.0, "gp": 1.0, "rra": 2.0}
        records = [
            {"problem": "booth", "size": 5, "noise": 0.0, "model": model, "seed": seed, "N": 10,
             "nrmse": values[seed], "nlpd": nlpd[model], "coverage": 0.9, "seconds": 1.0,
             "warned": False, "power": [], "each": {}}
            for model, values in rmse.items() for seed in range(3)
        ]  # fmt: skip
        found = cells(records).iloc[0]
        assert found["nrmse", "cka"] == pytest.approx(1.2 / 1.5)
        assert found["nlpd", "cka"] == pytest.approx(0.1)
        text = Structures().tables(records)["summary"].text
        assert "| all | 1 of 1 (100%) | 1 | 1 | 0.80 |" in text

    def test_cells(self):
        assert len(CELLS) == len(set(CELLS)) == 16 + 1 + 4 * 3
        assert {name for name, *_ in CELLS} == set(GROUPS)
        assert len(Structures(runs=2, models=("cka",)).tasks()) == 2 * len(CELLS)
        with pytest.raises(ValueError, match="no problem 'pendulums'"):
            Structures(problems=("pendulums",)).check()

    @pytest.mark.parametrize("name", ["arm", "cart-pole", "pendulum", "double-pendulum"])
    def test_transitions(self, name):
        """Few are part of many; all go on from where the one before ended, or are of records."""
        few, many = (systems.system(name, n, 60, 3) for n in (10, 50))
        assert torch.equal(few.train.states, many.train.states[:10])
        assert len(many.train.states) == 50
        assert torch.equal(few.test.states, systems.system(name, 10, 60, 4).test.states)
        known = {tuple(row) for row in many.train.states.tolist()}
        assert not known & {tuple(row) for row in many.test.states.tolist()}

    @pytest.mark.parametrize("name", ["pendulum", "double-pendulum"])
    def test_the_physics_of_records_is_crude_but_right(self, name):
        """It leaves less than half of the change in the machines, but not as little as noise."""
        data = systems.system(name, 50, 0, 0)
        with torch.no_grad():
            following = data.physics(torch.cat([data.test.states, data.test.actions], dim=-1))
        left = data.spec.change(following, data.test.next_states).square().mean(0).sqrt()
        change = data.spec.change(data.test.states, data.test.next_states).square().mean(0).sqrt()
        share = left / change
        assert (share < 0.55).all()
        assert share.max() > 0.2

    def test_too_few_transitions_in_the_records(self):
        with pytest.raises(ValueError, match="have 404 transitions, not 500"):
            systems.system("pendulum", 500, 0, 0)

    def test_double_pendulum_keeps_its_energy(self):
        """Without torques a rigid body's kinetic and potential energy are constant."""
        physics, x = (
            systems.double_pendulum_physics(),
            torch.tensor([[0.5, -0.8, 1.0, 2.0]]).double(),
        )
        mass, centre, length, coupling = (0.608, 0.630), (0.275, 0.166), 0.3, 0.630 * 0.3 * 0.166

        def energy(x):
            q1, q2, dq1, dq2 = x[0].tolist()
            first = 0.0547 + mass[1] * length**2
            kinetic = 0.5 * first * dq1**2 + 0.5 * 0.0252 * (dq1 + dq2) ** 2
            kinetic += coupling * math.cos(q2) * dq1 * (dq1 + dq2)
            height = -(mass[0] * centre[0] + mass[1] * length) * math.cos(q1)
            return kinetic + 9.81 * (height - mass[1] * centre[1] * math.cos(q1 + q2))

        before = energy(x)
        with torch.no_grad():
            for _ in range(50):
                x = physics(torch.cat([x, torch.zeros(1, 2).double()], dim=-1))
        assert energy(x) == pytest.approx(before, abs=1e-3)
