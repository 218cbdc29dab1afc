"""Fitting a model's hyper-parameters."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias, TypedDict, Unpack, overload

import torch
from botorch.models import ModelListGP
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.utils.transforms import is_fully_bayesian

from gpadjust.checks import checked_whole
from gpadjust.gp import AppendedPhysics
from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.bayes import SampleResult, default_num_samples, sample
from gpadjust.inference.calibrate import calibrate
from gpadjust.inference.optimise import FitResult, Search, maximise, optima
from gpadjust.inference.priors import register_priors
from gpadjust.inference.targets import LogPosterior
from gpadjust.inference.variational_fit import fit_variational
from gpadjust.models import TermsGP, VariationalCKA
from gpadjust.models.parameters import shared_parameters

Fittable: TypeAlias = BatchedMultiOutputGPyTorchModel | VariationalCKA


class FitOptions(TypedDict, total=False):
    """The options of :func:`fit`, by name.

    ``num_samples`` and ``num_draws`` are of ``"bayes"`` alone; :func:`fit` says what each does.
    """

    num_starts: int | None
    num_screened: int | None
    max_iterations: int
    seed: int
    num_samples: int | None
    num_draws: int | None
    prior: TermsGP | Sequence[TermsGP] | None


class Method(NamedTuple):
    """A way to fit.

    Attributes:
        run: Called with a model, a :class:`Search` and those of the method's own options that the
            user gave; it changes the model, and leaves it as it was if it raises an error.
        options: Least values of its own options, whole numbers, any of which may be None.
    """

    run: Callable[..., FitResult | SampleResult]
    options: dict[str, int]


def most_likely(model: Fittable, search: Search) -> FitResult:
    """Bring a model to its most likely hyper-parameters."""
    if isinstance(model, VariationalCKA):
        return fit_variational(model, search)
    if isinstance(model, TermsGP) and model.has_unknowns:
        return calibrate(model, search).result
    return maximise(model, search)


METHODS = {
    "map": Method(most_likely, {}),
    "bayes": Method(sample, {"num_samples": 1, "num_draws": 16}),
}
"""All methods by name: one more is an entry, which a module of its own can make."""
_ROUNDS = 30  # of refinements of the noise, at most
_SEARCH = {"num_starts": 1, "num_screened": 0, "max_iterations": 1, "seed": 0}  # least values


@overload
def fit(model: Fittable, method: Literal["map"], **options: Unpack[FitOptions]) -> FitResult: ...


@overload
def fit(
    model: Fittable, method: Literal["bayes"], **options: Unpack[FitOptions]
) -> SampleResult: ...


@overload
def fit(
    model: Fittable, method: None = ..., **options: Unpack[FitOptions]
) -> FitResult | SampleResult: ...


@overload
def fit(
    model: ModelListGP, method: str | None = ..., **options: Unpack[FitOptions]
) -> list[FitResult | SampleResult]: ...


def fit(
    model: Fittable | ModelListGP, method: str | None = None, **options: Unpack[FitOptions]
) -> FitResult | SampleResult | list[FitResult | SampleResult]:
    """Fit a model's hyper-parameters, in place: by sampling them, or to their most likely values.

    ``"bayes"``, the default where it can be done: full Bayes. The model then is a fully Bayesian
    model as BoTorch has them: it holds samples of its hyper-parameters, its posterior is a
    ``GaussianMixturePosterior``, and acquisition functions average over the samples. Draws around
    the modes, and as many of the prior, move to the posterior by annealed Hamiltonian Monte Carlo.
    Parameters without a prior get that of :func:`~gpadjust.inference.register_priors`. The size of
    a constant and of a linear trend in the data says nothing of how smooth the functions are. The
    parameters of a network that is the physics are at their most likely values.

    *A physics that misleads* is left out, *and one that is right* is left as it is, each with the
    probability that the data give it: beside the model itself (prior probability 0.32) there are
    the same without the physics, a Gaussian process around the mean of the targets (0.08), and the
    physics alone with noise (0.6). The posterior probability of each is the share of its samples
    among those that the model holds; ``result.relevance`` is that of the two with the physics,
    ``result.sufficiency`` that of the physics alone, of which are at most three quarters of the
    samples; data can refute it, and hardly confirm it. So are weighed, by 3 to 150 observations,
    models whose prior means are known and whose kernels have the default priors and an outputscale.
    Without the physics: a :class:`~gpadjust.CKA` or :class:`~gpadjust.RRA` of a physics without
    unknown or learnt parameters; of others ``relevance`` is None. The physics alone: what has f_p
    in the mean and no other functions than rho and one delta, of one output if it has unknown
    parameters; of others ``sufficiency`` is None.

    *Where left-out observations are missed* by more than predicted, as near a kink or a jump, the
    variances of the sum are larger; means stay. So of ``"bayes"`` with RBF and Matern kernels.

    *Unknown parameters of the physics*, which all outputs share, are learnt with all else, by
    either method; ``model.physics_parameters`` is what is known of them. With ``"bayes"`` each
    sample that the model holds has its own physics (least squares of randomised targets, Bardsley
    et al. 2014).

    ``"map"``: the most likely values, by L-BFGS from the best of many random starts and from the
    current parameters, so that the result is never less likely than these. Priors registered on
    the model are honoured (maximum a posteriori, otherwise maximum likelihood). With few data its
    intervals are far too narrow. It is the default for models of other libraries, and for batches
    of data sets, and all that a :class:`~gpadjust.VariationalCKA` has.

    Starts and bounds follow the data's scales, so that units of inputs, targets and physics make no
    difference.
    Parameters with ``requires_grad=False`` stay. A model that holds samples lets go of them first.
    Small problems are computed with one thread; the user's setting is restored after.

    Args:
        model: Any model of this library, any BoTorch model with batched outputs such as
            ``SingleTaskGP`` (for ``"map"``), or a ``ModelListGP`` of them.
        method: ``"bayes"`` or ``"map"``. Default: ``"bayes"`` if the model can hold samples.
        options: ``num_starts``, the number of starts that L-BFGS is run from, for each output
            (default: 8 of ``"bayes"``; 16 of ``"map"``, 8 if the physics learns, which is evaluated
            at one vector after the other). ``num_screened``, the number of random starts that are
            screened; 0 fits from the current parameters alone, a warm start (default: 128 of
            ``"bayes"``; 256 of ``"map"``, fewer for more than 100 points; 32 if the physics
            learns). ``max_iterations``, the limit of L-BFGS iterations from each start (500; at
            most 30 of ``"bayes"``, whose draws go on from there). ``seed`` of random starts and
            draws (0); the global random state is left alone. Of ``"bayes"`` only: ``num_samples``
            that the model is to hold
            (default: 16, 8 with more than 40 points, 4 with more than 100; 16 if the physics has
            unknown parameters, and up to 256 of a model that has nothing else), and ``num_draws``
            that the sampling begins with (default: 1,024; down to 128 with more than 70 points),
            which the effort of all that follows is in proportion to.

    Returns:
        For ``"map"`` the likelihood reached and whether the optimiser converged, otherwise the
        draws and how many of them count; a list of them for a ``ModelListGP``. The model is left in
        eval mode.

    Raises:
        TypeError: If the model is of another kind, or an option is no whole number.
        ValueError: If an option is out of range or not one of the method, no parameter is
            learnable, or a model is to be sampled that cannot be.
        RuntimeError: If the likelihood cannot be evaluated anywhere (the model is left unchanged),
            or a model of another library holds samples.

    Warns:
        OptimizationWarning: If the optimiser did not converge.
        SamplingWarning: If the draws do not show the posterior.
        ParameterWarning: If the observations hardly determine a parameter of the physics, or
            of a combination of some, or contradict its prior.
    """
    if isinstance(model, ModelListGP):
        return _fit_list(model, method, {**options})
    if not isinstance(model, Fittable):
        raise TypeError(
            "Expected a model of gpadjust, another BoTorch model with batched outputs, or a "
            f"ModelListGP of them, got {type(model).__name__}."
        )
    if is_fully_bayesian(model) and not isinstance(model, TermsGP):
        raise RuntimeError(
            f"The {type(model).__name__} holds samples of its hyper-parameters; build it again, to "
            "fit it."
        )
    method = method or ("bayes" if _can_be_sampled(model) else "map")
    own: dict[str, Any] = {**options}
    check_options(method, own)
    search = Search(**{name: own.pop(name) for name in _SEARCH if name in own})
    with threads_for(model.train_targets.shape[-1]), _without_samples(model):
        try:
            begin = time.perf_counter()
            if isinstance(model, TermsGP) and model.noise.rows is not None:
                _refine_noise(model, search)
            for _ in range(2):
                result = METHODS[method].run(model, search, **own)
                if not (isinstance(model, TermsGP) and model.noise.rows and _is_unconfirmed(model)):
                    break
            if isinstance(model, TermsGP):
                model.was_fitted = True
                model.eval()
                model.learn_local_errors()
            if isinstance(model, TermsGP) and isinstance(result, SampleResult):
                seconds = time.perf_counter() - begin
                result = replace(result, num_samples=model.num_samples, seconds=seconds)
            return result
        finally:
            model.eval()


def _refine_noise(model: TermsGP, search: Search) -> None:
    """Bring what is said of the noise of training rows to rest, by rough fits of a copy."""
    copy = deepcopy(model)
    rows: Any = copy.noise.rows
    rows.forget()
    search = search._replace(num_starts=4, num_screened=64)
    if not model.has_unknowns:
        register_priors(copy)
    for _ in range(_ROUNDS):
        if model.has_unknowns:
            most_likely(copy, search)
        else:
            target = LogPosterior(copy)
            vectors, values = optima(target, search)
            target.assign(vectors[values.argmin(0), torch.arange(values.shape[1])])
            copy.eval()
        if not rows.refine(copy):
            break
    for own, found in (
        (model.likelihood, copy.likelihood),
        (model.noise.rows, rows),
    ):
        for name, buffer in found.named_buffers(recurse=False):
            setattr(own, name, buffer)
    if model.noisy_inputs is not None:
        model.noisy_inputs.move(model, copy.noisy_inputs.shift)


def _is_unconfirmed(model: TermsGP) -> bool:
    """Return whether a fit contradicts the noise of its rows; then they are others, for another."""
    rows: Any = model.noise.rows
    if not rows.confirm(model.eval()):
        return False
    if model.num_samples is not None:
        model.release_samples()
    return True


def check_options(method: str, options: dict[str, Any]) -> None:
    """Raise what :func:`fit` raises of its options."""
    if method not in METHODS:
        raise ValueError(
            f"Unknown method {method!r}; expected {' or '.join(map(repr, sorted(METHODS)))}."
        )
    least = {**_SEARCH, **METHODS[method].options}
    for name, value in options.items():
        if name not in least:
            others = [other for other, each in METHODS.items() if name in each.options]
            hint = (
                f"it is one of method {others[0]!r}" if others else f"expected {', '.join(least)}"
            )
            raise ValueError(f"Method {method!r} has no option {name!r}; {hint}.")
        if value is None and Search._field_defaults.get(name) is None:
            continue
        checked_whole(name, value, least[name])


def _fit_list(
    models: ModelListGP, method: str | None, options: dict[str, Any]
) -> list[FitResult | SampleResult]:
    """Fit the parts of a list; those that are sampled hold the same number of samples."""
    methods = [method or ("bayes" if _can_be_sampled(m) else "map") for m in models.models]
    for each in methods:
        check_options(each, options)
    if "bayes" in methods and options.get("num_samples") is None:
        most = max(part.train_targets.shape[-1] for part in models.models)
        options = {**options, "num_samples": default_num_samples(most)}
    results: list[FitResult | SampleResult] = []
    for i, (part, each) in enumerate(zip(models.models, methods, strict=True)):
        has_samples = "num_samples" in METHODS[each].options
        own = {k: v for k, v in options.items() if has_samples or k != "num_samples"}
        own["seed"] = options.get("seed", 0) + i  # or their samples would be alike
        result: Any = fit(part, each, **own)
        results.append(result)
    return results


def _can_be_sampled(model: Fittable) -> bool:
    """Return whether a model can hold samples, and has something to sample."""
    if not isinstance(model, TermsGP):
        return False
    try:
        model.check_can_be_sampled()
    except ValueError:
        return False
    learnt = [name for name, p in model.named_parameters() if p.requires_grad]
    return len(learnt) > len(shared_parameters(model)) or model.has_unknowns


@contextmanager
def _without_samples(model: Fittable) -> Iterator[None]:
    """Let a model go of the samples that it holds; it holds them again if there is an error."""
    if not isinstance(model, TermsGP) or model.num_samples is None:
        yield
        return
    samples = {
        name: parameter.detach().clone()
        for name, parameter in model.named_parameters()
        if parameter.shape[:1] == (model.num_samples,)
    }
    errors = deepcopy(model.local_errors)
    model.release_samples()
    with torch.no_grad():
        for basis in model.covar_module.modules():
            if isinstance(basis, AppendedPhysics) and basis.learnt is not None:
                basis.learnt.zero_()  # where a new model has it
    try:
        yield
    except BaseException:
        model.release_samples()
        model.hold_samples(samples)
        model.local_errors = errors
        raise
