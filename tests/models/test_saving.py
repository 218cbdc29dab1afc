"""Models as files."""

import pytest
import torch
from botorch.models.transforms import Normalize
from torch.nn.functional import relu, silu

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, StackedGP, ZeroMeanGP, load, save
from gpadjust.physics import as_physics


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.pt"


def problem(uniform):
    X = uniform(8, 2) - 0.3
    Y = relu(X) * 1.2 + X.square()
    Y[2, 1] = torch.nan
    return X, Y, uniform(5, 2, seed=1)


def same(model, other, Z):
    for ours, theirs in zip(model.predict(Z), other.predict(Z), strict=True):
        torch.testing.assert_close(ours, theirs)


BUILDS = {
    "CKA": lambda X, Y: CKA(X, Y, physics=relu, center="mean", delta_mean="learn"),
    "learnt centre": lambda X, Y: CKA(X, Y, physics=relu, center="learn"),
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
    again = load(path)
    assert type(again) is type(model)
    assert again.input_names == model.input_names
    same(model, again, Z)


def test_one_that_was_conditioned_and_holds_samples(uniform, path):
    X, Y, Z = problem(uniform)
    model = CKA(X, Y, physics=relu)
    named = {n: p for n, p in model.named_parameters() if p.requires_grad}
    model.hold_samples({n: torch.stack([p.detach(), p.detach() + 0.5]) for n, p in named.items()})
    model = model.condition_on_observations(Z, relu(Z))
    save(model, path)
    again = load(path)
    assert again.num_samples == 2
    same(model, again, Z)


def test_what_has_no_name_is_given_again(uniform, path):
    X, Y, Z = problem(uniform)
    options = {"physics": lambda X: relu(X), "input_transform": Normalize(2)}
    model = CKA(X, Y, **options)
    save(model, path)
    with pytest.raises(ValueError, match="could not hold input_transform and physics"):
        load(path)
    same(model, load(path, **options), Z)


def test_another_physics_is_refused(uniform, path):
    X, Y, _ = problem(uniform)
    save(CKA(X, Y, physics={"a": relu, "b": silu}), path)
    with pytest.raises(ValueError, match=r"saved with another physics.*same order"):
        load(path, physics={"a": silu, "b": relu})
    subset = CKA(X, Y, physics=relu).subset_output([1])
    with pytest.raises(ValueError, match="all outputs of its physics, got a subset"):
        save(subset, path)


def test_a_class_that_cannot_be_imported_is_refused(uniform, path):
    class Local(CKA):
        pass

    X, Y, _ = problem(uniform)
    with pytest.raises(ValueError, match=r"Local cannot be imported again"):
        save(Local(X, Y, physics=relu), path)
    assert not path.exists()


def test_a_state_of_another_model_changes_nothing(uniform):
    X, Y, Z = problem(uniform)
    model = CKA(X, Y, physics=relu)
    before = model.predict(Z)
    state = {name: value + 1 for name, value in model.state_dict().items()}
    state["covar_module.terms.0.kernel.base_kernel.raw_lengthscale"] = torch.ones(2, 1, 3)
    for wrong in (state, ZeroMeanGP(X, Y).state_dict()):
        with pytest.raises(RuntimeError, match=r"left as it was; they differ in .*terms\.0"):
            model.load_state_dict(wrong)
    torch.testing.assert_close(model.predict(Z), before)


def test_whether_it_is_fitted_is_known_of_a_loaded_model(uniform, path):
    X, Y, _ = problem(uniform)
    model = CKA(X, Y, physics=relu)
    save(model, path)
    assert not model.is_fitted
    assert not load(path).is_fitted
    with torch.no_grad():
        model.likelihood.noise_covar.raw_noise += 0.1
    save(model, path)
    assert model.is_fitted
    assert load(path).is_fitted
    known = CKA(X, Y, physics=relu)
    for parameter in known.parameters():
        parameter.requires_grad_(False)
    assert known.is_fitted  # as nothing is to be learnt


def test_a_stacked_model_comes_back(uniform, path):
    X, Y, Z = problem(uniform)
    models = {name: BUILDS[name](X, Y) for name in ("learnt centre", "zero mean")}
    stacked = StackedGP(models, torch.tensor([[0.5, 0.25], [0.5, 0.75]]).double())
    save(stacked, path)
    again = load(path)
    assert again.weights == stacked.weights
    same(again, stacked, Z)
    with pytest.raises(ValueError, match="take the StackedGP that it was made from"):
        save(stacked.subset_output([0]), path)
    same(load(path), stacked, Z)


def test_a_stacked_model_of_several_physics_is_given_those_without_a_name(uniform, path):
    X, Y, Z = problem(uniform)
    parts = {"low": lambda X: X - 1, "high": relu}
    models = {
        f"of {name}": CKA(X, Y, physics=part)
        for name, part in zip(parts, as_physics(parts).parts, strict=True)
    }
    models |= {"of all": CKA(X, Y, physics=parts), "none": ZeroMeanGP(X, Y)}
    stacked = StackedGP(models, torch.full((4, 2), 0.25).double())
    save(stacked, path)
    with pytest.raises(ValueError, match="could not hold physics"):
        load(path)
    same(load(path, physics=parts), stacked, Z)


def test_files_that_are_no_models(path):
    with pytest.raises(FileNotFoundError):
        load(path)
    path.write_bytes(b"no model")
    with pytest.raises(ValueError, match="is not a model that gpadjust saved"):
        load(path)
    torch.save({"format": 99}, path)
    with pytest.raises(ValueError, match="expected format 1"):
        load(path)
    with pytest.raises(TypeError, match="Expected a model of gpadjust, got Linear"):
        save(torch.nn.Linear(1, 1), path)
