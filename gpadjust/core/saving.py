"""Models as files: data, settings and draws, and the physics by its name."""

from __future__ import annotations

import secrets
import sys
import warnings
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_switch
from gpadjust.core.data import names_of
from gpadjust.core.kernels import Kernel
from gpadjust.core.model import GP
from gpadjust.core.noise import Noise
from gpadjust.core.stacked import StackedGP
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Choice, LogNormal
from gpadjust.physics import PhysicsError
from gpadjust.physics.import_path import import_path, is_formula, physics_from_path

_FORMAT = 5
_COMPARED = 100  # rows whose covariances with all others distinguish kernels
_PARTS = (Kernel, Noise, InputTransform)  # of a model, that a file may contain by settings
_TUPLES = (Term, LogNormal, Choice)  # by fields


class Saved(NamedTuple):
    """A file, the import paths of its physics, and arguments that it does not contain."""

    path: Path
    physics: tuple[str, ...]
    missing: tuple[str, ...]


def save(model: GP | StackedGP, path: str | Path) -> Saved:
    """Save a model: its class, settings, data and draws, and its physics by the import path.

    Arguments that are not plain values (kernels, noises and transforms without ``settings``, lists
    of terms with such kernels, and lambdas) are to be passed to :func:`load`. The file is written
    under a fresh name and renamed, so that it is complete.

    Args:
        model: The model, or a mixture of several. A subclass of ``GP`` takes train_X, train_Y and
            train_Yvar first, and its ``settings`` are all other arguments but ``physics``.
        path: The file.

    Warns:
        UserWarning: If another program cannot import the physics: a lambda, or one of a script.

    Raises:
        TypeError: If it is not a model of this library.
        ValueError: If its class is not in a module, it has fantasies or a part of a model's rows
            or outputs, or the path is not a file in a folder that exists.

    Example:
        >>> import tempfile, torch
        >>> from gpadjust.core import CKA
        >>> from torch.nn.functional import silu
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * silu(X) + X, physics=silu)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     saved = save(model, f"{folder}/model.pt")
        ...     again = load(f"{folder}/model.pt", trusted=True)
        >>> saved.missing, torch.equal(again.predict(X).mean, model.predict(X).mean)
        ((), True)
    """
    if not isinstance(model, GP | StackedGP):
        raise TypeError(
            f"Expected a model of gpadjust.core; found {type(model).__name__}. Of a comparison "
            "save comparison.recommended, of a list each of model.models."
        )
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"Expected path as a file in a folder that exists; found {str(path)!r}.")
    models: Any = {"": model}
    mixture: dict[str, Any] | None = None
    if isinstance(model, StackedGP):
        models = dict(zip(model.names, model.models, strict=True))
        is_whole = bool((model.picks == model.picks[:, :1]).all())
        weights = {name: w[0] if is_whole else w for name, w in model.weights.items()}
        mixture = {"class": _path_of(type(model)), "weights": weights}
        mixture["num_components"] = len(model.picks)
    contents = {name: _content(gp) for name, gp in models.items()}
    missing = [*dict.fromkeys(name for content in contents.values() for name in content["missing"])]
    physics = [*dict.fromkeys(name for content in contents.values() for name in content["physics"])]
    if any(name is None or name.startswith("__main__:") for name in physics):
        warnings.warn(
            f"Other programs cannot import the physics of {path.name}, a lambda or a part of the "
            f"running script. Pass it again: load(path, {_call({'physics', *missing})}).",
            stacklevel=2,
        )
    part = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with part.open("xb") as file:  # not an existing file, nor where a link points to
            torch.save({"format": _FORMAT, "models": contents, "mixture": mixture}, file)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return Saved(path, tuple(filter(None, physics)), tuple(missing))


def load(path: str | Path, *, trusted: bool = False, **objects: Any) -> Any:
    """Load a model that :func:`save` wrote.

    A file that is not trusted executes nothing: its class is one of an imported module, and its
    physics is passed, or a formula. The physics of a trusted file is imported, which runs its
    module.

    Args:
        path: The file.
        trusted: Whether to import a physics that is not passed.
        objects: ``physics``, and other arguments that the file does not contain; an error names
            them. Of several physics by name each model of a mixture takes its one.

    Raises:
        OSError: If the file cannot be read.
        PhysicsError: If a physics fails at the training inputs.
        TypeError: If ``trusted`` is not True or False.
        ValueError: If the file is of another kind or damaged, objects are missing or differ from
            those of the saved model, or the class or physics is not imported, or not trusted.
    """
    check_switch("trusted", trusted)
    try:
        return _loaded(torch.load(path, map_location="cpu", weights_only=True), objects, trusted)
    except (OSError, PhysicsError):
        raise
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except Exception as error:
        cause = f"it is another kind of file, damaged, or an object is a wrong one ({error!r})"
        raise ValueError(f"Expected {path} as a model that gpadjust saved; {cause}.") from error


