"""Fitting a model's hyper-parameters."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, TypedDict, Unpack, overload

from botorch.models import ModelListGP
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.utils.transforms import is_fully_bayesian

from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.full_bayes import SampleResult, sample
from gpadjust.inference.map_fit import FitResult, Search, maximise
from gpadjust.inference.objective import Objective
from gpadjust.models import ExactGPBase

Method = Literal["map", "hmc"]

# Least values of the options of each method.
_SEARCH = {"num_starts": 1, "num_screened": 0, "max_iterations": 1, "seed": 0}
_OPTIONS: dict[str, dict[str, int]] = {
    "map": _SEARCH,
    "hmc": {**_SEARCH, "num_samples": 1, "num_iterations": 8, "progress": 0},
}


class FitOptions(TypedDict, total=False):
    """The options of :func:`fit`."""

    num_starts: int | None
    num_screened: int | None
    max_iterations: int
    seed: int
    num_samples: int
    num_iterations: int | None
    progress: bool


@overload
def fit(
    model: BatchedMultiOutputGPyTorchModel,
    method: Literal["map"] = ...,
    **options: Unpack[FitOptions],
) -> FitResult: ...


@overload
def fit(
    model: BatchedMultiOutputGPyTorchModel, method: Literal["hmc"], **options: Unpack[FitOptions]
) -> SampleResult: ...


@overload
def fit(
    model: ModelListGP, method: Method = ..., **options: Unpack[FitOptions]
) -> list[FitResult | SampleResult]: ...


def fit(
    model: BatchedMultiOutputGPyTorchModel | ModelListGP,
    method: Method = "map",
    **options: Unpack[FitOptions],
) -> FitResult | SampleResult | list[FitResult | SampleResult]:
    """Fit a model's hyper-parameters, in place: to their most likely values, or by sampling them.

    ``"map"``: Random starts are screened in one batch beside the model's current parameters;
    L-BFGS then runs from the best of them, for all outputs in lockstep, on a likelihood whose
    overall scale (and constant means, where they are unknown) is at its optimum in closed form.
    With more than some 150 points the search is made on 96 of them, and its best optima are
    refined on all. Starts and bounds follow the data's scales, so that units of inputs, targets
    and physics make no difference. The result is never less likely than the parameters that the
    model came with. Priors registered on the model are honoured (maximum a posteriori, otherwise
    maximum likelihood); parameters with ``requires_grad=False`` stay.

    ``"hmc"``: Full Bayes. With few data (about five points per input, say) the intervals of a point
    estimate are too narrow; those of a mixture over the hyper-parameters' posterior are far closer
    to what they say, and its mean errs less as a rule. The chains start from Laplace's
    approximation; 16 of them run in one batch, for two to four times as long as ``"map"`` with up
    to some 50 points, and for ten times as long and more from 200 on.
    Parameters without a prior get that of :func:`~gpadjust.inference.register_priors`, and the size
    of a constant and of a linear trend (of up to three inputs) in the data has no vote on how
    smooth the functions are. The model then is a fully Bayesian model as BoTorch has them: its
    posterior is a ``GaussianMixturePosterior``, and acquisition functions average over the samples.

    A model that holds samples lets go of them first. Small problems are computed with one thread;
    the user's setting is restored after.

    Args:
        model: Any model of this library, any BoTorch model with batched outputs such as
            ``SingleTaskGP`` (for ``"map"``), or a ``ModelListGP`` of them.
        method: ``"map"`` or ``"hmc"``.
        options: ``num_starts``, the number of starts that L-BFGS is run from, for each output
            (default: 16; 8 if the physics learns, which is evaluated at one vector after the
            other). ``num_screened``, the number of random starts that are screened; 0 fits from
            the current parameters alone, a warm start (default: 256, fewer for more than 100
            points; 32 if the physics learns). ``max_iterations``, the limit of L-BFGS iterations
            from each start (500). ``seed`` of random starts and sampler (0); the global random
            state is left alone. Of ``"hmc"`` only: ``num_samples`` that the model is to hold (16),
            ``num_iterations`` of each chain, of which the first half is thrown away (default: 40,
            fewer for more than 100 points), and ``progress``, whether to show a bar (False).

    Returns:
        For ``"map"`` the likelihood reached and whether the optimiser converged, otherwise the
        draws and whether they mixed; a list of them for a ``ModelListGP``. The model is left in
        eval mode.

    Raises:
        TypeError: If the model is of another kind, or an option is no whole number.
        ValueError: If an option is out of range or not one of the method, no parameter is
            learnable, or a model whose outputs share parameters is to be sampled.
        RuntimeError: If the likelihood cannot be evaluated anywhere (the model is left unchanged),
            or a model of another library holds samples.

    Warns:
        OptimizationWarning: If the optimiser did not converge.
        SamplingWarning: If the chains did not mix.
    """
    given: dict[str, Any] = {**options}
    check_options(method, given)
    if isinstance(model, ModelListGP):
        results: list[FitResult | SampleResult] = []
        for part in model.models:
            result = fit(part, method, **options)
            results.extend(result if isinstance(result, list) else [result])
        return results
    if not isinstance(model, BatchedMultiOutputGPyTorchModel):
        raise TypeError(
            "Expected a model of gpadjust, another BoTorch model with batched outputs, or a "
            f"ModelListGP of them, got {type(model).__name__}."
        )
    if is_fully_bayesian(model) and not isinstance(model, ExactGPBase):
        raise RuntimeError(
            f"The {type(model).__name__} holds samples of its hyper-parameters; build it anew, to "
            "fit it."
        )
    search = Search(**{name: given.pop(name) for name in _SEARCH if name in given})
    with threads_for(model.train_targets.shape[-1], others=True), _without_samples(model):
        if method == "map":
            return maximise(Objective(model), search)
        return sample(model, search, **given)


@contextmanager
def _without_samples(model: BatchedMultiOutputGPyTorchModel) -> Iterator[None]:
    """Let a model go of the samples that it holds; it holds them again if there is an error."""
    if not isinstance(model, ExactGPBase) or model.num_samples is None:
        yield
        return
    samples = {
        name: parameter.detach().clone()
        for name, parameter in model.named_parameters()
        if parameter.shape[:1] == (model.num_samples,)
    }
    model.release_samples()
    try:
        yield
    except BaseException:
        model.hold_samples(samples)
        raise


def check_options(method: str, options: dict[str, Any]) -> None:
    """Raise what :func:`fit` raises of its options."""
    if method not in _OPTIONS:
        raise ValueError(f"Unknown method {method!r}; expected 'map' or 'hmc'.")
    known = _OPTIONS[method]
    for name, value in options.items():
        if name not in known:
            of_other = name in _OPTIONS["hmc"]
            hint = "it is one of method 'hmc'" if of_other else f"expected {', '.join(known)}"
            raise ValueError(f"Method {method!r} has no option {name!r}; {hint}.")
        if value is None and name in ("num_starts", "num_screened", "num_iterations"):
            continue
        if not isinstance(value, int):
            raise TypeError(f"Expected {name} to be a whole number, got {value!r}.")
        if value < known[name]:
            raise ValueError(f"Expected {name} >= {known[name]}, got {value}.")
