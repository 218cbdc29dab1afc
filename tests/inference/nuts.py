"""An oracle for full Bayes: Pyro's NUTS on the potential that the library samples from."""

from copy import deepcopy

import torch
from pyro.infer import MCMC, NUTS

from gpadjust.inference.full_bayes import potential_of
from gpadjust.inference.map_fit import Search, maximise
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors

_INFINITE = 1e8  # Pyro takes no infinite energies


def nuts(model, num_samples, num_warmup, num_chains=2, seed=0):
    """Draws of the vectors of a model of one output, ``num_samples x num_chains x p``."""
    target = deepcopy(model)
    register_priors(target)
    objective = Objective(target, marginal=True, of_logs=True)
    maximise(objective, Search())
    optimum, potential = objective.parameters.current(), potential_of(objective)

    class Energy(torch.autograd.Function):
        @staticmethod
        def forward(ctx, vectors):
            value, gradient = potential(vectors.unsqueeze(0))
            ctx.save_for_backward(gradient.squeeze(0))
            return value.nan_to_num(posinf=_INFINITE).sum()

        @staticmethod
        def backward(ctx, outer):
            (gradient,) = ctx.saved_tensors
            return outer * gradient

    chains = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(num_chains):
            start = objective.parameters.clipped(optimum + 0.3 * torch.randn_like(optimum))[0]
            mcmc = MCMC(
                NUTS(potential_fn=lambda parameters: Energy.apply(parameters["vectors"])),
                num_samples=num_samples,
                warmup_steps=num_warmup,
                initial_params={"vectors": start},
                disable_progbar=True,
            )
            mcmc.run()
            chains.append(mcmc.get_samples()["vectors"].squeeze(1))
    return torch.stack(chains, dim=1)
