"""Models as files."""

import os
import secrets
import stat
import sys
from functools import partial

import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import MaternKernel, ScaleKernel
from torch.nn.functional import relu, silu

from gpadjust import core
from gpadjust.core import CKA, GP, MATERN52, KnownNoise, Stationary, ZeroMeanGP, load, save
from gpadjust.core.saving import _built_with
from gpadjust.kinds import Vanishing
from gpadjust.physics import FormulaPhysics, FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.systems import normal, refused, uniform

X = uniform(7, 2) - 0.3
Y = relu(X) * 1.2 + X.square()
Y[2, 1] = torch.nan
Z = X[:4] + 0.05
FORMULA = FormulaPhysics("a * x, x", ["x", "z"], unknowns={"a": Unknown(1.0, factor=1.5)})


class Gained(CKA):
    """A structure of a user, with its own setting and physics."""

    def __init__(self, train_X, train_Y, train_Yvar=None, *, gain):
        super().__init__(train_X, train_Y, train_Yvar, physics=lambda X: gain * relu(X))
        self.settings = {"gain": gain}


class Fixed(CKA):
    """A structure of a user, with its own physics."""

    def __init__(self, train_X, train_Y):
        super().__init__(train_X, train_Y, physics=lambda X: relu(X))
        self.settings = {}


def drawn(model):
    """Return the model with three draws, of which predictions average over two."""
    model.set_draws(0.3 * normal(3, *model.u.shape[1:], seed=1))
    model.u = torch.nn.Parameter(model.u[:2].detach().clone())
    return model


def same(one, other):
    for a, b in zip(one.predict(Z, True), other.predict(Z, True), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)
    assert torch.equal(one.u, other.u)
    assert torch.equal(one.draws, other.draws)
    assert type(one) is type(other)
    assert one.data.input_names == other.data.input_names


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.pt"


def terms():
    return [
        core.Term("f", Stationary(MATERN52), 0.2, core.LogNormal(1.0, 10.0)),
        core.Term("g", physics=0),
    ]


CHOICES = [core.Choice("all", 0.5), core.Choice("no f", 0.5, ("f.process", "f.constant"))]
CONSTANTS = {"rho": core.LogNormal(0.02, 90.0)}
NESTED = [core.Choice("all", 0.5), core.Choice("a factor", 0.5, ("rho.process", "delta.process"))]
EXTRA = [
    core.Term("zero at 0", Vanishing({0: 0.0})),
    core.Term("slope", constant=core.LogNormal(1.0, 10.0)),
]
OF_USERS = {"noise": Relative(), "input_transform": Normalize(2)}
# Models, and the objects that their files do not contain.
MODELS = {
    "CKA": (partial(CKA, X, Y, physics=relu, delta_mean=0.1, rho_mean=0.9, center=0.2), {}),
    "several": (partial(CKA, X, Y, 0.01, physics={"a": relu, "b": silu}, rho_mean=[1.0, 0.5]), {}),
    "RRA": (partial(core.RRA, X, Y, physics=[relu], num_features=16, seed=3), {}),
    "no constants": (partial(ZeroMeanGP, X, Y, constants=False), {}),
    "own class": (partial(Gained, X, Y, gain=2.0), {}),
    "own physics": (partial(Fixed, X, Y), {}),
    "kernel": (
        partial(CKA, X, Y, physics=relu),
        {"delta_covar_module": ScaleKernel(MaternKernel(1.5)), **OF_USERS},
    ),
    "known noise": (partial(CKA, X, Y, physics=relu), {"noise": KnownNoise(torch.rand_like(Y.mT))}),
    "choices": (
        partial(GP, X, Y, physics=[relu], choices=CHOICES),
        {"terms": terms(), **OF_USERS},
    ),
    "extra terms": (partial(CKA, X, Y, physics=relu, extra_terms=EXTRA), {}),
    "own nested": (partial(CKA, X, Y, physics=relu, nested=NESTED, constants=CONSTANTS), {}),
    "known": (partial(GP, X, Y, 0.1), {"terms": terms()[:1]}),
}


