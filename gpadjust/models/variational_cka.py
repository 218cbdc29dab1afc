"""Co-kriging adjustment of many observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any, Literal, NoReturn, Self, Unpack

import torch
from botorch.models.gpytorch import GPyTorchModel
from botorch.sampling.pathwise.paths import SamplePath
from botorch.sampling.pathwise.posterior_samplers import DrawMatheronPaths
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from torch import Size, Tensor
from torch.nn import Buffer

from gpadjust.checks import checked_whole
from gpadjust.gp import Term, VanishingKernel, WeightedSum
from gpadjust.gp.term import TermsMean, Unit
from gpadjust.models.parameters import scaled_rbf
from gpadjust.models.sparse_conditioning import SparseConditioning
from gpadjust.models.structures import CKA
from gpadjust.models.term_builder import (
    Center,
    KernelLike,
    Kernels,
    Means,
    ModelOptions,
    PhysicsLike,
    TermBuilder,
)
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import ArrayLike, TrainingData, training_data, with_names

_SEARCHED = 1000  # observations that an exact model of some takes
NOTHING = -60.0
"""The logarithm of a variance that is none."""


class VariationalCKA(TermsModel, GPyTorchModel):
    r"""Co-kriging adjustment with inducing points, for up to some 100,000 observations.

    The model is that of :class:`~gpadjust.CKA`, of which a distribution over the values at
    ``num_inducing`` points stands for all observations (Titsias 2009), so that learning takes
    :math:`O(n M^2)` instead of :math:`O(n^3)` operations. What the points cannot show, short-ranged
    variations of the bias, has a term of its own, ``rest``, without which intervals would be far
    too narrow. Posteriors of ``f`` and of :meth:`delta` have it in their variance.

    :func:`gpadjust.fit` finds hyper-parameters, points and the optimal distribution, in closed form
    from all observations; intervals are those of the most likely hyper-parameters. It cannot be
    conditioned on further observations, which ``fantasize`` and look-ahead acquisition functions
    want; the others take it.

    The arguments and errors are those of :class:`~gpadjust.CKA`, for one data set, and:

    Args:
        num_inducing: Number ``M`` of inducing points, at most that of observations. Time grows with
            its square.
        seed: Seed of which observations are searched and where inducing points begin.

    Attributes:
        inducing_points: Transformed inputs, ``(m) x M x (d + k)``.
        inducing_mean: The mean of the whitened values there, ``(m) x M``; before a fit the prior's.
        inducing_root: A lower root of their covariance, ``(m) x M x M``.
        rest: The term of what the inducing points cannot show.
        evidence: The lower bound of the log marginal likelihood that the last fit reached, ``(m)``,
            in model units; NaN before a fit.
        search_rows: The numbers of the observations that an exact model is searched with; None of a
            subset of a model's outputs, which is not fitted.

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

    not_sampled = (
        "Expected method 'map' or None for a VariationalCKA, got 'bayes': so many observations "
        "determine its hyper-parameters, which are not sampled."
    )
    _conditioning: SparseConditioning | None = None
    _has_transformed_inputs = True

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        num_inducing: int = 1000,
        rho_covar_module: Kernels = None,
        delta_covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        center: Center = "learn",
        seed: int = 0,
        **options: Unpack[ModelOptions],
    ) -> None:
        categorical, batch = options.get("categorical"), options.get("batch")
        data = training_data(train_X, train_Y, train_Yvar, categorical=categorical, batch=batch)
        if data.levels:  # of all rows
            options |= {"categorical": data.levels, "batch": [*data.batches]}
        if data.X.dim() > 2:
            raise ValueError(
                f"Expected train_X of one data set, n x d, got shape {tuple(data.X.shape)}; make a "
                "model of each."
            )
        checked_whole("num_inducing", num_inducing, 1)
        order, searched = _some_of_each_output(data.Y, seed)
        rows = order[:searched]
        # An exact model of some rows makes terms, units and noise.
        some = CKA(
            with_names(data.X[rows], data.input_names),
            *(None if given is None else given[rows] for given in data[1:3]),
            physics=physics,
            rho_covar_module=rho_covar_module,
            delta_covar_module=delta_covar_module,
            rho_mean=rho_mean,
            delta_mean=delta_mean,
            center=center,
            **options,
        )
        if some.noise.rows is not None or some.noise.selection(some.train_inputs[0]) is not None:
            raise ValueError(
                "Expected a likelihood with one variance for all observations, got "
                f"{type(some.likelihood).__name__}; CKA takes those with several, and those that "
                "differ from row to row."
            )
        if any(isinstance(part, VanishingKernel) for part in some.modules()):
            raise ValueError(
                "Expected kernels that vanish nowhere, got vanishing_rbf: what inducing points "
                "cannot show of delta would not vanish. CKA takes it."
            )
        super().__init__()
        self.covar_module, self.likelihood = some.covar_module, some.likelihood
        self.input_transform = some.input_transform
        if hasattr(some, "outcome_transform"):
            self.outcome_transform = some.outcome_transform
        self.__dict__["link"] = some.link
        self.input_names, self.output_names = data.input_names, data.output_names
        if data.levels:
            self.remember_levels(data)
        self._num_outputs, self._aug_batch_shape = some._num_outputs, some._aug_batch_shape
        d, zero = some.terms[-1].num_inputs, data.X.new_zeros(*self._aug_batch_shape, 1)
        kernel = scaled_rbf(d, self._aug_batch_shape).to(zero).requires_grad_(False)
        kernel.raw_outputscale.fill_(NOTHING)
        self.rest = Term("rest", kernel, d, None, zero)
        # The data move with the model, and are no part of its state.
        held = partial(Buffer, persistent=False)
        self._X: Tensor = held(data.X)
        self._Y: Tensor = held(data.Y)
        self._Yvar: Tensor | None = None if data.Yvar is None else held(data.Yvar)
        self._columns: Tensor = held(data.X)
        self.search_rows: Tensor | None = held(rows)
        self.ask_physics()
        self._scale_known_noise()
        points = self._columns[order[:num_inducing]].expand(*zero.shape[:-1], -1, -1).clone()
        self.inducing_points: Tensor = Buffer(points)
        self.inducing_mean: Tensor = Buffer(torch.zeros_like(points[..., 0]))
        self.inducing_root: Tensor = Buffer(torch.diag_embed(torch.ones_like(points[..., 0])))
        self.evidence: Tensor = Buffer(torch.full_like(zero[..., 0], torch.nan))
        self.eval()

    @property
    def train_inputs(self) -> tuple[Tensor]:
        """Transformed inputs with columns of f_p, ``n x (d + k)``."""
        return (self._columns,)

    @property
    def train_targets(self) -> Tensor:  # type: ignore[override]
        """Targets in model units, ``(m) x n``; NaN where one is missing."""
        shift, scale = self.units()
        Y = self._Y if self.link is None else self.link.value(self._Y)
        return (self.outputs_first(Y) - shift) / scale

    @property
    def mean_module(self) -> TermsMean:
        """The prior mean."""
        return TermsMean(self.covar_module)

    @property
    def terms(self) -> Sequence[Term]:
        """The terms of the sum, the rest the last."""
        return [*self.covar_module.terms, self.rest]

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms that are unknown; the rest, which is in delta, goes without."""
        return tuple(name for name in super().term_names if name != self.rest.name)

    def at(self, inputs: Tensor) -> WeightedSum:
        """Return the weighted sum at inputs, with the rest."""
        return self._with_rest(super().at(inputs))

    def _at(self, term: Term, inputs: Tensor) -> WeightedSum:
        found = super()._at(term, inputs)
        return self._with_rest(found) if term.unit is Unit.TARGET else found

    def _with_rest(self, f: WeightedSum) -> WeightedSum:
        return WeightedSum(f.x, [*f.parts, (self.rest, None)], f.shift)

    def conditioning(self) -> SparseConditioning:
        """Return the posterior of the terms by the inducing values."""
        known = self._conditioning
        if known is None or known.train_inputs[0] is not self.inducing_points:  # as after `.to`
            known = self._conditioning = SparseConditioning(
                self.inducing_points, self.inducing_mean, self.inducing_root, self.covar_module
            )
        return known

    def forget(self) -> None:
        """Forget what predictions are made of, after a change of parameters."""
        self._conditioning = None

    _revert_to_original_inputs = forget  # BoTorch's hook for train mode: inputs stay transformed

    def ask_physics(self) -> None:
        """Ask the physics about the training inputs again, by what was learnt of its parameters."""
        with torch.no_grad():
            self._columns = self.input_transform(self._X)

    def exact(self, with_physics: bool = False) -> TermsGP:
        """An exact model of the rows that are searched, in this model's units.

        It has the same terms and learnt noise, so that a fit of the one is a fit of the other;
        with the physics, also the input transform. A ValueError of a subset of the outputs.
        """
        rows, noise = self.search_rows, self.noise.known
        if rows is None:
            raise ValueError("Expected a whole model: a subset of a model's outputs is not fitted.")
        X, transform = self._columns, None
        if with_physics:
            X, transform = self._X, self.input_transform
        Y = self.outputs_last(self.train_targets)[rows]
        Yvar = None if noise is None else self.outputs_last(noise)[rows]
        data = TrainingData(X[rows], Y, Yvar, self.input_names, self.output_names)
        likelihood = self.likelihood if noise is None else None
        made = TermBuilder(data, transform, None, self.rest.num_inputs, likelihood)
        made.given.append(self.covar_module)
        return TermsGP(made, [*self.covar_module.terms])

    def data(self) -> dict[str, Tensor | None]:
        """Return the data of the model: raw inputs, targets and known variances."""
        return {"train_X": self._X, "train_Y": self._Y, "train_Yvar": self._Yvar}

    def _scale_known_noise(self) -> None:
        if self._Yvar is not None:
            Yvar = self._Yvar if self.link is None else self.link(self._Y, self._Yvar)[1]
            noise = self.outputs_first(Yvar.nan_to_num(nan=1.0)) / self.units()[1].square()
            self.likelihood = FixedNoiseGaussianLikelihood(noise)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, **options: Any
    ) -> Any:
        """Load parameters and inducing values; the data are those that the model has."""
        before = deepcopy(self.input_transform.state_dict())
        keys = super().load_state_dict(state_dict, strict, keep_transforms=False, **options)
        self._scale_known_noise()
        after = self.input_transform.state_dict()
        if not all(torch.equal(tensor, before[name]) for name, tensor in after.items()):
            self.ask_physics()
        self.forget()
        return keys

    def subset_output(self, idcs: list[int]) -> Self:
        """Subset the model along the outputs. It predicts, but is not to be fitted again."""
        kept, new = self.checked_outputs(idcs), deepcopy(self)
        if self.num_outputs == 1:
            return new
        index: Any = kept if len(kept) > 1 else kept[0]
        new.covar_module = self.covar_module[index]
        new.rest = self.rest.map_batches(lambda part: part[index])
        for name in ("inducing_points", "inducing_mean", "inducing_root", "evidence"):
            setattr(new, name, getattr(self, name)[index])
        for parameter in new.likelihood.parameters():
            if parameter.shape[:1] == self._aug_batch_shape:
                parameter.data = parameter.data[index]
        if hasattr(self, "outcome_transform"):
            new.outcome_transform = self.outcome_transform.subset_output(kept)
        new._num_outputs, new._aug_batch_shape = len(kept), new.covar_module.batch_shape
        new.output_names, new.search_rows = tuple(self.output_names[i] for i in kept), None
        new._Y, new._Yvar = self._Y[:, kept], None if self._Yvar is None else self._Yvar[:, kept]
        new._scale_known_noise()
        return new.eval()

    def condition_on_observations(self, X: Tensor, Y: Tensor, **kwargs: Any) -> NoReturn:
        """Refuse: inducing values that are optimal for further data are another fit."""
        raise NotImplementedError(
            "VariationalCKA cannot be conditioned on further observations, which fantasies and "
            "look-ahead acquisition functions need: build it of all data and fit it again, or take "
            "an exact CKA of some thousand."
        )

    def fantasize(self, X: Tensor, sampler: Any, **kwargs: Any) -> NoReturn:
        """Refuse, as :meth:`condition_on_observations`."""
        self.condition_on_observations(X, X)

    def log_evidence(self) -> tuple[str, Tensor | None]:
        """The lower bound that the last fit reached, in the user's units, ``(m)``."""
        if self.evidence.isnan().any():
            return "not fitted", None
        count = (~self.train_targets.isnan()).sum(-1)
        value = self.evidence - count * self.units()[1].squeeze(-1).log()
        if self.link is not None:
            value = value + self.outputs_first(self.link.log_slope(self._Y)).nansum(-1)
        return "evidence lower bound", value


