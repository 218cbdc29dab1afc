"""An exact Gaussian process that is a sum of terms, as a SingleTaskGP."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, Self, cast

import torch
from botorch.fit import _fit_fallback
from botorch.models import SingleTaskGP
from botorch.models.utils import fantasize as fantasize_flag
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.sampling.pathwise.update_strategies import GaussianUpdate
from botorch.settings import validate_input_scaling
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.mlls import ExactMarginalLogLikelihood, MarginalLogLikelihood
from gpytorch.models import ExactGP
from gpytorch.settings import detach_test_caches, lazily_evaluate_kernels, prior_mode
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor
from torch.nn.functional import pad

import gpadjust
from gpadjust.checks import checked_whole
from gpadjust.gp import SumOfTerms, Term
from gpadjust.gp.gaussian import negative_log_likelihood
from gpadjust.gp.kernels import Stationary
from gpadjust.gp.noise import RowNoise
from gpadjust.gp.term import TermsMean
from gpadjust.models.exact_conditioning import ExactConditioning
from gpadjust.models.hyperparameter_samples import (
    HOLDS_SAMPLES,
    hold_samples,
    let_all_learn,
    match_parameters,
    release_samples,
    transform_training_inputs,
)
from gpadjust.models.local_errors import LocalErrors
from gpadjust.models.parameters import learnt_noise, set_initial_values
from gpadjust.models.term_builder import TermBuilder
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.training_data import (
    ArrayLike,
    check_noise,
    new_observations,
    warn_of_copies,
)
from gpadjust.models.updates import NewRows, judge, keep_last

_ROUNDING = 1e-8  # of the targets' standard deviation: smaller errors are of rounding
_MANY = 5_000  # points, above which an exact fit takes long
# What a state has as many of as there were draws, samples or points.
_OF_ANY_NUMBER = ("draws", "coordinates", "points", "directions", "squares")


class TermsGP(TermsModel, SingleTaskGP):
    r"""The base of this library's exact models: a sum of terms, given as a list.

    A ``SingleTaskGP`` with independent outputs, of which a subset can be fitted again; it can be
    conditioned on observations before any prediction was made, with gradients to where they are
    made; ``output_indices`` may come in any order; an output may be missing (NaN) in some rows.

    Args:
        made: The data, and what the terms were made by.
        terms: The terms of the model.

    Attributes:
        was_fitted: Whether :func:`~gpadjust.fit` or ``load_state_dict`` gave it hyper-parameters;
            set it after training of your own.

    Raises:
        ValueError: If there are both known variances and a likelihood, or too few points for the
            unknown means of terms.
    """

    prediction_strategy: Any
    conditioning_class: ClassVar[type[ExactConditioning]] = ExactConditioning
    _learnt_noise = staticmethod(learnt_noise)

    def __init__(self, made: TermBuilder, terms: Sequence[Term]) -> None:
        data, likelihood = made.data, made.noise()
        if likelihood is not None and data.Yvar is not None:
            raise ValueError("Expected train_Yvar or a likelihood, got both: give one of them.")
        unknown = sum(term.learns_mean for term in terms)
        if unknown and data.X.shape[-2] < 2 + unknown:
            raise ValueError(
                f"Expected at least {2 + unknown} points to learn {unknown} constant means and a "
                f"variance, got {data.X.shape[-2]}; give the means: rho_mean=1.0, delta_mean=0.0."
            )
        if (n := data.X.shape[-2]) > _MANY:
            warnings.warn(
                f"{type(self).__name__} is exact: of {n} points a fit takes from many minutes to "
                f"hours, and each covariance {8e-9 * n**2:.1f} GB. gpadjust.VariationalCKA takes "
                "the arguments of CKA and is fitted to all of them in minutes.",
                stacklevel=3,
            )
        made.warn_of_physics(stacklevel=3)
        covar_module = SumOfTerms([*terms, *made.offsets()] if made.data.batches else terms)
        Y, Yvar = data.Y, data.Yvar
        noise = likelihood
        if likelihood is None and Yvar is None:
            noise = self._learnt_noise(covar_module.batch_shape)
        if made.units is not None:
            Y, Yvar = made.units(Y, Yvar)
        with validate_input_scaling(False):  # ours is by the data's scales, and NaN is missing
            super().__init__(
                data.X,
                Y,
                Yvar,
                likelihood=noise,
                covar_module=covar_module,
                mean_module=TermsMean(covar_module),
                outcome_transform=None,
                input_transform=made.input_transform,
            )
        if made.units is not None:  # not earlier: BoTorch would estimate it again
            units, link = made.units, made.link
            self.outcome_transform = units if link is None else link.units(units)
            self.__dict__["link"] = link  # no submodule, of which the class's None would be first
        if made.sources:
            self.likelihood.rows = RowNoise(made.sources, self.train_targets.shape)
        self.noisy_inputs = made.noisy_inputs
        self.local_errors = LocalErrors(made.batch_shape, made.num_inputs)
        self.local_errors.to(data.X)
        self.input_names, self.output_names = data.input_names, data.output_names
        if data.levels:
            self.remember_levels(data)
        set_initial_values(self, *made.given)
        self.was_fitted = False
        warn_of_copies(data, stacklevel=3)

    @property
    def is_fitted(self) -> bool:
        """True if the model was fitted, or has nothing to fit."""
        return self.was_fitted or not any(p.requires_grad for p in self.parameters())

    def custom_fit(self, mll: MarginalLogLikelihood, **options: Any) -> MarginalLogLikelihood:
        """BoTorch's hook: what ``fit_gpytorch_mll`` does to a model of this library.

        It is ``fit(model, "map")``, which keeps to priors and ``requires_grad``; with an optimizer,
        closure or other options of the caller's, or another objective, BoTorch's own.
        """
        mll.train()  # an error, if the model holds samples
        plain = type(mll) is ExactMarginalLogLikelihood and mll.likelihood is self.likelihood
        others = options.keys() - {"closure", "closure_kwargs", "optimizer_kwargs"}
        if not plain or others or any(options.values()):
            return _fit_fallback(mll, **options)
        # Without noise the likelihood has rounding errors at which SciPy's line search gives up,
        # and BoTorch throws away what was found. `fit` is asked for as a user would, by the name
        # of the package and at the call: rooms below are not imported here.
        gpadjust.fit(self, "map")
        return mll.eval()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluate the model at *transformed* inputs, as GPyTorch does."""
        if not self.training and self.train_inputs is not None and args:
            expected = self.train_inputs[0].shape[-1]
            if args[0].shape[-1] != expected:
                raise ValueError(
                    "In eval mode the model itself takes transformed inputs with "
                    f"{expected} columns, got shape {tuple(args[0].shape)}. Call "
                    "`model.posterior(X)` on raw inputs, or `model(model.transform_inputs(X))`."
                )
            if prior_mode.off():
                self.conditioning()
        return super().__call__(*args, **kwargs)

    def conditioning(self) -> ExactConditioning:
        """Return the posterior of the terms; it is built if there is none."""
        if self.prediction_strategy is None:
            self.prediction_strategy = self.conditioning_class(
                self.train_inputs[0], self.train_targets, self.noise, self.covar_module
            )
        strategy: ExactConditioning = self.prediction_strategy
        return strategy

    @torch.no_grad()
    def log_evidence(self) -> tuple[str, Tensor]:
        """The log marginal likelihood of the observations, in the user's units, ``... x (m)``."""
        train, (_, scale) = self.conditioning().train, self.units()
        covariance = train.covariance() + torch.diag_embed(self.conditioning().target_noise())
        value = -negative_log_likelihood(self.train_targets - train.mean(), covariance).value
        count = (~self.train_targets.isnan()).sum(-1)
        if self.link is not None:
            value = value + self.outputs_first(self.link.log_slope(self.user_targets())).nansum(-1)
        return "log likelihood", value - count * scale.squeeze(-1).log()

    def left_out(self) -> tuple[Tensor, Tensor]:
        r"""Each training target predicted from all others, means and variances ``... x (m) x n``.

        With :math:`\alpha = K^{-1} (y - m)` they are :math:`y_i - \alpha_i / [K^{-1}]_{ii}` and
        :math:`1 / [K^{-1}]_{ii}` (Rasmussen and Williams 2006, eqs. 5.10-5.12), in model units;
        NaN where there is no observation. Variances are those of an observation that is no outlier.
        """
        if self.training:
            self.eval()
        factors = self.conditioning().factors()
        alpha, precision = factors.alpha, factors.squared_columns()
        variance = precision.masked_fill(precision <= 0, torch.nan).reciprocal()
        mean = self.train_targets - alpha * variance
        if self.noise.rows is not None and self.noise.rows.outlying.any():
            noise = self.noise.at(self.train_inputs[0])
            outlying = self.noise.trusted(self.train_targets).isnan() & ~self.train_targets.isnan()
            least = (variance + noise - self.noise.of_rows(noise)).maximum(noise)
            variance = variance.where(~outlying, least)
        return mean, variance

    def outliers(self) -> Tensor:
        """Return the probability of each observation to be an outlier, ``batch_shape x n x m``.

        By the others, and by hyper-parameters that were fitted without those that are likelier
        outliers; of a ``likelihood="heavy-tailed"``.

        Raises:
            ValueError: If the noise has no heavy tails.
        """
        if not self.has_heavy_tails:
            raise ValueError(
                "The noise of the model has no outliers; build it with likelihood='heavy-tailed'."
            )
        from gpadjust.models.heavy_tails import probabilities

        self.eval()
        return self.outputs_last(probabilities(self))

    @torch.no_grad()
    def learn_local_errors(self) -> None:
        """Let variances be larger near what was missed when it was left out.

        Of a model that holds samples, with kernels in closed form and their lengthscales: as
        :class:`~gpadjust.models.local_errors.LocalErrors` says. :func:`~gpadjust.fit` does this.
        """
        learnt = [term for term in self.terms if term.scaled_by is None]
        forms = [term.form for term in learnt if term.kernel is not None]
        lengthscales = [form.lengthscale for form in forms if isinstance(form, Stationary)]
        if self.num_samples is None or not forms or len(lengthscales) < len(forms):
            return
        d, train = self.terms[0].num_inputs, self.train_inputs[0]
        lengthscales = [each.expand(*each.shape[:-1], d) for each in lengthscales]
        shortest = torch.stack(lengthscales).amin(0).log().mean(0).exp()
        mean, variance = self.left_out()
        spread = _ROUNDING * (self.train_targets - self.train_targets.nanmean(-1, keepdim=True))
        least = spread.square().nanmean(-1, keepdim=True)
        targets, noise = self.train_targets, self.noise
        targets = targets if noise.rows is None else noise.trusted(targets)
        squares = (targets - mean).square().mean(0) / variance.maximum(least).mean(0)
        _, rows = self.measured_rows(train)
        found = torch.ones_like(squares)
        found[..., rows] = squares[..., rows].nan_to_num(nan=1.0, posinf=1.0)
        points = train[..., :d].reshape(-1, *train.shape[-2:-1], d)[0]
        self.local_errors.learn(found, points, shortest)

    @property
    def larger_errors(self) -> LocalErrors | None:
        """The places of errors larger than the kernels', if there are any."""
        return None if self.local_errors.are_expected else self.local_errors

    def data(self) -> dict[str, Tensor | None]:
        """Return the data of the model: raw inputs, targets and known variances."""
        self.eval()
        inputs = self._original_train_inputs
        inputs = self.train_inputs[0] if inputs is None else inputs
        inputs = inputs.select(-3, 0) if self._num_outputs > 1 else inputs
        targets, noise, scale = self.user_targets(), self.noise.known, self.units()[1]
        noise = None if noise is None else self.outputs_last(noise * scale.square())
        if noise is not None and self.link is not None:
            noise = noise / (2 * self.link.log_slope(targets)).exp().nan_to_num(nan=1.0)
        given: Tensor | None = None
        if self.noisy_inputs is not None:
            inputs, _ = self.measured_rows(inputs)
            given = self.noisy_inputs.variances
            given = pad(given, (0, 0, 0, inputs.shape[-2] - len(given)))
        if self.num_samples is not None:
            inputs, targets = inputs[0], targets[0]
            if noise is not None and noise.shape != targets.shape:  # of later observations, too
                noise = noise[0]
        found = {"train_X": inputs, "train_Y": targets, "train_Yvar": noise}
        return found if given is None else {**found, "train_Xvar": given}

    def measured_rows(self, inputs: Tensor) -> tuple[Tensor, slice]:
        """Raw training inputs without what the model added to them, and the user's rows of them."""
        own = None if self.noisy_inputs is None else self.noisy_inputs.measured
        if own is not None and inputs.shape[-1] == own.shape[-1]:  # raw ones
            later = inputs[..., len(own) :, :]
            inputs = torch.cat([own.expand(*inputs.shape[:-2], *own.shape), later], dim=-2)
        return inputs, slice(None)

    def trend_inputs(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs of a linear trend in the targets, and the trend of each row.

        Args:
            inputs: Raw training inputs, ``... x n x d``, with what the model added to them.

        Returns:
            Inputs, and a column of ones and zeros for each trend, ``... x n x g``.
        """
        return inputs, torch.ones_like(inputs[..., :1])

    def hold_samples(self, samples: dict[str, Tensor]) -> None:
        """Make the model fully Bayesian: a batch of itself, one for each hyper-parameter sample.

        Its posterior then is a mixture, as of BoTorch's fully Bayesian models.

        Args:
            samples: Raw parameters by their names, ``S x`` the parameter's shape.

        Raises:
            RuntimeError: If the model holds samples already.
            ValueError: If the model cannot be fully Bayesian: it is of a batch of data sets, say.
        """
        if self.num_samples is not None:
            raise RuntimeError(HOLDS_SAMPLES)
        self.check_can_be_sampled()
        hold_samples(self, samples)
        self.was_fitted = True

    def release_samples(self) -> None:
        """Make the model, if it holds samples, what it was before, with the first of them.

        A model of fantasies raises a RuntimeError.
        """
        if self.num_samples is not None:
            release_samples(self)
            self.local_errors.forget()

    def check_can_be_sampled(self) -> None:
        """Raise a ValueError if the model cannot hold samples of its hyper-parameters."""
        if self.not_sampled:
            raise ValueError(self.not_sampled)
        # Of a model that holds samples these are a batch, too.
        held = 0 if self.num_samples is None else 1
        if self._input_batch_shape[held:]:
            raise ValueError(
                "Expected a model of one data set to hold samples, got one with batch_shape "
                f"{tuple(self._input_batch_shape)}; sample the data sets of a batch one by one."
            )

    def train(self, mode: bool = True) -> Self:
        """Put the model in train mode, or eval mode; one that holds samples is not trained."""
        if mode and self.num_samples is not None:
            raise RuntimeError(HOLDS_SAMPLES)
        return super().train(mode)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        """Load parameters; with those of a model that holds samples, this one holds them too."""
        samples = {
            name: state_dict[name]
            for name, parameter in self.named_parameters()
            if name in state_dict and state_dict[name].dim() > parameter.dim()
        }
        own = self.state_dict()
        other = {n for n in own.keys() & state_dict.keys() if own[n].shape != state_dict[n].shape}
        other = {n for n in other if n.rpartition(".")[-1] not in _OF_ANY_NUMBER}
        if samples:  # of which there are as many of each
            sizes = {len(values) for values in samples.values()}
            other = {n for n in other if state_dict[n].shape != (*sizes, *own[n].shape)}
        if other or (strict and own.keys() != state_dict.keys()):
            wrong = sorted(own.keys() ^ state_dict.keys()) or sorted(other)
            held = self.num_samples is not None
            hint = (
                " It holds samples: for a state with another number of them, or none, call "
                "`model.release_samples()` first."
            )
            raise RuntimeError(
                f"The state is of another model than this {type(self).__name__}, which is left as "
                f"it was; they differ in {', '.join(wrong[:5])}.{hint * held}"
            )
        if samples:
            self.train()
            # Before samples are held, for which inputs are transformed once and for all.
            prefix = "input_transform."
            own = {n.removeprefix(prefix): v for n, v in state_dict.items() if n.startswith(prefix)}
            if f"{prefix}coordinates" in samples:
                own["coordinates"] = samples[f"{prefix}coordinates"][0].flatten()
            if own:
                self.input_transform.load_state_dict(own, strict)
            self.hold_samples(samples)
        elif self.has_unknowns and self.num_samples is None:
            self.train()  # for inputs to be transformed again, with what is loaded
        before = self.measured_targets()
        keys = super().load_state_dict(state_dict, strict, *args, **kwargs)
        if self.noisy_inputs is not None:  # of which a fit moves the targets
            self.train_targets = self.train_targets + before - self.measured_targets()
            self.prediction_strategy = None
        self.was_fitted = True
        if self.num_samples is not None:
            transform_training_inputs(self)
        return keys

    @property
    def _subset_batch_dict(self) -> dict[str, int]:
        """The dimension of the outputs in each parameter and buffer, for ``subset_output``."""
        outputs: Size = self._aug_batch_shape
        return {
            name: len(outputs) - 1 - tensor.dim()
            for name, tensor in [*self.named_parameters(), *self.named_buffers()]
            if name.startswith(("covar_module.", "likelihood."))
            and tensor.shape[: len(outputs)] == outputs
            and self.num_outputs > 1
        }

    def subset_output(self, idcs: list[int]) -> Self:
        """Subset the model along the outputs; see BoTorch. Negative ones count from the end."""
        idcs, m = self.checked_outputs(idcs), self.num_outputs
        subset = super().subset_output(idcs)
        original = subset._original_train_inputs
        if original is not None and m > 1 and idcs != list(range(m)):
            # BoTorch subsets the transformed inputs only, and a later fit starts from these.
            subset._original_train_inputs = original[..., idcs if len(idcs) > 1 else idcs[0], :, :]
        subset.output_names = tuple(self.output_names[i] for i in idcs)
        if m > 1:
            subset.local_errors = self.local_errors.of_outputs(idcs)
            if self.noisy_inputs is not None:
                old, subset.noisy_inputs = subset.noisy_inputs, self.noisy_inputs.of_outputs(idcs)
                rows: Any = subset.noise.rows
                rows.sources = [subset.noisy_inputs if s is old else s for s in rows.sources]
        match_parameters(subset)
        return subset

    def _new_inputs(self, X: Tensor) -> Tensor:
        """Raw inputs to condition on; BoTorch's entropy searches transform them."""
        inputs = self.train_inputs[0].shape[-1]
        if X.shape[-1] == inputs != len(self.input_names) and hasattr(self, "input_transform"):
            return self.input_transform.untransform(X)
        return X

    def condition_on_observations(self, X: ArrayLike, Y: ArrayLike, **kwargs: Any) -> Self:
        """Condition on new observations; see BoTorch. No posterior has to be called before.

        The hyper-parameters stay, and with them the factors of the training covariance, to which
        ``k`` new points among ``n`` are appended in O(n^2 k). Samples of the physics alone stay
        what they are, whatever is observed: fit again if it may be wrong after all.

        Args:
            X: Raw inputs, ``batch_shape x k x d``.
            Y: Observations, ``(f) x batch_shape x k x m``, in the user's units; NaN where an
                output was not observed.
            kwargs: ``noise``, the variances of the new observations, of a model with known noise:
                of the shape of ``Y``, in the square of the user's units.

        Raises:
            TypeError: If ``X``, ``Y`` or ``noise`` is not float64.
            ValueError: If ``X`` is not finite, ``Y`` is missing in a whole row, their numbers of
                rows or of outputs disagree, or ``noise`` is missing, negative, of another shape, or
                given to a model that learns it.
        """
        names, m = self.input_names, self.num_outputs
        X, Y = new_observations(X, Y, names, m, self.levels, self.batches)
        X = self._new_inputs(X)
        return self.with_observations(X, Y, **kwargs)

    def update(
        self,
        X: ArrayLike,
        Y: ArrayLike,
        noise: Tensor | None = None,
        *,
        forget: int | None = None,
    ) -> None:
        r"""Take new observations, in place, at a cost that does not grow with their number.

        An :class:`~gpadjust.RRA` keeps its weights alone: each observation is a step of a Kalman
        filter. With ``forget``, an observation of k steps ago counts as one whose noise has the
        variance :math:`\sigma^2 e^{k / \text{forget}}`, so that where nothing is observed rho and
        delta return to their priors, slowly. Without it the answer is that of all observations
        together.

        Any other model keeps its last ``forget`` observations, and forgets those before.

        Hyper-parameters stay, also which samples of them a model holds; so do places of larger
        errors. Samples of the physics alone, which cannot learn, give way to copies of others.
        Where new observations are missed by more than predicted, as while a machine drifts,
        variances grow by the ratio (with ``forget``). To fit them again, build a model of recent
        observations.

        Args:
            X: Raw inputs, ``k x d``, of ``k`` observations in their order.
            Y: Observations, ``k x m``, in the user's units; NaN where an output was not observed.
            noise: Their variances, of a model with known noise, as in
                :meth:`condition_on_observations`.
            forget: A number of observations, at least 1, as above. Default: never forget, which
                an RRA alone can do.

        Raises:
            TypeError: If ``X``, ``Y`` or ``noise`` is not float64, or ``forget`` no whole number.
            ValueError: As of :meth:`condition_on_observations`; or if a model that keeps its
                observations is to forget none.
            NotImplementedError: If the model adds rows of its own to the observations, as an AR1.

        Example:
            >>> import torch
            >>> from gpadjust import RRA
            >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
            >>> model = RRA(X, 2 * X.sin(), physics=torch.sin)
            >>> model.update(X[:1], 2.1 * X[:1].sin(), forget=100)
        """
        X, Y = new_observations(X, Y, self.input_names, self.num_outputs)
        if X.dim() > 2 or Y.dim() > 2:
            raise ValueError(
                f"Expected X of shape k x d and Y of shape k x m, got {tuple(X.shape)} and "
                f"{tuple(Y.shape)}."
            )
        self._check_noise(noise, Y)
        self.eval()
        if forget is not None:
            forget = checked_whole("forget", forget, 1)
        with torch.no_grad():
            self._check_window(forget)
            let_all_learn(self)
            new = NewRows.of(self, X, Y, noise)
            if forget is not None:
                judge(self, new, forget)
            self._take(new, forget)

    def _take(self, new: NewRows, forget: int | None) -> None:
        """Take new observations, and forget others."""
        keep_last(self, new, cast("int", forget))

    def _check_window(self, forget: int | None) -> None:
        """Raise an error if a model cannot keep its last observations."""
        name = type(self).__name__
        if forget is None:
            raise ValueError(
                f"A {name} keeps its observations, so that its cost grows unless it forgets some: "
                "pass forget=200 for the last 200. An RRA takes any number; "
                "`condition_on_observations` returns a model of all."
            )
        if self.measured_rows(self.train_inputs[0])[1] != slice(None):
            raise NotImplementedError(
                f"A {name} has rows of its own among the observations, of which a window would "
                "forget some: take a CKA, or build the model again."
            )
        if self.noise.rows is not None and self.noise.rows.added.any():
            raise NotImplementedError(
                f"The inputs of this {name} are noisy (train_Xvar), and of new ones that is not "
                "known: build the model again."
            )

    def _check_noise(self, noise: Tensor | None, Y: Tensor) -> None:
        """Raise an error unless variances of new observations are given where they are known."""
        if self.noise.is_known and noise is None:
            raise ValueError(
                "The model was built with known noise (train_Yvar), so that of new observations is "
                "needed, too: pass `noise`, variances of the shape of Y."
            )
        if noise is not None:
            check_noise(noise, Y)
            if not self.noise.is_known:
                raise ValueError(
                    "The model learns its noise, which new observations have, too: leave `noise` "
                    "out, or build the model with known noise (train_Yvar)."
                )

    def with_observations(
        self, X: Tensor, Y: Tensor, noise: Tensor | None = None, **kwargs: Any
    ) -> Self:
        """Return a model of more observations, checked tensors of which whole rows may be NaN."""
        self._check_noise(noise, Y)
        if noise is not None:
            transform = getattr(self, "outcome_transform", None)
            if self.link is not None and fantasize_flag.off():
                noise = self.link(Y, noise)[1]
            if transform is not None and fantasize_flag.off():
                noise = noise / transform.stdvs.square()
            kwargs["noise"] = noise.nan_to_num(nan=1.0, posinf=1.0)  # where nothing was observed
        if self.num_samples is not None:
            # All samples see the same observations, unless these have a dimension for them, as
            # fantasies have.
            if fantasize_flag.on() or X.dim() == 2:
                X = X.unsqueeze(MCMC_DIM)
                X = X.expand(*X.shape[:MCMC_DIM], self.num_samples, *X.shape[-2:])
            if Y.dim() == 2:
                Y = Y.expand(self.num_samples, *Y.shape)
        self.eval()
        self.conditioning()
        # GPyTorch takes parts of a model off for a moment, while other threads may ask this one.
        shell = copy(self)
        shell._modules = copy(self._modules)
        # GPyTorch would cut the gradient to X, which look-ahead acquisition functions need.
        with detach_test_caches(not X.requires_grad), lazily_evaluate_kernels():
            return super(TermsGP, shell).condition_on_observations(X, Y, **kwargs)


@GaussianUpdate.register(TermsGP, _GaussianLikelihoodBase)  # type: ignore[untyped-decorator, unused-ignore]
def _update(model: TermsGP, likelihood: _GaussianLikelihoodBase, **arguments: Any) -> Any:
    """BoTorch's pathwise update, with the noise of each point."""
    noise, update = model.noise, GaussianUpdate.dispatch(ExactGP, _GaussianLikelihoodBase)
    if noise.rows is None and noise.selection(model.train_inputs[0]) is None:
        return update(model, likelihood, **arguments)
    variances = DiagLinearOperator(noise.of_rows(noise.at(model.train_inputs[0])))
    return update(model, likelihood, **{"noise_covariance": variances, **arguments})
