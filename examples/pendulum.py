"""A pendulum's log file: mass and inertia from it, and what the equation lacks.

Measured at DFKI (BSD 3-Clause): paper/machines/data/README.md of the repository.
"""

from importlib.resources import files

import matplotlib.pyplot as plt
import torch

from gpadjust import ODEPhysics, PhysicsMeanGP, Unknown
from gpadjust.dynamics import LearnedDynamics
from gpadjust.records import Records
from gpadjust.states import StateSpec

DATA = files("gpadjust.records") / "pendulum"


def frictionless(state, action, p):
    """Return rates of angle and angular velocity."""
    angle, rate = state.unbind(-1)
    torque = action[:, 0] - 9.81 * p.moment * angle.sin()
    return torch.stack([rate, torque / p.inertia], dim=-1)


unknowns = {
    "inertia": Unknown(0.17, factor=1.5, unit="kg m²"),
    "moment": Unknown(0.34, factor=1.5, unit="kg m"),
}
physics = ODEPhysics(frictionless, step=0.1, state_dim=2, unknowns=unknowns)
spec = StateSpec(["q", "dq"], ["u"], angles=["q"], step=0.1)
records, others = (
    Records.read_csv(DATA / f"{name}.csv", spec, segment="segment")
    for name in ("energy_shaping", "sac")
)
dynamics = LearnedDynamics(spec, physics, model=PhysicsMeanGP)
dynamics.update(*records.trajectories().spread(100, seed=0))
found = dynamics.model.physics_parameters
windows = others.windows(10)  # 1 s each, of another record
run = dynamics.free_run(windows.initial_states, windows.actions)
score = run.score(windows.measured)
inertia = found["inertia"]
error = score.median[-1, 0]
print(
    f"The inertia is {inertia.mean():.3f} ± {inertia.std():.3f} kg m²; after 1 s of "
    f"another record the predicted angle is off by {error:.2f} rad in the median."
)

figure, axes = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
for axis, (name, unknown) in zip(axes, unknowns.items(), strict=True):
    prior = unknown.guess * 1.5 ** torch.randn(10_000)
    axis.hist(prior.numpy(), bins=60, density=True, alpha=0.5, label="before")
    axis.hist(found[name].numpy(), bins=20, density=True, label="after the log")
    axis.set(xlabel=f"{name}, {unknown.unit}", xlim=(0, 3 * unknown.guess), yticks=[])
axes[0].legend(frameon=False)
figure.savefig("pendulum.png")
