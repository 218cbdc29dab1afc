"""Fitting a model's hyper-parameters."""

from __future__ import annotations

from typing import Literal, TypedDict, Unpack, get_args, overload

from botorch.models import ModelListGP
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.utils.transforms import is_fully_bayesian

from gpadjust.inference.maximisation import FitResult, maximise
from gpadjust.inference.objective import Objective
from gpadjust.inference.sampling import Sampler, SampleResult, sample

_WARMUP = {"hmc": 40, "nuts": 200}


class FitOptions(TypedDict, total=False):
    """The options of :func:`fit`."""

    num_starts: int | None
    num_screened: int | None
    max_iterations: int
    num_samples: int
    num_warmup: int | None
    seed: int
    progress: bool


@overload
def fit(
    model: BatchedMultiOutputGPyTorchModel,
    method: Literal["map"] = ...,
    **options: Unpack[FitOptions],
) -> FitResult: ...


@overload
def fit(
    model: BatchedMultiOutputGPyTorchModel, method: Sampler, **options: Unpack[FitOptions]
) -> SampleResult: ...


@overload
def fit(
    model: ModelListGP,
    method: Literal["map"] | Sampler = ...,
    **options: Unpack[FitOptions],
) -> list[FitResult | SampleResult]: ...


def fit(
    model: BatchedMultiOutputGPyTorchModel | ModelListGP,
    method: Literal["map"] | Sampler = "map",
    *,
    num_starts: int | None = None,
    num_screened: int | None = None,
    max_iterations: int = 500,
    num_samples: int = 64,
    num_warmup: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> FitResult | SampleResult | list[FitResult | SampleResult]:
    """Fit a model's hyper-parameters, in place: to their most likely values, or by sampling them.

    ``"map"``: Random starts are screened in one batch beside the model's current parameters;
    L-BFGS then runs from the best of them, for all outputs in lockstep, on a likelihood whose
    overall scale (and constant means, where they are unknown) is at its optimum in closed form.
    Starts and bounds follow the data's scales, so that units of inputs, targets and physics make
    no difference. The result is never less likely than the parameters that the model came with.
    Priors registered on the model are honoured (maximum a posteriori, otherwise maximum
    likelihood); parameters with ``requires_grad=False`` stay.

    ``"hmc"`` and ``"nuts"``: Full Bayes. With few data (about five points per input, say) the
    intervals of a point estimate are too narrow; those of a mixture over the hyper-parameters'
    posterior are far closer to what they say. ``"hmc"`` runs 16 chains of Hamiltonian Monte Carlo
    in one batch, and takes about five times as long as ``"map"``; ``"nuts"`` is Pyro's sampler, two
    chains one after the other, of the same posterior: far slower, and slow to mix under vague
    priors. Parameters without a prior get that of :func:`~gpadjust.inference.register_priors`. The
    model then is a fully Bayesian model as BoTorch has them: its posterior is a
    ``GaussianMixturePosterior``, and acquisition functions
    average over the samples.

    Args:
        model: Any model of this library, any BoTorch model with batched outputs such as
            ``SingleTaskGP`` (for ``"map"``), or a ``ModelListGP`` of them.
        method: ``"map"``, ``"hmc"`` or ``"nuts"``.
        num_starts: Number of starts that L-BFGS is run from, for each output. Default: 16; 8 if the
            physics learns, which is evaluated at one setting after the other.
        num_screened: Number of random starts that are screened; 0 fits from the current
            parameters alone (a warm start). Default: 256, fewer for more than 100 points; 32 if
            the physics learns.
        max_iterations: Limit of L-BFGS iterations from each start.
        num_samples: Number of samples that the model is to hold; sampling only.
        num_warmup: Number of iterations that adapt the sampler; sampling only. Default: 40 for
            ``"hmc"``, 200 for ``"nuts"``.
        seed: Seed of the random starts and the sampler. The global random state is left alone.
        progress: Whether to show a progress bar of the sampler.

    Returns:
        For ``"map"`` the likelihood reached and whether the optimiser converged, otherwise the
        draws and whether they mixed; a list of them for a ``ModelListGP``. The model is left in
        eval mode.

    Raises:
        TypeError: If the model is of another kind.
        ValueError: If an option is out of range, no parameter is learnable, or a model whose
            outputs share parameters is to be sampled.
        RuntimeError: If the likelihood cannot be evaluated anywhere (the model is left unchanged),
            or the model holds samples already.

    Warns:
        OptimizationWarning: If the optimiser did not converge.
        SamplingWarning: If the chains did not mix.
    """
    if method not in ("map", *get_args(Sampler)):
        raise ValueError(f"Unknown method {method!r}; expected 'map', 'hmc' or 'nuts'.")
    for name, value, least in (
        ("num_starts", num_starts, 1),
        ("num_screened", num_screened, 0),
        ("max_iterations", max_iterations, 1),
        ("num_samples", num_samples, 1),
        ("num_warmup", num_warmup, 8),
    ):
        if value is not None and value < least:
            raise ValueError(f"Expected {name} >= {least}, got {value}.")
    if isinstance(model, ModelListGP):
        results: list[FitResult | SampleResult] = []
        for part in model.models:
            result = fit(
                part,
                method,
                num_starts=num_starts,
                num_screened=num_screened,
                max_iterations=max_iterations,
                num_samples=num_samples,
                num_warmup=num_warmup,
                seed=seed,
                progress=progress,
            )
            results.extend(result if isinstance(result, list) else [result])
        return results
    if not isinstance(model, BatchedMultiOutputGPyTorchModel):
        raise TypeError(
            "Expected a model of gpadjust, another BoTorch model with batched outputs, or a "
            f"ModelListGP of them, got {type(model).__name__}."
        )
    if is_fully_bayesian(model):
        raise RuntimeError(
            "The model holds samples of its hyper-parameters already; build it anew to fit it."
        )
    if method == "map":
        return maximise(Objective(model), num_starts, num_screened, max_iterations, seed)
    if num_warmup is None:
        num_warmup = _WARMUP[method]
    return sample(
        model,
        method,
        lambda target: maximise(target, num_starts, num_screened, max_iterations, seed),
        num_samples,
        num_warmup,
        seed,
        progress,
    )
