"""Co-kriging adjustment of many observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, Literal, NoReturn, Self

import torch
from botorch.models.approximate_gp import ApproximateGPyTorchModel
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood, Likelihood
from torch import Size, Tensor

from gpadjust.gp import SumOfTerms, Term, TermsMean
from gpadjust.models.adjusted_gp import KernelLike, Means, PhysicsLike
from gpadjust.models.adjusted_model import AdjustedModel
from gpadjust.models.cholesky_strategy import Weights
from gpadjust.models.cka import CKA
from gpadjust.models.hyperparameters import scaled_rbf
from gpadjust.models.inducing_values import InducingGP, InducingStrategy, batch_of
from gpadjust.models.sampled_functions import check_number
from gpadjust.models.training_data import ArrayLike, TrainingData, training_data

_SEARCHED = 1000  # observations that an exact model of some takes
NOTHING = -60.0
"""The logarithm of a variance that is none."""
NEVER_SAMPLED = (
    "Expected method 'map' or None for a VariationalCKA, got 'bayes': so many observations tell "
    "its hyper-parameters, which are not sampled."
)


class VariationalCKA(AdjustedModel, ApproximateGPyTorchModel):
    r"""Co-kriging adjustment with inducing points, for up to some 100,000 observations.

    The model is that of :class:`~gpadjust.CKA`, :math:`f_a(x) = \rho(x) f_p(x) + \delta(x)`, of
    which a distribution over the values at ``num_inducing`` points stands for all observations
    (Titsias 2009), so that learning takes :math:`O(n M^2)` instead of :math:`O(n^3)` operations.
    What so many points cannot show has a term of its own, ``rest``: short-ranged variations of the
    bias, of which nothing is known but how large they are. Without it intervals would be far too
    narrow, as the points tie down the functions that they can show. Posteriors of ``f`` and of
    :meth:`delta` have it in their variance.

    :func:`gpadjust.fit` finds hyper-parameters, points and the optimal distribution, in closed form
    from all observations. It is also one of BoTorch's ``ApproximateGPyTorchModel``: ``model`` and
    ``likelihood``, in units after ``outcome_transform``, can be trained by minibatches with
    GPyTorch's ``VariationalELBO``.

    Intervals are those of the most likely hyper-parameters, which so many observations tell. It
    cannot be conditioned on further observations, which ``fantasize`` and look-ahead acquisition
    functions want; the others take it.

    The arguments and errors are those of :class:`~gpadjust.CKA`, for one data set, and:

    Args:
        num_inducing: Number ``M`` of inducing points, at most that of observations. Time grows with
            its square.
        seed: Seed of which observations are searched and where inducing points begin.

    Attributes:
        model: GPyTorch's variational model of one batch element per output, in model units.
        rest: The term of what the inducing points cannot show.
        evidence: The lower bound of the log marginal likelihood that the last fit reached, ``(m)``,
            in model units; NaN before a fit.

    Raises:
        ValueError: As :class:`~gpadjust.CKA`; and for a batch of data sets.

    Example:
        >>> import torch
        >>> from gpadjust import VariationalCKA, fit
        >>> train_X = torch.rand(500, 1, dtype=torch.float64)
        >>> train_Y = 2 * torch.sin(6 * train_X) + train_X
        >>> train_Y = train_Y + 0.1 * torch.randn(500, 1, dtype=torch.float64)
        >>> f_p = lambda X: torch.sin(6 * X)
        >>> model = VariationalCKA(train_X, train_Y, physics=f_p, num_inducing=20)
        >>> result = fit(model)
        >>> lower, upper = model.interval(train_X[:3])
        >>> rho, delta = model.rho(train_X[:3]), model.delta(train_X[:3])
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        num_inducing: int = 1000,
        rho_covar_module: KernelLike | Sequence[KernelLike] | None = None,
        delta_covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        center: float | Tensor | Literal["mean", "learn"] = "learn",
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
        seed: int = 0,
    ) -> None:
        data = training_data(train_X, train_Y, train_Yvar)
        if data.X.dim() > 2:
            raise ValueError(
                f"Expected train_X of one data set, n x d, got shape {tuple(data.X.shape)}; make a "
                "model of each."
            )
        check_number(num_inducing, "num_inducing")
        rows = _some_of_each_output(data, seed)
        noise = None if data.Yvar is None else data.Yvar[rows]
        # An exact model of some rows: it makes the terms, and is where a fit begins.
        start = CKA(
            data.X[rows],
            data.Y[rows],
            noise,
            physics=physics,
            rho_covar_module=rho_covar_module,
            delta_covar_module=delta_covar_module,
            rho_mean=rho_mean,
            delta_mean=delta_mean,
            center=center,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        with torch.no_grad():
            columns = start.input_transform(data.X)
        order = torch.cat([rows, _others(rows, len(data.X))])
        points = columns[order[: min(num_inducing, len(order))]]
        m = data.Y.shape[-1]
        super().__init__(
            InducingGP(start.covar_module, batch_of(start.covar_module, points)),
            start.likelihood,
            m,
        )
        self.input_transform = start.input_transform
        if hasattr(start, "outcome_transform"):
            self.outcome_transform = start.outcome_transform
        self._num_outputs, self._aug_batch_shape = m, Size([m] if m > 1 else [])
        self.rest = _rest(start.terms[-1].num_inputs, self._aug_batch_shape)
        self.input_names, self.output_names = data.input_names, data.output_names
        self.__dict__["start"] = start  # its modules are registered here
        self._original_train_inputs, self._has_transformed_inputs = data.X, True
        self._hold_data(columns, self._outputs_first(data.Y))
        self._take(columns, data.Y, data.Yvar)
        self.register_buffer("evidence", torch.full_like(self.train_targets[..., 0], torch.nan))
        self.eval()

    @property
    def covar_module(self) -> SumOfTerms:  # type: ignore[override]
        """The covariance of what the inducing points can show."""
        covariance: SumOfTerms = self.model.covar_module
        return covariance

    @property
    def mean_module(self) -> TermsMean:
        """The prior mean."""
        mean: TermsMean = self.model.mean_module
        return mean

    @property
    def terms(self) -> Sequence[Term]:
        """The terms of the sum, the rest the last."""
        return [*self.covar_module.terms, self.rest]

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms that are unknown; the rest, which is in delta, goes without."""
        return tuple(name for name in super().term_names if name != self.rest.name)

    @property
    def batch_shape(self) -> Size:
        """Empty: it is a model of one data set."""
        return Size()

    def forward(self, X: Tensor) -> MultivariateNormal:
        """Evaluate the variational model: at raw ``X`` in train mode, else at transformed inputs.

        Raises:
            ValueError: If ``X`` is raw in eval mode.
        """
        if not self.training:
            self.check_transformed(X)
        return super().forward(X)

    def strategy(self) -> InducingStrategy:
        """What is remembered of the inducing values to predict from; made if it is not there."""
        if self.model.strategy is None:
            self.model.strategy = InducingStrategy(self.model, self.likelihood)
        strategy: InducingStrategy = self.model.strategy
        return strategy

    def forget(self) -> None:
        """Forget what predictions are made of, after a change of parameters."""
        self.model.strategy = None

    def ask_physics(self) -> None:
        """Ask the physics about the training inputs again, by what was learnt of its parameters."""
        if self.start is not None:
            self.start.train()  # its inputs are then transformed again
        with torch.no_grad():
            columns = self.input_transform(self._original_train_inputs)
        self._hold_data(columns, self.train_targets)

    def data(self) -> dict[str, Tensor | None]:
        """The data that the model could be built on: raw inputs, targets and known variances."""
        shift, scale = self._units()
        noise: Tensor | None = None
        if isinstance(self.likelihood, FixedNoiseGaussianLikelihood):
            noise = self._outputs_last(self.likelihood.noise * scale.square())
        targets = self._outputs_last(self.train_targets * scale + shift)
        return {"train_X": self._original_train_inputs, "train_Y": targets, "train_Yvar": noise}

    def load_state_dict(
        self, state_dict: Any, strict: bool = True, keep_transforms: bool = False, **kwargs: Any
    ) -> Any:
        """Load parameters and inducing values; the data are those that the model has."""
        data: Any = self.data()
        before = {n: tensor.clone() for n, tensor in self.input_transform.state_dict().items()}
        keys = super().load_state_dict(state_dict, strict, keep_transforms=False, **kwargs)
        self._take(self.train_inputs[0], data["train_Y"], data["train_Yvar"])
        after = self.input_transform.state_dict()
        if any(not torch.equal(tensor, before[name]) for name, tensor in after.items()):
            self.ask_physics()
        self.model.variational_strategy._clear_cache()
        self.forget()
        return keys

    def subset_output(self, idcs: list[int]) -> Self:
        """Subset the model along the outputs. It predicts, but is not to be fitted again."""
        m = self.num_outputs
        if not idcs or any(not isinstance(i, int) or not -m <= i < m for i in idcs):
            raise ValueError(
                f"Expected numbers of outputs from 0 to {m - 1} (one at least), got {idcs}."
            )
        if m == 1:
            return deepcopy(self)
        kept = [i % m for i in idcs]
        index: Any = kept if len(kept) > 1 else kept[0]
        known: Any = self.model.variational_strategy.variational_distribution
        root = self.strategy().root
        new = deepcopy(self)
        new.model = InducingGP(self.covar_module[index], self.model.inducing_points[index].clone())
        new.model.hold(known.mean[index], root[index])
        new.rest = self.rest.map_batches(lambda part: part[index])
        new.likelihood = deepcopy(self.likelihood)
        _keep_noise(new.likelihood, index)
        if hasattr(self, "outcome_transform"):
            new.outcome_transform = self.outcome_transform.subset_output(kept)
        new._num_outputs = new._desired_num_outputs = len(kept)
        new._aug_batch_shape = Size([len(kept)] if len(kept) > 1 else [])
        new.output_names = tuple(self.output_names[i] for i in kept)
        new._hold_data(self.train_inputs[0], self.train_targets[index])
        new.evidence = self.evidence[index]
        new.__dict__["start"] = None
        return new.eval()

    def condition_on_observations(self, X: Tensor, Y: Tensor, **kwargs: Any) -> NoReturn:
        """Refuse: inducing values that are optimal for further data are another fit."""
        self._refuse_conditioning()

    def fantasize(self, X: Tensor, sampler: Any, **kwargs: Any) -> NoReturn:
        """Refuse, as :meth:`condition_on_observations`."""
        self._refuse_conditioning()

    def _refuse_conditioning(self) -> NoReturn:
        raise NotImplementedError(
            "VariationalCKA cannot be conditioned on further observations, which fantasies and "
            "look-ahead acquisition functions need: build it of all data and fit it again (a warm "
            "start of few iterations will do), or take an exact CKA of some thousand."
        )

    def _take(self, columns: Tensor, Y: Tensor, Yvar: Tensor | None) -> None:
        """Take transformed inputs, targets and known variances, ``n x m`` in the user's units."""
        shift, scale = self._units()
        self._hold_data(columns, (self._outputs_first(Y) - shift) / scale)
        if Yvar is not None:
            noise = self._outputs_first(Yvar) / scale.square()
            self.likelihood = FixedNoiseGaussianLikelihood(noise, learn_additional_noise=False)

    def _hold_data(self, columns: Tensor, targets: Tensor) -> None:
        self.train_inputs, self.train_targets = (columns,), targets
        # Where GPyTorch's closures look for the data of a variational model.
        self.model.train_inputs, self.model.train_targets = self.train_inputs, targets

    def _bases(self, inputs: Tensor) -> Weights:
        return [(term, term.weights(inputs)) for term in self.terms]

    def _term_weights(self, name: str, or_known: bool = False) -> Weights:
        weights = super()._term_weights(name, or_known)
        return [*weights, (self.rest, None)] if name == "delta" else weights

    def _evidence(self) -> tuple[str, Tensor | None]:
        if self.evidence.isnan().any():
            return "not fitted", None
        scale = self._units()[1].squeeze(-1)
        count = (~self.train_targets.isnan()).sum(-1)
        return "evidence lower bound", self.evidence - count * scale.log()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the data with the model."""
        new = super()._apply(fn, recurse)
        self._original_train_inputs = fn(self._original_train_inputs)
        self._hold_data(fn(self.train_inputs[0]), fn(self.train_targets))
        if self.start is not None:
            self.start._apply(fn)
        self.forget()
        return new


def _some_of_each_output(data: TrainingData, seed: int) -> Tensor:
    """Numbers of some rows, with observations of each output among them."""
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(data.X), generator=generator)
    observed = ~data.Y.isnan().cpu()[order]
    rank = observed.cumsum(0)
    taken = (observed & (rank <= max(2, _SEARCHED // data.Y.shape[-1]))).any(-1)
    first = order[taken]
    return torch.cat([first, order[~taken]])[: max(_SEARCHED, len(first))]


def _others(rows: Tensor, n: int) -> Tensor:
    """The numbers of all other rows."""
    taken = torch.zeros(n, dtype=torch.bool)
    taken[rows] = True
    return (~taken).nonzero().squeeze(-1)


def _rest(num_inputs: int, batch_shape: Size) -> Term:
    """A term of short-ranged variations, none to begin with."""
    kernel = scaled_rbf(num_inputs, batch_shape).double()
    kernel.requires_grad_(False)
    kernel.raw_outputscale.fill_(NOTHING)
    zero = torch.zeros(*batch_shape, 1, dtype=torch.float64)
    return Term("rest", kernel, num_inputs, None, zero)


def _keep_noise(likelihood: Any, index: Any) -> None:
    """Keep the noise of some outputs."""
    noise = likelihood.noise_covar
    name = "noise" if isinstance(likelihood, FixedNoiseGaussianLikelihood) else "raw_noise"
    values = getattr(noise, name)
    values = values.detach()[index]
    kept = values if name == "noise" else torch.nn.Parameter(values)
    setattr(noise, name, kept)
