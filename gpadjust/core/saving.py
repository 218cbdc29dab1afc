"""Models as files: data, settings and draws, and the physics by its name."""

from __future__ import annotations

import secrets
import sys
import warnings
from copy import deepcopy
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_kind, check_switch
from gpadjust.core.data import names_of
from gpadjust.core.kernels import Kernel
from gpadjust.core.model import GP
from gpadjust.core.noise import Noise
from gpadjust.core.stacked import StackedGP
from gpadjust.physics import PhysicsError
from gpadjust.physics.import_path import import_path, is_formula, physics_from_path

_FORMAT = 4
_COMPARED = 100  # rows whose covariances with all others tell kernels apart
_PARTS = (Kernel, Noise, InputTransform)  # of a model, which a file may hold


class Saved(NamedTuple):
    """A file, the import paths of its physics, and which arguments it could not hold."""

    path: Path
    physics: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass
class _Frame:
    """Inputs whose columns have names, which kernels and transforms may ask for."""

    values: Tensor
    columns: tuple[str, ...]

    @property
    def shape(self) -> torch.Size:
        return self.values.shape

    def to_numpy(self) -> np.ndarray:
        return self.values.numpy()


def save(model: GP | StackedGP, path: str | Path) -> Saved:
    """Save a model: its class, settings, data and draws, and its physics by the import path.

    Arguments that are not plain values (kernels, noises and transforms without ``settings``,
    lambdas, and the terms of a plain ``GP``) are to be given to :func:`load` again. The file is
    written under a fresh name and renamed: it is complete or not there, and a symbolic link at
    ``path`` is replaced.

    Args:
        model: The model, or a mixture of several. A class of one's own takes train_X, train_Y and
            train_Yvar first, and its ``settings`` are all its other arguments but ``physics``.
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
    check_kind("model", model, GP | StackedGP, "a model of gpadjust.core")
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"Expected path as a file in a folder that exists; found {str(path)!r}.")
    content = _stack_content(model) if isinstance(model, StackedGP) else _content(model)
    missing, names = content["missing"], content["physics"]
    if "physics" in missing or any(name.startswith("__main__:") for name in names):
        warnings.warn(
            f"Other programs cannot import the physics of {path.name}, a lambda or a part of the "
            f"running script. Pass it again: load(path, {_call({'physics', *missing})}).",
            stacklevel=2,
        )
    part = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with part.open("xb") as file:  # not an existing file, nor where a link points to
            torch.save(content, file)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return Saved(path, tuple(filter(None, names)), tuple(missing))


def load(path: str | Path, *, trusted: bool = False, **objects: Any) -> Any:
    """Load a model that :func:`save` wrote.

    A stranger's file executes nothing: its class is one of an imported module, and its physics is
    given, or a formula. Only a trusted file's physics is imported, which runs its module.

    Args:
        path: The file.
        trusted: Whether to import a physics that is not given.
        objects: ``physics``, and what the file could not hold; an error names it.

    Raises:
        OSError: If the file cannot be read.
        PhysicsError: If a physics fails at the training inputs.
        TypeError: If ``trusted`` is not True or False.
        ValueError: If the file is another kind or damaged, objects are missing or others than the
            model was built with, or the class or physics is not imported, or not trusted.
    """
    check_switch("trusted", trusted)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        make = _stack if "models" in content else _model
        return make(content, objects, trusted)
    except (OSError, PhysicsError):
        raise
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except Exception as error:
        cause = f"it is another kind of file, damaged, or an object is a wrong one ({error!r})"
        raise ValueError(f"Expected {path} as a model that gpadjust saved; {cause}.") from error


def _content(model: GP) -> dict[str, Any]:
    """Return what the file of a model holds."""
    model_class, data, n = type(model), model.data, model.rows_of_fit
    module, name = model_class.__module__, model_class.__qualname__
    if getattr(sys.modules[module], name, None) is not model_class:
        raise ValueError(f"Expected a class of a module; found {name}. Move it out of functions.")
    if model.batch_shape or model._outputs is not None or n > len(data.Y):
        raise ValueError(
            "Expected a model of one data set and all its outputs; found fantasies, or a part of "
            "the rows or outputs. Save the model that it was made from."
        )
    parameters = signature(model_class).parameters.values()
    takes_physics = any(p.name == "physics" or p.kind is p.VAR_KEYWORD for p in parameters)
    names = [import_path(each) for each in model.physics] if takes_physics else []
    settings = {n: _packed(v) for n, v in model.settings.items() if n != "outcome_transform"}
    if settings.get("noise") is not None:
        settings["noise"] = _packed(model.noise.of_rows(torch.arange(n)))
    if settings.get("input_transform") is not None:
        settings["input_transform"] = _packed(data.transform)
    missing = [name for name, value in settings.items() if not _is_plain(value)]
    scalings = [term.name for term in model.terms if term.physics is not None]
    is_mapping = model_class is not GP and all(each.startswith("rho_") for each in scalings)
    tensors = {"X": data.X, "Y": data.Y, "Yvar": data.Yvar, "u": model.u, "draws": model.draws}
    return {
        "format": _FORMAT,
        "class": f"{module}:{name}",
        "settings": {name: value for name, value in settings.items() if name not in missing},
        "missing": missing + ["physics"] * (None in names),
        "physics": [name or "" for name in names],
        "physics_names": [each.removeprefix("rho_") for each in scalings if is_mapping],
        "rows_of_fit": n,
        "names": [list(data.input_names), list(data.output_names)],
        "built_with": _built_with(model, n),
        "buffers": {name: v.cpu() for name, v in model.named_buffers(recurse=False)},
        **{name: v if v is None else v.detach().cpu().clone() for name, v in tensors.items()},
    }


def _stack_content(model: StackedGP) -> dict[str, Any]:
    """Return what the file of a mixture holds: its models, and a weight of each, or each output."""
    models = {n: _content(each) for n, each in zip(model.names, model.models, strict=True)}
    is_whole = bool((model.picks == model.picks[:, :1]).all())
    weights = {name: own[0] if is_whole else own for name, own in model.weights.items()}
    return {
        "class": f"{type(model).__module__}:{type(model).__qualname__}",
        "models": models, "weights": weights, "num_components": len(model.picks),
        "missing": [*dict.fromkeys(n for each in models.values() for n in each["missing"])],
        "physics": [*dict.fromkeys(n for each in models.values() for n in each["physics"])],
    }  # fmt: skip


def _packed(value: Any) -> Any:
    """Return a noise, kernel or transform as its class and settings, if it has any."""
    if not isinstance(value, _PARTS) or not hasattr(value, "settings"):
        return value
    own = type(value)
    settings = {name: _packed(each) for name, each in value.settings.items()}
    return {"class": f"{own.__module__}:{own.__qualname__}", "settings": settings}


def _unpacked(value: Any) -> Any:
    """Return what was packed; its class is one of this library or of an imported module."""
    if not isinstance(value, dict) or value.keys() != {"class", "settings"}:
        return value
    module, _, name = value["class"].partition(":")
    if module.startswith("gpadjust."):
        import_module(module)
    own = getattr(sys.modules.get(module), name, None)
    if not isinstance(own, type) or not issubclass(own, _PARTS):
        raise ValueError(f"no class {value['class']} was found; import its module first.")
    return own(**{name: _unpacked(each) for name, each in value["settings"].items()})


def _is_plain(value: Any) -> bool:
    """Return whether ``torch.load`` reads a value with ``weights_only=True``."""
    if type(value) in (list, tuple):
        return all(map(_is_plain, value))
    if type(value) is dict:
        return all(map(_is_plain, value.values()))
    return type(value) in (bool, int, float, str, type(None), Tensor)


@torch.no_grad()
def _built_with(model: GP, n: int) -> dict[str, Tensor]:
    """Return numbers at the first n inputs and the prior's middle, which tell models apart."""
    values, X = model.table.values(torch.zeros_like(model.u[:1])), model.data.X[:n]
    places = model.places(X, values)
    total = model.term_sum.at(values, places)
    own = model.noise.of_rows(torch.arange(n)) or model.noise
    noise = own.variance(values, places, True)[..., :n]
    numbers = {f"physics {i + 1}": f * model.unit for i, f in enumerate(places.f)}
    numbers |= {"unit": model.unit, "mean": total.mean, "noise": noise}
    for row in (*model.table.own, *model.table.shared):
        numbers[f"prior of {row.name}"] = torch.stack([row.location, row.location + row.scale])
    for choice in model.table.choices:
        numbers[f"choice {choice[0]} {choice[2]}"] = torch.tensor(choice.probability)
    numbers["kernel"] = total.cross(total.of_rows(slice(_COMPARED))).sum(-1)
    return {name: value.detach().cpu().clone() for name, value in numbers.items()}


