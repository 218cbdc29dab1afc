"""Models as files."""

import sys
import warnings

import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import MaternKernel, ScaleKernel
from torch.nn.functional import relu, silu

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, StackedGP, ZeroMeanGP, load, save
from gpadjust.inference import register_priors
from gpadjust.models.parameters import scaled_rbf
from tests.systems import holding, refused, same


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.pt"


def problem(uniform):
    X = uniform(8, 2) - 0.3
    Y = relu(X) * 1.2 + X.square()
    Y[2, 1] = torch.nan
    return X, Y, uniform(5, 2, seed=1)


class Gained(CKA):
    """A structure of one's own, with an option whose name begins as that of the physics."""

    def __init__(self, train_X, train_Y, train_Yvar=None, *, physics, physics_gain=1.0, low=0.0):
        def gained(X):
            return physics_gain * physics(X) + low

        super().__init__(train_X, train_Y, train_Yvar, physics=gained)


class Renamed(CKA):
    """A structure of one's own, with names of its own for the data."""

    def __init__(self, X, Y, **options):
        super().__init__(X, Y, **options)


class Passing(CKA):
    """One whose noise is not known."""

    def __init__(self, train_X, train_Y, *, physics):
        super().__init__(train_X, train_Y, physics=physics)


def saved(model, path):
    """Save a model of a physics that has no name, without the warning of it."""
    with pytest.warns(UserWarning, match=r"cannot import.*load\(path, .*physics="):
        save(model, path)


BUILDS = {
    "CKA": lambda X, Y: CKA(X, Y, physics=relu, center="mean", delta_mean="learn"),
    "learnt center": lambda X, Y: CKA(X, Y, physics=relu, center="learn"),
    "several": lambda X, Y: CKA(X, Y, 0.01, physics={"a": relu, "b": silu}),
    "RRA": lambda X, Y: RRA(X, Y, physics=relu, num_features=16, seed=3),
    "physics mean": lambda X, Y: PhysicsMeanGP(X, Y, physics=relu, rho_mean=0.9),
    "zero mean": lambda X, Y: ZeroMeanGP(X, Y, outcome_transform=None),
    "AR1": lambda X, Y: AR1(X, Y, physics=relu, low_X=X + 0.1),
}


@pytest.mark.parametrize("name", list(BUILDS))
def test_a_model_comes_back(name, uniform, path):
    X, Y, Z = problem(uniform)
    model = BUILDS[name](X, Y)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter) * parameter.requires_grad
    model.input_names = ("left [m]", "right [m]")
    save(model, path)
    assert torch.load(path, weights_only=True)["missing"] == []
    assert [each.name for each in path.parent.iterdir()] == ["model.pt"]
    again = load(path, trusted=True)
    assert type(again) is type(model)
    assert again.input_names == model.input_names
    same(model.predict(Z), again.predict(Z))


@pytest.mark.parametrize("Yvar", [None, 0.01])
def test_one_that_was_conditioned_and_holds_samples(uniform, path, Yvar):
    X, Y, Z = problem(uniform)
    model = holding(CKA(X, Y, Yvar, physics=relu), 0.0, 0.5)
    noise = None if Yvar is None else torch.full_like(Z, 0.3)
    model = model.condition_on_observations(Z, relu(Z), noise=noise)
    save(model, path)
    again = load(path, trusted=True)
    assert again.num_samples == 2
    same(model.predict(Z), again.predict(Z))


def test_what_has_no_name_is_given_again_and_compared(uniform, path):
    X, Y, Z = problem(uniform)
    options = {"physics": lambda X: relu(X), "input_transform": Normalize(2)}
    model = CKA(X, Y, **options)
    saved(model, path)
    refused(ValueError, "input_transform and physics", load, path)
    same(model.predict(Z), load(path, **options).predict(Z))
    model = Gained(X, Y, physics=relu, physics_gain=3.0, low=1.0)
    saved(model, path)
    assert torch.load(path, weights_only=True)["options"] == {"physics_gain": 3.0, "low": 1.0}
    same(model.predict(Z), load(path, physics=relu).predict(Z))
    X, Y, _ = problem(uniform)
    model = CKA(X, 1e-10 * Y, physics=lambda X: 1e-10 * relu(X))
    saved(model, path)
    refused(ValueError, "saved with another physics", load, path, physics=lambda X: 3e-10 * relu(X))
    load(path, physics=lambda X: 1e-10 * relu(X))