def _content(model: GP) -> dict[str, Any]:
    """Return the content of the file of a model."""
    data, n = model.data, model.rows_of_fit
    if model.batch_shape or model._outputs is not None or n > len(data.Y):
        raise ValueError("Expected one data set with all outputs, not fantasies or a part of it.")
    parameters = signature(type(model)).parameters.values()
    takes_physics = any(p.name == "physics" or p.kind is p.VAR_KEYWORD for p in parameters)
    paths = [import_path(f_p) for f_p in model.physics if takes_physics]
    settings = {name: v for name, v in model.settings.items() if name != "outcome_transform"}
    learnt = {"noise": model.noise.of_rows(torch.arange(n)), "input_transform": data.transform}
    settings |= {name: v for name, v in learnt.items() if settings.get(name) is not None}
    settings = {name: _packed(value) for name, value in settings.items()}
    missing = [name for name, value in settings.items() if not _is_plain(value)]
    settings = {name: value for name, value in settings.items() if name not in missing}
    if None in paths:
        missing.append("physics")
    scalings = [term.name for term in model.terms if term.physics is not None]
    is_mapping = type(model) is not GP and all(name.startswith("rho_") for name in scalings)
    return {
        "class": _path_of(type(model)),
        "settings": settings,
        "missing": missing,
        "physics": paths,
        "physics_names": [name.removeprefix("rho_") for name in scalings if is_mapping],
        "rows_of_fit": n,
        "names": [list(data.input_names), list(data.output_names)],
        "built_with": _built_with(model, n),
        "X": data.X.detach(),
        "Y": data.Y.detach(),
        "Yvar": data.Yvar,
        "u": model.u.detach(),
        "draws": model.draws,
        "buffers": dict(model.named_buffers(recurse=False)),
    }


def _path_of(kind: type[Any]) -> str:
    """Return the name of a class and its module; a ValueError if it is inside of a function."""
    module, name = kind.__module__, kind.__qualname__
    if getattr(sys.modules[module], name, None) is not kind:
        raise ValueError(f"Expected a class of a module; found {name}. Move it out of functions.")
    return f"{module}:{name}"


def _class_of(path: str, base: Any) -> Any:
    """Return a class by its name, of this library or of a module that is imported."""
    module, _, name = path.partition(":")
    if module.startswith("gpadjust."):
        import_module(module)
    kind = getattr(sys.modules.get(module), name, None)
    if not isinstance(kind, type) or not issubclass(kind, base):
        raise ValueError(f"no class {path} was found; import its module first.")
    return kind


def _packed(value: Any) -> Any:
    """Return a value with its parts as their classes and settings, if they have any."""
    if type(value) in (list, tuple):
        return type(value)(_packed(item) for item in value)
    if isinstance(value, Mapping):
        return {name: _packed(item) for name, item in value.items()}
    settings = None
    if isinstance(value, _TUPLES):
        settings = value._asdict()
    elif isinstance(value, _PARTS):
        settings = getattr(value, "settings", None)
    if settings is None:
        return value
    return {"class": _path_of(type(value)), "settings": _packed(settings)}


def _unpacked(value: Any) -> Any:
    """Return the reverse of :func:`_packed`."""
    if isinstance(value, list | tuple):
        return type(value)(_unpacked(item) for item in value)
    if not isinstance(value, dict):
        return value
    items = {name: _unpacked(item) for name, item in value.items()}
    if items.keys() != {"class", "settings"}:
        return items
    return _class_of(items["class"], (*_PARTS, *_TUPLES))(**items["settings"])


def _is_plain(value: Any) -> bool:
    """Return whether ``torch.load`` reads a value with ``weights_only=True``."""
    if type(value) is dict:
        value = list(value.values())
    if type(value) in (list, tuple):
        return all(map(_is_plain, value))
    return type(value) in (bool, int, float, str, type(None), Tensor)


@torch.no_grad()
def _built_with(model: GP, n: int) -> dict[str, Tensor]:
    """Return numbers at the first n inputs and the prior's middle, which distinguish models."""
    values = model.table.values(torch.zeros_like(model.u[:1]))
    places = model.places(model.data.X[:n], values)
    total = model.term_sum.evaluate(values, places)
    noise = model.noise.of_rows(torch.arange(n)) or model.noise
    numbers = {f"physics {i + 1}": f * model.unit for i, f in enumerate(places.f)}
    numbers["mean"] = total.mean * model.unit
    numbers["noise"] = noise.variance(values, places, True)[..., :n] * model.unit.square()
    for row in model.table.rows:
        numbers[f"prior of {row.name}"] = torch.stack([row.location, row.location + row.scale])
    for choice in model.table.choices:
        numbers[f"choice {choice.text} {choice.zeros}"] = torch.tensor(choice.probability)
    return numbers | {"kernel": total.cross(total.of_rows(slice(_COMPARED))).sum(-1)}


