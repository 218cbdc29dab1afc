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


def save(model: TermsModel, path: str | Path) -> None:
    """Save a model: data, settings, hyper-parameters (or samples of them), and names.

    The physics is saved by its import path, if it is a function or object of a module. What cannot
    be saved (a lambda, a kernel or transform of yours) is to be given to :func:`load` again.

    Args:
        model: The model.
        path: The file, which ``torch.load`` reads with ``weights_only=True``.

    Raises:
        TypeError: If it is no model of this library, or a :class:`~gpadjust.StackedGP`, whose
            models and ``weights`` are to be saved instead.
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
    if isinstance(model, StackedGP):
        raise TypeError(
            "Expected a model of one structure, got a StackedGP: save the models that it was made "
            "of (of a comparison its `models`) one by one, beside its `weights`, and stack them "
            "again when they are loaded."
        )
    if not isinstance(model, TermsModel):
        raise TypeError(f"Expected a model of gpadjust, got {type(model).__name__}.")
    name = f"{type(model).__module__}:{type(model).__qualname__}"
    if getattr(import_module(type(model).__module__), type(model).__qualname__, None) is None:
        raise ValueError(f"{name} cannot be imported again: define the class in a module.")
    missing, physics, f_p = [*model.objects], None, None
    transform: Any = getattr(model, "input_transform", None)
    if isinstance(transform, PhysicsInput):
        given: Any = transform.physics
        several = isinstance(given, JoinedPhysics)
        parts = zip(given.names, given.parts, strict=True) if several else [("", given)]
        physics = {name: import_path(part) for name, part in parts}
        if None in physics.values():
            missing.append("physics")
        data: Any = model.data()
        with torch.no_grad():
            f_p = transform.values(data["train_X"])
        if f_p.shape[-1] != model.num_outputs * len(physics):
            raise ValueError("Expected a model of all outputs of its physics, got a subset.")
    content = {
        "format": _FORMAT,
        "class": name,
        "options": model.options,
        "missing": missing,
        "physics": physics,
        "physics_values": f_p,
        "data": model.data(),
        "names": [list(model.input_names), list(model.output_names)],
        "state": model.state_dict(),
    }
    part = Path(f"{path}.part")
    torch.save(content, part)
    part.replace(path)


def load(path: str | Path, **objects: Any) -> TermsModel:
    """Load a model that :func:`save` wrote.

    The classes of model and physics are imported by the names in the file, which runs the code of
    their modules: open files that you trust only.

    Args:
        path: The file.
        objects: ``physics`` and other arguments of the model that could not be saved; an error
            says which.

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
    model = model_class(**content["data"], **{**content["options"], **objects})
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