def test_what_could_not_come_back_is_refused(uniform, path):
    class Local(CKA):
        pass

    X, Y, Z = problem(uniform)
    model = CKA(X, Y, physics=relu)
    refused(ValueError, r"Local cannot be imported again", save, Local(X, Y, physics=relu), path)
    refused(ValueError, r"Renamed.*train_X.*train_Y", save, Renamed(X, Y, physics=relu), path)
    refused(ValueError, "got a subset", save, model.subset_output([1]), path)
    assert not path.exists()
    model = Passing(X, Y, physics=relu)
    save(model, path)
    same(model.predict(Z), load(path, trusted=True).predict(Z))
    save(CKA(X, Y, physics={"a": relu, "b": silu}), path)
    other = {"a": silu, "b": relu}
    refused(ValueError, r"another physics.*same order", load, path, physics=other)


def test_whether_it_is_fitted_is_known_of_a_loaded_model(uniform, path):
    X, Y, _ = problem(uniform)
    model = CKA(X, Y, physics=relu)
    for expected in (False, True):
        model.was_fitted = expected  # as `fit` says it
        save(model, path)
        assert load(path, trusted=True).is_fitted == expected
        assert model.subset_output([0]).is_fitted == expected
        save(StackedGP({"CKA": model}, [[1.0, 1.0]]), path)
        assert load(path, trusted=True).made_of["CKA"].is_fitted == expected
    known = CKA(X, Y, physics=relu)
    for parameter in known.parameters():
        parameter.requires_grad_(False)
    assert known.is_fitted  # as nothing is to be learnt


@pytest.mark.parametrize("name", ["low_covar_module", "delta_covar_module"])
def test_a_kernel_is_given_again(uniform, path, name):
    """A kernel of AR1's low level is no datum of it, and came back as another."""
    X, Y, Z = problem(uniform)

    def kernel(num_inputs, batch_shape):
        base = MaternKernel(0.5, ard_num_dims=num_inputs, batch_shape=batch_shape)
        return ScaleKernel(base, batch_shape=batch_shape).double()

    model = AR1(X, Y, physics=relu, low_X=X + 0.1, **{name: kernel})
    save(model, path)
    refused(ValueError, f"could not hold {name}", load, path, trusted=True)
    same(model.predict(Z), load(path, trusted=True, **{name: kernel}).predict(Z))
    with pytest.raises(ValueError, match=r"MaternKernel 0\.5.*RBFKernel"):
        load(path, trusted=True, **{name: scaled_rbf})
    save(AR1(X, Y, physics=relu, low_X=X + 0.1), path)
    refused(ValueError, rf"model\.pt: .*{name}.*: nothing", load, path, **{name: kernel})


def test_a_stacked_model_comes_back(uniform, path):
    X, Y, Z = problem(uniform)
    models = {name: BUILDS[name](X, Y) for name in ("learnt center", "zero mean")}
    stacked = StackedGP(models, torch.tensor([[0.5, 0.25], [0.5, 0.75]]).double())
    save(stacked, path)
    again = load(path, trusted=True)
    assert again.weights == stacked.weights
    same(again.predict(Z), stacked.predict(Z))
    refused(ValueError, "take the StackedGP", save, stacked.subset_output([0]), path)
    same(load(path, trusted=True).predict(Z), stacked.predict(Z))


def test_what_is_no_model_and_no_file_and_what_a_failed_write_leaves(
    uniform, path, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    model = ZeroMeanGP(*problem(uniform)[:2])
    for wrong, error, says in (
        (None, TypeError, "Expected path as the name of a file, got None"),
        (tmp_path, ValueError, "is a folder; name a file in it"),
        (tmp_path / "none" / "model.pt", ValueError, "in a folder that does not exist"),
    ):
        refused(error, says, save, model, wrong)
    assert not [*tmp_path.iterdir()]
    refused(TypeError, r"model of gpadjust.*Linear", save, torch.nn.Linear(1, 1), path)
    refused(FileNotFoundError, "model.pt", load, path)
    path.write_bytes(b"no model")
    refused(ValueError, "not a model", load, path)
    for format in (99, [3], torch.ones(2)):
        torch.save({"format": format}, path)
        refused(ValueError, r"model\.pt .*expected format 3", load, path)
    model = ZeroMeanGP(*problem(uniform)[:2])
    save(model, path)
    before = path.read_bytes()

    def full(content, part):
        part.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", full)
    refused(OSError, "No space", save, model, path)
    assert [*path.parent.iterdir()] == [path]
    assert path.read_bytes() == before


def test_a_physics_of_a_script_is_told_of(uniform, path, monkeypatch):
    X, Y, Z = problem(uniform)
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "script_physics", lambda X: relu(X), raising=False)
    function = main.script_physics
    function.__module__, function.__qualname__ = "__main__", "script_physics"
    model = CKA(X, Y, physics=function)
    saved(model, path)
    same(model.predict(Z), load(path, trusted=True).predict(Z))  # by the same script
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save(CKA(X, Y, physics=relu), path)


