"""Models as files: data, settings and hyper-parameters, and the physics by its name."""

from __future__ import annotations

import sys
import warnings
from copy import deepcopy
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import torch
from gpytorch.kernels import Kernel

from gpadjust.checks import check_switch
from gpadjust.gp import PhysicsInput
from gpadjust.models.stacked import StackedGP
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import with_names
from gpadjust.physics import JoinedPhysics, Physics, PhysicsError, PhysicsWarning, as_physics
from gpadjust.physics.import_path import import_path, is_formula, physics_from_path

_FORMAT = 3


class Saved(NamedTuple):
    """Manifest of a file that :func:`save` wrote.

    Attributes:
        path: The file.
        physics: The import paths by which :func:`load` finds the physics.
        missing: The arguments that :func:`load` has to be given, as the file could not hold them.
    """

    path: Path
    physics: tuple[str, ...]
    missing: tuple[str, ...]


def save(model: TermsModel | StackedGP, path: str | Path) -> Saved:
    """Save a model: data, settings, hyper-parameters (or samples of them), and names.

    The physics is saved by its import path, if it is a function or object of a module. What cannot
    be saved (a lambda, a kernel or transform of yours) is to be given to :func:`load` again.

    Args:
        model: The model.
        path: The file, which ``torch.load`` reads with ``weights_only=True``.

    Returns:
        What the file holds of the physics, and what it could not hold.

    Warns:
        UserWarning: If another program cannot import the physics: a lambda, or one of a script.

    Raises:
        TypeError: If it is no model of this library, or the path none.
        ValueError: If its class is not in its module or has other names for the data, it is a
            subset of a model's outputs, or the path is a folder, or in none that exists.

    Example:
        >>> import tempfile, torch
        >>> from gpadjust import CKA, load, save
        >>> from torch.nn.functional import silu
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * silu(X) + X, physics=silu)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     saved = save(model, f"{folder}/model.pt")
        ...     again = load(f"{folder}/model.pt", physics=silu)
        >>> saved.missing, torch.equal(again.posterior(X).mean, model.posterior(X).mean)
        ((), True)
    """
    if not isinstance(path, str | Path):
        raise TypeError(f"Expected path as the name of a file, got {path!r}.")
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        what = "a folder; name a file in it" if path.is_dir() else "in a folder that does not exist"
        raise ValueError(f"The path {str(path)!r} is {what}.")
    content = content_of(model)
    models = content["models"].values() if "models" in content else [content]
    names = {name for each in models for name in (each["physics"] or {}).values()}
    missing = {name for each in models for name in each["missing"]}
    if any(name is None or name.startswith("__main__:") for name in names):
        asked = {"physics", *missing}
        warnings.warn(
            f"The physics of {path.name} is a lambda or belongs to the running script, so that "
            "other programs cannot import it. Pass it again when you load the model, "
            f"load(path, {', '.join(f'{name}=...' for name in sorted(asked))}).",
            stacklevel=2,
        )
    part = path.with_name(f"{path.name}.part")
    try:
        torch.save(content, part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return Saved(path, tuple(sorted(names - {None})), tuple(sorted(missing)))


def content_of(model: TermsModel | StackedGP) -> dict[str, Any]:
    """The contents of a file of a model; the errors are those of :func:`save`."""
    if isinstance(model, StackedGP):
        return {
            "format": _FORMAT,
            "models": {name: content_of(part) for name, part in model.made_of.items()},
            "weights": torch.tensor([*model.weights.values()], dtype=torch.float64),
            "num_components": model.num_samples,
        }
    if not isinstance(model, TermsModel):
        raise TypeError(f"Expected a model of gpadjust, got {type(model).__name__}.")
    name = f"{type(model).__module__}:{type(model).__qualname__}"
    if getattr(import_module(type(model).__module__), type(model).__qualname__, None) is None:
        raise ValueError(f"{name} cannot be imported again: define the class in a module.")
    missing, physics, f_p, names = [*model.objects], None, None, []
    transform: Any = getattr(model, "input_transform", None)
    data: Any = model.data()
    if lacking := _not_taken(type(model), [n for n, value in data.items() if value is not None]):
        raise ValueError(
            f"{name} could not be built again: its constructor takes no "
            f"{' and no '.join(lacking)}. Name its data arguments as the library does."
        )
    if isinstance(transform, PhysicsInput):
        given: Any = transform.physics
        several = isinstance(given, JoinedPhysics)
        names = [*given.names] if several else [given.name]
        parts = zip(given.names, given.parts, strict=True) if several else [("", given)]
        physics = {name: import_path(part) for name, part in parts}
        missing += ["physics"] * (None in physics.values())
        with torch.no_grad():
            f_p = transform.values(data["train_X"])
        if f_p.shape[-1] != model.num_outputs * len(physics):
            raise ValueError("Expected a model of all outputs of its physics, got a subset.")
    return {
        "format": _FORMAT,
        "class": name,
        "options": model.options,
        "missing": missing,
        "physics": physics,
        "physics_names": names,
        "physics_values": f_p,
        "data": data,
        "kernels": _kernels(model),
        "names": [list(model.input_names), list(model.output_names)],
        "was_fitted": getattr(model, "was_fitted", True),
        "learnt": [name for name, p in model.named_parameters() if p.requires_grad],
        "state": {name: v for name, v in model.state_dict().items() if "_prior." not in name},
    }


def load(path: str | Path, *, trusted: bool = False, **objects: Any) -> Any:
    """Load a model that :func:`save` wrote.

    A file of a stranger executes nothing: numbers are read without pickle, the class is of this
    library or of a module that you have imported, and the physics is the one that you give, or a
    formula. The physics of a trusted file is imported by its name, which runs its module.

    Args:
        path: The file.
        trusted: Whether to import a physics that is not given by its name in the file.
        objects: ``physics`` and other arguments of the model that could not be saved; an error
            says which. Of a mixture each goes to the models that have it.

    Raises:
        FileNotFoundError: If there is no such file.
        PhysicsError: If a physics fails at the training inputs.
        TypeError: If ``trusted`` is not True or False.
        ValueError: If it is no such file, or damaged; if objects are missing, or given though the
            file holds them; if the module of the class was not imported; or if a physics is only
            named and the file not trusted, cannot be imported, or is another than the model was
            built with.
    """
    check_switch("trusted", trusted)
    try:
        content = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is not a model that gpadjust saved, or is damaged.") from error
    found = content.get("format") if isinstance(content, dict) else None
    if not isinstance(found, int) or found != _FORMAT:
        raise ValueError(
            f"{path} is not a model that this version of gpadjust saved; expected format {_FORMAT}."
        )
    try:
        return _loaded(content, objects, trusted)
    except PhysicsError:
        raise
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except Exception as error:
        found = f"({type(error).__name__}: {error})"
        raise ValueError(f"{path} is damaged, or what was given is wrong {found}.") from error


def _loaded(
    content: dict[str, Any], objects: dict[str, Any], trusted: bool
) -> TermsModel | StackedGP:
    """The model of a file, with the objects that are given beside it."""
    stacked = "models" in content
    models = content["models"] if stacked else {"": content}
    known = {name for each in models.values() for name in each["missing"]}
    known |= {"physics"} if any(each["physics"] for each in models.values()) else set()
    if objects.keys() - known:
        raise ValueError(
            f"it does not take {', '.join(sorted(objects.keys() - known))}, but only what the file "
            f"could not hold: {', '.join(sorted(known)) or 'nothing'}."
        )
    built = {name: _model(each, objects, trusted) for name, each in models.items()}
    if stacked:
        return StackedGP(built, content["weights"], content["num_components"])
    return built[""]


def _model(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> TermsModel:
    missing = [name for name in content["missing"] if name not in objects]
    if missing:
        given = ", ".join(f"{name}=..." for name in missing)
        raise ValueError(
            f"the file could not hold {' and '.join(missing)}: give what the model was built with, "
            f"load(path, {given})."
        )
    module, _, name = content["class"].partition(":")
    model_class = getattr(sys.modules.get(module), name, None)  # nothing is imported for it
    if not isinstance(model_class, type) or not issubclass(model_class, TermsModel):
        way = "has no such model" if module in sys.modules else "was not imported: do so first"
        raise ValueError(f"it is of the class {content['class']}, but the module {module!r} {way}.")
    own = {n: deepcopy(objects[n]) for n in content["missing"] if n != "physics"}
    if content["physics"] is not None:
        own["physics"] = _physics(content, objects, trusted)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # it was said when the model was built
        data = {name: value for name, value in content["data"].items() if value is not None}
        data["train_X"] = with_names(data["train_X"], content["names"][0])  # kernels may use them
        model: TermsModel = model_class(**data, **{**content["options"], **own})
    if (found := _kernels(model)) != content["kernels"]:
        raise ValueError(
            f"it was saved with other kernels: expected {', '.join(content['kernels'])}, found "
            f"{', '.join(found)}. Give those that the model was built with."
        )
    priors = {name: v for name, v in model.state_dict().items() if "_prior." in name}
    model.load_state_dict(content["state"] | priors)
    learnt = {*content["learnt"]}
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name in learnt)
    expected: Any = content["physics_values"]
    if expected is not None:
        with torch.no_grad():
            values = model.input_transform.values(content["data"]["train_X"])
        tiny = 1e-9 * expected.abs().amax(-2, keepdim=True)
        if values.shape != expected.shape or bool(
            ((values - expected).abs() > 1e-6 * expected.abs() + tiny).any()
        ):
            raise ValueError(
                "it was saved with another physics: its values at the training inputs differ. "
                "Give the one that the model was built with (of several, in the same order), with "
                "the same priors of unknown parameters."
            )
    model.input_names, model.output_names = (tuple(names) for names in content["names"])
    model.was_fitted = content["was_fitted"]
    return model.eval()


def _not_taken(model_class: type[TermsModel], names: list[str]) -> list[str]:
    """The arguments of data that the constructor of a class does not take by name."""
    own = [*signature(model_class.__init__).parameters.values()][1:]
    needed = {p.name for p in own if p.kind is p.POSITIONAL_OR_KEYWORD and p.default is p.empty}
    passes = any(p.kind is p.VAR_KEYWORD for p in own) and needed <= {*names}
    return [] if passes else [name for name in names if name not in {p.name for p in own}]


def _kernels(model: TermsModel) -> list[str]:
    """The kernels of a model, by their classes and what tells kernels of one class apart."""
    kernels = [each for each in model.covar_module.modules() if isinstance(each, Kernel)]
    return [f"{type(k).__qualname__} {getattr(k, 'nu', '')}".strip() for k in kernels]


def _named_physics(path: str, trusted: bool) -> Physics:
    """The physics of a file by its import path, not called yet."""
    if not trusted and not is_formula(path):
        raise ValueError(
            f"it names {path} as its physics, which is code. Give the physics, load(path, "
            "physics=...), or, if you trust the file, have it imported, load(path, trusted=True)."
        )
    return physics_from_path(path)


def _physics(content: dict[str, Any], objects: dict[str, Any], trusted: bool) -> Any:
    """The physics that is given, of several the model's own, or else those that the file names."""
    if "physics" not in objects:
        named = content["physics"].items()
        parts = {name: _named_physics(path, trusted) for name, path in named}
        return parts[""] if "" in parts else as_physics(parts)
    physics, names = as_physics(objects["physics"]), content["physics_names"]
    if isinstance(physics, JoinedPhysics) and len(names) == 1 and names[0] in physics.names:
        return physics.parts[physics.names.index(names[0])]
    return physics