@pytest.mark.parametrize("conditioned", [False, True])
@pytest.mark.parametrize("name", list(MODELS))
def test_a_model_comes_back(name, conditioned, path):
    build, objects = MODELS[name]
    model = drawn(build(**objects))
    if conditioned:
        noise = torch.full_like(Y[:3], 0.2) if model.data.Yvar is not None else None
        model = model.condition_on_observations(3 * X[:3] + 1.0, Y[2:5] * 9.0, noise)
    model.data = model.data._replace(input_names=("left [m]", "right [m]"))
    saved = save(model, path)
    assert set(saved.missing) == set(objects)
    assert torch.load(path, weights_only=True)["models"][""]["missing"] == list(saved.missing)
    same(load(path, trusted=True, **objects), model)


@pytest.mark.parametrize("physics", [{"a": relu}, [relu, silu]])
def test_a_physics_that_is_passed(physics, path):
    model = drawn(CKA(X, Y, physics=physics))
    save(model, path)
    same(load(path, physics=physics), model)


def test_a_lambda_is_passed_again(path):
    physics = FunctionPhysics(lambda X, p: p.a[:, None] * X, unknowns={"a": Unknown(1.0, sd=0.1)})
    model = drawn(CKA(X, Y, physics=physics))
    with pytest.warns(UserWarning, match=r"load\(path, physics=\.\.\.\)"):
        saved = save(model, path)
    assert saved == (path, (), ("physics",))
    same(load(path, physics=physics), model)


def test_formulas_need_no_trust(path):
    model = drawn(CKA(X, Y, physics=FORMULA))
    assert save(model, path).physics[0].startswith("formula:")
    same(load(path), model)


def bad(tensor):
    """Return a copy with NaN in it."""
    return torch.cat([tensor[:1] * torch.nan, tensor[1:]])


MODEL = drawn(CKA(X, Y, physics=relu))
CHECKS = _built_with(MODEL, 7)


def nested(*probabilities, kind="Choice"):
    """Return the content of a file for the nested models of the model with other probabilities."""
    choices = zip(MODEL.table.choices, probabilities, strict=True)
    settings = [choice._asdict() | {"probability": p} for choice, p in choices]
    return {
        "nested": [{"class": f"gpadjust.core.unknowns:{kind}", "settings": s} for s in settings]
    }


# Changes of the content of a file, at which None deletes, and the words of the error.
BAD_FILES = {
    "NaN u": ({"u": bad(MODEL.u.detach())}, "finite coord"),
    "no draws": ({"u": MODEL.u[:0].detach()}, "finite coord"),
    "other draws": ({"draws": MODEL.draws[..., 1:]}, "finite coord"),
    "NaN X": ({"X": bad(X)}, "finite"),
    "moved X": ({"X": X + 0.1}, "another physics 1"),
    "longer Y": ({"Y": torch.cat([Y, Y])}, "one length"),
    "rows": ({"rows_of_fit": 1}, "at least 2 points"),
    "no such rows": ({"rows_of_fit": True}, "at least 2 points"),
    "fewer names": ({"names": [["a"], ["b", "c"]]}, "a name of each"),
    "another format": ({"format": 3}, "found 3, of another version .* fit the model and save it"),
    "no check": ({"built_with": None}, "damaged"),
    "NaN check": ({"built_with": CHECKS | {"mean": bad(CHECKS["mean"])}}, "another mean"),
    "another class": ({"class": "gpadjust.core.structures:RRA"}, "kernels|damaged|another"),
    "no model": ({"class": "builtins:dict"}, "import its module first"),
    "not imported": ({"class": "antigravity:GP"}, "import its module first"),
    "other settings": ({"settings": {"nested": False}}, "another prior of choice"),
    "other choices": ({"settings": nested(0.5, 0.3, 0.2)}, "another choice your formula corrected"),
    "a class of no part": ({"settings": nested(0.45, 0.35, 0.2, kind="Row")}, "no class .*Row"),
    "unknown settings": ({"settings": {"gain": 2.0}}, "wrong one"),
    "a path of code": ({"physics": ["antigravity:geohash"]}, "is the code antigravity"),
    "a bad formula": ({"physics": ["formula:{}"]}, "formula"),
}


@pytest.mark.parametrize("name", list(BAD_FILES))
def test_a_bad_file(name, path):
    changes, words = BAD_FILES[name]
    save(MODEL, path)
    file = torch.load(path, weights_only=True)
    content = file if "format" in changes else file["models"][""]
    content |= changes
    for key in [key for key, value in changes.items() if value is None]:
        del content[key]
    torch.save(file, path)
    refused(ValueError, words, load, path, **{} if "physics" in changes else {"physics": relu})
    assert "antigravity" not in sys.modules


