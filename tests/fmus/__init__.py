"""FMUs of our own C code, made when they are needed: a tank with a wall, and a ball."""

import atexit
import functools
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest

# Name, unit, causality, variability, initial, start and number of the state it is the rate of; in
# the order of model.c.
STATE, CONSTANT = ("continuous", "exact"), ("fixed", "exact")
TANK = [
    ("tank.T", "K", "output", *STATE, 300, 0),
    ("wall[1].T", "K", "local", *STATE, 300, 0),
    ("der(tank.T)", "", "local", "continuous", "calculated", None, 1),
    ("der(wall[1].T)", "", "local", "continuous", "calculated", None, 2),
    ("heater", "W", "input", "continuous", "", 0, 0),
    ("ambient", "K", "input", "continuous", "", 300, 0),
    ("tank.C", "J/K", "parameter", *CONSTANT, 4000, 0),
    ("wall[1].G", "W/K", "parameter", *CONSTANT, 50, 0),
    ("wall[1].C", "J/K", "parameter", *CONSTANT, 1000, 0),
    ("loss", "W/K", "parameter", *CONSTANT, 10, 0),
    ("wall_start", "K", "parameter", *CONSTANT, 0, 0),
]
BALL = [
    ("h", "m", "output", *STATE, 1, 0),
    ("v", "m/s", "output", *STATE, 0, 0),
    ("der(h)", "", "local", "continuous", "calculated", None, 1),
    ("der(v)", "", "local", "continuous", "calculated", None, 2),
    ("e", "", "parameter", *CONSTANT, 0.7, 0),
    ("g", "m/s2", "parameter", *CONSTANT, 9.81, 0),
]
WEAK = "__attribute__((weak))"
MODELS = {"tank": (1, TANK, 0), "ball": (2, BALL, 1)}


def attributes(**values):
    return "".join(f" {k}={quoteattr(str(v))}" for k, v in values.items() if v not in ("", None))


def description(name, fmi, variables, number, indicators, interface):
    """The modelDescription.xml of one of the models."""
    exchange = {"completedIntegratorStepNotNeeded": "true"} if fmi == 2 else {}
    kinds = f"<ModelExchange{attributes(modelIdentifier=name, **exchange, **interface['any'])}/>"
    kinds += (
        f"<CoSimulation{attributes(modelIdentifier=name, **interface['any'], **interface['cs'])}/>"
    )
    units = "".join(f'<Unit name="{unit}"/>' for unit in sorted({v[1] for v in variables} - {""}))
    rates = [i for i, v in enumerate(variables) if v[6]]
    text = ""
    for i, (own, unit, causality, variability, initial, start, rate) in enumerate(variables):
        about = {"name": own, "valueReference": i, "causality": causality}
        about |= {"variability": variability, "initial": initial}
        value = {"unit": unit, "start": None if initial == "calculated" else start}
        if rate:
            value["derivative"] = rate if fmi == 2 else rate - 1
        if fmi == 2:
            real = f"<Real{attributes(**value)}/>"
            text += f"<ScalarVariable{attributes(**about)}>{real}</ScalarVariable>"
        else:
            text += f"<Float64{attributes(**about, **value)}/>"
    if fmi == 2:
        entries = "".join(f'<Unknown index="{i + 1}"/>' for i in rates)
        structure = f"<Derivatives>{entries}</Derivatives>"
        head = {"fmiVersion": "2.0", "guid": number, "numberOfEventIndicators": indicators}
    else:
        about = {"name": "time", "valueReference": 99, "causality": "independent"}
        text += f"<Float64{attributes(**about, variability='continuous')}/>"
        structure = "".join(f'<ContinuousStateDerivative valueReference="{i}"/>' for i in rates)
        structure += '<EventIndicator valueReference="0"/>' * indicators
        head = {"fmiVersion": "3.0", "instantiationToken": number}
    return (
        f"<fmiModelDescription{attributes(modelName=name, **head)}>{kinds}"
        f"<UnitDefinitions>{units}</UnitDefinitions><ModelVariables>{text}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def functions(fmi):
    """All functions of FMI that FMPy looks for."""
    from fmpy import fmi2, fmi3

    kinds = {2: (fmi2.FMU2Slave, fmi2.FMU2Model), 3: (fmi3.FMU3Slave, fmi3.FMU3Model)}[fmi]
    return sorted({name for kind in kinds for name in dir(kind) if name.startswith(f"fmi{fmi}")})


@functools.cache
def fmu(name="tank", fmi=2, *, only_one=False, any_step=True, of=None, initial=None):
    """The path of an FMU, one whose variable `of` has another `initial`."""
    fmpy = pytest.importorskip("fmpy")
    compiler = shutil.which("cc") or pytest.skip("there is no C compiler")
    number, variables, indicators = MODELS[name]
    folder = Path(tempfile.mkdtemp(prefix="fmu_"))
    atexit.register(shutil.rmtree, folder)
    library = folder / f"{name}{fmpy.sharedLibraryExtension}"
    headers = Path(fmpy.__file__).parent / "c-code"
    options = [f"-DFMI={fmi}", f"-DMODEL={number}", f"-DONLY_ONE={int(only_one)}", f"-I{headers}"]
    command = [compiler, "-std=c99", "-O1", "-shared", "-fPIC", *options]
    sources = [Path(__file__).with_name("model.c"), folder / "others.c"]
    # Functions of model.c take the place of these.
    sources[1].write_text(
        "\n".join(f"{WEAK} int {name}() {{ return 3; }}" for name in functions(fmi))
    )
    subprocess.run([*command, "-o", library, *sources, "-lm"], check=True)
    interface = {
        "any": {"canBeInstantiatedOnlyOncePerProcess": str(only_one).lower()},
        "cs": {"canHandleVariableCommunicationStepSize": str(any_step).lower()},
    }
    variables = [(*v[:4], initial if v[0] == of else v[4], *v[5:]) for v in variables]
    xml = description(name, fmi, variables, number, indicators, interface)
    place = fmpy.platform if fmi == 2 else fmpy.platform_tuple
    with zipfile.ZipFile(folder / f"{name}.fmu", "w") as file:
        file.writestr("modelDescription.xml", xml)
        file.write(library, f"binaries/{place}/{library.name}")
    return folder / f"{name}.fmu"