def _some_of_each_output(Y: Tensor, seed: int) -> tuple[Tensor, int]:
    """Row numbers in a random order, and how many of the first have observations of each output."""
    generator = torch.Generator().manual_seed(checked_whole("seed", seed))
    order = torch.randperm(len(Y), generator=generator).to(Y.device)
    observed = ~Y.isnan()[order]
    taken = (observed & (observed.cumsum(0) <= max(2, _SEARCHED // Y.shape[-1]))).any(-1)
    return torch.cat([order[taken], order[~taken]]), max(_SEARCHED, int(taken.sum()))


class _Paths(SamplePath):
    """Functions from the posterior as BoTorch's sample paths, of a sample shape."""

    def __init__(self, functions: Any, shape: Size) -> None:
        super().__init__()
        self.functions, self.shape = functions, shape

    def forward(self, X: Tensor, **kwargs: Any) -> Tensor:
        """From raw ``... x q x d``, whose batch meets the sample shape, to ``... x (m) x q``."""
        lead, (q, d) = torch.broadcast_shapes(X.shape[:-2], self.shape), X.shape[-2:]
        own = X.expand(*lead, q, d).reshape(-1, self.shape.numel(), q, d)
        values = self.functions.each(own.transpose(0, 1).flatten(1, 2))
        values = values.unflatten(1, (-1, q)).transpose(0, 1).reshape(*lead, q, -1)
        return values.mT if self.functions.has_outputs else values.squeeze(-1)

    def set_ensemble_as_batch(self, ensemble_as_batch: bool) -> None:
        """Nothing: there is no ensemble."""


@DrawMatheronPaths.register(VariationalCKA)  # type: ignore[untyped-decorator, unused-ignore]
def _draw_paths(model: VariationalCKA, *, sample_shape: Size, **options: Any) -> _Paths:
    return _Paths(model.sample_functions(sample_shape.numel()), sample_shape)
