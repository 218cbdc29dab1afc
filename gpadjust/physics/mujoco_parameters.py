"""Parameters of a MuJoCo model by name: written into a copy of it, or into its MJCF."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

Array = NDArray[np.float64]

_CENTER = ("com_x", "com_y", "com_z")
_STRETCH = ("stretch_x", "stretch_y", "stretch_z")
_SHEAR = ("shear_xy", "shear_xz", "shear_yz")
_SHAPE = {*_CENTER, *_STRETCH, *_SHEAR}  # of the mass of a body, which compiling again writes
FIELDS = {
    "body": ("mass", *_CENTER, *_STRETCH, *_SHEAR),
    "joint": ("damping", "frictionloss", "armature", "stiffness"),
    "tendon": ("damping", "frictionloss", "armature", "stiffness"),
    "actuator": ("gear", "kp", "kv"),
    "geom": ("friction",),
}
"""Names of parameters, by the kind of element that has them."""
_SIGNED = {*_CENTER, *_SHEAR, "gear"}
_NAMES = ", ".join(sorted(set().union(*FIELDS.values())))
_EXPECTED = f"expected 'element.parameter', the latter one of {_NAMES}, or an edit= that reads it"
_MOST_MODELS, _MOST_BYTES = 1024, 2**28  # that are remembered

_LOCK = RLock()  # of data, and of MuJoCo's handler of warnings: there is one for all threads

Edit = Callable[[Any, ParameterValues], object]


@contextmanager
def silenced() -> Iterator[None]:
    """Keep MuJoCo from printing and logging the message of an error, and other threads out."""
    import mujoco

    with _LOCK:
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda text: None)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)


class Place(NamedTuple):
    """Where a parameter is in a model."""

    kind: str
    element: str
    field: str


class ModelParameters:
    """The unknown parameters of a model, and the compiled model of some values.

    ``spec`` makes a new ``MjSpec`` of the MJCF; it is None if there is no MJCF.
    """

    def __init__(
        self,
        model: Any,
        spec: Callable[[], Any] | None,
        unknowns: Mapping[str, Unknown],
        edit: Edit | None,
    ) -> None:
        if edit is not None and spec is None:
            raise ValueError("edit changes an MjSpec; give the MJCF or that, not an MjModel.")
        self.model, self.spec, self.unknowns, self.edit = model, spec, unknowns, edit
        self._models: dict[bytes, Any] = {}
        self._data: Any = None  # slower to make than a model
        self.places: dict[str, Place] = {}
        for name, unknown in unknowns.items():
            place = self._place(name)  # None of one that the edit reads
            if place is not None:
                self._check(name, place, unknown)
                self.places[name] = place
        if edit is not None:
            guesses = np.array([unknown.guess for unknown in unknowns.values()])
            values = _Read(unknowns, guesses)
            with silenced():
                self._edited(values)
            if unread := {*unknowns} - {*self.places} - values.names:
                raise ValueError(f"edit does not read {min(unread)!r}, and {_EXPECTED}.")

    def compiled(self, values: Array) -> Any:
        """Return the model with these values of the parameters, ``p``."""
        key = values.tobytes()  # equal parameters alone are equal bytes
        with silenced():
            if key not in self._models:
                if len(self._models) >= min(_MOST_MODELS, _MOST_BYTES // self.model.nbuffer):
                    self._models.clear()
                self._models[key] = self._compiled(values)
            return self._models[key]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_models": {}, "_data": None}

    def _compiled(self, values: Array) -> Any:
        import mujoco

        if not self.unknowns and self.edit is None:
            return self.model
        named = ParameterValues(self.unknowns, values)
        shapes = dict[str, dict[str, float]]()
        for name, place in self.places.items():
            if place.field in _SHAPE:
                shapes.setdefault(place.element, {})[place.field] = named[name]
        is_as_compiled = self.edit is None and not shapes
        model = copy(self.model) if is_as_compiled else self._edited(named, shapes)
        for name, place in self.places.items():
            if place.field not in _SHAPE:
                _write(model, place, named[name])
        if self._data is None or not is_as_compiled:
            self._data = mujoco.MjData(model)
        mujoco.mj_setConst(model, self._data)  # quantities of masses and gears
        return model

    def _edited(self, named: ParameterValues, shapes: Mapping[str, Any] | None = None) -> Any:
        """Return the compiled model of the MJCF, edited, with bodies of other shapes of mass."""
        assert self.spec is not None, "checked before"
        spec = self.spec()
        if self.edit is not None:
            self.edit(spec, named)
        model = spec.compile()  # which computes the inertia of geoms
        if shapes:
            _deform(spec, model, shapes)
            model = spec.compile()
        before, after = _sizes(self.model), _sizes(model)
        changed = [name for name, size in before.items() if after[name] != size]
        if changed:  # data of another size would be written beyond their end
            raise ValueError(
                f"edit has changed {', '.join(changed)}; expected other numbers in the same "
                "bodies, joints, geoms, actuators and sensors."
            )
        return model

    def _place(self, name: str) -> Place | None:
        """Return where a parameter is; None if the edit is to read it."""
        element, _, field = name.rpartition(".")
        elements = {
            kind: names_of(self.model, kind) for kind, fields in FIELDS.items() if field in fields
        }
        kinds = [kind for kind, names in elements.items() if element in names]
        if len(kinds) == 1:
            return Place(kinds[0], element, field)
        if self.edit is not None and not kinds:
            return None
        if not elements or not element:
            raise ValueError(f"Unknown parameter {name!r}; {_EXPECTED}.")
        raise ValueError(
            f"Expected {name!r} to name one {' or '.join(elements)}, of "
            f"{', '.join(sorted(set().union(*elements.values())))}; found {len(kinds)}."
        )

    def _check(self, name: str, place: Place, unknown: Unknown) -> None:
        """Raise a ValueError if a parameter cannot vary as by its prior."""
        element = getattr(self.model, place.kind)(place.element)
        if place.field not in _SIGNED and unknown.factor is None and unknown.bounds[0] < 0:
            raise ValueError(
                f"{name!r} cannot be negative, and by its prior, {unknown!r}, it can be: give it a "
                "factor, or bounds=(0, ...)."
            )
        if place.field in _SHAPE and self.spec is None:
            raise ValueError(f"{name!r} needs the MJCF or an MjSpec; found an MjModel.")
        if place.kind == "body" and element.mass[0] == 0:
            raise ValueError(f"{name!r}: the body has no mass in the MJCF; give it some.")
        # A servo's force has its gains in the bias, - kp q - kv v.
        feedback = {"kp": slice(1, 2), "kv": slice(1, 3)}.get(place.field)
        if feedback is not None and not element.biasprm[feedback].any():
            raise ValueError(f"{name!r}: the actuator is not a servo with it; a motor has a gear.")


class _Read(ParameterValues):
    """Values of parameters that record which of them were read."""

    def __init__(self, names: Any, rows: Any) -> None:
        super().__init__(names, rows)
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.names.add(name)
        return super().__getitem__(name)


def names_of(model: Any, kind: str) -> list[str]:
    """Return the names of the elements of a kind, empty where they have none."""
    number = getattr(model, {"joint": "njnt"}.get(kind, f"n{kind}"), model.nu)  # before MuJoCo 4
    return [getattr(model, kind)(i).name for i in range(number)]


def _sizes(model: Any) -> dict[str, float]:
    """Return the numbers of all elements of a compiled model, and its time step."""
    sizes = {name: getattr(model, name) for name in dir(model) if name.startswith("n")}
    sizes = {name: size for name, size in sizes.items() if isinstance(size, int)}
    return {**sizes, "the time step": model.opt.timestep}


def _write(model: Any, place: Place, value: float) -> None:
    """Write a parameter into a compiled model."""
    element = getattr(model, place.kind)(place.element)
    match place:
        case Place(field="mass"):
            element.inertia[:] *= value / element.mass[0]
            element.mass[0] = value
        case Place(field="kp"):  # force = kp (u - q)
            element.gainprm[0] = value
            element.biasprm[1] = -value
        case Place(field="kv"):  # - kv v, or kv (u - v) of a servo of velocities
            if element.biasprm[1] == 0:
                element.gainprm[0] = value
            element.biasprm[2] = -value
        case Place(kind="tendon"):
            getattr(model, f"tendon_{place.field}")[element.id] = value
        case _:
            getattr(element, place.field)[0] = value


def _deform(spec: Any, model: Any, shapes: Mapping[str, Mapping[str, float]]) -> None:
    """Write the inertia of bodies into an MJCF, of which ``model`` is compiled."""
    import mujoco

    # Else the inertia of geoms would count, not the one written here.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in spec.bodies[1:]:
        i = body.id
        shape = shapes.get(body.name, {})
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.body_iquat[i])
        R = rotation.reshape(3, 3)
        # Second moments about the center, of the principal moments: S = R (tr(I) / 2 - I) R^T
        S = R @ np.diag(model.body_inertia[i].sum() / 2 - model.body_inertia[i]) @ R.T
        A = np.diag([shape.get(name, 1.0) for name in _STRETCH])
        A[np.triu_indices(3, 1)] = [shape.get(name, 0.0) for name in _SHEAR]
        S = A @ S @ A.T
        # I = tr(S) 1 - S: no moment is negative or exceeds the sum of the others.
        inertia = np.trace(S) * np.eye(3) - S
        center = [shape.get(c, x) for c, x in zip(_CENTER, model.body_ipos[i], strict=True)]
        body.explicitinertial, body.mass, body.ipos = True, model.body_mass[i], center
        body.fullinertia = [*inertia.diagonal(), *inertia[np.triu_indices(3, 1)]]
        body.iquat = [1.0, 0.0, 0.0, 0.0]
