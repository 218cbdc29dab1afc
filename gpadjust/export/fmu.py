"""A fitted model, or the dynamics that hold one, as an FMU."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from gpadjust.core import GP
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export.c_program import c_source
from gpadjust.export.equations import own_dynamics
from gpadjust.export.finite_sum import model_of

_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}

_PHYSICS = Template("""\
static void physics_of(const double *x, double *f_p)
{
$statements
}
""")
_GROUPS = {  # of variables, by the arguments of the program
    **{"x": "inputs", "action": "inputs", "f_p": "f_p"},
    **{"state": "outputs", "mean": "outputs", "variance": "sd"},
}
# The functions of FMI 2.0 for co-simulation, in plain types of C: a boolean or status is an int.
_INTERFACE = Template("""
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define REFUSED(name, ...) EXPORT int name(__VA_ARGS__) { return n ? 3 : 0; }

typedef struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
} Callbacks;
typedef struct { double v[$size]; int is_stale; const Callbacks *callbacks; } Instance;
static const double start_values[$size] = {$start};

$physics
static void update(double *v)
{
#if $has_physics
    const double read[] = {$read};
    physics_of(read, v + $f_p);
#endif
    $call;
    for (int i = $sd; i < $size; i++) v[i] = sqrt(v[i]);
}

static int logged(const Instance *c, const char *message)
{
    if (c->callbacks && c->callbacks->log)
        c->callbacks->log(c->callbacks->environment, "$name", 3, "logStatusError", message);
    return 3;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const k[]) { return 0; }
EXPORT int fmi2Reset(Instance *c)
{
    memcpy(c->v, start_values, sizeof c->v);
    c->is_stale = 1;
    return 0;
}
EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                             const Callbacks *callbacks, int visible, int logging)
{
    Instance *c = type == 1 && strcmp(guid, "$guid") == 0 ? calloc(1, sizeof *c) : NULL;
    if (c) {
        c->callbacks = callbacks;
        fmi2Reset(c);
    }
    return c;
}
EXPORT void fmi2FreeInstance(void *c) { free(c); }
EXPORT int fmi2SetupExperiment(void *c, int d, double t, double a, int s, double b) { return 0; }
EXPORT int fmi2EnterInitializationMode(void *c) { return 0; }
EXPORT int fmi2ExitInitializationMode(void *c) { return 0; }
EXPORT int fmi2Terminate(void *c) { return 0; }
EXPORT int fmi2GetReal(Instance *c, const unsigned r[], size_t n, double value[])
{
    if ($is_direct && c->is_stale) update(c->v);
    c->is_stale = 0;
    for (size_t i = 0; i < n; i++) value[i] = c->v[r[i]];
    return 0;
}
EXPORT int fmi2SetReal(Instance *c, const unsigned r[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= $settable) return logged(c, "A mean or standard deviation cannot be set.");
        c->v[r[i]] = value[i];
    }
    c->is_stale = 1;
    return 0;
}
EXPORT int fmi2DoStep(Instance *c, double t, double h, int is_final)
{
    if ($is_direct) return 0;
    if (fabs(h - $step) > 1e-9 * $step) return logged(c, "Expected a step of $step.");
    update(c->v);
    return 0;
}
REFUSED(fmi2GetInteger, void *c, const unsigned r[], size_t n, int value[])
REFUSED(fmi2GetBoolean, void *c, const unsigned r[], size_t n, int value[])
REFUSED(fmi2GetString, void *c, const unsigned r[], size_t n, const char *value[])
REFUSED(fmi2SetInteger, void *c, const unsigned r[], size_t n, const int value[])
REFUSED(fmi2SetBoolean, void *c, const unsigned r[], size_t n, const int value[])
REFUSED(fmi2SetString, void *c, const unsigned r[], size_t n, const char *const value[])
REFUSED(fmi2SetRealInputDerivatives, void *c, const unsigned r[], size_t n, const int o[],
        const double value[])
REFUSED(fmi2GetRealOutputDerivatives, void *c, const unsigned r[], size_t n, const int o[],
        double value[])
REFUSED(fmi2GetDirectionalDerivative, void *c, const unsigned u[], size_t n, const unsigned k[],
        size_t m, const double a[], double b[])
