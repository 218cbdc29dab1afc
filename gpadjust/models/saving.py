"""Models as files: data, settings and hyper-parameters, and the physics by its name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from gpadjust.gp import PhysicsInput
from gpadjust.models.stacked import StackedGP
from gpadjust.models.terms_model import TermsModel
from gpadjust.physics import JoinedPhysics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path

_FORMAT = 1


def save(model: TermsModel | StackedGP, path: str | Path) -> None:
    """Save a model: data, settings, hyper-parameters (or samples of them), and names.

    The physics is saved by its import path, if it is a function or object of a module. What cannot
    be saved (a lambda, a kernel or transform of yours) is to be given to :func:`load` again. Of a
    :class:`~gpadjust.StackedGP`, its models and weights.

    Args:
        model: The model.
        path: The file, which ``torch.load`` reads with ``weights_only=True``.

    Raises:
        TypeError: If it is no model of this library.
        ValueError: If its class is not in its module, or it is a subset of a model's outputs.

    Example:
        >>> import tempfile, torch
        >>> from gpadjust import CKA, load, save
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * X.sin() + X, physics=lambda X: X.sin())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(model, f"{folder}/model.pt")
        ...     again = load(f"{folder}/model.pt", physics=lambda X: X.sin())
        >>> torch.equal(again.posterior(X).mean, model.posterior(X).mean)
        True
    """
    content: dict[str, Any]
    if isinstance(model, StackedGP):
        content = {
            "format": _FORMAT,
            "models": {name: _content(part) for name, part in model.made_of.items()},
            "weights": torch.tensor([*model.weights.values()], dtype=torch.float64),
            "num_components": model.num_samples,
        }
    else:
        content = _content(model)
    part = Path(f"{path}.part")
    torch.save(content, part)
    part.replace(path)


def _content(model: TermsModel) -> dict[str, Any]:
    """What a file holds of a model of one structure."""
    if not isinstance(model, TermsModel):
        raise TypeError(f"Expected a model of gpadjust, got {type(model).__name__}.")
    name = f"{type(model).__module__}:{type(model).__qualname__}"
    if getattr(import_module(type(model).__module__), type(model).__qualname__, None) is None:
        raise ValueError(f"{name} cannot be imported again: define the class in a module.")
    missing, physics, f_p, names = [*model.objects], None, None, []
    transform: Any = getattr(model, "input_transform", None)
    if isinstance(transform, PhysicsInput):
        given: Any = transform.physics
        several = isinstance(given, JoinedPhysics)
        names = [*given.names] if several else [given.name]
        parts = zip(given.names, given.parts, strict=True) if several else [("", given)]
        physics = {name: import_path(part) for name, part in parts}
        if None in physics.values():
            missing.append("physics")
        data: Any = model.data()
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
        "data": model.data(),
        "names": [list(model.input_names), list(model.output_names)],
        "state": model.state_dict(),
    }


def load(path: str | Path, **objects: Any) -> Any:
    """Load a model that :func:`save` wrote.

    The classes of model and physics are imported by the names in the file, which runs the code of
    their modules: open files that you trust only.

    Args:
        path: The file.
        objects: ``physics`` and other arguments of the model that could not be saved; an error
            says which. Of a mixture each goes to the models that have it; of several physics, by
            their names, as the model was built with.

    Returns:
        The model, an :class:`~gpadjust.models.TermsModel` or a :class:`~gpadjust.StackedGP`.

    Raises:
        ValueError: If it is no such file, if objects are missing, or a physics cannot be imported
            or is another than the model was built with.
    """
    try:
        content = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is not a model that gpadjust saved, or is damaged.") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(
            f"{path} is not a model that this version of gpadjust saved; expected format {_FORMAT}."
        )
    if "models" not in content:
        return _model(path, content, objects)
    models = {
        name: _model(path, each, _own(each, objects)) for name, each in content["models"].items()
    }
    return StackedGP(models, content["weights"], content["num_components"])


def _own(content: dict[str, Any], objects: dict[str, Any]) -> dict[str, Any]:
    """Those of the objects that a model of a mixture is built with."""
    own = {name: each for name, each in objects.items() if name in content["missing"]}
    if "physics" not in objects or content["physics"] is None:
        return own
    physics, names = as_physics(objects["physics"]), content["physics_names"]
    if isinstance(physics, JoinedPhysics) and len(names) == 1 and names[0] in physics.names:
        return {**own, "physics": physics.parts[physics.names.index(names[0])]}
    return {**own, "physics": physics}


def _model(path: str | Path, content: dict[str, Any], objects: dict[str, Any]) -> TermsModel:
    """The model of one structure that a file holds."""
    missing = [name for name in content["missing"] if name not in objects]
    if missing:
        given = ", ".join(f"{name}=..." for name in missing)
        raise ValueError(
            f"{path} could not hold {' and '.join(missing)}: give what the model was built with, "
            f"load(path, {given})."
        )
    module, _, name = content["class"].partition(":")
    model_class = getattr(import_module(module), name, None)
    if not isinstance(model_class, type) or not issubclass(model_class, TermsModel):
        raise ValueError(f"{path} is of {content['class']}, which is no model of gpadjust.")
    if content["physics"] is not None and "physics" not in objects:
        parts = {name: physics_from_path(path) for name, path in content["physics"].items()}
        objects["physics"] = parts[""] if "" in parts else as_physics(parts)
    model: TermsModel = model_class(**content["data"], **{**content["options"], **objects})
    model.load_state_dict(content["state"])
    expected: Any = content["physics_values"]
    if expected is not None:
        with torch.no_grad():
            found = model.input_transform.values(content["data"]["train_X"])
        if found.shape != expected.shape or not torch.allclose(found, expected, rtol=1e-6):
            raise ValueError(
                f"{path} was saved with another physics: its values at the training inputs differ. "
                "Give the one that the model was built with (of several, in the same order), with "
                "the same priors of unknown parameters."
            )
    model.input_names, model.output_names = (tuple(names) for names in content["names"])
    return model.eval()