def test_a_file_of_code_is_not_executed(path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(path) + ".bomb",)

    for content in ({"format": 5, "models": Bomb()}, [1], "text", {}):
        torch.save(content, path)
        refused(ValueError, r"Expected .* as a model", load, path)
    path.write_bytes(b"no file of torch")
    refused(ValueError, r"Expected .* as a model", load, path)
    assert [*path.parent.iterdir()] == [path]


SILU = partial(CKA, X, Y, physics=silu)
KERNEL = {"delta_covar_module": Stationary(MATERN52), "noise": core.Noise()}
OTHER_KERNEL = {"delta_covar_module": Stationary(core.MATERN32), "noise": core.Noise()}
KNOWN = {"terms": terms(), "noise": KnownNoise(torch.ones_like(Y.mT))}
WIDER = [terms()[0]._replace(constant=core.LogNormal(1.0, 11.0)), terms()[1]]
OF_RELU = partial(GP, X, Y, physics=[relu])
# A model, the objects that it is loaded with, and the words of the error.
WRONG_OBJECTS = [
    (SILU, {}, {}, "is the code torch.nn.functional:silu"),
    (SILU, {}, {"physics": relu}, "another physics 1"),
    (SILU, {}, {"physics": [silu, silu]}, "another physics 2"),
    (SILU, {}, {"physics": silu, "terms": 1}, "otherwise only its physics"),
    (SILU, KERNEL, {"physics": silu}, r"load\(path, delta_covar_module=\.\.\., noise"),
    (SILU, KERNEL, {"physics": silu} | OTHER_KERNEL, "another kernel"),
    (SILU, KERNEL, {"physics": silu} | KERNEL | {"noise": Relative()}, "another noise"),
    (SILU, KERNEL, {"physics": silu} | KERNEL | {"noise": 3}, "wrong one"),
    (OF_RELU, KNOWN, KNOWN | {"terms": WIDER}, "another prior"),
]


@pytest.mark.parametrize(("build", "own", "objects", "words"), WRONG_OBJECTS)
def test_wrong_objects(build, own, objects, words, path):
    save(drawn(build(**own)), path)
    load(path, trusted=True, **own)
    refused(ValueError, words, load, path, **objects, trusted=build is OF_RELU)


def local():
    class Local(CKA):
        pass

    return Local(X, Y, physics=relu)


@pytest.mark.parametrize(("make", "words"), [
    (lambda: CKA(X, Y, physics=relu).subset_output([0]), "a part of"),
    (lambda: CKA(X, Y, physics=relu).subset_rows(torch.arange(4)), "a part of"),
    (lambda: ZeroMeanGP(X, Y).subset_rows(torch.arange(4)), "a part of"),
    (lambda: MODEL.condition_on_observations(X[:1].expand(3, 1, 2), Y[:1]), "fantasies"),
    (local, "Move it out of functions"),
])  # fmt: skip
def test_models_that_cannot_be_saved(make, words, path):
    refused(ValueError, words, save, make(), path)
    assert not [*path.parent.iterdir()]


def test_paths(path, tmp_path):
    refused(TypeError, "a model of", save, torch.nn.Linear(1, 1), path)
    for wrong in (tmp_path, tmp_path / "none" / "model.pt"):
        refused(ValueError, "a folder that exists", save, MODEL, wrong)
    refused(FileNotFoundError, "model.pt", load, path)
    refused(TypeError, "trusted", load, path, trusted=1)


def test_a_link_is_replaced_and_not_followed(path, tmp_path):
    other, plain = tmp_path / "other", tmp_path / "plain"
    other.write_text("kept")
    path.symlink_to(other)
    save(MODEL, path)
    assert other.read_text() == "kept"
    assert not path.is_symlink()
    plain.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_failure_leaves_the_file_as_before(path, monkeypatch):
    save(MODEL, path)
    before = path.read_bytes()

    def full(content, file):
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", full)
    refused(OSError, "No space", save, MODEL, path)
    assert path.read_bytes() == before
    assert [*path.parent.iterdir()] == [path]


def test_names_of_parts_cannot_be_guessed(path, monkeypatch):
    """A name that exists, as a link of somebody else, is not written to."""
    secret = path.with_name("secret")
    path.with_name(".taken.part").symlink_to(secret)
    monkeypatch.setattr(secrets, "token_hex", lambda number: "taken")
    refused(FileExistsError, "taken", save, MODEL, path)
    assert not secret.exists()
