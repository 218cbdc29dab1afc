"""A fitted model, or the dynamics that hold one, as an FMU."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from importlib.resources import files
from itertools import accumulate
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from gpadjust.dynamics import Dynamics
from gpadjust.export.c_program import c_source
from gpadjust.export.equations import exportable
from gpadjust.export.finite_sum import model_of
from gpadjust.physics import Physics

_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}


class _Variable(NamedTuple):
    """A variable of an FMU; its value reference is its place."""

    name: str
    unit: str
    causality: str  # "input", "output" or "local"
    start: float | None  # None if it is computed


def export_fmu(
    fitted: Any,
    path: str | Path,
    *,
    physics: str | None = None,
    variance: bool = True,
    observation_noise: bool = False,
) -> Path:
    """Write a fitted model as an FMU, for Simulink, Modelica tools, FMPy and others; return it.

    It is one of FMI 2.0 for co-simulation, with the program of :func:`c_source` as source and
    compiled for this platform. Its variables have the names of the data, with a unit in brackets,
    ``"head [m]"``, as their unit; ``NAME_sd`` is the standard deviation of an output.

    - Of a model the outputs are those at the inputs of the same moment.
    - Of dynamics a step is one control step, ``StateSpec.step``, no other: inputs are the actions,
      outputs the states, whose start values can be set, and the standard deviations of that step.

    The values of f_p are a further input of each output, ``f_p_NAME``: connect your model to it, or
    give f_p in C. It is within where :func:`c_source` has it.

    Args:
        fitted: The model, dynamics that have learnt, or an identification.
        path: The file, ``NAME.fmu``, with a name of C.
        physics: f_p in C, to take the place of its inputs: statements that set ``f_p[0]`` and so
            on, from the columns ``x[0]`` and so on that the physics reads. ``math.h`` is there.
        variance: If True, there are standard deviations.
        observation_noise: If True, these include the noise.

    Raises:
        TypeError, ValueError, RuntimeError: As :func:`c_source`; a TypeError also of a physics
            itself, whose outputs have no names; a ValueError also if dynamics have no step, the
            model has no physics, names are not different, or the code cannot be compiled.
        OSError: If there is no C compiler, or the file cannot be written.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.export import export_fmu
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, X.sin(), physics=lambda X: X)
        >>> export_fmu(model, "pump.fmu", physics="f_p[0] = x[0];")  # doctest: +SKIP
        PosixPath('pump.fmu')
    """
    path = Path(path)
    name = path.stem
    fitted = exportable(fitted, name)
    if isinstance(fitted, Physics):
        raise TypeError(
            f"The physics {fitted.name!r} has no names of outputs, which an FMU needs: give it "
            "some, as a step of PhysicsDynamics(StateSpec(states, actions, step=...), physics), or "
            "take c_source."
        )
    code = c_source(fitted, name, variance=variance, observation_noise=observation_noise)
    signature = rf"^void {name}_(predict|step)\(([^)]*)\)"
    # The arguments of the program are the groups of variables.
    ((function, text),) = re.findall(signature, code, re.MULTILINE)
    arguments = re.findall(r"\*(\w+)", text)
    spec = getattr(fitted, "spec", None)  # of dynamics
    step = getattr(spec, "step", None)
    if spec and step is None:
        raise ValueError("Expected the duration of a step: StateSpec(..., step=0.1).")
    if physics is not None and "f_p" not in arguments:
        raise ValueError("The program has no f_p as an argument: leave physics= out.")
    groups = _variables(fitted, arguments, physics is not None)
    # Value references are places in one array, of which the program gets parts.
    places = dict(zip(groups, accumulate(map(len, groups.values()), initial=0), strict=False))
    places |= {"action": places["x"], "state": places["mean"]}
    variables = [variable for group in groups.values() for variable in group]
    names = [variable.name for variable in variables]
    for variable in names:
        if names.count(variable) > 1:
            raise ValueError(
                f"Expected different names of inputs and outputs; found two {variable!r}."
            )
    read = [*range(places["f_p"])]  # places that f_p reads
    if spec:
        read = [*range(places["mean"], places["variance"]), *read]
        read = [read[i] for i in spec.physics_columns]
    # The same model has the same identity, which a simulator compares with that of the library.
    guid = hashlib.sha256(f"{code}{physics}".encode()).hexdigest()[:32]
    interface = files("gpadjust.export").joinpath("fmu.c").read_text(encoding="utf-8")
    code += Template(interface).substitute(
        name=name,
        guid=guid,
        size=len(names),
        start=", ".join(repr(variable.start or 0.0) for variable in variables),
        physics=physics or "",
        has_physics=int(physics is not None),
        read=", ".join(f"v[{i}]" for i in read),
        f_p=places["f_p"],
        sd=places["variance"],
        call=f"{name}_{function}({', '.join(f'v + {places[a]}' for a in arguments)})",
        is_direct=int(not spec),
        settable=places["variance" if spec else "mean"],
        step=repr(step or 1.0),
    )
    system, suffix = _SYSTEMS.get(sys.platform, ("linux", ".so"))
    binary = f"binaries/{system}{64 if sys.maxsize > 2**32 else 32}/{name}{suffix}"
    contents = {
        "modelDescription.xml": _description(name, guid, variables, step),
        f"sources/{name}.c": code.encode(),
        binary: _compiled(code, name, suffix),
    }
    with ZipFile(path, "w") as file:
        for place, content in contents.items():
            entry = ZipInfo(place)  # with a fixed date, so that the same model makes the same file
            entry.external_attr = 0o755 << 16
            file.writestr(entry, content, ZIP_DEFLATED)
    return path


def _variables(fitted: Any, arguments: list[str], has_physics: bool) -> dict[str, list[_Variable]]:
    """Return the variables by arguments of the program, in the order of their references."""
    first: float | None = None
    if isinstance(fitted, Dynamics):
        spec = fitted.spec
        inputs, outputs = spec.actions, spec.states
        start = [0.0] * spec.action_dim
        first = 0.0
        returned = [spec.states[i] for i in spec.moving]
    else:
        data = model_of(fitted).data
        inputs, outputs = data.input_names, data.output_names
        start = data.X[0].tolist()
        returned = [*outputs]
    groups = {
        "x": [_variable(name, "input", value) for name, value in zip(inputs, start, strict=True)],
        "f_p": [],
        "mean": [_variable(name, "output", first) for name in outputs],
        "variance": [],
    }
    if "f_p" in arguments:
        number = len(model_of(fitted).physics)
        heads = [f"f_p{i + 1}" for i in range(number)] if number > 1 else ["f_p"]
        kind = ("local", None) if has_physics else ("input", 0.0)
        groups["f_p"] = [_variable(f"{h}_{output}", *kind) for h in heads for output in returned]
    if "variance" in arguments:
        groups["variance"] = [_variable(name, "output", None, "_sd") for name in outputs]
    return groups


def _variable(name: str, causality: str, start: float | None, suffix: str = "") -> _Variable:
    """Return a variable of data, whose name may end with a unit in brackets."""
    match = re.fullmatch(r"\s*(.*\S)\s*\[(.*)\]\s*", name)
    if match is None:
        return _Variable(name + suffix, "", causality, start)
    return _Variable(match[1] + suffix, match[2], causality, start)


def _description(name: str, guid: str, variables: list[_Variable], step: float | None) -> bytes:
    """Return modelDescription.xml."""
    about = {"modelName": name, "guid": guid, "generationTool": "gpadjust"}
    root = Element("fmiModelDescription", about, fmiVersion="2.0")
    any_step = {"canHandleVariableCommunicationStepSize": str(step is None).lower()}
    able = {"canGetAndSetFMUstate": "true", **any_step}
    interface = SubElement(root, "CoSimulation", able, modelIdentifier=name)
    SubElement(SubElement(interface, "SourceFiles"), "File", name=f"{name}.c")
    # FMI 2.0, section 2.2: units, variables, and the dependencies of outputs.
    units = sorted({variable.unit for variable in variables} - {""})
    if units:
        defined = SubElement(root, "UnitDefinitions")
        for unit in units:
            SubElement(defined, "Unit", name=unit)
    if step is not None:
        SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(step))
    listed = SubElement(root, "ModelVariables")
    variability = "discrete" if step else "continuous"
    for i, variable in enumerate(variables):
        about = {"name": variable.name, "valueReference": str(i), "causality": variable.causality}
        value = {"unit": variable.unit} if variable.unit else {}
        initial = "calculated"
        if variable.start is not None:
            value["start"] = repr(variable.start)
            initial = "exact"
        if variable.causality != "input":
            about["initial"] = initial
        entry = SubElement(listed, "ScalarVariable", about, variability=variability)
        SubElement(entry, "Real", value)
    structure = SubElement(root, "ModelStructure")
    outputs = [i for i, variable in enumerate(variables) if variable.causality == "output"]
    computed = [i for i in outputs if variables[i].start is None]
    for tag, places in {"Outputs": outputs, "InitialUnknowns": computed}.items():
        if places:
            group = SubElement(structure, tag)
            for i in places:
                SubElement(group, "Unknown", index=str(i + 1))
    return tostring(root, "utf-8", xml_declaration=True)


def _compiled(code: str, name: str, suffix: str) -> bytes:
    """Return the library of a file of C."""
    names = [os.environ.get("CC", ""), "cc", "gcc", "clang"]
    compiler = next((name for name in names if name and shutil.which(name)), None)
    if compiler is None:
        raise OSError(
            "An FMU contains a compiled program, and no C compiler was found: cc, gcc, clang, or "
            "the one of the variable CC. Install one, or take c_source."
        )
    with TemporaryDirectory() as folder:
        source, library = Path(folder, f"{name}.c"), Path(folder, name + suffix)
        source.write_text(code)
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        options += ["-Werror=implicit-function-declaration"]  # which fails when it is loaded
        command = [compiler, *options, "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ValueError(f"{compiler} cannot compile the program: {done.stderr[-1000:]}")
        return library.read_bytes()
