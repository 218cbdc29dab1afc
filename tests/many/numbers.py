"""Data, and models at random numbers without a fit, in one table of coordinates."""

import torch

from gpadjust.core import CKA
from tests.systems import normal, uniform, wave, waves


def problem(n, num_outputs=1, seed=0, fine=0.0, noise=0.1):
    """Inputs, and noisy observations of a function with a bias that is fine or not."""
    X = uniform(n, 1, seed=seed)
    f = truth(X, fine)[..., :num_outputs]
    return X, f + noise * normal(n, num_outputs, seed=seed + 1)


def truth(X, fine=0.0):
    return 1.2 * waves(X) + 0.5 * X + fine * (50 * X).sin() * (9 * X).cos()


def at_random(model, scale=0.3, seed=0):
    """The model at random coordinates, without a rest; noise outweighs the nugget."""
    u = scale * normal(*model.u.shape, seed=seed)
    values = model.table.values(u)
    noise = {n: v.clamp_min(1e-3) for n, v in values.items() if n.startswith("noise.")}
    u = model.table.with_values(u, noise)
    model.set_draws(model.table.with_choice(u, 0))
    return model


def exact_of(model):
    """The exact CKA of the same data at the same numbers."""
    data, m = model.data, model.num_outputs
    options = {n: v for n, v in model.settings.items() if n != "num_inducing"}
    physics = model.physics[0]
    exact = CKA(data.X, data.Y, data.Yvar, physics=physics, nested=False, **options)
    values = {n: v.detach() for n, v in model.values.items()}
    u = exact.table.with_values(exact.u.detach(), values)
    if shared := len(exact.table.shared):
        u = torch.cat([u[..., :-shared], model.u.detach()[..., -shared:]], -1)
    exact.set_draws(u)
    assert exact.num_outputs == m
    return exact


def physics_of(num_outputs):
    return waves if num_outputs == 2 else wave
