"""Gaussian processes that adjust a physics model to data: the calls, on one page.

Inputs X are ``n x d``, outputs Y ``n x m``, in your units: float64 tensors, arrays, frames, Series.
The physics f_p takes rows of X and returns rows of Y. ``from gpadjust import CKA, fit`` and so on.

The usual way::

    model = CKA(X, Y, physics=f_p)               # rho(x) f_p(x) + delta(x)
    print(fit(model))                            # does f_p help? A point fit: fit(model, "map")
    print(model.summary())                       # hyper-parameters and noise, in your units
    mean, variance = model.predict(X)            # of a measurement: observation_noise=True
    lower, upper = model.interval(X, level=0.95)
    rho, delta = model.rho(X), model.delta(X)    # where and how is f_p wrong?
    print(compare(X, Y, f_p))                    # does f_p help, and which model is best?
    save(model, "model.pt")
    model = load("model.pt", physics=f_p)        # or trusted=True: imported by its name

Other models, with the same calls::

    CKA(X, Y, physics={"a": f_p, "b": g_p})      # several physics
    PhysicsMeanGP(X, Y, physics=f_p)             # delta alone
    ScaleGP(X, Y, physics=f_p)                   # rho alone
    ZeroMeanGP(X, Y)                             # no physics
    RRA(X, Y, physics=f_p)                       # functions to call anywhere
    VariationalCKA(X, Y, physics=f_p)            # up to 100,000 rows
    AR1(X, Y, physics=f_p, bounds=[[0], [1]])    # a constant rho; f_p by samples

Other data, for each of these; names of gpadjust.kinds::

    CKA(X, Y, 0.1**2, physics=f_p)               # noise of a known variance
    CKA(X, Y, physics=f_p, noise=HeavyTails())   # outliers; RelativeNoise(): errors in per cent
    LinkedCKA(X, Y, physics=f_p, link="log")     # positive outputs; (0, 1): between bounds
    CKA(frame, Y, physics=f_p, input_transform=Categories())   # columns of text

Other physics, with unknown parameters or without::

    FormulaPhysics("1 + x", ["x"])               # a formula as text, or a spreadsheet's
    BlackBoxPhysics(simulator)                   # NumPy code; SubprocessPhysics: a program
    ODEPhysics(rate, step=0.1, state_dim=1)      # a differential equation
    FMUPhysics("tank.fmu", ["heater"], ["tank.T"], times=60)   # a model of Modelica or Simulink
    law = FunctionPhysics(lambda X, p: p.gain * X[:, 0], unknowns={"gain": Unknown(1.0, factor=2)})
    CalibratedPhysics(X, Y, physics=law)         # the law alone
    Unknown(0.1, factor=2, function_of="v", between=(0, 9))   # a function in the law, friction(v)

Each object draws itself, and is a table in a notebook::

    model.plot()                                 # predictions, rho and delta; also of a mixture
    comparison.plot()                            # of compare: left-out predictions, and scores
    model.priors().plot()                        # of all numbers, and the posterior
    parameters.plot()                            # model.physics_parameters: posterior and prior
    leave_one_out(model).plot()                  # left-out predictions, and their residuals
    collection.plot()                            # of collect: path and best so far; or regret
    identification.plot()                        # of identify: free runs; .lack.plot()
    agent.plot()                                 # its rewards, and the last episode

Beyond the models::

    from gpadjust.validation import leave_one_out, trust   # errors, coverage; what decides
    from gpadjust.validation.plots import plot_adjustment  # rho and delta
    from gpadjust.report import report                     # a page to show
    from gpadjust.active import collect                    # the next point to measure
    from gpadjust.physics import MujocoPhysics             # a MuJoCo model, its unknown numbers
    from gpadjust.records import Records, smooth           # log files of machines, as they are
    from gpadjust.dynamics import LearnedDynamics          # the next state of a system
    from gpadjust.control import MPCAgent                  # a controller; SAC and TD3: gpadjust.rl
    from gpadjust.export import c_source, casadi_function  # onto the machine; export_fmu
    from gpadjust.sklearn import CKARegressor              # scikit-learn; Ax: gpadjust.ax
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpadjust.core import (
        CKA,
        RRA,
        CalibratedPhysics,
        PhysicsMeanGP,
        ScaleGP,
        StackedGP,
        ZeroMeanGP,
        fit,
        load,
        save,
    )
    from gpadjust.kinds import AR1, EmulatedPhysics
    from gpadjust.many import VariationalCKA
    from gpadjust.physics import (
        BlackBoxPhysics,
        FMUPhysics,
        FormulaPhysics,
        FunctionPhysics,
        ODEPhysics,
        PhysicsError,
        PhysicsWarning,
        SubprocessPhysics,
        Unknown,
    )
    from gpadjust.validation import compare

__version__ = "0.3.0"

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "BlackBoxPhysics",
    "CalibratedPhysics",
    "EmulatedPhysics",
    "FMUPhysics",
    "FormulaPhysics",
    "FunctionPhysics",
    "ODEPhysics",
    "PhysicsError",
    "PhysicsMeanGP",
    "PhysicsWarning",
    "ScaleGP",
    "StackedGP",
    "SubprocessPhysics",
    "Unknown",
    "VariationalCKA",
    "ZeroMeanGP",
    "compare",
    "fit",
    "load",
    "save",
]

# Rooms that need no extra, in the order in which a name of `__all__` is looked for.
_ROOMS = ("physics", "core", "kinds", "many", "validation", "states", "active", "dynamics")
# Rooms that are not searched for names; most need an extra.
_OTHER_ROOMS = ("ax", "control", "export", "files", "records", "report", "rl", "sklearn", "systems")


def __getattr__(name: str) -> Any:
    """Import a name or a room at its first use: environments need no BoTorch, which is slow."""
    if name in (*_ROOMS, *_OTHER_ROOMS):
        try:
            return import_module(f"gpadjust.{name}")
        except ImportError as error:  # hasattr and help go on
            raise AttributeError(str(error)) from error
    if name in __all__:
        for room in _ROOMS:
            module = import_module(f"gpadjust.{room}")
            if hasattr(module, name):
                globals()[name] = getattr(module, name)
                return globals()[name]
    raise AttributeError(f"module 'gpadjust' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_ROOMS, *_OTHER_ROOMS, "__version__"})
