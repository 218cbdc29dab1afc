"""The runs of a simulator that would tell most."""

from __future__ import annotations

from typing import Any

import torch
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.gp import WeightedSum
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import ArrayLike, to_tensor

_CANDIDATES = 512


@torch.no_grad()
def next_runs(
    model: TermsModel,
    X: ArrayLike,
    number: int = 1,
    *,
    bounds: Tensor | None = None,
    seed: int = 0,
) -> Tensor:
    r"""Return the runs of an emulated simulator that would tell most of what a model predicts.

    The outcome of a run at u tells of the error e of the emulator. With the model's posterior given
    all measurements, the variances of its predictions would become smaller by

    .. math:: \sum_i \mathrm{Cov}(f_a(x_i), e(u))^2 / (\mathrm{Var}(e(u)) + s),

    with s the noise of the simulator; of several outputs, summed in units of their targets. Each
    run is the best of candidates, half of them at the ``X`` themselves with likely parameters,
    given those before it (a sequential design as of Cohn 1996).

    Args:
        model: A model of an :class:`~gpadjust.EmulatedPhysics`.
        X: The inputs to be predicted, ``n x d``.
        number: How many runs.
        bounds: Of the inputs of the runs, unknown parameters included, ``2 x D``. Default: those of
            the runs so far.
        seed: Of the candidates, of which there are 512.

    Returns:
        Inputs of the runs, ``number x D``, in the order of ``runs_X``.

    Raises:
        TypeError: If the physics is not one that is emulated.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, EmulatedPhysics
        >>> from gpadjust.emulation import next_runs
        >>> runs_X = torch.tensor([[0.0], [0.4], [0.8], [2.9]], dtype=torch.float64)
        >>> simulator = EmulatedPhysics(runs_X, torch.sin(2 * runs_X))
        >>> X = torch.linspace(0, 3, 13, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X[::6], 2 * torch.sin(2 * X[::6]), physics=simulator)
        >>> 0.8 < next_runs(model, X).item() < 2.9
        True
    """
    physics: Any = getattr(model.input_transform, "physics", None)
    if not getattr(physics, "is_emulated", False) or hasattr(physics, "parts"):
        raise TypeError(
            "Expected a model of a single EmulatedPhysics, whose runs are to be chosen, got one of "
            f"{type(physics).__name__}."
        )
    checked_whole("number", number, 1)
    X = to_tensor(X, "X")
    runs = physics.emulator.data()["train_X"]
    bounds = torch.stack([runs.amin(0), runs.amax(0)]) if bounds is None else bounds.to(runs)
    d, unknowns = physics.num_inputs, physics.unknowns
    u = draw_sobol_samples(bounds, _CANDIDATES, 1, seed=seed).squeeze(1)
    at_points = u[: _CANDIDATES // 2]  # where predictions are asked for, with likely parameters
    pick = torch.arange(len(at_points)).to(u.device)
    at_points[:, :d] = physics.read(X)[pick % len(X)]
    if unknowns:
        draws = model.physics_parameters.draws
        at_points[:, d:] = draws[pick * 7919 % len(draws)]
    sought = model.at(model.model_inputs(X))
    errors = WeightedSum(_rows_of_runs(model, u), [(t, None) for t in model.terms if t.scaled_by])
    conditioning: Any = model.conditioning()
    factors, train = conditioning.factors(), conditioning.train
    white = [factors.whiten(each.cross(train)) for each in (errors, sought)]
    own = errors.covariance() - white[0] @ white[0].mT
    cross = sought.cross(errors) - white[1] @ white[0].mT
    scale = model.units()[1]
    noise = physics.emulator.noise.at(physics.emulator.train_inputs[0])
    noise = (noise.mean(-1, keepdim=True) * physics.emulator.units()[1].square()).mean() / (
        scale.square()
    )
    chosen = []
    for _ in range(number):
        variance = own.diagonal(dim1=-1, dim2=-2)
        least = 1e-9 * variance.amax(-1, keepdim=True)
        gain = cross.square().sum(-2) / (variance + noise + least)
        best = int(gain.reshape(-1, gain.shape[-1]).mean(0).argmax())
        chosen.append(best)
        column = own[..., best : best + 1]
        size = (variance[..., best : best + 1] + noise + least[..., :1]).unsqueeze(-1)
        cross = cross - cross[..., best : best + 1] @ column.mT / size
        own = own - column @ column.mT / size
    return u[chosen]


def _rows_of_runs(model: TermsModel, u: Tensor) -> Tensor:
    """Rows of the model's columns of which its term of the error reads runs ``N x D``."""
    transform: Any = model.input_transform
    physics = transform.physics
    X = u.new_zeros(len(u), transform.num_inputs)
    X[:, list(physics.inputs or range(transform.num_inputs))] = u[:, : physics.num_inputs]
    columns = torch.cat([X, u[:, physics.num_inputs :]], dim=-1)
    f_p = u.new_zeros(len(u), physics.num_outputs)
    train = model.train_inputs[0]
    front = u.new_zeros(len(u), train.shape[-1] - columns.shape[-1] - f_p.shape[-1])
    rows = torch.cat([front, columns, f_p], dim=-1)
    return rows.expand(*train.shape[:-2], *rows.shape)