EXPORT int fmi2GetFMUstate(Instance *c, void **state)
{
    if (!*state) *state = malloc(sizeof *c);
    return *state ? memcpy(*state, c, sizeof *c), 0 : 3;
}
EXPORT int fmi2SetFMUstate(Instance *c, const Instance *state)
{
    memcpy(c->v, state->v, sizeof c->v);
    c->is_stale = state->is_stale;
    return 0;
}
EXPORT int fmi2FreeFMUstate(void *c, void **state) { free(*state); *state = NULL; return 0; }
EXPORT int fmi2SerializedFMUstateSize(void *c, void *state, size_t *size)
{
    *size = sizeof(Instance);
    return 0;
}
EXPORT int fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size)
{
    return size >= sizeof(Instance) ? memcpy(bytes, state, sizeof(Instance)), 0 : 3;
}
EXPORT int fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(Instance)) return 3;
    if (!*state) *state = malloc(size);
    return *state ? memcpy(*state, bytes, size), 0 : 3;
}
EXPORT int fmi2CancelStep(void *c) { return 3; }
EXPORT int fmi2GetStatus(void *c, int kind, int *value) { return 2; }
EXPORT int fmi2GetRealStatus(void *c, int kind, double *value) { return 2; }
EXPORT int fmi2GetIntegerStatus(void *c, int kind, int *value) { return 2; }
EXPORT int fmi2GetBooleanStatus(void *c, int kind, int *value) { return 2; }
EXPORT int fmi2GetStringStatus(void *c, int kind, const char **value) { return 2; }
""")


class _Variable(NamedTuple):
    """A variable of an FMU; its value reference is its place."""

    name: str
    unit: str
    causality: str
    start: float | None  # of what can be set


class _Variables(NamedTuple):
    """The variables of an FMU, in the order of their value references."""

    inputs: list[_Variable]
    f_p: list[_Variable]
    outputs: list[_Variable]
    sd: list[_Variable]

    @property
    def all(self) -> list[_Variable]:
        """All of them."""
        return [variable for group in self for variable in group]

    def place(self, group: str) -> int:
        """Return the place of the first variable of a group."""
        return sum(len(each) for each in self[: self._fields.index(group)])


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

    What f_p returns is a further input of each output, ``f_p_NAME``: connect your model to it, or
    give f_p in C. It is within where :func:`c_source` has it.

    Args:
        fitted: The model, dynamics that have learnt, or an identification.
        path: The file, ``NAME.fmu``, with a name of C.
        physics: f_p in C, to take the place of its inputs: statements that set ``f_p[0]`` and so
            on, from the columns ``x[0]`` and so on that the physics reads. ``math.h`` is there.
        variance: Whether there are standard deviations.
        observation_noise: If True, these include the noise.

    Raises:
        TypeError, ValueError, RuntimeError: As :func:`c_source`; a ValueError also if dynamics have
            no step, the model has no physics, names are not different, or the code cannot be
            compiled.
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
    path, fitted = Path(path), own_dynamics(fitted)
    name = path.stem
    code = c_source(fitted, name, variance=variance, observation_noise=observation_noise)
    kind, arguments = _signature(code, name)
    step = fitted.spec.step if hasattr(fitted, "spec") else None
    if step is None and kind == "step":
        raise ValueError("Expected the duration of a step: StateSpec(..., step=0.1).")
    if physics is not None and "f_p" not in arguments:
        raise ValueError("The program has no f_p as an argument: leave physics= out.")
    variables = _variables(fitted, arguments, physics is not None)
    names = [variable.name for variable in variables.all]
    twice = [each for each in names if names.count(each) > 1]
    if twice:
        raise ValueError(f"Expected different names of inputs and outputs; found two {twice[0]!r}.")
    places = {each: variables.place(group) for each, group in _GROUPS.items()}
    guid = hashlib.sha256(f"{code}{physics}".encode()).hexdigest()[:32]
    code += _INTERFACE.substitute(
        name=name,
        size=len(names),
        start=", ".join(repr(variable.start or 0.0) for variable in variables.all),
        physics="" if physics is None else _PHYSICS.substitute(statements=physics),
        read=", ".join(f"v[{i}]" for i in _read(fitted, variables)),
        has_physics=int(physics is not None),
        f_p=places["f_p"],
        sd=places["variance"],
        call=f"{name}_{kind}({', '.join(f'v + {places[each]}' for each in arguments)})",
        is_direct=int(step is None),
        settable=places["mean" if step is None else "variance"],
        step=repr(step or 1.0),
        guid=guid,
    )
    system, suffix = _SYSTEMS.get(sys.platform, ("linux", ".so"))
    binary = f"binaries/{system}{64 if sys.maxsize > 2**32 else 32}/{name}{suffix}"
    files = {
        "modelDescription.xml": _description(name, guid, variables.all, step).encode(),
        f"sources/{name}.c": code.encode(),
        binary: _compiled(code, name, suffix),
    }
    with ZipFile(path, "w", ZIP_DEFLATED) as file:
        for each, content in files.items():
            entry = ZipInfo(each)  # with a fixed date, so that the same model makes the same file
            entry.compress_type, entry.external_attr = ZIP_DEFLATED, 0o755 << 16
            file.writestr(entry, content)
    return path


def _signature(code: str, name: str) -> tuple[str, list[str]]:
    """Return which function a program has, "predict" or "step", and its arguments by name."""
    (found,) = re.findall(rf"^void {name}_(predict|step)\(([^)]*)\)", code, re.MULTILINE)
    return found[0], re.findall(r"\*(\w+)", found[1])


def _variables(fitted: GP | LearnedDynamics, arguments: list[str], has_physics: bool) -> _Variables:
    """Return the variables of a model or dynamics."""
    spec, f_p = getattr(fitted, "spec", None), list[str]()
    if spec is not None:
        inputs, outputs, start = spec.actions, spec.states, [0.0] * spec.action_dim
        returned, first = [spec.states[i] for i in spec.moving], 0.0
    else:
        data = model_of(fitted).data
        inputs, outputs, start = data.input_names, data.output_names, data.X[0].tolist()
        returned, first = [*outputs], None
    if "f_p" in arguments:
        several = len(model_of(fitted).physics)
        heads = [f"f_p{i + 1}" for i in range(several)] if several > 1 else ["f_p"]
        f_p = [f"{head}_{output}" for head in heads for output in returned]
    return _Variables(
        [_variable(name, "input", value) for name, value in zip(inputs, start, strict=True)],
        [_variable(name, "local" if has_physics else "input", 0.0) for name in f_p],
        [_variable(name, "output", first) for name in outputs],
        [_variable(name, "output", None, "_sd") for name in outputs if "variance" in arguments],
    )


def _read(fitted: GP | LearnedDynamics, variables: _Variables) -> list[int]:
    """Return the places of what the physics reads."""
    inputs, spec = [*range(len(variables.inputs))], getattr(fitted, "spec", None)
    if spec is None:
        return inputs
    entries = [*range(variables.place("outputs"), variables.place("sd")), *inputs]
    return [entries[i] for i in spec.physics_columns]


def _variable(name: str, causality: str, start: float | None, suffix: str = "") -> _Variable:
    """Return a variable of data, whose name may end with a unit in brackets."""
    bare, bracket, unit = name.partition("[")
    is_unit = bool(bracket) and bare.strip() and unit.rstrip().endswith("]")
    own = bare.strip() if is_unit else name
    return _Variable(own + suffix, unit.rstrip()[:-1] if is_unit else "", causality, start)


def _description(name: str, guid: str, variables: list[_Variable], step: float | None) -> str:
    """Return modelDescription.xml."""
    variability = "continuous" if step is None else "discrete"
    units = sorted({variable.unit for variable in variables} - {""})
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    lines += [f'<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{guid}"']
    lines += ['  generationTool="gpadjust" variableNamingConvention="flat">']
    lines += [f'<CoSimulation modelIdentifier="{name}" canGetAndSetFMUstate="true"']
    is_any = "true" if step is None else "false"
    lines += [f'  canSerializeFMUstate="true" canHandleVariableCommunicationStepSize="{is_any}">']
    lines += [f'<SourceFiles><File name="{name}.c"/></SourceFiles></CoSimulation>']
    if units:
        named = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in units)
        lines += [f"<UnitDefinitions>{named}</UnitDefinitions>"]
    if step is not None:
        lines += [f'<DefaultExperiment startTime="0" stepSize="{step!r}"/>']
    lines += ["<ModelVariables>"]
    for i, variable in enumerate(variables):
        has_start = variable.start is not None and variable.causality != "local"
        initial = f' initial="{"exact" if has_start else "calculated"}"'
        initial = "" if variable.causality == "input" else initial
        start = f' start="{variable.start!r}"' if has_start else ""
        unit = f" unit={quoteattr(variable.unit)}" if variable.unit else ""
        lines += [
            f'<ScalarVariable name={quoteattr(variable.name)} valueReference="{i}" causality='
            f'"{variable.causality}" variability="{variability}"{initial}><Real{unit}{start}/>'
            "</ScalarVariable>"
        ]
    places = [i for i, variable in enumerate(variables) if variable.causality == "output"]
    computed = [i for i in places if variables[i].start is None]
    lines += ["</ModelVariables>", "<ModelStructure>"]
    for tag, own in {"Outputs": places, "InitialUnknowns": computed}.items():
        entries = "".join(f'<Unknown index="{i + 1}"/>' for i in own)
        lines += [f"<{tag}>{entries}</{tag}>"] * bool(own)
    return "\n".join([*lines, "</ModelStructure>", "</fmiModelDescription>", ""])


def _compiled(code: str, name: str, suffix: str) -> bytes:
    """Return the library of a file of C."""
    known = [os.environ.get("CC", ""), "cc", "gcc", "clang"]
    compiler = next((each for each in known if each and shutil.which(each)), None)
    if compiler is None:
        raise OSError(
            "An FMU contains a compiled program, and no C compiler was found: cc, gcc, clang, or "
            "the one that the variable CC names. Install one, or take c_source."
        )
    with TemporaryDirectory() as folder:
        source, library = Path(folder, f"{name}.c"), Path(folder, name + suffix)
        source.write_text(code)
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        options += ["-Werror=implicit-function-declaration"]  # or no one can load the library
        command = [compiler, *options, "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ValueError(f"{compiler} cannot compile the program: {done.stderr[-1000:]}")
        return library.read_bytes()