def _stack(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> StackedGP:
    """Return the mixture of a file; of several physics each model takes its own."""
    _check_objects(content, objects)
    models = {}
    for name, each in content["models"].items():
        own = {n: v for n, v in objects.items() if n in each["missing"] and n != "physics"}
        physics = [objects["physics"]] if each["physics"] and "physics" in objects else []
        if physics and isinstance(physics[0], dict) and not each["physics_names"]:
            physics = [*physics[0].values()]
        models[name] = _first_that_fits(each, own, physics, trusted)
    return _class_of(content, StackedGP)(models, content["weights"], content["num_components"])


def _first_that_fits(
    content: dict[str, Any], objects: dict[str, Any], physics: list[Any], trusted: bool
) -> GP:
    """Return the model of a file with the first of several physics that it was built with."""
    for i, each in enumerate(physics or [None]):
        own = objects if each is None else objects | {"physics": each}
        try:
            return _model(content, own, trusted)
        except ValueError:
            if i + 1 >= len(physics):
                raise
    raise AssertionError


def _check_objects(content: dict[str, Any], objects: dict[str, Any]) -> None:
    """Raise a ValueError unless objects are what a file needs, with its physics or without."""
    known = {*content["missing"], *["physics"] * bool(content["physics"])}
    if objects.keys() - known or {*content["missing"]} - objects.keys():
        raise ValueError(
            f"expected what the file could not hold, load(path, {_call(content['missing'])}), and "
            f"nothing else but its physics; found load(path, {_call(objects)})."
        )


def _class_of(content: dict[str, Any], kind: type[Any]) -> Any:
    """Return the class of a file's model, of a module that is imported."""
    module, _, name = content["class"].partition(":")
    found = getattr(sys.modules.get(module), name, None)  # nothing is imported for it
    if not isinstance(found, type) or not issubclass(found, kind):
        raise ValueError(f"no model {content['class']} was found; import its module first.")
    return found


def _model(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> GP:
    """Return the model of a file, with the objects that are given."""
    if content["format"] != _FORMAT:
        raise ValueError(f"expected format {_FORMAT}; found {content['format']}.")
    _check_objects(content, objects)
    model_class = _class_of(content, GP)
    settings = {name: _unpacked(value) for name, value in content["settings"].items()}
    settings |= {n: deepcopy(objects[n]) for n in content["missing"]}
    if content["physics"]:
        given = "physics" in objects
        settings["physics"] = objects["physics"] if given else _physics(content, trusted)
    n, X, Y, Yvar = (content[name] for name in ("rows_of_fit", "X", "Y", "Yvar"))
    data = [X, Y] if Yvar is None else [X, Y, Yvar]
    inputs, outputs = (tuple(map(str, names)) for names in content["names"])
    is_right = type(n) is int and 2 <= n <= len(X) and all(len(v) == len(X) for v in data)
    if not is_right or (len(inputs), len(outputs)) != (X.shape[-1], Y.shape[-1]):
        raise ValueError("expected data of one length, and a name of each input and output.")
    named = X[:n] if inputs == names_of(X, "x") else _Frame(X[:n], inputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they came when the model was built
        model: GP = model_class(named, *(v[:n] for v in data[1:]), **settings)
    built_with = _built_with(model, n)
    if other := built_with.keys() ^ content["built_with"].keys():
        raise ValueError(f"it was saved with other kernels: {', '.join(sorted(other))}.")
    for name, value in built_with.items():
        saved, size = content["built_with"][name], 1e-6 * value.abs() + 1e-9 * value.abs().max()
        if saved.shape != value.shape or not ((saved - value).abs() <= size).all():
            raise ValueError(
                f"it was saved with another {name}: numbers at the training inputs differ. Give "
                "what the model was built with (several physics in the same order)."
            )
    model.set_draws(content["u"].double())
    u = model.u
    model.set_draws(content["draws"].double())
    model.u = u
    buffers = dict(model.named_buffers(recurse=False))
    if buffers.keys() != content["buffers"].keys():
        raise ValueError(f"expected tensors {[*buffers]}; found {[*content['buffers']]}.")
    for name, value in content["buffers"].items():
        setattr(model, name, value)
    model.data = model.data._replace(input_names=inputs, output_names=outputs)
    if n < len(X):
        late = None if Yvar is None or Yvar[n:].allclose(Yvar[:n].mean(0)) else Yvar[n:]
        model = model.condition_on_observations(X[n:], Y[n:], late)
    return model.eval()


def _physics(content: dict[str, Any], trusted: bool) -> Any:
    """Return the physics that a file names."""
    for name in content["physics"]:
        if not trusted and not is_formula(name):
            raise ValueError(
                f"its physics is the code {name}. Give the physics, load(path, physics=...), or "
                "have it imported if you trust the file, load(path, trusted=True)."
            )
    parts = [physics_from_path(name) for name in content["physics"]]
    if content["physics_names"]:
        return dict(zip(content["physics_names"], parts, strict=True))
    is_list = len(parts) > 1 or content["class"] == f"{GP.__module__}:GP"
    return parts if is_list else parts[0]


def _call(names: Any) -> str:
    return ", ".join(f"{name}=..." for name in sorted(names)) or "..."