def _loaded(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> Any:
    """Return the model or mixture of a file, with the objects that are given."""
    if content["format"] != _FORMAT:
        version = f"found {content['format']}, of another version of gpadjust"
        raise ValueError(f"expected format {_FORMAT}; {version}: fit the model and save it again.")
    contents = content["models"].values()
    missing = {name for part in contents for name in part["missing"]}
    possible = missing | {"physics" for part in contents if part["physics"]}
    if not missing <= objects.keys() <= possible:
        raise ValueError(
            f"expected the arguments that the file does not contain, load(path, {_call(missing)}), "
            f"and otherwise only its physics; found load(path, {_call(objects)})."
        )
    mixture = content["mixture"]
    if mixture is None:
        return _model(content["models"][""], objects, trusted)
    models = {n: _of_mixture(part, objects, trusted) for n, part in content["models"].items()}
    return _class_of(mixture["class"], StackedGP)(
        models, mixture["weights"], mixture["num_components"]
    )


def _of_mixture(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> GP:
    """Return a model of a mixture, with the one of several physics that it was built with."""
    physics = objects.get("physics")
    takes_one = len(content["physics"]) == 1 and not content["physics_names"]
    if takes_one and isinstance(physics, Mapping):
        for f_p in physics.values():
            with suppress(ValueError):
                return _model(content, objects | {"physics": f_p}, trusted)
    return _model(content, objects, trusted)


def _model(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> GP:
    """Return the model of a file, with the objects that are given."""
    settings = {name: _unpacked(value) for name, value in content["settings"].items()}
    settings |= {name: objects[name] for name in content["missing"]}
    if content["physics"]:
        settings["physics"] = objects.get("physics")
        if settings["physics"] is None:
            settings["physics"] = _physics(content, trusted)
    n, X, Y, Yvar = (content[name] for name in ("rows_of_fit", "X", "Y", "Yvar"))
    inputs, outputs = (tuple(map(str, names)) for names in content["names"])
    if (*X.shape, *Y.shape) != (len(X), len(inputs), len(X), len(outputs)):
        raise ValueError("expected data of one length, and a name of each input and output.")
    named: Any = X[:n]
    if inputs != names_of(X, "x"):  # kernels and transforms may ask for these
        named = SimpleNamespace(columns=inputs, shape=named.shape, to_numpy=named.numpy)
    data = [Z[:n] for Z in (Y, Yvar) if Z is not None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they came when the model was built
        model: GP = _class_of(content["class"], GP)(named, *data, **settings)
    built_with, saved = _built_with(model, n), content["built_with"]
    for name in [*built_with, *saved]:
        ours, theirs = (numbers.get(name, X.new_zeros(0)) for numbers in (built_with, saved))
        is_same = ours.shape == theirs.shape
        if not is_same or not torch.allclose(theirs, ours, 1e-6, 1e-9 * float(ours.abs().max())):
            raise ValueError(
                f"it was saved with another {name}; pass what the model was built with, several "
                "physics in the same order."
            )
    model.set_draws(content["u"])
    u = model.u
    model.set_draws(content["draws"])
    model.u = u
    for name, _ in [*model.named_buffers(recurse=False)]:
        setattr(model, name, content["buffers"][name])
    model.data = model.data._replace(input_names=inputs, output_names=outputs)
    if n < len(Y):
        data = [Z[n:] for Z in (Y, Yvar) if Z is not None]
        model = model.condition_on_observations(X[n:], *data)
    return model.eval()


def _physics(content: dict[str, Any], trusted: bool) -> Any:
    """Return the physics that a file names."""
    for path in content["physics"]:
        if not trusted and not is_formula(path):
            raise ValueError(
                f"its physics is the code {path}. Pass the physics, load(path, physics=...), or "
                "import it if you trust the file, load(path, trusted=True)."
            )
    parts = [physics_from_path(path) for path in content["physics"]]
    if content["physics_names"]:
        return dict(zip(content["physics_names"], parts, strict=True))
    return parts if len(parts) > 1 or content["class"] == _path_of(GP) else parts[0]


def _call(names: Any) -> str:
    return ", ".join(f"{name}=..." for name in sorted(names)) or "..."