class TestFilesOfStrangers:
    @pytest.fixture
    def content(self, uniform, path):
        """`content(**changes)` is the path of a file of a model with these parts changed."""
        X, Y, _ = problem(uniform)
        save(CKA(X, Y, physics=relu), path)
        held = torch.load(path, weights_only=True)

        def content(**changes):
            torch.save({**held, **changes}, path)
            return path

        content.held = held
        return content

    @pytest.fixture
    def planted(self, tmp_path, monkeypatch):
        """A module that leaves a trace when it is imported, and when it is called."""
        trace = tmp_path / "trace"
        (tmp_path / "planted_module.py").write_text(
            f"from pathlib import Path\nfrom os import _exit\n"
            f"trace = Path({str(trace)!r})\ntrace.touch()\n"
            "class X:\n    def __init__(self, *args):\n        trace.write_text('called')\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        yield trace
        sys.modules.pop("planted_module", None)

    def test_what_is_imported_and_given(self, content, planted, uniform):
        with pytest.raises(ValueError, match="'planted_module' was not imported"):
            load(content(**{"class": "planted_module:X"}))
        assert not planted.exists()
        for name in ("gpadjust.models.structures:None", "builtins:dict", "torch.nn:Linear"):
            refused(ValueError, r"model\.pt: .*has no such model", load, content(**{"class": name}))
        path = content(physics={"": "planted_module:X"})
        assert load(path, physics=relu).num_outputs == 2
        assert not planted.exists()
        for given in ({"foo": 1}, {"train_Y": uniform(8, 2)}, {"center": 0.0}):
            refused(ValueError, rf"{next(iter(given))}.*physics", load, content(), **given)
        refused(ValueError, r"model\.pt is damaged", load, content(), physics=3.0)

    NAMES = ("planted_module:X", "planted_module:_exit", "os:_exit", "torch:os._exit")

    @pytest.mark.parametrize("name", NAMES)
    def test_a_physics_is_imported_of_a_trusted_file_alone(self, content, planted, name):
        """One of a module that is there already is not called either."""
        path = content(physics={"": name})
        refused(ValueError, rf"model\.pt: .*{name}.*physics=.*trusted=True", load, path)
        assert not planted.exists()
        refused(TypeError, "trusted must be True or False", load, path, trusted=name)
        if name == "planted_module:X":
            refused(ValueError, r"model\.pt: .*not name a physics", load, path, trusted=True)
            assert planted.exists()
            assert not planted.read_text()

    PARTS = ("class", "options", "missing", "physics", "physics_values", "data", "names", "state")

    @pytest.mark.parametrize("part", PARTS)
    def test_damaged_parts(self, content, part):
        """One that is left out or wrong is an error with the file's name, or does no harm."""
        path = content()
        torch.save({name: each for name, each in content.held.items() if name != part}, path)
        refused(ValueError, r"model\.pt is damaged.*KeyError", load, path, trusted=True)
        errors = 0
        for wrong in (None, 3, "x", [3], {"x": 3}, {"train_X": 1}, torch.ones(2)):
            try:
                load(content(**{part: wrong}), trusted=True)
            except ValueError as error:
                errors += "model.pt" in str(error)
        assert errors > 3


def test_what_a_fit_may_move_comes_back_and_another_state_changes_nothing(uniform, path):
    X, Y, Z = problem(uniform)
    model = CKA(X, Y, physics=relu)
    model.likelihood.noise = 0.5
    model.likelihood.noise_covar.raw_noise.requires_grad_(False)
    register_priors(model)
    save(model, path)
    again = load(path, trusted=True)
    same(model.predict(Z), again.predict(Z))
    learnt = [{n for n, p in m.named_parameters() if p.requires_grad} for m in (model, again)]
    assert learnt[0] == learnt[1]
    model = CKA(X, Y, physics=relu)
    before = model.predict(Z)
    state = {name: value + 1 for name, value in model.state_dict().items()}
    state["covar_module.terms.0.kernel.base_kernel.raw_lengthscale"] = torch.ones(2, 1, 3)
    for wrong in (state, ZeroMeanGP(X, Y).state_dict()):
        refused(RuntimeError, r"as it was.*terms\.0", model.load_state_dict, wrong)
    torch.testing.assert_close(model.predict(Z), before)
